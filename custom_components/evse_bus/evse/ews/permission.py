"""Letting a car charge or not: ``sl`` 6 and ``sl`` 3, each in its states only.

A second 6 unlocks the cable, and a 3 in the wrong state starts whoever comes next. So
each is sent right after an ``rc``, in the same turn of the bus; a 6 is not said again
before the port had the time to follow; and after a lost answer the state decides.
"""

from collections.abc import Callable
from math import inf
from typing import TYPE_CHECKING, Final

from ..conversation import rest
from ..errors import (
    NotAvailableError,
    NotConfirmedError,
    ReplyTimeoutError,
    SupersededError,
)
from ..exchange import Turn
from ..model import Fault, OrderChange
from ..safety import Setpoint
from .readings import RUNNING
from .timing import LOOK_AGAIN, READY_PATIENCE, READY_PAUSE, SETTLING
from .wire.answers import EwsRefusedError, Refusal
from .wire.commands import start_stop
from .wire.frames import CommandId, Request
from .wire.states import (
    ABORTED,
    AFTER_OUR_PAUSE,
    BLOCKED,
    CHARGING,
    CHARGING_OPTIMISED,
    ENDED,
    FREE,
    SEARCHING,
    STARTING,
    WAITING,
    StartStop,
)
from .wire.status import PortStatus, StartRelease

if TYPE_CHECKING:
    from .reader import EwsReader

SENDS: Final = 2
"""How often one order is said at most in one conversation."""
_CHARGING: Final = (CHARGING, CHARGING_OPTIMISED)
_NOTHING_TO_START: Final = (FREE, SEARCHING, ENDED, ABORTED, BLOCKED)
"""No car waits for a start: permission is given, and there is nothing to say."""


