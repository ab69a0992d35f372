"""Permission to charge: order ``sl`` 6 pauses a charge, order ``sl`` 3 starts one.

In the wrong state either does harm: a second 6 unlocks the cable, and a 3 without a
waiting car starts the next one that comes. So each is sent right after an ``rc``, in
the same turn, and only in its states (`states.RULES`); a 6 is repeated only after the
port has had time to follow; and after a lost reply the next status decides.

By its status alone, a pause of ours could also be one of the car, or the end of a
charge. `PauseTracker` follows which it is, by the orders sent and the status since.
"""

from collections.abc import Callable
from enum import Enum
from math import inf
from typing import Final

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
from .port import BoxPort
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
    RUNNING,
    SEARCHING,
    STARTING,
    WAITING,
    StartStop,
)
from .wire.status import PortStatus, StartRelease

SENDS: Final = 2
"""How often an order is sent at most in one conversation."""
_CHARGING: Final = frozenset({CHARGING, CHARGING_OPTIMISED})
_NO_CAR_WAITS: Final = frozenset({FREE, SEARCHING, ENDED, ABORTED, BLOCKED})
"""There is nothing to start: permission is given without an order."""


class Pause(Enum):
    """Whether the port is in a pause that we have ordered."""

    NONE = "none"
    POSSIBLE = "possible"
    OURS = "ours"


class PauseTracker:
    """Follows whether a pause of ours stands at a port.

    | Event                                                | `pause` after it         |
    | ---------------------------------------------------- | ------------------------ |
    | The tracker starts: an earlier run may have paused   | POSSIBLE                 |
    | Order 6 is sent                                      | POSSIBLE                 |
    | It is confirmed, or followed after a lost reply      | OURS                     |
    | It is refused                                        | NONE                     |
    | A status that is no pause, or an unlocked plug       | NONE                     |
    | Order 3 is confirmed, or refused: the charge is over | NONE                     |
    | A command stops the charge or unlocks the plug       | NONE                     |
    | The session counters go back, or the box restarts    | POSSIBLE, if it was OURS |
    """

    def __init__(self) -> None:
        """Start without knowledge of earlier runs.

        The stored orders do not help: the one that led to a pause may be replaced.
        """
        self.pause = Pause.POSSIBLE
        self.for_current = False
        """Only a limit of 0 A demands it: a higher one ends it."""
        self._sent_at = -inf
        self._last: PortStatus | None = None
        """The last status in which a pause of ours may have stood."""

    @property
    def was_sent(self) -> bool:
        """Return whether order 6 was sent, and not taken back by order 3."""
        return self._sent_at > -inf

    def is_settling(self, now: float) -> bool:
        """Return whether the port may not have followed order 6 yet."""
        return now < self._sent_at + SETTLING

    def on_sent(self, status: PortStatus, now: float) -> None:
        """Take note that order 6 is sent, in this status."""
        self.pause = Pause.POSSIBLE
        self._sent_at = now
        self._last = status

    def on_started(self) -> None:
        """Take note that order 3 was confirmed."""
        self.pause = Pause.NONE
        self._sent_at = -inf

    def end(self) -> None:
        """Take note that the pause is over."""
        self.pause = Pause.NONE
        self.for_current = False

    def doubt(self) -> None:
        """Take note that the pause may be over; a higher limit no longer ends it."""
        if self.pause is Pause.OURS:
            self.pause = Pause.POSSIBLE
        self.for_current = False

    def on_status(self, status: PortStatus, now: float, *, has_lock: bool) -> None:
        """Check by a status whether the pause still stands.

        ``now``: loop time, s. ``has_lock``: the port is known to lock its plugs.
        """
        if self.pause is Pause.NONE:
            # The car goes on, or has left: a higher limit must not start the next one.
            self.for_current = False
            return
        before, self._last = self._last, status
        unlocked = _was_unlocked(before, status) or (has_lock and _is_free(status))
        is_pause = status.state in AFTER_OUR_PAUSE and not unlocked
        is_settling = status.state in _CHARGING and self.is_settling(now)
        if not is_pause and not is_settling:
            self.end()
        elif _counters_went_back(before, status):
            # Another charge, or a box whose counters restart with a pause, where a
            # second order 6 would unlock.
            self.doubt()


def _waits_for_start(status: PortStatus) -> bool:
    return status.state == WAITING and status.start is not StartRelease.RELEASED


def _was_unlocked(before: PortStatus | None, status: PortStatus) -> bool:
    return before is not None and bool(before.locked) and status.locked is False


def _is_free(status: PortStatus) -> bool:
    return status.state == ENDED and status.locked is False


def _counters_went_back(before: PortStatus | None, status: PortStatus) -> bool:
    return before is not None and (
        status.session_time < before.session_time
        or status.session_energy < before.session_energy
    )


