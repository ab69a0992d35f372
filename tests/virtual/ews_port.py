"""One charging port of a virtual EWS-Box: its orders and events."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .ews_machine import PortMachine
from .ews_session import Result
from .ews_states import Status

if TYPE_CHECKING:
    from .ews_lock import Unlocking


class EwsPort(PortMachine):
    """A port; plain attributes may be set at any time.

    - `cable`: A of the plugged cable (None: not readable); `cable_must_match`: one below
      the installation's current is an error, not a limit
    - `limit`: of `st`; `optimised`; `start_mode`: 0, 1 requested, 2 released
    - `rcd_tripped`, `meter_broken`; `wants_fan`: the car requires ventilation
    - `pause_status`: the status after a stop by `sl` 6, 0x50 or 0x42
    """

    # For tests

    @property
    def locked(self) -> bool:
        """Return whether the plug is locked."""
        return self.lock.locked

    @property
    def unlocked_while_car_wants(self) -> list[Unlocking]:
        """Return the unlockings while the car was requesting charge."""
        return [u for u in self.history.unlockings if u.car_wanted]

    @property
    def currents(self) -> tuple[float, float, float]:
        """Return the car's phase currents, A."""
        return self.car.phase_currents if self.car else (0.0, 0.0, 0.0)

    # Events

    def plug_cable(self) -> None:
        """Plug in a cable without a car at its other end."""
        self.cable_in = self._loose_cable = True

    def tear_cable_out(self) -> None:
        """Pull it by force, also out of a lock."""
        self.cable_in = self._loose_cable = False

    def initialise(self, now: float, duration: float) -> None:
        """Go to 0xF0 for this time (s)."""
        self._now = now
        self._go(Status.INIT)
        self._init_until = now + duration
        self._starting = self.server_paused = False
        self.start_mode = 0
        self.relay.open()

    def power_off(self, now: float, *, restart: bool, mains: bool = True) -> None:
        """Lose the mains: contactor open, lock open, the limit of `st` lost.

        Without `mains` only the processor restarts: the lock stays where it is.
        """
        self._now = now
        self._restart = restart and self.active
        self.relay.open()
        if self.lock.locked and mains and not self.contactor:
            self._unlocked("power failure")
            self.lock.spring_open()
        if self.active:
            self._over(Result.NONE)
        self.limit = 0
        self.start_mode = 0
        self.optimised = False

    # Orders (of the server, a key, a card, the web page)

    def stop(self, reason: str) -> None:
        """End the charge and unlock (`sl` 1, the stop key)."""
        self.start_mode = 0
        self._starting = False
        if self.status in Status.ACTIVE:
            self._end(Status.ENDED, Result.STOPPED, reason)
            return
        if self.status == Status.UNLOCK_ERROR:
            self._go(self._after_unlock)
        self.unlock(reason)

    def pause(self) -> None:
        """End the charge, keep the lock (`sl` 6 while charging)."""
        self.start_mode = 0
        self._over(Result.STOPPED)
        if self._open_contactor():
            self.server_paused = True
            self._go(self.pause_status)

    def lock_manually(self) -> None:
        """Lock (`sl` 7)."""
        if self.has_lock and (not self.lock.locked or self.lock.moving):
            self.lock.drive(locked=True, now=self._now, reason="sl 7")

    def abort(self, result: int, reason: str) -> None:
        """End a charge with an error, and unlock."""
        if self.active or self._starting:
            self._starting = False
            self._end(Status.ABORTED, result, reason)
        else:
            self.unlock(reason)
