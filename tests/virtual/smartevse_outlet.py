"""The clock of a virtual SmartEVSE: seconds, errors, its own cycle. No wire."""

from __future__ import annotations

from .smartevse_registers import (
    LESS_6A,
    MASTER,
    NO_COMM,
    NO_CURRENT,
    NO_SUN,
    NORMAL,
    RCD,
    SOLAR,
    TEMP_HIGH,
)
from .smartevse_states import CHARGE_DELAY, NEVER, STOP_DELAY, SmartEvseStates, pwm_of

# In device time, s. A second of the recorded 2.17 is a little short.
STEP = 0.01
SECOND = 0.989
COMM_TIMEOUT = 10
TOO_HOT, COOL_AGAIN = 65, 55
# The later dialects poll their nodes before they calculate.
POLLING = 0.1
# As a master: between the polls, and from the last to the broadcast (`master`).
POLL_SPACING, POLL_TO_BROADCAST = 0.109, 0.129


class SmartEvseOutlet(SmartEvseStates):
    """One outlet with a clock: `step` brings it up to a time.

    `second`: the duration of its second, s; `comm_time`: its count of seconds without
    a broadcast.
    """

    second = SECOND
    comm_time = COMM_TIMEOUT

    # Time

    def step(self, now: float) -> None:
        """Advance to `now`."""
        if self._now is None or self._second_at is None:
            self._now = now
            self._second_at = now + self.second
        while self._now < now:
            self._now = min(now, self._now + STEP)
            self._live(self._now)
        if self.car is not None:
            offer = self.pilot_current if self.contactor else None
            self.energy_wh += self.car.step(now, offer)
            self.car_current = self.car.current

    def _live(self, now: float) -> None:
        if self.rcd_tripped:
            self.error = RCD
            if self.state != "A":
                self.stop()
        self._follow_pilot(now)
        while self._polls and now >= self._polls[0][0]:
            self.polls_due.append(self._polls.pop(0)[1])
        if self._cycle_at is not None and now >= self._cycle_at:
            self._cycle_at = None
            if self._polls_nodes:
                self.write_due = True
            else:
                self.calculate()
        if self._second_at is not None and now >= self._second_at:
            self._second_at += self.second
            self._every_second(now)
        if self.error & NO_COMM and self.comm_timeout == self.comm_time:
            self.error &= ~NO_COMM
        if self.slave and self.charge_delay == 0 and not self.dialect.gentle:
            self.error &= ~(LESS_6A | NO_SUN)

    # Every second

    def _every_second(self, now: float) -> None:
        self.temperature_measured = self.temperature
        if self.state == "B" and 0 < self._activation < NEVER:
            self._activation -= 1
        if self.state == "T":
            self._activation_timer -= 1
            if self._activation_timer <= 0:
                self.go("B")
                self._activation = NEVER
        if self.state == "C1":
            self._wait_for_the_car()
        if self.solar_timer:
            self.solar_timer -= 1
            if not self.solar_timer:
                self.error |= NO_SUN
                if self.state == "C":
                    self.stop()
        self.charge_delay = max(0, self.charge_delay - 1)
        self._check_errors()
        if self.external_master:
            self.external_master -= 1
        self._run_cycle(now)

    def _wait_for_the_car(self) -> None:
        """Open the contactor under a car that does not end its request in C1."""
        if self._c1_timer:
            self._c1_timer -= 1
            return
        self.go("B1")
        if not self.dialect.version3:
            self.charge_delay = STOP_DELAY

    def _check_errors(self) -> None:
        if self.temperature < COOL_AGAIN:
            self.error &= ~TEMP_HIGH
        lacking = LESS_6A | NO_SUN
        if self.error & lacking and not self.slave and self._enough():
            self.error &= ~lacking
            self.error_broadcasts.append(self.error)
        if self.comm_timeout == 0 and not self.error & NO_COMM:
            self.error |= NO_COMM
            self.stop()
        elif self.comm_timeout:
            self.comm_timeout -= 1
        if self.temperature >= TOO_HOT and not self.error & TEMP_HIGH:
            self.error |= TEMP_HIGH
            self.stop()
        if self.error & NO_CURRENT:
            self.error &= ~NO_CURRENT
            solar = self.settings["mode"] == SOLAR
            self.error |= NO_SUN if solar else LESS_6A
            self.stop()
            self.charge_delay = CHARGE_DELAY
        elif self.error & lacking and self.dialect.status_writable:
            self.stop()
            self.charge_delay = CHARGE_DELAY

    def _run_cycle(self, now: float) -> None:
        """Set the current every two seconds, unless there is another master."""
        if self.slave or (self.dialect.external_master and self.external_master):
            return
        if self._cycle:
            self._cycle -= 1
            return
        self._cycle = 1
        if self.settings["mode"] != NORMAL and not self.meter_works:
            return
        self.comm_timeout = self.comm_time
        self._cycle_at = now + (POLLING if self.dialect.status_writable else 0.0)
        if self._polls_nodes:
            self.round_begins = True
            self._cycle_at = None

    @property
    def _polls_nodes(self) -> bool:
        """Return whether it is the master of a later dialect."""
        return self.load_balance == MASTER and self.dialect.polled is not None

    def plan_polls(self, nodes: list[int], now: float) -> None:
        """As a master: poll these nodes, one after the other."""
        self.round_begins = False
        self._polls = [(now + POLL_SPACING * n, u) for n, u in enumerate(nodes)]
        last = self._polls[-1][0] if self._polls else now
        self._cycle_at = last + POLL_TO_BROADCAST

    def write_sent(self, now: float, *, written: bool) -> None:
        """As a master: one write more, or none is left before the broadcast."""
        self.write_due = False
        if written:
            self._cycle_at = now + POLL_TO_BROADCAST
        else:
            self.calculate()

    def calculate(self) -> None:
        """Set current and PWM: its own cycle."""
        self.cycles += 1
        self._recalculate()
        if self.state == "C" and not self._meter_leaves_enough():
            self._lack()
        if self.state in ("B", "C"):
            self.pilot_current = pwm_of(self.current)
