"""The states of a virtual SmartEVSE, and their changes by the pilot. No clock.

Written from the manual, the recorded traces, and the facts in the README; what 3.x
does otherwise is in `smartevse_outlet3`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .smartevse_registers import (
    DISABLED,
    LESS_6A,
    MASTER,
    NO_CURRENT,
    NO_SUN,
    NORMAL,
    RCD,
    SOLAR,
    Dialect,
)
from .smartevse_sharing import Sharing

if TYPE_CHECKING:
    from .car import Car

# In device time, s.
DEBOUNCE = 0.01
CABLE_MEASUREMENT = 0.09
ACK_TIMEOUT = 0.98
CHARGE_DELAY = 60
STOP_DELAY = 15
B1_DELAY = 3
C1_TIME = 6
START_TIMEOUT = 5
ACTIVATION_AFTER = 30
ACTIVATION_TIME = 3
LOWEST_PWM, HIGHEST_PWM = 60, 800
# HEAD, since its first cycle in C (recorded in `first_minutes`): until when, 0.1 A.
MEASUREMENT = ((40, 60), (50, 80), (56, 60), (66, 80), (72, 60), (82, 80))
UNPLUGGED, CONNECTED, CHARGING = 12, 9, 6
NEVER = 255

WAITING = {"E": 0x01, "F": 0x02, "G": 0x03, "H": 0x04}


def pwm_of(tenths: int) -> float:
    """Return the current that the pilot signals, A, for 0.1 A; out of range: 6 A."""
    return (tenths if LOWEST_PWM <= tenths <= HIGHEST_PWM else LOWEST_PWM) / 10


class SmartEvseStates:
    """One outlet without a clock of its own; plain attributes may be set at any time.

    `request_lasts`: time that a car must request power before the box follows, s.

    - `settings`: the stored settings by name; `override` and `current` in 0.1 A
    - `access`, `error` (bits), `state`, `contactor` (closed or not)
    - `pilot_current`: the current that the pilot signals, A; 0 = no PWM
    - `pilot_voltage`: 12, 9 or 6 V on the pilot in place of the car's; None: the car's
    - `temperature` in degrees; `meter_works`, `meter_leaves` (A) of its mains meter,
      which it has in the modes smart and solar
    """

    request_lasts = DEBOUNCE

    def __init__(
        self,
        dialect: Dialect,
        car: Car | None = None,
        *,
        cable: int = 16,
        settings: dict[str, int] | None = None,
    ) -> None:
        """Make an outlet that was just switched on."""
        self.dialect = dialect
        self.car = car
        self.cable = cable
        self.settings = {n: s.default for n, s in dialect.settings.items()}
        self.settings.update(settings or {})
        self.pilot_voltage: int | None = None
        self.temperature = 20
        self.rcd_tripped = False
        # False: the car's smallest current is known already.
        self.measures = dialect.measures
        self.meter_works = True
        self.meter_leaves = 80.0
        self.switch_closed = True
        self.stored = dict(self.settings)
        self.car_current = 0.0
        self._offered = False
        self.energy_wh = 0.0
        # (register, value) to send: a slave's requests, to its own address.
        self.asked: list[tuple[int, int]] = []
        self.error_broadcasts: list[int] = []
        # As a master of a later dialect: nodes to poll now.
        self.polls_due: list[int] = []
        # As one: a round begins; it may write to a node before the broadcast.
        self.round_begins = self.write_due = False
        self.cycles = 0
        self._now: float | None = None
        self.power_up()
        self.temperature_measured = self.temperature

    def power_up(self) -> None:
        """Begin with the stored settings: all volatile state is lost."""
        self.settings = dict(self.stored)
        self.state = "A"
        # A defect: access that is off does not change the state.
        self.keeps_charging = False
        self.access = False
        self.error = 0
        self.contactor = False
        self.pilot_current = 0.0
        self.cable_measured = 0
        # For a second after a power cycle (2.30 and HEAD, `power_cycle`).
        self.temperature_measured = 0
        self.phases = 0
        self.override = 0
        self.current = 0
        self.charge_delay = 0
        self.solar_timer = 0
        self.comm_timeout = START_TIMEOUT
        self.external_master = 0
        self.sharing = Sharing(self, self.dialect.units)
        self._cycle = 0
        self._wanted = 0
        self._next = ""
        self._next_since = 0.0
        self._asked_at = float("-inf")
        self._second_at: float | None = None
        self._cycle_at: float | None = None
        self._polls: list[tuple[float, int]] = []
        self._c1_timer = 0
        self._measured_from: float | None = None
        self._activation = NEVER
        self._activation_timer = 0
        self.open_access()

    # Facts

    @property
    def load_balance(self) -> int:
        """Return the load-balance setting, which is also the address."""
        return self.settings["load_balance"]

    @property
    def disabled(self) -> bool:
        """Return whether load balancing is off."""
        return self.load_balance == DISABLED

    @property
    def slave(self) -> bool:
        """Return whether a master sets its current."""
        return self.load_balance > MASTER

    @property
    def own_maximum(self) -> int:
        """Return min(configured, cable) in 0.1 A, as in its requests."""
        return 10 * min(self.settings["max_current"], self.cable_measured)

    @property
    def pilot(self) -> int:
        """Return the voltage of the pilot: 12 no car, 9 connected, 6 requesting."""
        if self.pilot_voltage is not None:
            return self.pilot_voltage
        car = self.car
        if car is None or not car.plugged:
            self._offered = False
            return UNPLUGGED
        if self.pilot_current > 0:
            self._offered = True
            return CHARGING if car.accepts(self.pilot_current) else CONNECTED
        holds = car.requesting and car.requests_without_pwm and self._offered
        return CHARGING if holds or car.current > 0 else CONNECTED

    @property
    def measuring_cable(self) -> bool:
        """Return whether it is about to enter B: a frame waits until it has."""
        return self._next == "B" and self.state in ("A", "B1")

    def open_access(self) -> None:
        """Open access unless a switch decides; done whenever settings are stored."""
        if self.settings["switch"] not in (1, 2):
            self.access = True

    # Events from outside

    def set_access(self, allowed: bool) -> None:  # noqa: FBT001 - a register's value
        """Set the access bit."""
        self.access = allowed
        if allowed or self.keeps_charging:
            return
        if not self.dialect.gentle:
            self.go("A")
        elif self.state in ("B", "C"):
            self.go("C1" if self.state == "C" else "B1")

    def set_error(self, bits: int) -> None:
        """Take over error bits from a master: any of them stops the charge."""
        self.error = bits
        if bits:
            self.stop()
            self.charge_delay = CHARGE_DELAY

    def stop(self) -> None:
        """Stop because of an error."""
        if not self.dialect.gentle:
            self.go("A")
        elif self.state != "C1":
            self.go("C1" if self.state == "C" else "B1")

    def press(self) -> None:
        """Press the button, or move the switch, at the box."""
        switch = self.settings["switch"]
        if switch == 1:
            self.set_access(not self.access)
        elif switch == 2:
            self.switch_closed = not self.access
            self.set_access(self.switch_closed)
        elif self.state == "C":
            self.go("C1" if self.dialect.gentle else "A")
            self.charge_delay = STOP_DELAY
        if not self.rcd_tripped:
            self.error &= ~RCD

    def go(self, state: str) -> None:
        """Change the state, with its immediate effects."""
        self.state = state
        self._next = ""
        if state in ("A", "B1"):
            self.contactor = False
            self.pilot_current = 0.0
        if state == "C":
            self.contactor = True
            self._activation = NEVER
        if not self.dialect.gentle:
            return
        if state == "A":
            self.error &= ~(NO_SUN | LESS_6A)
            self.charge_delay = 0
            # HEAD, `next_car`.
            self.phases = 0
        elif state == "B1":
            self.charge_delay = self.charge_delay or B1_DELAY
        elif state == "C1":
            self.pilot_current = 0.0
            self._c1_timer = C1_TIME
            self.charge_delay = STOP_DELAY

    # The pilot

    def _lasts(self, target: str, now: float, seconds: float) -> bool:
        if self._next != target:
            self._next = target
            self._next_since = now
        return now - self._next_since >= seconds

    def _follow_pilot(self, now: float) -> None:
        """Change the state by the voltage of the pilot."""
        pilot = self.pilot
        if self.state in ("A", "B1") or (
            self.state == "F" and self.dialect.status_writable
        ):
            self._in_a(pilot, now)
        elif self.state == "B" or (self.state == "G" and self.dialect.status_writable):
            self._in_b(pilot, now)
        elif self.state == "C":
            self._in_c(pilot, now)
        elif self.state == "C1":
            if pilot == UNPLUGGED and self._lasts("A", now, DEBOUNCE):
                self.go("A")
            elif pilot == CONNECTED and self._lasts("B1", now, DEBOUNCE):
                self.go("B1")
        elif self.state in WAITING:
            self._wait(now)

    def _in_a(self, pilot: int, now: float) -> None:
        if pilot == UNPLUGGED:
            if self.state != "A":
                self.go("A")
            self.error &= ~(NO_SUN | LESS_6A)
            self.charge_delay = 0
            self._next = ""
            self._measured_from = None
            return
        ready = self.access and not self.error and not self.charge_delay
        if self.state == "F" or pilot != CONNECTED or not ready:
            self._next = ""
        elif self._lasts("B", now, DEBOUNCE + CABLE_MEASUREMENT):
            fixed = self.settings["config"]
            self.cable_measured = self.settings["max_current"] if fixed else self.cable
            self._wanted = self.own_maximum
            if self.slave:
                self._ask("F", now)
            elif not self.dialect.gentle or self._enough():
                self.current = self._wanted
                self.enter_b()
            else:
                self._lack()

    def enter_b(self) -> None:
        """Go to B; the cycle or a broadcast starts the PWM."""
        self.go("B")
        self._activation = ACTIVATION_AFTER

    def _in_b(self, pilot: int, now: float) -> None:
        if pilot == UNPLUGGED:
            if self._lasts("A", now, DEBOUNCE):
                self._leave(now)
        elif pilot == CHARGING:
            ready = not self.error and not self.charge_delay and self.state == "B"
            if self.dialect.version3:
                ready = ready and self.access
            if self._lasts("C", now, self.request_lasts) and ready:
                if self.slave:
                    self._ask("G", now)
                elif self._enough():
                    self.go("C")
                    if self.dialect.gentle:
                        # Until its first cycle (HEAD, `normal`: 9 s after access).
                        self.current = 0
                    else:
                        self._recalculate()
                else:
                    self._lack()
        else:
            self._next = ""
            if self._activation == 0:
                self.go("T")
                self.pilot_current = 0.0
                self._activation_timer = ACTIVATION_TIME

    def _in_c(self, pilot: int, now: float) -> None:
        if pilot == UNPLUGGED:
            if self._lasts("A", now, DEBOUNCE):
                self.contactor = False
                self._leave(now)
        elif pilot == CONNECTED:
            if self._lasts("B", now, DEBOUNCE):
                self.contactor = False
                if self.slave and not self.dialect.status_writable:
                    self._ask("H", now)
                else:
                    self.go("B")
        else:
            self._next = ""

    def _leave(self, now: float) -> None:
        if self.slave and not self.dialect.status_writable:
            self._ask("E", now)
        else:
            self.go("A")

    def _ask(self, waiting: str, now: float) -> None:
        """Send a request to the master, and wait; later dialects wait to be polled."""
        self.state = waiting
        self._next = ""
        self._asked_at = now
        if not self.dialect.status_writable:
            register = WAITING[waiting]
            value = self._wanted if waiting in ("F", "G") else 0
            self.asked.append((register, value))

    def _wait(self, now: float) -> None:
        if self.dialect.status_writable or now - self._asked_at <= ACK_TIMEOUT:
            return
        if self.state == "F":
            self.go("A")
        elif self.state == "G":
            self.go("B")
        else:
            self._ask(self.state, now)

    def _lack(self) -> None:
        """Set the error of too little current; the 2.17 sets the reason later."""
        lacking = NO_SUN if self.settings["mode"] == SOLAR else LESS_6A
        self.error |= lacking if self.dialect.status_writable else NO_CURRENT

    def _enough(self) -> bool:
        """Return whether meter and load balancing leave enough current to start."""
        if self.load_balance == MASTER and not self.sharing.available():
            return False
        return self._meter_leaves_enough()

    def _meter_leaves_enough(self) -> bool:
        normal = self.settings["mode"] == NORMAL
        return normal or self.meter_leaves >= self.settings["min_current"]

    def _recalculate(self) -> None:
        """Take over the override, or the maximum, while charging."""
        charge = self.override or self.own_maximum
        if self.load_balance == MASTER:
            charge = self.sharing.split(charge)
        elif self.settings["mode"] != NORMAL:
            charge = min(charge, int(self.meter_leaves * 10))
        if self.state == "C":
            measured = self._measurement()
            self.current = charge if measured is None else measured

    def _measurement(self) -> int | None:
        """Return the current while the smallest one of a car is searched, 0.1 A."""
        if not self.measures or self.slave or self._now is None:
            return None
        if self._measured_from is None:
            self._measured_from = self._now
        elapsed = self._now - self._measured_from
        return next((one for until, one in MEASUREMENT if elapsed < until), None)
