"""One SmartEVSE that is polled: without load balancing, or its own master.

It is read first, always. Its limit is an override of the box's own maximum: forgotten
in a power failure, taken off by a 0, and in force only while a car charges. So it is
written ahead for the car that comes, read back while it charges, and asserted downward
whenever it is read back above the order. 0 A is never written: a pause is access off.
PROTOCOLS.md, 3.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Final, override

from ..conversation import rest
from ..errors import (
    NotConfirmedError,
    RefusedOrderError,
    SupersededError,
)
from ..exchange import Turn
from ..model import (
    MINIMUM_CURRENT,
    Command,
    CurrentLimit,
    Fault,
    OrderChange,
    Orders,
    Persistence,
)
from ..safety import Setpoint, clamp
from .box import WRITES
from .config import PolledConfig
from .dialects import MAPS, Dialect, Status
from .mode import mode_conversation
from .polled import PolledBox
from .registers import tenths, write_current
from .states import CHARGING, is_stopped, offered, state_of, tells_plug
from .timing import LOOK_AGAIN, SETTLING

_NOTHING_NEW: Final = OrderChange()
_LOWEST: Final = Orders(limit=CurrentLimit(current=MINIMUM_CURRENT))


class PolledSmartEvse(PolledBox):
    """One SmartEVSE that is polled."""

    def __init__(self, config: PolledConfig, orders: Orders) -> None:
        """Take the set-up; the box is not known before it answers."""
        super().__init__(config, orders)
        self._written: int | None = None
        """The override it has of us, 0.1 A; ``None``: not known."""
        self._confirmed: int | None = None
        """The set-point within which it was read back to charge, 0.1 A."""
        self._fell_back = False
        self._looked_at = 0.0
        self._limit_paused = False
        """Our own 0 A has turned its access off; a higher limit gives it back."""
        self._defied: float | None = None
        """What it offered whatever it was told, A: access was turned off for that."""

    @property
    @override
    def waits_for_current(self) -> bool:
        return self._limit_paused

    @override
    def forget(self) -> None:
        super().forget()
        self._written = None

    @override
    def on_missed(self, now: float) -> None:
        super().on_missed(now)
        # It may have been switched off and on again.
        self._written = None

    # -- What it says ----------------------------------------------------------------

    @override
    def take(self, status: Status, now: float) -> None:
        before = self.status
        if before is not None and before.maximum and status.maximum is None:
            # Only a restart forgets the cable.
            self._written = None
        super().take(status, now)
        self._looked_at = now
        charging = status.raw_state in CHARGING
        within = charging and not self._is_above(status)
        setpoint = tenths(self.setpoint)
        if charging and not within:
            # Offered more than it had already obeyed.
            self._fell_back = self._confirmed == setpoint
        self._confirmed = setpoint if within else None
        if status.access and not self.setpoint.paused:
            # Somebody has opened it: what was to be given back is given back.
            self._limit_paused = False
            self._defied = None
        settled = self._defied is None and not self._must_stop()
        if settled and (within or not charging):
            self.notice(Fault.LIMIT_NOT_TAKEN, present=False)

    def _is_above(self, status: Status, setpoint: Setpoint | None = None) -> bool:
        """Return whether more is offered than may be; ahead of a car it is not."""
        wanted = self.setpoint if setpoint is None else setpoint
        current = offered(self.known_dialect, status)
        return current is not None and current > wanted.current

    # -- What must be so ---------------------------------------------------------------

    @override
    def must_maintain(self, now: float) -> bool:
        return (
            super().must_maintain(now)
            or self._must_stop()
            or self._must_write()
            or self._may_start(_NOTHING_NEW)
        )

    @override
    async def maintain(self, turn: Turn) -> None:
        await self._stop_if_need_be(turn)
        if turn.now >= self.configuration_due:
            # Once in a while the override is written anew: a short failure of its
            # power may have passed unseen.
            self._written = None
        await super().maintain(turn)
        # What it may offer is known only now.
        await self._stop_if_need_be(turn)
        if self._must_write():
            await self._follow(turn, lambda: self.setpoint)
        if self._may_start(_NOTHING_NEW):
            # What took its current away was no order: installation, settings, time.
            await self._allow(turn, _NOTHING_NEW)

    async def _stop_if_need_be(self, turn: Turn) -> None:
        if self._must_stop():
            ours = self.effective_orders.allowed is not False
            await self._stop(turn, ours=ours)
            await rest(0.0)

    def _must_stop(self) -> bool:
        """Return whether a car may charge that must not."""
        if self.status is None or not self.setpoint.paused:
            return False
        return not is_stopped(self.known_dialect, self.status)

    async def _stop(self, turn: Turn, *, ours: bool) -> None:
        """Turn access off; what our own limit takes away it may give back."""
        had_access = self.status is None or self.status.access
        try:
            await self.set_access(turn, allowed=False)
        except NotConfirmedError:
            self.notice(Fault.LIMIT_NOT_TAKEN, present=True)
            raise
        self._limit_paused = ours and (had_access or self._limit_paused)
        if not ours:
            self._defied = None
            self.notice(Fault.LIMIT_NOT_TAKEN, present=False)

    def _must_write(self) -> bool:
        status = self.status
        if status is None:
            return False
        ahead = self._ahead(status, self.setpoint)
        if ahead is None:
            return False
        if status.raw_state in CHARGING and self._is_above(status, ahead):
            return True
        return self._written != tenths(ahead)

    def _ahead(self, status: Status, setpoint: Setpoint) -> Setpoint | None:
        """Return what the override should be now; ``None``: cannot be said.

        The cable of the car that comes is not known before it is there, and the
        override counts more than the box's own knowledge of it: 6 A until then.
        """
        dialect = self.known_dialect
        plugged = (
            tells_plug(dialect, status) and state_of(dialect, status.raw_state).plugged
        )
        if plugged and not setpoint.paused:
            return setpoint
        limits = replace(self.limits, reported=MINIMUM_CURRENT, minimum=MINIMUM_CURRENT)
        lowest = clamp(_LOWEST, limits)
        return None if lowest.paused else lowest

    # -- The current -----------------------------------------------------------------

    async def _follow(self, turn: Turn, wanted: Callable[[], Setpoint]) -> None:
        """Write the override; while a car charges, until it is read back.

        A box that goes on offering more is stopped: a limit is a promise. Raises
        NotConfirmedError then.
        """
        told = None
        for _ in range(WRITES):
            await self.reach(turn)
            status = self.status
            if status is None:
                continue
            if self._fell_back:
                self.statistics.reasserted += 1
                self._fell_back = False
            told = await self._write_current(turn, status, wanted)
            if status.raw_state not in CHARGING:
                return
            if self.known_dialect is not Dialect.LATER:
                await rest(LOOK_AGAIN)
            await self._settle(turn, wanted)
            status = self.status
            setpoint = wanted()
            if (
                status is None
                or status.raw_state not in CHARGING
                or setpoint.paused
                or not self._is_above(status, setpoint)
            ):
                return
            await rest(0.0)
        await self._give_up(turn, judged=told == tenths(wanted()))

    async def _give_up(self, turn: Turn, *, judged: bool) -> None:
        """Stop a box that does not follow; ``judged``: it had its time.

        Raises NotConfirmedError, or SupersededError where a newer order came.
        """
        status = self.status
        if status is None:
            message = f"{self.config.name} has not told whether it follows its limit"
            raise NotConfirmedError(message)
        if not judged:
            message = "a newer limit came first"
            raise SupersededError(message)
        offers = offered(self.known_dialect, status)
        await self._stop(turn, ours=True)
        self._defied = offers
        self.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        message = (
            f"{self.config.name} offers {offers:g} A whatever it is told, and has been "
            "stopped: set MAX in its menu to what may flow, or make it a slave of Home "
            "Assistant (firmware 2.17 as released takes no limit when it is polled)"
        )
        raise NotConfirmedError(message)

    async def _write_current(
        self, turn: Turn, status: Status, wanted: Callable[[], Setpoint]
    ) -> int:
        """Write the override; return what was sent, 0.1 A."""
        dialect = self.known_dialect
        sent: list[int] = []

        def request() -> bytes:
            setpoint = self._ahead(status, wanted())
            if setpoint is None:
                message = f"{self.config.name}: no current may be offered"
                raise RefusedOrderError(message)
            sent.append(tenths(setpoint))
            return write_current(self.config.address, dialect, setpoint)

        answer = await self.write(turn, request, MAPS[dialect].current_register)
        self._written = None if answer is None else sent[-1]
        return sent[-1]

    async def _settle(self, turn: Turn, wanted: Callable[[], Setpoint]) -> None:
        """Look until the box offers what was written, or had the time to."""
        if self.known_dialect is Dialect.LATER:
            # Looking sooner would keep it from following; a poll may look for us.
            written_at = turn.now
            while self._looked_at < written_at:
                while (pause := self.minimum_pause(turn.now)) > 0:
                    await rest(pause)
                if self._looked_at < written_at:
                    await self.see(turn)
            return
        until = turn.now + SETTLING
        while True:
            await self.see(turn)
            status = self.status
            if (
                turn.now >= until
                or status is None
                or status.raw_state not in CHARGING
                or offered(self.known_dialect, status) == wanted().current
            ):
                return
            await rest(LOOK_AGAIN)

    # -- Orders ----------------------------------------------------------------------

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        with self.conversing():
            await self._prepare(turn, change)
            if self._wanted(change).paused:
                if self._must_pause(change):
                    ours = orders.allowed is not False
                    await self._stop(turn, ours=ours)
                return
            await self._allow(turn, change)

    async def _prepare(self, turn: Turn, change: OrderChange) -> None:
        """See how the box is now; the user's pause goes out sooner."""
        await self.reach(turn)
        if change.allowed is False:
            return
        await self.see(turn)
        await rest(0.0)
        if self.configuration is None:
            # Without its own limits it would get 6 A first.
            await self.read_configuration(turn)

    def _must_pause(self, change: OrderChange) -> bool:
        """Return whether a pause has to be said: the user's always, at once."""
        return change.allowed is False or (
            self.status is None or not is_stopped(self.known_dialect, self.status)
        )

    def _wanted(self, change: OrderChange) -> Setpoint:
        return clamp(self.order_to_send(change), self.limits)

    async def _allow(self, turn: Turn, change: OrderChange) -> None:
        """Let the box follow orders that let a car charge."""

        def wanted() -> Setpoint:
            return self._wanted(change)

        await self._follow(turn, wanted)
        await rest(0.0)
        if not self._may_start(change):
            return

        def still() -> bool:
            # Not where a pause came meanwhile: that one is on its way.
            return not (wanted().paused or self.leaves)

        await self.set_access(turn, allowed=True, still=still)
        self._limit_paused = False
        self._defied = None

    def _may_start(self, change: OrderChange) -> bool:
        """Return whether access is to be turned on: nobody's change of a limit does.

        The user's word does, and a limit gives back what only a limit of 0 A took.
        """
        if change.allowed is True:
            return True
        if not self._limit_paused or self.status is None or self.status.access:
            return False
        wanted = self._wanted(change)
        return not wanted.paused and wanted.current >= (self._defied or 0.0)

    # -- Commands --------------------------------------------------------------------

    @override
    async def command(
        self, command: Command, value: bool | int | str | None = None
    ) -> None:
        if command is not Command.SET_MODE:
            await super().command(command, value)
            return
        conversation = mode_conversation(self, value)
        await self.run(conversation, persistence=Persistence.REPEATABLE)


__all__ = ["PolledConfig", "PolledSmartEvse"]
