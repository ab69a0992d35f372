"""Home Assistant as the load-balancing master of SmartEVSE slaves (dialect 2.17).

One broadcast every 2 s carries the current of each slave; a slave that has received
none for 10 s stops by itself. `sharing` decides the values; this module decides when:
listen for another master, read the slaves, broadcast, and fall silent as soon as
another master is on the line. Source: PROTOCOLS.md, 3.
"""

from abc import ABC, abstractmethod
import asyncio
from collections.abc import Mapping
from contextlib import suppress
from enum import Enum, auto
from functools import partial
import logging
from math import inf
from typing import Final, override

from ..charger import Charger
from ..conversation import rest
from ..errors import ExchangeError, LineBusyError, NotAvailableError
from ..exchange import Request, Turn
from ..framing import Frame
from ..master import BusMaster
from ..memory import LineMemory
from ..modbus import ModbusFrame
from ..model import Circuit, Fault
from ..safety import Setpoint
from .balancing import CURRENTS, broadcast, decode_request, is_foreign_broadcast
from .memory import SmartEvseMemory
from .registers import LONGEST_REQUEST, tenths
from .sharing import (
    LOWEST,
    STOPS_ALONE,
    Claim,
    Draw,
    above_share,
    checked,
    fit_to_limit,
    grant,
    next_values,
    split,
)

_LOGGER: Final = logging.getLogger(__name__)

PERIOD: Final = 2.0
"""From broadcast to broadcast, s."""
SLACK: Final = 0.020
"""Longest delay of a broadcast that is not late, s."""
LISTENING: Final = 2.5
"""Time to listen for another master before our first broadcast, s."""
READING: Final = 1.5
"""Longest time that the first broadcast waits for the slaves to be read, s."""
STAY_SILENT: Final = 60.0
"""Silence after the last frame of another master, s."""
ECHO: Final = 0.5
"""A broadcast equal to ours that comes within this time is its echo, s: a network port
may pass it on when the next one has gone out already."""
STILL_CHARGING: Final = 8.0
"""After a shorter silence of ours the slaves still charge: do not listen first, s."""
RETRY: Final = 0.5
"""Pause after a turn that failed unexpectedly, s."""
PATIENCE: Final = 3.0
"""Longest wait for a broadcast after the circuit limit has changed, s."""

_OTHER_MASTER: Final = (
    "another master speaks on this line; two masters would undo each other's limits"
)


class Slave(ABC):
    """A slave, as its master knows it."""

    available: bool
    share: float
    """Current that the last broadcast left for it, A."""
    has_other_dialect: bool
    """It does not understand our broadcasts."""

    @property
    @abstractmethod
    def unit(self) -> int:
        """Return its address."""

    @property
    @abstractmethod
    def setpoint(self) -> Setpoint:
        """Return the set-point within its `share`."""

    @property
    @abstractmethod
    def worst_case(self) -> float | None:
        """Return the longest time that one exchange with it can take, s."""

    @abstractmethod
    def join(self, master: Master | None) -> None:
        """Set its master."""

    @abstractmethod
    def has_reservation(self, now: float) -> bool:
        """Return whether a current is reserved for it that it does not draw yet."""

    @abstractmethod
    def claim(self, now: float, *, may_draw: bool) -> Claim:
        """Return its claim to a share."""

    @abstractmethod
    def setpoint_within(self, share: float) -> Setpoint:
        """Return the set-point within a share, A."""

    @abstractmethod
    def on_share(self, share: int, now: float) -> None:
        """Follow a changed share, 0.1 A; 0: stop."""

    @abstractmethod
    def read_soon(self, now: float) -> None:
        """Read its status as soon as the bus is free."""

    @abstractmethod
    async def read_status_once(self, turn: Turn) -> None:
        """Read its status in one exchange."""


class _Phase(Enum):
    """The phase that the master is in."""

    LISTENING = auto()
    READING = auto()
    BROADCASTING = auto()
    SILENCED = auto()
    """Another master is on the line."""


