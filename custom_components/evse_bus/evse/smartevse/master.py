"""Home Assistant as the load-balancing master of SmartEVSE slaves (dialect 2.17).

Every 2 s all slaves are told their currents in one broadcast; a slave that hears none
for 10 s stops by itself. Who gets how much is `sharing`'s to say; this module has the
turns: listen before the first word, look at the slaves, broadcast, fall silent where
another master speaks. Source: PROTOCOLS.md, 3.
"""

import asyncio
from contextlib import suppress
from enum import Enum, auto
from functools import partial
import logging
from math import inf
from typing import TYPE_CHECKING, Final, cast, override

from ..charger import Charger
from ..errors import LineBusyError, NotAvailableError
from ..exchange import Request, Turn
from ..framing import Frame
from ..master import BusMaster
from ..modbus import ModbusFrame
from ..model import Fault, Supply
from .balancing import CURRENTS, broadcast, decode_request, is_foreign_broadcast
from .registers import LONGEST_REQUEST, tenths
from .sharing import (
    LOWEST,
    STOPS_ALONE,
    Claim,
    Draw,
    checked,
    grant,
    in_the_way,
    next_values,
    split,
    together,
)

if TYPE_CHECKING:
    from .member import Member

_LOGGER: Final = logging.getLogger(__name__)

PERIOD: Final = 2.0
"""From broadcast to broadcast, s."""
SLACK: Final = 0.020
"""How late a broadcast may begin, s."""
LISTENING: Final = 2.5
"""How long we listen for another master before our first word, s."""
LOOKING: Final = 1.5
"""How long a first broadcast waits for the slaves to be read, s."""
OTHERS: Final = 60.0
"""How long we stay silent after the last word of another master, s."""
ECHO: Final = 0.5
"""Our own broadcast, heard again within this time, is no other master's, s. A network
port may hand it on when another one has gone out already."""
LIVE_ON: Final = 8.0
"""After a shorter silence of ours the slaves still charge: no time to lose, s."""
RETRY: Final = 0.5
"""Pause after a turn that failed unforeseen, s."""
PATIENCE: Final = 3.0
"""Longest wait for a broadcast that carries a new supply, s."""

_OTHER_MASTER: Final = (
    "another master speaks on this line; two masters would undo each other's limits"
)


class _Phase(Enum):
    """What the master does."""

    LISTENING = auto()
    LOOKING = auto()
    SPEAKING = auto()
    HUSHED = auto()