class Permission:
    """What a port has been allowed, as far as it is our doing."""

    def __init__(self, port: EwsReader) -> None:
        """Take the port; what an earlier run of ours has paused nobody knows."""
        self._port = port
        # The orders do not tell: what has paused it may be gone from them.
        self.paused: bool | None = None
        """We have paused this charge; ``None``: perhaps (an answer was lost, or it was
        before our time)."""
        self.waits_for_current = False
        """Our own 0 A has paused it: a higher limit lets it go on."""
        self._said_at = -inf
        self._started_at = -inf
        self._was_locked = False
        self._energy = 0
        self._time = 0

    def forget(self) -> None:
        """Note that no pause of ours stands any more: stopped or unlocked."""
        self.paused = False
        self.waits_for_current = False

    def doubt(self) -> None:
        """Note that a pause of ours stands perhaps, and gives nothing back any more."""
        if self.paused:
            self.paused = None
        self.waits_for_current = False

    # -- What is known -------------------------------------------------------------

    def watch(self, seen: PortStatus) -> None:
        """See whether our pause still stands."""
        if self.paused is False:
            # It goes on, or somebody has ended it: whoever comes next did not wait.
            self.waits_for_current = False
            return
        other = seen.session_time < self._time or seen.session_energy < self._energy
        self._time, self._energy = seen.session_time, seen.session_energy
        unlocked = self._was_locked and seen.locked is False
        self._was_locked = bool(seen.locked)
        unlocked |= self._is_free(seen)
        still = seen.status in AFTER_OUR_PAUSE and not unlocked
        # Said a moment ago: it may not have followed yet.
        still |= seen.status in _CHARGING and self._is_settling()
        if not still:
            self.paused = False
            self._was_locked = False
            self.waits_for_current = False
        elif other:
            # Another charge, or counters that begin anew with a pause: a 6 that is
            # said again would unlock.
            self.doubt()

    def _is_free(self, seen: PortStatus) -> bool:
        """Return whether a charge has ended with its plug free: no pause of ours."""
        known = self._port.box.installation
        has_lock = known is not None and known.fixed_cable is False
        return has_lock and seen.status == ENDED and seen.locked is False

    def _is_settling(self) -> bool:
        bus = self._port.bus
        return bus is not None and bus.now < self._said_at + SETTLING

    def is_paused(self, seen: PortStatus) -> bool:
        """Return whether the port stands in our pause."""
        return self.paused is True and seen.status in AFTER_OUR_PAUSE

    def is_session(self, seen: PortStatus, *, was: bool) -> bool:
        """Return whether a charge is under way; in our pause it still is.

        ``was``: it was when we looked last.
        """
        if seen.status in RUNNING or self.is_paused(seen):
            return True
        bus = self._port.bus
        resumes = bus is not None and bus.now < self._started_at + SETTLING
        return (
            was and seen.status in AFTER_OUR_PAUSE and (self.paused is None or resumes)
        )

    def must_pause(self, setpoint: Setpoint) -> bool:
        """Return whether a car charges, or may at any moment, that must not."""
        seen = self._port.seen
        return setpoint.paused and seen is not None and self._runs(seen)

    def _runs(self, seen: PortStatus) -> bool:
        """Return whether order 6 would pause a charge here, and not unlock.

        In 0x42 and 0x43 that is only known where it is no pause of ours.
        """
        if seen.status in _CHARGING:
            return True
        return seen.status in RUNNING and self.paused is False

    # -- Pausing -------------------------------------------------------------------

    async def pause(self, turn: Turn, *, for_current: bool) -> None:
        """Stop a charge under way, and keep the cable locked.

        ``for_current``: only our limit of 0 A wants so. Raises NotConfirmedError when
        it goes on, EwsRefusedError when the box says no, and what `EwsReader.look` raises.
        """
        port = self._port
        sends = 0
        if not for_current:
            self.waits_for_current = False
        while True:
            await port.ready(turn)
            seen = await port.look_now(turn)
            if not self._runs(seen):
                break
            if turn.now >= self._said_at + SETTLING:
                if sends == SENDS:
                    port.notice(Fault.LIMIT_NOT_TAKEN, present=True)
                    message = f"{port.config.name} does not pause"
                    raise NotConfirmedError(message)
                sends += 1
                await self._say_pause(turn, seen)
            await rest(LOOK_AGAIN)
        if sends and self.paused is None and seen.status in AFTER_OUR_PAUSE:
            # The answer was lost, and it has followed.
            self.paused = True
        if for_current and self.paused is not False and self._said_at > -inf:
            self.waits_for_current = seen.status in AFTER_OUR_PAUSE

    async def _say_pause(self, turn: Turn, seen: PortStatus) -> None:
        port = self._port
        changes = port.box.changes

        def request() -> Request:
            if port.box.changes != changes:
                message = f"{port.config.name}: something happens there right now"
                raise SupersededError(message)
            self._said_at = turn.now
            # Until the answer nobody knows.
            self.paused = None
            self._time, self._energy = seen.session_time, seen.session_energy
            self._was_locked = bool(seen.locked)
            return start_stop(port.port, StartStop.PAUSE, seen)

        try:
            await port.box.tell(turn, CommandId.START_STOP, request)
        except SupersededError:
            return
        except ReplyTimeoutError:
            # Perhaps it was heard: the next look tells.
            return
        except EwsRefusedError:
            self.paused = False
            port.notice(Fault.LIMIT_NOT_TAKEN, present=True)
            raise
        self.paused = True

    # -- Starting ------------------------------------------------------------------

    def may_start(self, change: OrderChange) -> bool:
        """Return whether a start is to be said: nobody's change of a limit does.

        The user's word does, and a limit gives back what only a limit of 0 A took.
        """
        if change.allowed is True:
            return True
        asked = change.current is not None or any(
            phase is not None for phase in change.phases
        )
        return asked and self.waits_for_current

    async def start(
        self, turn: Turn, still: Callable[[], bool], *, for_current: bool
    ) -> None:
        """Let the car charge that waits, or that we have paused.

        Where there is nothing to start, nothing is said. ``still`` is asked right
        before each word. ``for_current``: only a limit wants so, for the car that a
        limit has stopped and no other. Raises NotAvailableError in a state in which
        nothing can be started, NotConfirmedError when it does not start or is aborted
        at once, EwsRefusedError, SupersededError, and what `EwsReader.look` raises.
        """
        port = self._port
        patience = turn.now + READY_PATIENCE
        said_at: float | None = None
        sends = 0
        while True:
            await port.ready(turn)
            seen = await port.look_now(turn)
            settled = said_at is None or turn.now >= said_at + SETTLING
            if self._has_started(seen, settled=settled):
                break
            if seen.status == STARTING:
                self._check_patience(turn, patience)
                await rest(READY_PAUSE)
                continue
            if not settled:
                await rest(LOOK_AGAIN)
                continue
            if sends == SENDS:
                message = f"{port.config.name} does not start"
                raise NotConfirmedError(message)
            if self._nobody_waits(seen, said=sends > 0, for_current=for_current):
                break
            said_at, done = await self._say_start(turn, seen, still)
            if done is None:
                self._check_patience(turn, patience)
                said_at = None
                await rest(READY_PAUSE)
                continue
            sends += 1
            await rest(LOOK_AGAIN)
        self.waits_for_current = False

    def _check_patience(self, turn: Turn, until: float) -> None:
        if turn.now >= until:
            message = f"{self._port.config.name} is still starting up"
            raise NotAvailableError(message)

    def _nobody_waits(self, seen: PortStatus, *, said: bool, for_current: bool) -> bool:
        """Return whether there is nothing to start.

        Raises NotConfirmedError where the box has aborted what was ``said`` to start.
        """
        if said and seen.status == ABORTED:
            message = f"{self._port.config.name}: the box has aborted the charge"
            raise NotConfirmedError(message)
        if for_current and not self.waits_for_current:
            return True
        return seen.status in _NOTHING_TO_START and not self._goes_on(seen)

    def _goes_on(self, seen: PortStatus) -> bool:
        """Return whether a charge stands here that we have paused, perhaps."""
        return self.paused is not False and seen.status in AFTER_OUR_PAUSE

    def _has_started(self, seen: PortStatus, *, settled: bool) -> bool:
        if seen.status in _CHARGING and not self._is_settling():
            return True
        if seen.status in RUNNING and self.paused is False:
            return True
        # Released: it locks the plug, and then waits for the car.
        released = seen.start is StartRelease.RELEASED
        return settled and released and seen.status == WAITING

    async def _say_start(
        self, turn: Turn, seen: PortStatus, still: Callable[[], bool]
    ) -> tuple[float, bool | None]:
        """Say it; return when, and whether it was taken (``None``: not ready yet)."""
        port = self._port

        def request() -> Request:
            if not still():
                raise SupersededError("a newer command came first")
            paused = self.paused is not False
            return start_stop(port.port, StartStop.START, seen, paused=paused)

        try:
            await port.box.tell(turn, CommandId.START_STOP, request)
        except ReplyTimeoutError:
            return turn.now, False
        except EwsRefusedError as error:
            if error.reason is Refusal.NOT_READY:
                return turn.now, None
            if error.reason is Refusal.WAITING_FOR_UNPLUG:
                self.paused = False
                self.waits_for_current = False
            raise
        self.paused = False
        self._said_at = -inf
        self._started_at = turn.now
        return turn.now, True
