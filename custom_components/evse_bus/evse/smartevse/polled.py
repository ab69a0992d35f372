"""One SmartEVSE that is polled: without load balancing, or its own master.

It is read before anything is written. Its limit is an override of its own maximum: a
power failure or a write of 0 removes it, and it applies only while a car charges. So
it is written before a car comes, read back while the car charges, and reasserted
whenever the box offers more than the order. 0 A is never written: a pause turns access
off.

A later box needs quiet: any request on the line, to any address, suspends its own 2 s
cycle for 4 s; without that cycle no new current takes effect, and after 10 s it stops
with NO_COMM. So all exchanges that are due go in one burst, followed by quiet time.
Only a pause does not wait for its end. PROTOCOLS.md, 3.

Several conversations may wait for the end of one quiet time (orders, and the override
of a box just found). They go in one burst, and what one of them has written is not
written again by the next: each write would put off the read-back of all.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from math import inf
from typing import ClassVar, Final, override

from ..conversation import FollowUp, rest
from ..errors import (
    LineBusyError,
    NotConfirmedError,
    RefusedOrderError,
    SharedAddressError,
    SupersededError,
)
from ..exchange import Request, Turn
from ..memory import LineMemory
from ..model import (
    MINIMUM_CURRENT,
    Command,
    CurrentLimit,
    FailSafe,
    Fault,
    OrderChange,
    Orders,
    PauseReason,
    Persistence,
    Range,
    Setting,
)
from ..registers import Block
from ..safety import Setpoint, clamp
from ..schedule import Kind
from .charger import SmartEvseCharger
from .config import PolledConfig
from .dialects import MAPS, Status
from .memory import SmartEvseMemory
from .mode import mode_conversation
from .plug import has_restarted
from .reader import READ_AGAIN, TIMING, WRITES
from .registers import tenths, write_current
from .states import (
    CHARGING,
    UNPLUGGED,
    is_stopped,
    offered,
    shows_plug,
    state_of,
)

QUIET: Final = 6.5
"""Time without any request on the line that a later box needs, s."""
BURST: Final = 1.0
"""Time from the first request of a burst in which another turn may join it, s."""
COMMANDS_FIRST: Final = 0.05
"""Pause between the end of the quiet time and a poll, s."""
SETTLING: Final = 3.0
"""Longest time in which 2.17 and 2.20 follow a new current, s (their cycle: 2 s)."""

_NO_CHANGE: Final = OrderChange()
_LOWEST: Final = Orders(limit=CurrentLimit(current=MINIMUM_CURRENT))


class PolledSmartEvse(SmartEvseCharger[PolledConfig]):
    """One SmartEVSE that has no master, or is its own."""

    pauses_hurry: ClassVar = True
    # No other charger has a deadline here, and one burst costs a later box one quiet.
    bursts: ClassVar = True
    # A power failure opens access that was off, so a box that is back must be read
    # soon; one that receives but is not received still gets its quiet.
    timing: ClassVar = replace(TIMING, backoff=QUIET, backoff_limit=QUIET)

    def __init__(self, config: PolledConfig, orders: Orders) -> None:
        """Begin with an unknown box."""
        super().__init__(config, orders)
        self._line_memory = LineMemory()
        """That of the line, once it is on a bus."""
        self._burst_until = -inf
        """Loop time until which a turn may join the burst that has begun."""
        self._written: int | None = None
        """The override that we wrote last, 0.1 A; ``None``: not known to be there."""
        self._written_at = -inf
        """Loop time of the last write of an override."""
        self._read_back = True
        """The status was read since, when the override had had time to take effect."""
        self._confirmed: int | None = None
        """The set-point within which it was read back to charge, 0.1 A."""
        self._charging_since: float | None = None
        """Loop time at which the car was first seen to charge."""
        self._searches = False
        """It may be searching for the car's smallest current, whatever its limit."""
        self._fell_back = False
        """It offers more than it had already confirmed."""
        self._paused_for_limit = False
        """Our own 0 A has turned its access off; a higher limit restores it."""
        self._excess: float | None = None
        """Access was turned off because it kept offering this current, A."""
        self._shutting_down = False

    # -- Timing --------------------------------------------------------------------

    @property
    @override
    def exchanges_per_turn(self) -> int:
        # Dialect (4), status, settings (2), access and current, both read back.
        return 12

    @override
    def minimum_pause(self, now: float) -> float:
        return 0.0 if now < self._burst_until else self._rest_of_quiet(now)

    def _rest_of_quiet(self, now: float) -> float:
        """Return the time until the box has had its quiet, s."""
        if not self._needs_quiet:
            return 0.0
        # Any request counts: to any address, of another bus before, or of a search.
        return max(0.0, self._line_memory.sent_at + QUIET - now)

    @property
    def _needs_quiet(self) -> bool:
        """Return whether it needs quiet; before it is known, as the last box here."""
        memory = self._line_memory.of(SmartEvseMemory)
        if self.dialect is not None:
            memory.needs_quiet = MAPS[self.dialect].needs_quiet
        return memory.needs_quiet

    @override
    def resume(self, memory: LineMemory) -> None:
        super().resume(memory)
        self._line_memory = memory

    @override
    def plan(self, now: float) -> None:
        super().plan(now)
        # A little after the quiet: a command that waited for its end goes first.
        quiet = now + self._rest_of_quiet(now) + COMMANDS_FIRST
        if self._needs_quiet:
            self.slot.ready = self.slot.due = max(self.slot.ready, quiet)

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        if self.minimum_pause(turn.now) > 0:
            message = f"{self.config.name} must be left alone: its quiet was disturbed"
            raise LineBusyError(message)
        return await super().poll(turn)

    @override
    async def read(self, turn: Turn, block: Block) -> bytes:
        self._begin_burst(turn.now)
        return await super().read(turn, block)

    def _begin_burst(self, now: float) -> None:
        """Begin a burst with the request about to be sent, unless one has begun."""
        if self._rest_of_quiet(now) <= 0:
            self._burst_until = now + BURST

    @override
    async def read_status_once(self, turn: Turn) -> None:
        asked_at = turn.now
        rested = self._rest_of_quiet(asked_at) <= 0
        await super().read_status_once(turn)
        settling = 0.0 if self._needs_quiet else SETTLING
        if rested and asked_at >= self._written_at + settling:
            self._read_back = True

    # -- State ---------------------------------------------------------------------

    @property
    @override
    def waits_for_current(self) -> bool:
        return self._paused_for_limit

    @property
    @override
    def pause_reason(self) -> PauseReason | None:
        not_followed = None
        if self._excess is not None:
            not_followed = PauseReason.LIMIT_NOT_FOLLOWED
        return super().pause_reason or not_followed

    @property
    @override
    def fail_safe(self) -> FailSafe | None:
        return FailSafe.FORGETS

    @property
    @override
    def begins_with(self) -> float | None:
        if self.configuration is None:
            return None
        # Whatever the cable of today: the next one may carry more.
        return float(self.configuration.settings[Setting.MAXIMUM_CURRENT])

    @property
    @override
    def settings(self) -> Mapping[Setting, Range]:
        ranges = dict(super().settings)
        if self.configuration is None or not ranges:
            return ranges
        # With a minimum above the maximum no car could charge at all.
        values = self.configuration.settings
        own = ranges[Setting.MAXIMUM_CURRENT]
        least = min(max(own.minimum, values[Setting.MINIMUM_CURRENT]), own.maximum)
        ranges[Setting.MAXIMUM_CURRENT] = replace(own, minimum=least)
        own = ranges[Setting.MINIMUM_CURRENT]
        most = max(min(own.maximum, values[Setting.MAXIMUM_CURRENT]), own.minimum)
        ranges[Setting.MINIMUM_CURRENT] = replace(own, maximum=most)
        return ranges

    @override
    def on_line_open(self) -> None:
        super().on_line_open()
        self._written = None
        if self._serial is None:
            # Another box may be in its place, whose access a driver has turned off.
            self._paused_for_limit = False

    @override
    def on_line_reopened(self) -> None:
        # Between two polls of a box that answers nothing has taken its place.
        paused = self._paused_for_limit and not self.misses
        super().on_line_reopened()
        self._paused_for_limit |= paused

    @override
    def on_missed(self, now: float, why: str) -> None:
        super().on_missed(now, why)
        # It may have been switched off and on again.
        self._written = None

    @override
    def on_status(self, status: Status, now: float) -> None:
        if self.status is not None and has_restarted(self.status, status):
            self._written = None
        super().on_status(status, now)
        charging = status.raw_state in CHARGING
        self._follow_car(status, now)
        within = charging and not self._is_above(status)
        setpoint = tenths(self.setpoint)
        if charging and not within:
            self._fell_back = self._confirmed == setpoint
        self._confirmed = setpoint if within else None
        if status.access is True and not self.setpoint.paused:
            # Access was opened at the box: nothing is left to restore.
            self._paused_for_limit = False
            self._excess = None
        settled = self._excess is None and not self._must_stop()
        if settled and (within or not charging):
            self.notice(Fault.LIMIT_NOT_TAKEN, present=False)

    def _follow_car(self, status: Status, now: float) -> None:
        """Take note of when the car began to charge, and of its leaving."""
        dialect = self.known_dialect
        row = MAPS[dialect]
        if status.raw_state in CHARGING:
            if self._charging_since is None:
                self._charging_since = now
        elif status.raw_state == UNPLUGGED and (row.shows_plug or shows_plug(status)):
            self._charging_since = None
        since = self._charging_since
        current = offered(dialect, status)
        self._searches = (
            since is not None
            and now < since + row.search_time
            and current is not None
            and current <= row.search_current
        )

    def _is_above(self, status: Status, setpoint: Setpoint | None = None) -> bool:
        """Return whether more than the set-point is offered; False without a car."""
        wanted = self.setpoint if setpoint is None else setpoint
        current = offered(self.known_dialect, status)
        return current is not None and current > wanted.current

    # -- Address -------------------------------------------------------------------

    @property
    @override
    def shares_address(self) -> bool:
        others = self.bus is not None and len(self.bus.chargers) > 1
        return self.config.address == 0 and others

    @override
    async def write(self, turn: Turn, request: Request, register: int) -> bool | None:
        self._check_alone()
        self._begin_burst(turn.now)
        return await super().write(turn, request, register)

    def _check_alone(self) -> None:
        """Raise SharedAddressError where a write would reach others too.

        2.17 without load balancing has the address at which all others listen.
        """
        if self.shares_address:
            self.notice(Fault.DUPLICATE_ADDRESS, present=True)
            message = (
                f"{self.config.name} has address 0, at which every SmartEVSE listens: "
                "nothing is written while others are on its bus"
            )
            raise SharedAddressError(message)

    # -- Maintenance ---------------------------------------------------------------

    @override
    def must_maintain(self, now: float) -> bool:
        return (
            super().must_maintain(now)
            or self._must_stop()
            or self._must_write()
            or self._may_start(_NO_CHANGE)
        )

    @override
    async def maintain(self, turn: Turn) -> None:
        await self._stop_if_necessary(turn)
        if turn.now >= self.configuration_due:
            # The override is rewritten at times: a short power failure of the box may
            # have passed unnoticed.
            self._written = None
        await super().maintain(turn)
        # The settings just read may have lowered the set-point.
        await self._stop_if_necessary(turn)
        if self._must_write():
            await self._follow(turn, lambda: self.setpoint, is_standing=True)
        if self._may_start(_NO_CHANGE):
            # No order took its current away: installation limit, settings or lifetime.
            await self._enable(turn, _NO_CHANGE)

    async def _stop_if_necessary(self, turn: Turn) -> None:
        if self._must_stop():
            ours = self.effective_orders.allowed is not False
            await self._stop(turn, ours=ours)
            await rest()

    def _must_stop(self) -> bool:
        """Return whether a car could charge against the set-point."""
        if self.status is None or not self.setpoint.paused:
            return False
        return not is_stopped(self.known_dialect, self.status)

    async def _stop(self, turn: Turn, *, ours: bool) -> None:
        """Turn access off; ``ours``: for lack of current, so that it is restored."""
        had_access = self.has_access is not False
        try:
            await self.set_access(turn, allowed=False)
        except NotConfirmedError:
            # Where access is off, the car alone is the problem (`watch_pause`).
            self.notice(Fault.LIMIT_NOT_TAKEN, present=self.has_access is not False)
            raise
        self._paused_for_limit = ours and (had_access or self._paused_for_limit)
        if not ours:
            self._excess = None
            self.notice(Fault.LIMIT_NOT_TAKEN, present=False)

    def _must_write(self) -> bool:
        """Return whether the override differs from the one that it should have."""
        status = self.status
        if status is None:
            return False
        target = self._override_for(status, self.setpoint)
        return target is not None and not self._stands(status, target)

    def _stands(self, status: Status, target: Setpoint) -> bool:
        """Return whether an override was written and may be in force: no second write.

        A car that charges with more disproves it, once it has had time to take effect.
        """
        if self._written != tenths(target):
            return False
        if self._searches:
            return True
        charging = status.raw_state in CHARGING
        return not (charging and self._read_back and self._is_above(status, target))

    def _override_for(self, status: Status, setpoint: Setpoint) -> Setpoint | None:
        """Return the override for a status; ``None``: no current is allowed.

        The cable of the next car is unknown before it is plugged in and measured, and
        the override takes precedence over the box's own knowledge of it: 6 A until then.
        """
        dialect = self.known_dialect
        plugged = state_of(dialect, status.raw_state).plugged
        if plugged and status.maximum is not None and not setpoint.paused:
            return setpoint
        limits = replace(self.limits, reported=MINIMUM_CURRENT, minimum=MINIMUM_CURRENT)
        lowest = clamp(_LOWEST, limits)
        return None if lowest.paused else lowest

    # -- The current ---------------------------------------------------------------

    async def _follow(
        self,
        turn: Turn,
        wanted: Callable[[], Setpoint],
        *,
        is_standing: bool = False,
    ) -> None:
        """Write the override, unless it stands; while a car charges, read it back.

        ``is_standing``: the set-point is that of the orders that stand; one that is
        under way takes precedence.

        A box that goes on offering more is stopped: a limit must hold. Raises
        NotConfirmedError then.
        """
        sent = None
        for _ in range(WRITES):
            await self.reach(turn)
            status = self.status
            if status is None:
                continue
            sent = await self._write_unless_it_stands(turn, status, wanted)
            if status.raw_state not in CHARGING:
                return
            await self._settle(turn, wanted)
            if is_standing and self._written not in (None, sent):
                # An order has been written meanwhile; it is confirmed or taken back.
                return
            status = self.status
            setpoint = wanted()
            if (
                status is None
                or status.raw_state not in CHARGING
                or setpoint.paused
                or not self._is_above(status, setpoint)
            ):
                return
            await rest()
        await self._stop_excess(turn, is_current=sent == tenths(wanted()))

    async def _write_unless_it_stands(
        self, turn: Turn, status: Status, wanted: Callable[[], Setpoint]
    ) -> int | None:
        """Return the override that is to be read back, 0.1 A."""
        target = self._override_for(status, wanted())
        if target is not None and self._stands(status, target):
            # Another conversation has written it.
            return self._written
        if self._fell_back:
            self.statistics.reasserted += 1
            self._fell_back = False
        return await self._write_current(turn, status, wanted)

    async def _stop_excess(self, turn: Turn, *, is_current: bool) -> None:
        """Stop a box that does not follow; ``is_current``: the limit has not changed.

        Raises NotConfirmedError, or SupersededError where a newer order came.
        """
        status = self.status
        if status is None:
            message = f"{self.config.name} did not reply to confirm its limit"
            raise NotConfirmedError(message)
        if not is_current:
            message = "a newer limit came first"
            raise SupersededError(message)
        excess = offered(self.known_dialect, status)
        await self._stop(turn, ours=True)
        self._excess = excess
        self.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        message = (
            f"{self.config.name} offers {excess:g} A whatever its limit, and has been "
            "stopped: set MAX in its menu to what may flow, or make it a slave of Home "
            "Assistant (firmware 2.17 as released takes no limit when it is polled)"
        )
        raise NotConfirmedError(message)

    async def _write_current(
        self, turn: Turn, status: Status, wanted: Callable[[], Setpoint]
    ) -> int:
        """Write the override; return the value sent, 0.1 A."""
        dialect = self.known_dialect
        sent: list[int] = []

        def request() -> bytes:
            setpoint = self._override_for(status, wanted())
            if setpoint is None:
                message = f"{self.config.name}: no current may be offered"
                raise RefusedOrderError(message)
            sent.append(tenths(setpoint))
            return write_current(self.config.address, dialect, setpoint)

        answer = await self.write(turn, request, MAPS[dialect].current_register)
        self._written = None if answer is None else sent[-1]
        self._written_at = turn.now
        self._read_back = False
        return sent[-1]

    async def _settle(self, turn: Turn, wanted: Callable[[], Setpoint]) -> None:
        """Read the status until the box follows, or has had the time to.

        A poll or another conversation may come first: one reading is for all.
        """
        needs_quiet = MAPS[self.known_dialect].needs_quiet
        if not needs_quiet and not self._read_back:
            await rest(READ_AGAIN)
        while not self._read_back or self._searches_above(wanted()):
            if (pause := self._rest_of_quiet(turn.now)) > 0:
                await rest(pause)
                continue
            await self.read_status(turn)
            status = self.status
            if status is None or status.raw_state not in CHARGING:
                return
            if needs_quiet:
                continue
            if offered(self.known_dialect, status) == wanted().current:
                return
            await rest(READ_AGAIN)

    def _searches_above(self, setpoint: Setpoint) -> bool:
        """Return whether more is offered only in search of a smallest current."""
        status = self.status
        return (
            self._searches and status is not None and self._is_above(status, setpoint)
        )

    # -- Orders --------------------------------------------------------------------

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        with self.conversing():
            await self._prepare(turn, change)
            if self._wanted(change).paused:
                if self._must_pause(change):
                    ours = orders.allowed is not False
                    await self._stop(turn, ours=ours)
                if change.allowed is True and orders.allowed is not False:
                    # The user has allowed it, and a higher limit will do the rest.
                    self._paused_for_limit = True
                return
            await self._enable(turn, change)

    async def _prepare(self, turn: Turn, change: OrderChange) -> None:
        """Read the present state, except before a pause of the user."""
        await self.reach(turn)
        if change.allowed is False:
            return
        await self.read_status(turn)
        await rest()
        if self.configuration is None:
            # Without its own limits it would get 6 A first.
            await self.read_configuration(turn)

    def _must_pause(self, change: OrderChange) -> bool:
        """Return whether to send a pause: always where the user has just paused."""
        return change.allowed is False or (
            self.status is None or not is_stopped(self.known_dialect, self.status)
        )

    def _wanted(self, change: OrderChange) -> Setpoint:
        return clamp(self.order_to_send(change), self.limits)

    async def _enable(self, turn: Turn, change: OrderChange) -> None:
        """Make the box follow orders with which a car may charge."""

        def wanted() -> Setpoint:
            return self._wanted(change)

        await self._follow(turn, wanted)
        await rest()
        if not self._may_start(change):
            return

        def still_wanted() -> bool:
            # A pause that came meanwhile has a conversation of its own.
            return not (wanted().paused or self._shutting_down)

        await self.set_access(turn, allowed=True, still_wanted=still_wanted)
        self._paused_for_limit = False
        self._excess = None

    def _may_start(self, change: OrderChange) -> bool:
        """Return whether access is to be turned on.

        A start by the user turns it on; a limit only restores access that a limit of
        0 A has turned off.
        """
        if change.allowed is True:
            return True
        status = self.status
        if not self._paused_for_limit or status is None or status.access is not False:
            return False
        wanted = self._wanted(change)
        return not wanted.paused and wanted.current >= (self._excess or 0.0)

    # -- Commands ------------------------------------------------------------------

    @override
    async def command(
        self, command: Command, value: bool | int | str | None = None
    ) -> None:
        if command is not Command.SET_MODE:
            await super().command(command, value)
            return
        conversation = mode_conversation(self, value)
        await self.run(conversation, persistence=Persistence.REPEATABLE)

    @override
    async def on_shutdown(self, *, removed: bool = False) -> None:
        if removed or not self.config.stop_on_shutdown:
            return
        # A start that is half done must not end after this.
        self._shutting_down = True
        await self.run(
            partial(self.set_access, allowed=False),
            persistence=Persistence.STANDING,
            kind=Kind.PAUSE,
        )
