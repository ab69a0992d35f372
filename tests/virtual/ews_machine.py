"""The state machine of a charging port of a virtual EWS-Box. No wire.

Statuses: manual, `rc`. Transitions: manual, 2.2, 3.1.4 to 3.1.8 and 5; the README lists
the assumptions for the others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from .ews_lock import Contactor, LockMotor, Unlocking
from .ews_session import Result, Session
from .ews_states import Installation, PortHistory, Status

if TYPE_CHECKING:
    from collections.abc import Callable

    from .car import Car

MODE1_CURRENT = 16
STEPS = 8


class PortMachine:
    """Cable, car, lock and contactor, and the status that follows from them."""

    def __init__(self, number: int, car: Car | None = None) -> None:
        """Make a port without a car."""
        self.number = number
        self.car = car
        self.installation = Installation()
        self.lock = LockMotor()
        self.relay = Contactor()
        self.session = Session()
        self.history = PortHistory()
        self.status = Status.NOT_CONNECTED
        self.cable: int | None = 32
        self.cable_must_match = False
        self.limit = 0
        self.optimised = False
        self.start_mode = 0
        self.rcd_tripped = self.meter_broken = self.wants_fan = False
        self.pause_status: Literal[0x50, 0x42] = 0x50
        self.search_time = 0.3
        # Totals that the next answers report in place of the meter's: it fails.
        self.meter_reads: list[float] = []
        self.server_paused = False
        self.cable_in = False
        self.on_event: Callable[[], None] = lambda: None
        self.clock: Callable[[], tuple[int, ...]] = lambda: (0,) * 6
        self._now = 0.0
        self._loose_cable = False
        self._seen_since: float | None = None
        self._starting = False
        self._after_unlock = Status.ENDED
        self._after_rcd: int | None = None
        self._init_until: float | None = None
        self._restart = False

    @property
    def contactor(self) -> bool:
        """Return whether the car has voltage."""
        return self.relay.closed

    @property
    def ceiling(self) -> int:
        """Return min(jumper, installation, cable): the highest limit for `st`, A."""
        installation = self.installation
        if installation.mode1:
            return MODE1_CURRENT
        values = [installation.jumper, installation.limit or installation.jumper]
        if self.cable_in and not installation.fixed_cable and self.cable:
            values.append(self.cable)
        return min(values)

    @property
    def offered(self) -> int:
        """Return the highest current the box delivers now, A."""
        return min(self.ceiling, self.limit or self.ceiling)

    @property
    def pilot(self) -> bool:
        """Return whether a car is detected on the pilot."""
        return self.car is not None and self.car.plugged and self.cable_in

    @property
    def active(self) -> bool:
        """Return whether a charge is going on, pauses of the car included."""
        return self.status in Status.ACTIVE and not self.server_paused

    @property
    def in_use(self) -> bool:
        """Return whether it blocks the other port in exclusive mode."""
        return self.status not in {0x00, 0x10, Status.BLOCKED, Status.INIT}

    @property
    def has_lock(self) -> bool:
        """Return whether it has a lock."""
        return not (self.installation.fixed_cable or self.installation.mode1)

    # Starting and unlocking

    def pull_cable(self) -> bool:
        """Pull the cable at the box; return False if it is locked."""
        if self.lock.locked or self.lock.moving:
            return False
        self.cable_in = self._loose_cable = False
        return True

    def release_start(self, cause: str) -> None:
        """Start, or let the next car start."""
        if self.active:
            return
        self.start_mode = 2
        self._cause = cause
        self.relay.forget_toggles()
        if self.server_paused or self.status in Status.IDLE:
            self._begin()

    def unlock(self, reason: str) -> None:
        """Open the lock, unless the contactor is closed."""
        self.server_paused = False
        if self.status in Status.ACTIVE and not self.contactor:
            # Until now it may have been shown as a pause; now the charge is over.
            self._go(Status.ENDED)
        engaged = self.lock.locked or self.lock.target
        if self.has_lock and engaged and not self.contactor:
            self.lock.drive(locked=False, now=self._now, reason=reason)

    # Time

    _cause = ""

    def step(self, now: float) -> None:
        """Advance to this time."""
        self._now = now
        ended = self.lock.step(now)
        self._cable_moves()
        if ended:
            self._lock_ended(ended)
        for _ in range(STEPS):
            before = self.status, self._starting
            self._transition()
            if (self.status, self._starting) == before:
                break
        self._draw(now)

    def _cable_moves(self) -> None:
        plugged = self.car is not None and self.car.plugged
        comes = plugged and not self.cable_in and not self._loose_cable
        if self.installation.fixed_cable or comes:
            self.cable_in = True
        elif self.cable_in and not plugged and not self._loose_cable:
            # The driver has unplugged the car and waits for the lock.
            self.pull_cable()
        if not self.pilot:
            self._seen_since = None
        elif self._seen_since is None:
            self._seen_since = self._now

    def _lock_ended(self, how: str) -> None:
        if how == "unlocked":
            self._unlocked(self.lock.reason)
        if self.status == Status.INIT:
            return
        if how == "locked" and self._starting:
            self._starting = False
            self._enter_charging()
        elif how == "failed" and not self.lock.locked:
            self._starting = False
            self.start_mode = 0
            self._go(Status.LOCK_ERROR)
        elif how == "failed":
            self._after_unlock = (
                self.status if self.status in Status.OVER else Status.ENDED
            )
            self._go(Status.UNLOCK_ERROR)

    def _unlocked(self, reason: str) -> None:
        wants = self.car is not None and self.car.plugged and self.car.requesting
        self.history.unlockings.append(Unlocking(self._now, reason, wants))
        self.history.unlocked_under_power += self.contactor

    def _transition(self) -> None:
        status = self.status
        if self._init_until is not None:
            self._initialising()
        elif not self.installation.enabled:
            self._go(Status.NOT_CONNECTED)
        elif self.rcd_tripped != (status == Status.RCD):
            self._rcd_changed()
        elif self.active:
            self._charging()
        elif status in Status.IDLE:
            self._idle()
        elif status != Status.RCD:
            self._over_or_stuck()
        elif self.relay.closed and self.relay.open():
            self.unlock("RCD")

    def _over_or_stuck(self) -> None:
        if self.status == Status.CONTACTOR_OFF_ERROR:
            if self.relay.open():
                self._end(Status.ABORTED, self.session.result, "contactor")
        elif not self.cable_in:
            self._gone(Status.NOT_CONNECTED)
        elif self.installation.fixed_cable and not self.pilot:
            self._gone(Status.SEARCHING)
        elif self.server_paused and not self._starting and not self.pilot:
            # The car has left: the driver takes the cable.
            self._end(Status.ENDED, Result.PILOT_LOST, "pilot lost")

    def _initialising(self) -> None:
        opened = self.relay.open()
        if self._init_until is None or self._now < self._init_until:
            return
        self._init_until = None
        if not opened:
            self._restart = False
            self._go(Status.CONTACTOR_OFF_ERROR)
            return
        self._go(Status.NOT_CONNECTED)
        if self._restart and self.cable_in:
            self.release_start("power failure")
        self._restart = False

    def _rcd_changed(self) -> None:
        if self.rcd_tripped:
            was_over = self.status in Status.OVER
            self._after_rcd = self.status if was_over else None
            if self.active or self._starting:
                self._starting = False
                self._end(Status.ABORTED, Result.RCD, "RCD")
                self._after_rcd = Status.ABORTED
            self.server_paused = False
            self.start_mode = 0
            self._go(Status.RCD)
        else:
            after = self._after_rcd or Status.NOT_CONNECTED
            self._go(Status.CONTACTOR_OFF_ERROR if self.contactor else after)

    def _idle(self) -> None:
        status = self._idle_status()
        fixed = self.installation.fixed_cable
        rest = Status.SEARCHING if fixed else Status.NOT_CONNECTED
        was_there = {Status.WAITING} if fixed else Status.PLUGGED
        if status == rest and self.status in was_there:
            self._gone(status)
        self._go(status)
        if status != Status.WAITING:
            self._starting = False
        elif self.start_mode == 2 and not self._starting:
            self._begin()

    def _idle_status(self) -> int:
        """Return the first status whose condition holds."""
        installation = self.installation
        since = self._now if self._seen_since is None else self._seen_since
        seen = self._seen_since is not None and self._now - since >= self.search_time
        for holds, status in (
            (installation.config_error, Status.CONFIG_ERROR),
            (installation.reader_missing, Status.NO_READER),
            (installation.blocked, Status.BLOCKED),
            (not self.cable_in, Status.NOT_CONNECTED),
            (not self._cable_fits(), Status.CABLE_ERROR),
            (not (seen or installation.mode1), Status.SEARCHING),
        ):
            if holds:
                return status
        return Status.WAITING

    def _cable_fits(self) -> bool:
        if self.installation.fixed_cable or self.installation.mode1:
            return True
        if not self.cable:
            return False
        nominal = self.installation.limit or self.installation.jumper
        least = min(nominal, self.installation.jumper) if self.cable_must_match else 6
        return self.cable >= least

    def _begin(self) -> None:
        """Begin a start that was released: ventilation, lock, contactor."""
        if self.status != Status.WAITING and not self.server_paused:
            return
        if self.wants_fan and not self.installation.fan:
            self._end(Status.ABORTED, Result.NO_FAN, "no ventilation")
        elif not self.has_lock or (self.lock.locked and not self.lock.moving):
            self._enter_charging()
        elif not self._starting:
            self._starting = True
            self.lock.drive(locked=True, now=self._now, reason="start")

    def _enter_charging(self) -> None:
        self.history.starts.append((self._now, self._cause))
        self.session.start(resumed=self.server_paused)
        self.server_paused = False
        self._go(Status.PAUSE + self.optimised)

    def _charging(self) -> None:
        problem = self._problem()
        if problem is not None:
            self._end(*problem)
            return
        if self._car_ready():
            if not self.relay.close(self._now):
                self._end(Status.CONTACTOR_ON_ERROR, Result.NONE, "contactor")
            elif self.relay.toggled_too_often(self._now):
                self._end(Status.ABORTED, Result.UNSTABLE, "unstable pilot")
            else:
                self._go(Status.CHARGING + self.optimised)
        elif self._open_contactor():
            self._go(Status.PAUSE + self.optimised)

    def _problem(self) -> tuple[int, int, str] | None:
        if not self.cable_in:
            return Status.ABORTED, Result.CABLE_LOST, "cable lost"
        if not self.pilot and not self.installation.mode1:
            return Status.ENDED, Result.PILOT_LOST, "pilot lost"
        if self.meter_broken:
            return Status.ABORTED, Result.METER, "meter"
        if self.wants_fan and not self.installation.fan:
            return Status.ABORTED, Result.NO_FAN, "no ventilation"
        return None

    def _car_ready(self) -> bool:
        if self.car is None:
            return False
        if self.installation.mode1:
            return self.car.plugged
        return self.car.accepts(self.offered)

    def _open_contactor(self) -> bool:
        if self.relay.open():
            return True
        self._go(Status.CONTACTOR_OFF_ERROR)
        return False

    def _end(self, status: int, result: int, reason: str) -> None:
        """End the charge: contactor off, then the lock."""
        self._over(result)
        self.start_mode = 0
        self.server_paused = False
        if self._open_contactor():
            self._go(status)
            self.unlock(reason)

    def _over(self, result: int) -> None:
        if not self.server_paused:
            self.session.end(result, self.clock())
            self.on_event()
        elif result == Result.PILOT_LOST:
            self.session.result = result

    def _gone(self, status: int) -> None:
        """Drop all state of the car that left."""
        self.start_mode = 0
        self.server_paused = self._starting = self.optimised = False
        self.session.gone()
        self._go(status)

    def _go(self, status: int) -> None:
        if status != self.status:
            self.status = status
            self.history.statuses.append((self._now, status))

    def _draw(self, now: float) -> None:
        offered = self.offered if self.contactor else None
        wh = 0.0
        if self.car is not None:
            wh = self.car.step(now, offered)
            self.history.highest_draw = max(
                self.history.highest_draw, *self.car.phase_currents
            )
        if self.contactor:
            self.history.highest_offer = max(self.history.highest_offer, self.offered)
        self.session.live(now, wh, active=self.active)
