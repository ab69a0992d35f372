"""Home Assistant as the load-balancing master of SmartEVSE slaves.

One broadcast every 2 s carries the current of each slave; one that has received none
for 10 s stops by itself (all but some 3.x). `sharing` decides the values; this module
decides when: listen for another master, read the slaves, broadcast, and fall silent as
soon as another master is on the line. A broadcast is for the dialects of one family:
where slaves are of two, nothing is written at all. Source: PROTOCOLS.md, 3.
"""

import asyncio
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
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
from .balancing import broadcast, decode_request, is_foreign_broadcast
from .dialects import FAMILIES, MAPS, Balancing, Dialect, Family, Handshake
from .member import Member
from .memory import SmartEvseMemory
from .other_masters import OtherMasters
from .registers import LONGEST_REQUEST, tenths
from .sharing import (
    LOWEST,
    Claim,
    Contactor,
    Draw,
    above_share,
    checked,
    fit_to_limit,
    grant,
    next_values,
    room,
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
READING_ALL: Final = 8.0
"""The same where a broadcast might be for others than those that were not read yet, s."""
STAY_SILENT: Final = 60.0
"""Silence after the last frame of another master, s."""
STILL_CHARGING: Final = 8.0
"""After a shorter silence of ours the slaves still charge: do not listen first, s."""
RETRY: Final = 0.5
"""Pause after a turn that failed unexpectedly, s."""
PATIENCE: Final = 3.0
"""Longest wait for a broadcast after the circuit limit has changed, s."""
SPACING: Final = 0.03
"""Silence before a request from 2.20 on, s: no recorded master had less."""

_OTHER_MASTER: Final = (
    "another master speaks on this line; two masters would undo each other's limits"
)
_MIXED: Final = (
    "the boxes on this line have firmware that needs different broadcasts; "
    "those for one would change the settings of another"
)


class _Phase(Enum):
    """The phase that the master is in."""

    LISTENING = auto()
    READING = auto()
    BROADCASTING = auto()
    MIXED = auto()
    """The slaves are of two families: they are read only."""
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
        self._unknown_since = inf
        """Loop time since which nothing was broadcast before we began to."""
        self._slaves: list[Member] = []
        self._family = Family.V2_17
        """Whom the broadcasts are for, once there are some."""
        self._probed_at = -inf
        """Loop time of the last turn that a slave without a reply was given."""
        self._draws: dict[int, Draw] = {}
        self._read_units: set[int] = set()
        """Units that were read, or did not reply, since we began to read them."""
        self._values: tuple[int, ...] = ()
        """Values of the last broadcast, 0.1 A."""
        self._memory = SmartEvseMemory()
        """That of the line, once it is on a bus."""
        self._has_sent = False
        """One of the broadcasts so far was ours, not of an earlier bus."""
        self._others = OtherMasters()
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
    def slaves(self) -> list[Member]:
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
        self.on_dialect()

    @override
    def removed(self, charger: Charger) -> None:
        slave = _slave(charger)
        self._slaves.remove(slave)
        slave.join(None)
        draw = self._draws.get(slave.unit)
        if draw is not None and not draw.row.fail_safe_proven and not draw.was_read:
            # It was never seen here, and would block all others for ever.
            del self._draws[slave.unit]
        self.on_dialect()

    def draw(self, unit: int) -> Draw:
        """Return the knowledge of the current that one unit draws."""
        if unit not in self._draws:
            draw = self._draws[unit] = Draw(self._habits(unit), self._unknown_since)
            # All broadcasts so far have carried a 0 for it.
            draw.sent(0, self._sent_at)
        return self._draws[unit]

    def _habits(self, unit: int) -> Balancing:
        """Return the habits of a slave, the worst of its family if it was never read."""
        dialects = (s.expected_dialect for s in self._slaves if s.unit == unit)
        dialect = next(dialects, None)
        if dialect is not None:
            return MAPS[dialect].balancing
        if self._family is Family.LATER:
            return MAPS[Dialect.V3_OLD].balancing
        return FAMILIES[self._family]

    def _all_draws(self) -> dict[int, Draw]:
        """Return the draws of all boxes that may follow our broadcasts.

        A slave that was removed while it charged still follows them.
        """
        for slave in self.slaves:
            self.draw(slave.unit).row = self._habits(slave.unit)
        return self._draws

    @property
    @override
    def details(self) -> Mapping[str, object]:
        shares = {str(unit): tenths / 10 for unit, tenths in self.shares().items()}
        # Amperes, by Modbus address.
        return {"supply": self.circuit, "shares": shares, "family": self._family}

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
            claim = slave.claim(now, may_draw=draws[unit].may_charge(now))
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
            and (values.get(slave.unit) or draws[slave.unit].may_charge(now))
        ]
        stopped = {unit for unit, draw in draws.items() if draw.row.zero_stops}
        return fit_to_limit(self._limit - taken, values, active, stopped)

    def _is_active(self, slave: Member, now: float) -> bool:
        """Return whether a slave may draw current, or is about to."""
        return self.draw(slave.unit).may_charge(now) or slave.has_reservation(now)

    def room(self, unit: int) -> float:
        """Return the current that the others leave for a unit now, 0.1 A."""
        return room(unit, self._limit, self._all_draws(), self.now)

    def waits_for_unread(self, unit: int) -> bool:
        """Return whether it may not begin before another was read, however long."""
        if self._phase is not _Phase.BROADCASTING:
            return False
        others = (draw for one, draw in self._all_draws().items() if one != unit)
        now = self.now
        return any(
            not draw.row.fail_safe_proven and draw.most(now) == inf for draw in others
        )

    def grant(self, unit: int) -> int:
        """Return the current that may be granted to this unit now, 0.1 A; 0: none."""
        share = self.shares().get(unit, 0)
        return grant(self._limit, share, unit, self._all_draws(), self.now)

    def above_share(self, unit: int) -> Sequence[Member]:
        """Return the slaves that must go down before this one may begin.

        Those that do not answer are left out: they cannot confirm it.
        """
        units = set(above_share(self.shares(), self._all_draws(), self.now)) - {unit}
        return [
            slave for slave in self.slaves if slave.unit in units and slave.available
        ]

    async def lower(self, turn: Turn, slaves: Sequence[Member]) -> None:
        """Broadcast lower values, then read them back: a conversation.

        A slave whose reading fails is left as it is. Raises what `Turn.send` raises.
        """
        await self.send_broadcast(turn)
        for slave in reversed(slaves):
            await rest(worst_case=slave.worst_case)
            with suppress(ExchangeError, LineBusyError, NotAvailableError):
                await slave.read_status_once(turn)

    # -- Readings of the slaves --------------------------------------------------

    def on_status(
        self, unit: int, value: int, contactor: Contactor, *, complete: bool
    ) -> None:
        """Note a status: the current read back, 0.1 A, and the contactor.

        ``complete``: the settings of the slave are known, too.
        """
        draw = self.draw(unit)
        draw.row = self._habits(unit)
        draw.read(value, self.now, contactor)
        if complete:
            self._on_read(unit)
        self.update_shares()

    def on_complete(self, unit: int) -> None:
        """Note that the settings of a slave are known, too."""
        self._on_read(unit)
        self.update_shares()

    def on_missed(self, unit: int, *, gone: bool) -> None:
        """Note that a slave did not reply; ``gone``: several times in a row."""
        # One lost reply does not show whom a broadcast would reach.
        if gone or self._reading_time < READING_ALL:
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
        return self._by_unit(
            {
                slave.unit: slave.setpoint_within(values[slave.unit] / 10)
                for slave in self.slaves
            }
        )

    def _by_unit(self, setpoints: Mapping[int, Setpoint]) -> tuple[int, ...]:
        """Return the values of a broadcast, for unit 1, 2 and so on, 0.1 A."""
        units = range(1, FAMILIES[self._family].currents + 1)
        return tuple(tenths(setpoints[u]) if u in setpoints else 0 for u in units)

    def _broadcast(self) -> bytes:
        """Return the broadcast of this moment, which must be sent now."""
        now = self.now
        values = self._next_values(now)
        setpoints: dict[int, Setpoint] = {}
        for slave in self.slaves:
            slave.share = values[slave.unit] / 10
            setpoints[slave.unit] = slave.setpoint
        before = self._values
        self._values = self._by_unit(setpoints)
        for unit, draw in self._draws.items():
            draw.sent(_value(self._values, unit), now)
        for slave in self.slaves:
            lower = _value(self._values, slave.unit) < _value(before, slave.unit)
            if lower and self.draw(slave.unit).may_charge(now):
                # Until it has confirmed that, no other slave can go up.
                slave.read_soon(now)
        reached = {u: one for u, one in setpoints.items() if u <= len(self._values)}
        frame = broadcast(self._family, reached)
        self._memory.broadcast_at = now
        self._has_sent = True
        self._others.sent(frame, now)
        self._broadcast_sent.set()
        return frame

    async def send_broadcast(self, turn: Turn) -> None:
        """Broadcast in any turn; raises what `Turn.send` raises.

        Has no effect before the slaves were read. Raises NotAvailableError where they
        are of two families.
        """
        if self._phase is _Phase.MIXED:
            raise _mixed()
        if self._phase is _Phase.BROADCASTING:
            await turn.send(partial(self.unless_forbidden, self._broadcast))
            now = self.now
            if now < self._planned and self._setpoints(now) == self._values:
                # Nothing is left to be broadcast before the next regular one.
                self.slot.ready = max(self.slot.ready, self._planned)

    @override
    async def turn(self, turn: Turn) -> None:
        now = turn.now
        if self._phase in (_Phase.LISTENING, _Phase.SILENCED):
            self._start_reading(now)
            return
        if self._phase is _Phase.READING:
            self._begin(now)
        if self._phase is not _Phase.BROADCASTING:
            return
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

    def _begin(self, now: float) -> None:
        """Broadcast from now on, to the family that was found."""
        families = self._families()
        if len(families) > 1:
            self._stop_for_mix()
            return
        # Before any slave was read: only 2.17 hears that, and the others ignore it.
        self._family = next(iter(families), Family.V2_17)
        self._set_spacing()
        self.notice(Fault.MIXED_DIALECTS, present=False)
        _LOGGER.debug("Master of %s slaves (%s)", len(self.slaves), self._family)
        self._phase = _Phase.BROADCASTING
        self._planned = now

    def _set_spacing(self) -> None:
        if self.bus is None or self._family is Family.V2_17:
            return
        wire = self.bus.wire
        if wire.timing.silence < SPACING:
            wire.timing = replace(wire.timing, silence=SPACING)
            wire.on_times_changed()

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

    # -- Families ----------------------------------------------------------------

    def _families(self) -> set[Family]:
        """Return the families of the slaves, as read last or kept from earlier."""
        dialects = {slave.expected_dialect for slave in self._slaves} - {None}
        return {MAPS[one].balancing.family for one in dialects if one is not None}

    def on_dialect(self) -> None:
        """Look again at the dialects of all slaves: one was read, or is gone."""
        families = self._families()
        if len(families) > 1:
            if self._phase is _Phase.BROADCASTING:
                self._stop_for_mix()
        elif self._phase is _Phase.MIXED or (
            self._phase is _Phase.BROADCASTING
            and families
            and self._family not in families
        ):
            # To other boxes than before: only after it has listened.
            self._listen(self.now)
            if self.bus is not None:
                self.bus.reschedule()

    def _stop_for_mix(self) -> None:
        """Write nothing more: the slaves stop by themselves, as far as they do."""
        self._phase = _Phase.MIXED
        self._wait(inf)
        if self.bus is not None:
            _LOGGER.warning("%s: %s", self.bus.name, _MIXED)
        self.notice(Fault.MIXED_DIALECTS, present=True)

    def unless_forbidden(self, request: Request) -> bytes:
        """Return the bytes of a request that writes; as `unless_silent`.

        Raises NotAvailableError also where the slaves are of two families.
        """
        if len(self._families()) > 1:
            raise _mixed()
        return self.unless_silent(request)

    # -- Slaves that do not reply ------------------------------------------------

    def next_probe(self, now: float) -> float:
        """Return when one that has not replied is to be read again: one a period.

        Before the broadcasts begin, it delays none.
        """
        if self._phase is _Phase.READING:
            return now
        self._probed_at = max(now, self._probed_at) + PERIOD
        return self._probed_at

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
                self._forget(now)
            self._start_reading(now)
            return
        self._listen(now)

    def _listen(self, now: float) -> None:
        """Listen for another master; then read the slaves anew."""
        self._phase = _Phase.LISTENING
        self._forget(now)
        self._wait(now + LISTENING)

    def _forget(self, now: float) -> None:
        """Drop all that is known of the slaves' currents."""
        self._unknown_since = now
        self._draws.clear()
        self._read_units.clear()
        self._values = ()

    @property
    def _reading_time(self) -> float:
        """Return the longest time for which the slaves are only read, s."""
        if not self._slaves:
            return 0.0
        is_sure = all(slave.expected_dialect is not None for slave in self._slaves)
        return (
            READING if is_sure and Family.V2_20 not in self._families() else READING_ALL
        )

    def _start_reading(self, now: float) -> None:
        """Read the slaves, then begin: there is no other master."""
        self.notice(Fault.SECOND_MASTER, present=False)
        self._phase = _Phase.READING
        self._read_units.clear()
        self._wait(now + self._reading_time)

    @override
    def on_unsolicited(self, frame: Frame) -> bool:
        if not isinstance(frame, ModbusFrame):
            return False
        now = self.now
        if self._others.is_one(frame, self._draws, now):
            self._fall_silent(now)
            return True
        if is_foreign_broadcast(frame):
            return True
        request = decode_request(frame)
        draw = self._draws.get(request.unit) if request is not None else None
        if draw is not None and draw.row.handshake is Handshake.REQUESTS:
            draw.requested(now)
        # While we are silent no slave may queue an answer: it would never be sent.
        return request is not None and self.silent

    def _fall_silent(self, now: float) -> None:
        """Silence the whole bus beside another master."""
        is_new = self._phase is not _Phase.SILENCED
        self._phase = _Phase.SILENCED
        # The next bus on this line must listen first, however soon it comes.
        self._memory.broadcast_at = -inf
        self._forget(now)
        self._wait(now + STAY_SILENT)
        self.notice(Fault.SECOND_MASTER, present=True)
        if is_new and self.bus is not None:
            _LOGGER.warning("%s: %s", self.bus.name, _OTHER_MASTER)
            self.bus.silence(_OTHER_MASTER)


def _value(values: Sequence[int], unit: int) -> int:
    """Return the value for a unit in a broadcast, 0.1 A; 0: it has none.

    A broadcast of 2.17 ends with unit 4; a slave that was never read may have a higher
    address.
    """
    return values[unit - 1] if unit <= len(values) else 0


def _other_master() -> NotAvailableError:
    return NotAvailableError(_OTHER_MASTER, "smartevse_other_master")


def _mixed() -> NotAvailableError:
    return NotAvailableError(_MIXED, "smartevse_mixed_dialects")


def _slave(charger: Charger) -> Member:
    if not isinstance(charger, Member):
        message = f"{charger.config.name} is no slave of a SmartEVSE master"
        raise TypeError(message)
    return charger