class Permission:
    """Pauses and starts the charges of one port, and follows whose pause it is in."""

    def __init__(self, port: BoxPort) -> None:
        """Take the port that sends."""
        self._port = port
        self._tracker = PauseTracker()
        self._started_at = -inf
        self._withheld_in: int | None = None
        """The state in which the user allowed a car that waits, with a limit too low
        for it: 0x30, or 0xF0 while the box starts."""

    # -- State -----------------------------------------------------------------------

    @property
    def pause_state(self) -> Pause:
        """Return whether a pause of ours stands."""
        return self._tracker.pause

    @property
    def waits_for_current(self) -> bool:
        """Return whether only the limit is too low: a higher one lets the car charge."""
        return self._tracker.for_current or self._withheld_in is not None

    def has_ended(self, status: PortStatus) -> bool:
        """Return whether only plugging in anew lets a car charge again."""
        return status.state == ABORTED or (
            status.state == ENDED and self._tracker.pause is Pause.NONE
        )

    def on_status(self, status: PortStatus) -> None:
        """Check by a status whether our pause still stands, or a start is withheld."""
        still_starts = self._withheld_in == status.state == STARTING
        if self._withheld_in is not None and not still_starts:
            self._withheld_in = WAITING if _waits_for_start(status) else None
        installation = self._port.box.installation
        has_lock = installation is not None and installation.fixed_cable is False
        self._tracker.on_status(status, self._port.now, has_lock=has_lock)

    def forget(self) -> None:
        """Take note that a command has stopped the charge or unlocked the plug."""
        self._tracker.end()
        self._withheld_in = None

    def doubt(self) -> None:
        """Take note that the box has restarted: our pause may be over."""
        self._tracker.doubt()
        self._withheld_in = None

    def on_lost(self) -> None:
        """Take note that the port is out of sight: another car may come unnoticed."""
        self._withheld_in = None

    def adopt_pause(self) -> None:
        """Take note that the pause of a ceiling in an earlier run is proved to stand."""
        tracker = self._tracker
        if tracker.pause is Pause.POSSIBLE:
            tracker.pause = Pause.OURS
            tracker.for_current = True

    def withhold_start(self) -> None:
        """Take note that the user allows a charge for which the limit is too low."""
        status = self._port.last_status
        if status is None:
            return
        tracker = self._tracker
        if _waits_for_start(status) or status.state == STARTING:
            self._withheld_in = status.state
        elif tracker.pause is not Pause.NONE and status.state in AFTER_OUR_PAUSE:
            tracker.for_current = True

    def is_paused(self, status: PortStatus) -> bool | None:
        """Return whether the port is in our pause; ``None``: it may be."""
        if self._tracker.pause is Pause.POSSIBLE:
            return None
        return self._tracker.pause is Pause.OURS and status.state in AFTER_OUR_PAUSE

    def is_session(self, status: PortStatus, *, before: bool) -> bool:
        """Return whether a charge is under way, pauses of ours included.

        ``before``: whether it was by the status before this one.
        """
        if status.state in RUNNING or self.is_paused(status):
            return True
        is_starting = self._port.now < self._started_at + SETTLING
        may_go_on = self._tracker.pause is Pause.POSSIBLE or is_starting
        return before and status.state in AFTER_OUR_PAUSE and may_go_on

    def must_pause(self, setpoint: Setpoint) -> bool:
        """Return whether a car charges, or may at any moment, against the orders."""
        status = self._port.last_status
        return setpoint.paused and status is not None and self._can_pause(status)

    def may_start(self, change: OrderChange) -> bool:
        """Return whether a change of the orders may start a car.

        The user's permission may. A limit may only end the pause that a lower one has
        begun, or start the car that the user allowed meanwhile.
        """
        if change.allowed is True:
            return True
        sets_limit = change.current is not None or any(
            phase is not None for phase in change.phases
        )
        return sets_limit and self.waits_for_current

    def _can_pause(self, status: PortStatus) -> bool:
        """Return whether order 6 would pause a charge here, and not unlock.

        A paused one (0x42, 0x43) only where the pause is the car's for certain.
        """
        if status.state in _CHARGING:
            return True
        return status.state in RUNNING and self._tracker.pause is Pause.NONE

    async def _read_status(self, turn: Turn) -> PortStatus:
        await self._port.ready(turn)
        return await self._port.read_fresh_status(turn)

    # -- Pausing ---------------------------------------------------------------------

    async def pause(self, turn: Turn, *, for_current: bool) -> None:
        """Pause a charge under way; its cable stays locked.

        ``for_current``: charging is allowed, and only the limit is too low for it.
        Raises NotConfirmedError when the charge goes on, EwsRefusedError, and what
        `BoxPort.read_status` raises.
        """
        tracker = self._tracker
        if not for_current:
            tracker.for_current = False
            self._withheld_in = None
        sends = 0
        status = await self._read_status(turn)
        while self._can_pause(status):
            if not tracker.is_settling(turn.now):
                if sends == SENDS:
                    self._port.notice(Fault.LIMIT_NOT_TAKEN, present=True)
                    message = f"{self._port.config.name} does not pause"
                    raise NotConfirmedError(message)
                sends += 1
                await self._send_pause(turn, status)
            await rest(LOOK_AGAIN)
            status = await self._read_status(turn)
        has_followed = status.state in AFTER_OUR_PAUSE
        if sends and has_followed and tracker.pause is Pause.POSSIBLE:
            # The reply was lost, but not the order.
            tracker.pause = Pause.OURS
        if for_current and tracker.was_sent and tracker.pause is not Pause.NONE:
            tracker.for_current = has_followed

    async def _send_pause(self, turn: Turn, status: PortStatus) -> None:
        """Send order 6, unless an info record comes first.

        Then, and after a lost reply, the next status decides.
        """
        port, tracker = self._port, self._tracker

        def request() -> Request:
            tracker.on_sent(status, turn.now)
            return start_stop(port.number, StartStop.PAUSE, status)

        try:
            confirmed = await port.send_order(turn, request)
        except SupersededError:
            return
        except EwsRefusedError:
            tracker.pause = Pause.NONE
            port.notice(Fault.LIMIT_NOT_TAKEN, present=True)
            raise
        if confirmed:
            tracker.pause = Pause.OURS

    # -- Starting --------------------------------------------------------------------

    async def start(
        self, turn: Turn, is_wanted: Callable[[], bool], *, for_current: bool
    ) -> None:
        """Start the car that waits, or end our pause; without either, do nothing.

        ``is_wanted`` is called right before each order. ``for_current``: only a limit
        demands it, for the car that a lower limit has paused or kept from its start.
        Raises NotAvailableError in a state in which nothing can be started,
        NotConfirmedError when the charge does not start or is aborted at once,
        EwsRefusedError, SupersededError, and what `BoxPort.read_status` raises.
        """
        patience = turn.now + READY_PATIENCE
        sent_at: float | None = None
        sends = 0
        while True:
            status = await self._read_status(turn)
            settled = sent_at is None or turn.now >= sent_at + SETTLING
            if self._has_started(status, settled=settled):
                break
            if status.state == STARTING:
                await self._wait_for_boot(turn, patience)
            elif not settled:
                await rest(LOOK_AGAIN)
            elif sends == SENDS:
                message = f"{self._port.config.name} does not start"
                raise NotConfirmedError(message)
            elif self._is_needless(status, sent=sends > 0, for_current=for_current):
                break
            elif await self._send_start(turn, status, is_wanted):
                sent_at = turn.now
                sends += 1
                await rest(LOOK_AGAIN)
            else:
                sent_at = None
                await self._wait_for_boot(turn, patience)
        self._tracker.for_current = False
        self._withheld_in = None

    def _has_started(self, status: PortStatus, *, settled: bool) -> bool:
        tracker = self._tracker
        if status.state in _CHARGING and not tracker.is_settling(self._port.now):
            return True
        if status.state in RUNNING and tracker.pause is Pause.NONE:
            return True
        # Released: the plug is locked, then the car has to begin.
        released = status.start is StartRelease.RELEASED
        return settled and released and status.state == WAITING

    def _is_needless(
        self, status: PortStatus, *, sent: bool, for_current: bool
    ) -> bool:
        """Return whether there is nothing to start.

        ``sent``: order 3 was sent. Raises NotConfirmedError where the box has aborted
        the charge since.
        """
        if sent and status.state == ABORTED:
            message = f"{self._port.config.name}: the box has aborted the charge"
            raise NotConfirmedError(message)
        if for_current and not self.waits_for_current:
            return True
        may_be_paused = (
            self._tracker.pause is not Pause.NONE and status.state in AFTER_OUR_PAUSE
        )
        return status.state in _NO_CAR_WAITS and not may_be_paused

    async def _wait_for_boot(self, turn: Turn, until: float) -> None:
        if turn.now >= until:
            message = f"{self._port.config.name} is still starting up"
            raise NotAvailableError(message, f"ews_{Refusal.NOT_READY}")
        await rest(READY_PAUSE)

    async def _send_start(
        self, turn: Turn, status: PortStatus, is_wanted: Callable[[], bool]
    ) -> bool:
        """Send order 3; return False where the box is not ready for it yet.

        After a lost reply the next status decides.
        """
        port, tracker = self._port, self._tracker

        def request() -> Request:
            if not is_wanted():
                raise SupersededError("a newer command came first")
            paused = tracker.pause is not Pause.NONE
            return start_stop(port.number, StartStop.START, status, paused=paused)

        try:
            await port.box.send_command(turn, CommandId.START_STOP, request)
        except ReplyTimeoutError:
            return True
        except EwsRefusedError as error:
            if error.reason is Refusal.NOT_READY:
                return False
            if error.reason is Refusal.WAITING_FOR_UNPLUG:
                tracker.end()
            raise
        tracker.on_started()
        self._started_at = turn.now
        return True