class Master(BusMaster):
    """The broadcast, and the current that all slaves together may draw."""

    def __init__(self, circuit: Circuit) -> None:
        """Raise RefusedOrderError for values out of range."""
        super().__init__()
        # A late broadcast has no deadline to defend it: short as it is, it goes first.
        self.slot.due = -inf
        self._circuit = checked(circuit)
        self._phase = _Phase.LISTENING
        self._planned = 0.0
        """Loop time of the next regular broadcast."""
        self._unknown_until = inf
        """Loop time at which a slave that was never read has stopped by itself."""
        self._slaves: list[Slave] = []
        self._draws: dict[int, Draw] = {}
        self._read_units: set[int] = set()
        """Units that were read, or did not reply, since we began to read them."""
        self._values: tuple[int, ...] = ()
        """Values of the last broadcast, 0.1 A."""
        self._memory = SmartEvseMemory()
        """That of the line, once it is on a bus."""
        self._has_sent = False
        """One of the broadcasts so far was ours, not of an earlier bus."""
        self._echoes: list[tuple[float, bytes]] = []
        """Our broadcasts whose echo may still come, and when they were sent."""
        self._is_planned = False
        """`failed` has nothing to plan."""
        self._broadcast_sent = asyncio.Event()

    # -- The circuit limit -------------------------------------------------------

    @property
    def circuit(self) -> Circuit:
        """Return the circuit that the slaves share."""
        return self._circuit

    @override
    async def change_circuit(self, circuit: Circuit) -> None:
        self._circuit = checked(circuit)
        self.updated()
        self._broadcast_sent.clear()
        self.update_shares()
        self.broadcast_soon()
        if self._phase is _Phase.BROADCASTING and self.slaves:
            with suppress(TimeoutError):
                async with asyncio.timeout(PATIENCE):
                    await self._broadcast_sent.wait()

    @property
    def now(self) -> float:
        """Return the loop time, s."""
        return asyncio.get_running_loop().time()

    @property
    def _limit(self) -> int:
        """Return the circuit limit, 0.1 A."""
        return round(self._circuit.limit * 10)

    @property
    def _minimum(self) -> int:
        """Return the least share of a slave that charges, 0.1 A."""
        return round(self._circuit.minimum * 10)

    # -- The slaves --------------------------------------------------------------

    @property
    def slaves(self) -> list[Slave]:
        """Return the slaves of this bus."""
        return list(self._slaves)

    @override
    def resume(self, memory: LineMemory) -> None:
        self._memory = memory.of(SmartEvseMemory)

    @property
    def _sent_at(self) -> float:
        """Return the loop time of our last broadcast, of this bus or an earlier one."""
        return self._memory.broadcast_at

    @override
    def added(self, charger: Charger) -> None:
        slave = _slave(charger)
        self._slaves.append(slave)
        slave.join(self)

    @override
    def removed(self, charger: Charger) -> None:
        slave = _slave(charger)
        self._slaves.remove(slave)
        slave.join(None)

    def draw(self, unit: int) -> Draw:
        """Return the knowledge of the current that one unit draws."""
        if unit not in self._draws:
            draw = self._draws[unit] = Draw(self._unknown_until)
            # All broadcasts so far have carried a 0 for it.
            draw.sent(0, self._sent_at)
        return self._draws[unit]

    def _all_draws(self) -> dict[int, Draw]:
        """Return the draws of all boxes that may follow our broadcasts.

        A slave that was removed while it charged still follows them.
        """
        for slave in self.slaves:
            self.draw(slave.unit)
        others = {slave.unit for slave in self.slaves if slave.has_other_dialect}
        return {u: draw for u, draw in self._draws.items() if u not in others}

    @property
    @override
    def details(self) -> Mapping[str, object]:
        shares = {str(unit): tenths / 10 for unit, tenths in self.shares().items()}
        # Amperes, by Modbus address.
        return {"supply": self.circuit, "shares": shares}

    def shares(self) -> dict[int, int]:
        """Return the share of each slave once all have followed, 0.1 A.

        A slave that draws nothing has the share that a request would get it now.
        """
        now = self.now
        draws = self._all_draws()
        slaves = {slave.unit: slave for slave in self.slaves if slave.unit in draws}
        claims = [
            Claim(unit=unit, demand=0, fixed=True)
            for unit, draw in draws.items()
            if unit not in slaves and draw.most(now) > 0
        ]
        idle: list[Claim] = []
        for unit, slave in slaves.items():
            claim = slave.claim(now, may_draw=draws[unit].may_draw)
            (claims if self._is_active(slave, now) else idle).append(claim)
        shares = split(self._limit, self._minimum, claims)
        for claim in idle:
            shares[claim.unit] = split(self._limit, self._minimum, [*claims, claim])[
                claim.unit
            ]
        return {unit: shares[unit] for unit in slaves}

    def _next_values(self, now: float) -> dict[int, int]:
        """Return the value of the next broadcast for each slave, 0.1 A."""
        draws = self._all_draws()
        values = next_values(self._limit, self.shares(), draws, now)
        removed = (draw.most(now) for unit, draw in draws.items() if unit not in values)
        taken = sum(LOWEST for most in removed if most > 0)
        active = [
            slave.unit
            for slave in self.slaves
            if self._is_active(slave, now)
            # One that draws nothing and has no share takes nothing from the others.
            and (values.get(slave.unit) or self.draw(slave.unit).may_draw)
        ]
        return fit_to_limit(self._limit - taken, values, active)

    def _is_active(self, slave: Slave, now: float) -> bool:
        """Return whether a slave may draw current, or is about to."""
        return self.draw(slave.unit).may_draw or slave.has_reservation(now)

    def grant(self, unit: int) -> int:
        """Return the current that may be granted to this unit now, 0.1 A; 0: none."""
        share = self.shares().get(unit, 0)
        return grant(self._limit, share, unit, self._all_draws(), self.now)

    def above_share(self, unit: int) -> list[Slave]:
        """Return the slaves that must go down before this one may begin.

        Those that do not answer are left out: they cannot confirm it.
        """
        units = set(above_share(self.shares(), self._all_draws(), self.now)) - {unit}
        return [
            slave for slave in self.slaves if slave.unit in units and slave.available
        ]

    async def lower(self, turn: Turn, slaves: list[Slave]) -> None:
        """Broadcast lower values, then read them back: a conversation.

        A slave whose reading fails is left as it is. Raises what `Turn.send` raises.
        """
        await self.send_broadcast(turn)
        for slave in reversed(slaves):
            await rest(worst_case=slave.worst_case)
            with suppress(ExchangeError, LineBusyError, NotAvailableError):
                await slave.read_status_once(turn)

    # -- Readings of the slaves --------------------------------------------------

    def on_status(self, unit: int, value: int, *, closed: bool, complete: bool) -> None:
        """Note a status: the current read back, 0.1 A, and the contactor.

        ``complete``: the settings of the slave are known, too.
        """
        self.draw(unit).read(value, self.now, closed=closed)
        if complete:
            self._on_read(unit)
        self.update_shares()

    def on_missed(self, unit: int) -> None:
        """Note that a slave did not reply."""
        self._on_read(unit)
        self.update_shares()

    def _on_read(self, unit: int) -> None:
        self._read_units.add(unit)
        if self._phase is _Phase.READING and self._all_read():
            self._have_turn_soon()

    def _all_read(self) -> bool:
        return self._read_units >= {slave.unit for slave in self.slaves}

    def update_shares(self) -> None:
        """Share anew; broadcast at once if that changes a value."""
        if self._phase is not _Phase.BROADCASTING or not self.slaves:
            return
        now = self.now
        shares = self.shares()
        for slave in self.slaves:
            if slave.unit in shares:
                slave.on_share(shares[slave.unit], now)
        if self._setpoints(now) != self._values:
            self.broadcast_soon()

    # -- The broadcast -----------------------------------------------------------

    def broadcast_soon(self) -> None:
        """Broadcast as soon as the line is free; the regular ones stay as planned."""
        if self._phase is _Phase.BROADCASTING:
            self._have_turn_soon()

    def _have_turn_soon(self) -> None:
        self.slot.ready = min(self.slot.ready, self.now)
        if self.bus is not None:
            self.bus.reschedule()

    def _setpoints(self, now: float) -> tuple[int, ...]:
        """Return the values that a broadcast would carry now, 0.1 A."""
        values = self._next_values(now)
        by_unit = {
            slave.unit: tenths(slave.setpoint_within(values[slave.unit] / 10))
            for slave in self.slaves
            if slave.unit in values
        }
        return tuple(by_unit.get(unit, 0) for unit in range(1, CURRENTS + 1))

    def _broadcast(self) -> bytes:
        """Return the broadcast of this moment, which must be sent now."""
        now = self.now
        values = self._next_values(now)
        by_unit: dict[int, Setpoint] = {}
        for slave in self.slaves:
            if slave.unit in values:
                slave.share = values[slave.unit] / 10
                by_unit[slave.unit] = slave.setpoint
        setpoints = [by_unit.get(unit) for unit in range(1, CURRENTS + 1)]
        before = self._values
        self._values = tuple(0 if one is None else tenths(one) for one in setpoints)
        for unit, draw in self._draws.items():
            draw.sent(self._values[unit - 1], now)
        for slave in self.slaves:
            lower = before and self._values[slave.unit - 1] < before[slave.unit - 1]
            if lower and self.draw(slave.unit).may_draw:
                # Until it has confirmed that, no other slave can go up.
                slave.read_soon(now)
        frame = broadcast(setpoints)
        self._memory.broadcast_at = now
        self._has_sent = True
        self._echoes = [one for one in self._echoes if now - one[0] <= ECHO]
        self._echoes.append((now, frame))
        self._broadcast_sent.set()
        return frame

    async def send_broadcast(self, turn: Turn) -> None:
        """Broadcast in any turn; raises what `Turn.send` raises.

        Has no effect before the slaves were read.
        """
        if self._phase is _Phase.BROADCASTING:
            await turn.send(partial(self.unless_silent, self._broadcast))

    @override
    async def turn(self, turn: Turn) -> None:
        now = turn.now
        if self._phase in (_Phase.LISTENING, _Phase.SILENCED):
            self._start_reading(now)
            return
        if self._phase is _Phase.READING:
            _LOGGER.debug("Master of %s slaves", len(self.slaves))
            self._phase = _Phase.BROADCASTING
            self._planned = now
        if not self.slaves:
            # A scan or an empty bus: other boxes must not follow us.
            self._planned = now + PERIOD
            self._wait(self._planned)
            return
        try:
            await self.send_broadcast(turn)
        except LineBusyError:
            # The line was never silent for long enough: try again at once.
            self._plan(turn.now, turn.now)
            self._is_planned = True
            raise
        self._plan_next(now)

    def _plan_next(self, now: float) -> None:
        """Plan the next broadcast, whenever this one went."""
        while self._planned <= now:
            self._planned += PERIOD
        self._plan(self._planned, self._planned)

    def _plan(self, ready: float, planned: float) -> None:
        self.slot.ready = ready
        self.slot.start_by = planned + SLACK
        if self.bus is not None:
            self.slot.worst_case = self.bus.wire.send_time(LONGEST_REQUEST)

    def _wait(self, until: float) -> None:
        self.slot.ready = until
        self.slot.start_by = inf

    @override
    def failed(self, now: float) -> None:
        if not self._is_planned and not self.silent:
            self._plan(now + RETRY, now + RETRY)
        self._is_planned = False

    # -- Other masters -----------------------------------------------------------

    @property
    @override
    def period(self) -> float:
        return PERIOD

    @property
    @override
    def silent(self) -> bool:
        return self._phase in (_Phase.LISTENING, _Phase.SILENCED)

    @property
    @override
    def refusal(self) -> NotAvailableError | None:
        return _other_master() if self._phase is _Phase.SILENCED else None

    def unless_silent(self, request: Request) -> bytes:
        """Return the bytes of a request; called right before they are sent.

        Raises NotAvailableError where another master is on the line: a conversation
        under way must not go on either.
        """
        if self.silent:
            raise _other_master()
        return request() if callable(request) else request

    @override
    def on_line_open(self, now: float) -> None:
        if self._phase is _Phase.SILENCED and self.slot.ready > now:
            return
        if now - self._sent_at < STILL_CHARGING:
            # The slaves still charge by our last broadcast: the next one comes soon.
            if not self._has_sent:
                # What an earlier bus has left them is not known.
                self._forget(now + STOPS_ALONE)
            self._start_reading(now)
            return
        self._phase = _Phase.LISTENING
        self._forget(now + STOPS_ALONE)
        self._wait(now + LISTENING)

    def _forget(self, unknown_until: float) -> None:
        """Drop all that is known of the slaves' currents."""
        self._unknown_until = unknown_until
        self._draws.clear()
        self._read_units.clear()
        self._values = ()

    def _start_reading(self, now: float) -> None:
        """Read the slaves, then begin: there is no other master."""
        self.notice(Fault.SECOND_MASTER, present=False)
        self._phase = _Phase.READING
        self._read_units.clear()
        self._wait(now + (READING if self.slaves else 0.0))

    @override
    def on_unsolicited(self, frame: Frame) -> bool:
        if not isinstance(frame, ModbusFrame):
            return False
        now = self.now
        if is_foreign_broadcast(frame):
            if not any(
                raw == frame.raw and now - when <= ECHO for when, raw in self._echoes
            ):
                self._fall_silent(now)
            return True
        request = decode_request(frame)
        if request is not None and request.unit in self._draws:
            self._draws[request.unit].requested(now)
        # While we are silent no slave may queue an answer: it would never be sent.
        return request is not None and self.silent

    def _fall_silent(self, now: float) -> None:
        """Silence the whole bus beside another master."""
        is_new = self._phase is not _Phase.SILENCED
        self._phase = _Phase.SILENCED
        # The next bus on this line must listen first, however soon it comes.
        self._memory.broadcast_at = -inf
        self._forget(now + STOPS_ALONE)
        self._wait(now + STAY_SILENT)
        self.notice(Fault.SECOND_MASTER, present=True)
        if is_new and self.bus is not None:
            _LOGGER.warning("%s: %s", self.bus.name, _OTHER_MASTER)
            self.bus.silence(_OTHER_MASTER)


def _other_master() -> NotAvailableError:
    return NotAvailableError(_OTHER_MASTER, "smartevse_other_master")


def _slave(charger: Charger) -> Slave:
    if not isinstance(charger, Slave):
        message = f"{charger.config.name} is no slave of a SmartEVSE master"
        raise TypeError(message)
    return charger
