"""The sun that the cars can have: their own power, less the grid, less the battery."""

from math import inf
from typing import Final

from .meter import LAGS, History, Lag, Rhythm, Silence
from .readings import BatteryReport, GridReport, plausible

REACTION: Final = 10.0
"""A car has followed a changed offer after this time, s."""
PATIENCE: Final = 20.0
"""A report waits so long for a measurement of the cars, s."""
_FULL: Final = 100.0


class Surplus:
    """What the cars could take without a purchase, W, from the reports so far."""

    def __init__(self, priority: float | None) -> None:
        """Know nothing; ``priority`` of a battery, %, below which it goes first.

        ``None``: there is no battery.
        """
        self.priority = priority
        self.lag = Lag()
        self.power: float | None = None
        """W; ``None``: no report yet. Only `silence` shows whether it still counts."""
        self._meter = Rhythm()
        self._battery = Rhythm()
        self._cars = History(LAGS[-1] + 120.0)
        self._battery_report: BatteryReport | None = None
        self._elapsed = 0.0
        self._moved = -inf
        self._waiting: tuple[float, float, float] | None = None
        """A report that waits: its time, the power without the cars, its elapsed time."""

    @property
    def period(self) -> float | None:
        """Return the usual time between two reports of the meter, s."""
        return self._meter.period

    def age(self, now: float) -> float:
        """Return the age of the meter's value, its delay included, s."""
        return self._meter.age(now) + self.lag.seconds

    def silence(self, now: float) -> Silence:
        """Return whether meter and battery report."""
        found = self._meter.silence(now)
        if self.priority is None:
            return found
        return max(found, self._battery.silence(now), key=_SEVERITY.index)

    def cars(self, at: float, power: float) -> None:
        """Note what all cars that charge from the sun take together, W, as measured."""
        self._cars.note(at, power)
        self._settle(at)

    def moved(self, at: float) -> None:
        """Note that an offer was changed: cars may take something else from now on."""
        self._moved = at

    def battery(self, report: BatteryReport, now: float) -> None:
        """Take a report of the battery; an implausible one is none."""
        if report.restored or not plausible(report.power):
            return
        if self._battery.take(report.at, now) is not None:
            self._battery_report = report

    def grid(self, report: GridReport, now: float) -> None:
        """Take a report of the meter; an implausible one is none."""
        if report.restored or not plausible(report.power):
            return
        elapsed = self._meter.take(report.at, now)
        if elapsed is None:
            return
        self._waiting = (report.at, report.power + self._from_battery(), elapsed)
        self._settle(now)

    def _settle(self, now: float) -> None:
        """Compare a report with what the cars took at its time, once that is known.

        With an older measurement a change of the car would look like one of the sun.
        """
        if self._waiting is None:
            return
        at, rest, elapsed = self._waiting
        measured = self._cars.last
        same = at - self.lag.seconds
        if (
            measured < same
            and self._moved > measured - REACTION
            and now < at + PATIENCE
        ):
            return
        self._waiting = None
        length = LAGS[-1] + min(self._meter.period or 0.0, LAGS[-1])
        self.lag.learn(
            at,
            lambda age: rest - self._cars.at(at - age),
            self._cars.spread(at - length, at),
            gap=not elapsed,
        )
        self.power = self._cars.at(same) - rest
        self._elapsed += elapsed

    def take_elapsed(self, now: float) -> float:
        """Return the time that reports since the last call stand for, s."""
        self._settle(now)
        elapsed, self._elapsed = self._elapsed, 0.0
        return elapsed

    def _from_battery(self) -> float:
        """Return what counts as taken from the battery, W.

        Below its priority the battery keeps what it takes; what it gives is no sun.
        """
        report = self._battery_report
        priority = self.priority
        if report is None or priority is None:
            return 0.0
        charge = report.charge
        if priority > 0 and (charge is None or not priority <= charge <= _FULL):
            return max(report.power, 0.0)
        return report.power


_SEVERITY: Final = (Silence.NONE, Silence.NEW, Silence.SILENT, Silence.DEAD)
