"""The outlet of a virtual SmartEVSE 3.x: what it does unlike the boxes of v2.

Read in its sources (main.cpp, main_c.h), never run: the facts in the README. What they
do not settle is a parameter, see `Version3`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .smartevse_outlet import SmartEvseOutlet
from .smartevse_registers import LESS_6A, NO_COMM, NORMAL, TEMP_HIGH, Version3
from .smartevse_states import CHARGE_DELAY, CONNECTED

if TYPE_CHECKING:
    from .car import Car
    from .smartevse_registers import Dialect

EV_METER = 0x08
# Seconds without a reply of the EV meter until this error.
EV_TIMEOUT = 64
TOO_HOT, COOL_AGAIN = 65, 55
# A request of the car lasts so long before the box sees it, s.
REQUEST_LASTS = 0.5
MODEM = ("M1", "M2", "M3")


class SmartEvseOutlet3(SmartEvseOutlet):
    """One outlet of 3.x.

    - `access_word`: its register; `access` is whether that is 1
    - `flash_writes`: how often access was stored
    """

    second = 1.0
    request_lasts = REQUEST_LASTS
    flash_access = 1
    flash_writes = 0

    def __init__(
        self,
        dialect: Dialect,
        car: Car | None = None,
        *,
        cable: int = 16,
        settings: dict[str, int] | None = None,
    ) -> None:
        """Make an outlet that was just switched on."""
        self.version = dialect.version3 or Version3()
        self.comm_time = self.version.no_comm
        super().__init__(dialect, car, cable=cable, settings=settings)

    def power_up(self) -> None:
        """Begin with the stored settings, and access, where that is stored."""
        super().power_up()
        word = int(self.settings["switch"] not in (1, 2))
        if self.version.access_stored:
            word = self.flash_access
        self.access_word = word
        self.access = word == 1
        self.comm_timeout = self.comm_time
        self.ev_timeout = EV_TIMEOUT
        self.meters_due: list[int] = []
        self._pilot_cut = 0
        self._modem_timer = 0
        self._was_in_modem = False

    # Events from outside

    def open_access(self) -> None:
        """Follow a change of the stored settings."""
        if self.version.settings_open_access:
            self.set_access(1)

    def set_access(self, allowed: bool | int) -> None:  # noqa: FBT001 - a register's value
        """Set the access word; 0 and 2 end a charge."""
        self.access_word = int(allowed)
        if self.version.access_stored:
            self.flash_access = self.access_word
            self.flash_writes += 1
        self.access = self.access_word == 1
        if self.access or self.keeps_charging:
            return
        if self.state == "C":
            self.go("C1")
        elif self.state == "B" or self.state in MODEM:
            self.go("B1")

    def set_mode(self, mode: int) -> None:
        """Take over another mode from a master or the menu."""
        if mode == self.settings["mode"]:
            return
        self.settings["mode"] = mode
        if self.version.mode_stored:
            self.stored["mode"] = mode
        if self.version.mode_opens_access:
            self.set_access(1)

    def set_error(self, bits: int) -> None:
        """Take over error bits from a master: any of them stops the charge."""
        if bits & NO_COMM:
            self.comm_timeout = 0
        super().set_error(bits)

    def stop(self) -> None:
        """Stop because of an error."""
        if self.state == "C":
            self.go("C1")
        elif self.state not in ("A", "B1", "C1"):
            self.go("B1")

    def go(self, state: str) -> None:
        """Change the state; entering B1 with access on cuts the pilot."""
        if state == "B1" and self.state != "B1" and self.access:
            self._pilot_cut = self.version.pilot_cut
        if state == "A":
            self._pilot_cut = 0
            self._was_in_modem = False
        super().go(state)

    # The pilot

    def _follow_pilot(self, now: float) -> None:
        if self.state == "B1" and self._pilot_cut:
            # It cannot see the car now.
            return
        if self.state in MODEM:
            if self.pilot == CONNECTED or self._offered:
                return
            self.go("A")
        super()._follow_pilot(now)

    def _in_a(self, pilot: int, now: float) -> None:
        unable = self.error or self.charge_delay
        if self.state == "A" and pilot == CONNECTED and self.access and unable:
            self.go("B1")
            return
        ready = self.access and not unable
        wants = self.state != "F" and pilot == CONNECTED and ready
        if wants and self.version.modem and not self._was_in_modem:
            self._was_in_modem = True
            self.go(MODEM[0])
            self._modem_timer = self.version.modem
            return
        super()._in_a(pilot, now)

    # Every second

    def _every_second(self, now: float) -> None:
        if self._pilot_cut:
            self._pilot_cut -= 1
        if self.state in MODEM:
            self._modem_timer -= 1
            if self._modem_timer <= 0:
                step = MODEM.index(self.state) + 1
                self._modem_timer = self.version.modem
                self.go(MODEM[step] if step < len(MODEM) else "B1")
        super()._every_second(now)

    def _check_errors(self) -> None:
        if self.temperature < COOL_AGAIN:
            self.error &= ~TEMP_HIGH
        if self.slave:
            self._check_master()
        if self.settings["ev_meter"]:
            self._check_ev_meter()
        if self.temperature >= TOO_HOT and not self.error & TEMP_HIGH:
            self.error |= TEMP_HIGH
            self.stop()
        if self.error & LESS_6A and not self.slave and self._enough():
            self.error &= ~LESS_6A
            self.error_broadcasts.append(self.error)
        if self.error & LESS_6A:
            self.stop()
            self.charge_delay = CHARGE_DELAY

    def _check_master(self) -> None:
        may = self.version.no_comm_in_normal or self.settings["mode"] != NORMAL
        if self.comm_timeout == 0 and not self.error & NO_COMM and may:
            self.error |= NO_COMM
            self.stop()
        elif self.comm_timeout:
            self.comm_timeout -= 1

    def _check_ev_meter(self) -> None:
        smart = self.settings["mode"] != NORMAL
        if self.ev_timeout == 0 and not self.error & EV_METER and smart:
            self.error |= EV_METER
            self.stop()
        elif self.ev_timeout:
            self.ev_timeout -= 1

    def _run_cycle(self, now: float) -> None:
        """Ask its meters, and as a master its nodes, whoever else speaks."""
        due = not self.slave and not self._cycle
        super()._run_cycle(now)
        if due:
            self.meters_due += [
                self.settings[f"{name}_address"]
                for name in ("mains", "ev")
                if self.settings[f"{name}_meter"]
            ]