class Master(BusMaster):
    """The broadcast, and what all slaves together may draw."""

    def __init__(self, supply: Supply) -> None:
        """Raise RefusedOrderError for a supply that cannot be."""
        super().__init__()
        # Before all that waits: it is short, and late it has no deadline to defend it.
        self.slot.due = -inf
        self._supply = checked(supply)
        self._phase = _Phase.LISTENING
        self._planned = 0.0
        self._unknown_until = inf
        self._slaves: list[Member] = []
        self._draws: dict[int, Draw] = {}
        self._looked_at: set[int] = set()
        self._sent: tuple[int, ...] = ()
        self._spoke_at = -inf
        self._spoken: list[tuple[float, bytes]] = []
        """Our broadcasts whose echo may still come."""
        self._is_planned = False
        self._has_spoken = asyncio.Event()

    # -- The supply --------------------------------------------------------------

    @property
    def supply(self) -> Supply:
        """Return what the slaves share."""
        return self._supply

    async def change_supply(self, supply: Supply) -> None:
        """Share another supply; return when a broadcast has carried it, if any does.

        Raises RefusedOrderError for a supply that cannot be.
        """
        self._supply = checked(supply)
        self.updated()
        self._has_spoken.clear()
        self.changed()
        self.hurry()
        if self._phase is _Phase.SPEAKING and self.slaves:
            with suppress(TimeoutError):
                async with asyncio.timeout(PATIENCE):
                    await self._has_spoken.wait()

    @property
    def now(self) -> float:
        """Return the loop time, s."""
        return asyncio.get_running_loop().time()

    @property
    def _limit(self) -> int:
        return round(self._supply.limit * 10)

    # -- The slaves --------------------------------------------------------------

    @property
    def slaves(self) -> list[Member]:
        """Return the slaves that are set up; nothing else is on this bus."""
        return list(self._slaves)

    @override
    def added(self, charger: Charger) -> None:
        slave = cast("Member", charger)
        self._slaves.append(slave)
        slave.join(self)

    @override
    def removed(self, charger: Charger) -> None:
        slave = cast("Member", charger)
        self._slaves.remove(slave)
        slave.join(None)

    def draw(self, unit: int) -> Draw:
        """Return what is known of the current of one unit."""
        if unit not in self._draws:
            draw = self._draws[unit] = Draw(self._unknown_until)
            # It was nobody's word so far, and heard so.
            draw.said(0, self._spoke_at)
        return self._draws[unit]

    def _all_draws(self) -> dict[int, Draw]:
        """Return the draws of all that may follow our broadcasts.

        A slave that was taken off while it charged goes on with what it hears.
        """
        for slave in self.slaves:
            self.draw(slave.unit)
        foreign = {slave.unit for slave in self.slaves if slave.is_foreign}
        return {u: draw for u, draw in self._draws.items() if u not in foreign}

    def shares(self) -> dict[int, int]:
        """Return what each slave gets when all have followed, 0.1 A.

        A slave that draws nothing has the share that it would get if it asked now.
        """
        now = self.now
        draws = self._all_draws()
        slaves = {slave.unit: slave for slave in self.slaves if slave.unit in draws}
        claims = [
            Claim(unit=unit, wish=0, fixed=True)
            for unit, draw in draws.items()
            if unit not in slaves and draw.most(now) > 0
        ]
        idle: list[Claim] = []
        for unit, slave in slaves.items():
            claim = slave.claim(now, may_draw=draws[unit].may_draw)
            (claims if self._is_active(slave, now) else idle).append(claim)
        minimum = round(self._supply.minimum * 10)
        shares = split(self._limit, minimum, claims)
        for claim in idle:
            shares[claim.unit] = split(self._limit, minimum, [*claims, claim])[
                claim.unit
            ]
        return {unit: shares[unit] for unit in slaves}

    def _values(self, now: float) -> dict[int, int]:
        draws = self._all_draws()
        values = next_values(self._limit, self.shares(), draws, now)
        gone = (draw.most(now) for unit, draw in draws.items() if unit not in values)
        taken = sum(LOWEST for most in gone if most > 0)
        active = [
            slave.unit
            for slave in self.slaves
            if self._is_active(slave, now)
            # Who draws nothing and may have nothing takes nothing from the others.
            and (values.get(slave.unit) or self.draw(slave.unit).may_draw)
        ]
        return together(self._limit - taken, values, active)

    def _is_active(self, slave: Member, now: float) -> bool:
        """Return whether a slave may draw current, or is about to."""
        return self.draw(slave.unit).may_draw or slave.is_promised(now)

    def in_the_way(self, unit: int) -> list[Member]:
        """Return the slaves that must go down first before this one may begin."""
        found = in_the_way(self.shares(), self._all_draws(), self.now)
        units = set(found) - {unit}
        return [slave for slave in self.slaves if slave.unit in units]

    def grant(self, unit: int) -> int:
        """Return the current that may be granted to this unit now, 0.1 A; 0: none."""
        share = self.shares().get(unit, 0)
        return grant(self._limit, share, unit, self._all_draws(), self.now)

    # -- What the slaves tell ----------------------------------------------------

    def took(self, slave: Member, value: int, *, closed: bool) -> None:
        """Note what a slave read back (0.1 A), and whether its contactor is closed."""
        self.draw(slave.unit).read(value, self.now, closed=closed)
        if slave.configuration is not None:
            self._looked(slave.unit)
        self.changed()

    def missed(self, slave: Member) -> None:
        """Note that a slave did not answer."""
        self._looked(slave.unit)
        self.changed()

    def _looked(self, unit: int) -> None:
        self._looked_at.add(unit)
        if self._phase is _Phase.LOOKING and self._all_looked_at():
            self._speak_now()

    def _all_looked_at(self) -> bool:
        return self._looked_at >= {slave.unit for slave in self.slaves}

    def changed(self) -> None:
        """Look whether the slaves must be told something else than they were."""
        if self._phase is not _Phase.SPEAKING or not self.slaves:
            return
        now = self.now
        shares = self.shares()
        for slave in self.slaves:
            if slave.unit in shares:
                slave.may_have(shares[slave.unit], now)
        if self._words(now) != self._sent:
            self.hurry()

    # -- The broadcast -----------------------------------------------------------

    def hurry(self) -> None:
        """Broadcast as soon as the line is free; the regular ones stay as planned."""
        if self._phase is _Phase.SPEAKING:
            self._speak_now()

    def _speak_now(self) -> None:
        self.slot.ready = min(self.slot.ready, self.now)
        if self.bus is not None:
            self.bus.reschedule()

    def _words(self, now: float) -> tuple[int, ...]:
        """Return the values of the next broadcast, 0.1 A, for units 1 to 4."""
        values = self._values(now)
        by_unit = {
            slave.unit: tenths(slave.setpoint_within(values[slave.unit] / 10))
            for slave in self.slaves
            if slave.unit in values
        }
        return tuple(by_unit.get(unit, 0) for unit in range(1, CURRENTS + 1))

    def frame(self) -> bytes:
        """Return the broadcast of this moment, which must be sent now."""
        now = self.now
        values = self._values(now)
        setpoints = {}
        for slave in self.slaves:
            if slave.unit in values:
                slave.share = values[slave.unit] / 10
                setpoints[slave.unit] = slave.setpoint
        words = [setpoints.get(unit) for unit in range(1, CURRENTS + 1)]
        before = self._sent
        self._sent = tuple(0 if one is None else tenths(one) for one in words)
        for unit, draw in self._draws.items():
            draw.said(self._sent[unit - 1], now)
        for slave in self.slaves:
            lower = before and self._sent[slave.unit - 1] < before[slave.unit - 1]
            if lower and self.draw(slave.unit).may_draw:
                # Until it has confirmed that, nobody else can go up.
                slave.look_soon(now)
        raw = broadcast(words)
        self._spoke_at = now
        self._spoken = [one for one in self._spoken if now - one[0] <= ECHO]
        self._spoken.append((now, raw))
        self._has_spoken.set()
        return raw

    async def speak(self, turn: Turn) -> None:
        """Broadcast in somebody's turn; raises what `Turn.send` raises.

        Nothing is said before we have looked at the slaves.
        """
        if self._phase is _Phase.SPEAKING:
            await turn.send(partial(self.unless_silent, self.frame))

    @override
    async def turn(self, turn: Turn) -> None:
        now = turn.now
        if self._phase in (_Phase.LISTENING, _Phase.HUSHED):
            self._look(now)
            return
        if self._phase is _Phase.LOOKING:
            _LOGGER.debug("master of %s slaves", len(self.slaves))
            self._phase = _Phase.SPEAKING
            self._planned = now
        if not self.slaves:
            # A scan or an empty bus: nothing is imposed on whoever listens.
            self._planned = now + PERIOD
            self._wait(self._planned)
            return
        try:
            await self.speak(turn)
        except LineBusyError:
            # The patience for silence is over, the duty is not: again at once.
            self._plan(turn.now, turn.now)
            self._is_planned = True
            raise
        self._next(now)

    def _next(self, now: float) -> None:
        """Plan the next broadcast from the plan, not from when this one went."""
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

    # -- Silence -----------------------------------------------------------------

    @property
    @override
    def silent(self) -> bool:
        return self._phase in (_Phase.LISTENING, _Phase.HUSHED)

    @property
    @override
    def refusal(self) -> str | None:
        return _OTHER_MASTER if self._phase is _Phase.HUSHED else None

    def unless_silent(self, request: Request) -> bytes:
        """Return what is to be sent; NotAvailableError where another master spoke.

        Asked when the line is quiet: what was under way must not go out either.
        """
        if self.silent:
            raise NotAvailableError(_OTHER_MASTER)
        return request() if callable(request) else request

    @override
    def on_line_open(self, now: float) -> None:
        if self._phase is _Phase.HUSHED and self.slot.ready > now:
            return
        if now - self._spoke_at < LIVE_ON:
            # The slaves still charge by our word: they hear it again soon.
            self._look(now)
            return
        self._phase = _Phase.LISTENING
        self._forget(now + STOPS_ALONE)
        self._wait(now + LISTENING)

    def _forget(self, unknown_until: float) -> None:
        self._unknown_until = unknown_until
        self._draws.clear()
        self._looked_at.clear()
        self._sent = ()

    def _look(self, now: float) -> None:
        """Nobody else is master: look at the slaves, then begin."""
        self.notice(Fault.SECOND_MASTER, present=False)
        self._phase = _Phase.LOOKING
        self._looked_at.clear()
        self._wait(now + (LOOKING if self.slaves else 0.0))

    @override
    def on_unsolicited(self, frame: Frame) -> bool:
        if not isinstance(frame, ModbusFrame):
            return False
        now = self.now
        if is_foreign_broadcast(frame):
            if not any(
                raw == frame.raw and now - when <= ECHO for when, raw in self._spoken
            ):
                self._hush(now)
            return True
        request = decode_request(frame)
        if request is not None and request.unit in self._draws:
            self._draws[request.unit].asked(now)
        # While we are silent it is nobody's here: no turn would ever come.
        return request is not None and self.silent

    def _hush(self, now: float) -> None:
        """Another master speaks: let nobody on this bus speak beside it."""
        fresh = self._phase is not _Phase.HUSHED
        self._phase = _Phase.HUSHED
        self._forget(now + STOPS_ALONE)
        self._wait(now + OTHERS)
        self.notice(Fault.SECOND_MASTER, present=True)
        if fresh and self.bus is not None:
            _LOGGER.warning("%s: %s", self.bus.name, _OTHER_MASTER)
            self.bus.silence(_OTHER_MASTER)
