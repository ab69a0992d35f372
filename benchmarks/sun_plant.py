"""A house in simulation: panels, meter, battery, cars; a controller sees the meter.

A second is a step. Counted is how much of the sun the cars took, how much else they
took, and how often they were started.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Protocol

from .sun_month import Day

VOLTS = 230.0
MINIMUM = 6.0
MAXIMUM = 16.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Car:
    """A car and its charger."""

    phases: int = 3
    step: float = 0.1
    delay: int = 8
    """s from the offer until it takes current."""
    slew: float = 3.0
    """A in a second, up; down is at once."""
    most: float = MAXIMUM
    """A that it takes at most."""
    refuses_after: int | None = None
    """It no longer charges after so many starts of a day."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Battery:
    """A home battery that keeps the grid at 0 as far as it can."""

    priority: float
    """%; the house charges it first below that."""
    capacity: float = 10_000.0
    """Wh."""
    most: float = 5000.0
    """W, both ways."""
    first: float = 20.0
    """% in the morning."""
    delay: int = 3
    """s until it has followed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One house; the month is run in it with each controller."""

    name: str
    period: int = 10
    """s between two reports of the meter."""
    lag: int = 0
    """s; age of the meter's values."""
    cars: Sequence[Car] = (Car(),)
    measured_every: int = 2
    """s between two measurements of a charger."""
    battery: Battery | None = None
    dropouts: int = 0
    """Times a day without any report, 1 to 20 min each."""
    freezes: int = 0
    """Times a day with the same value again and again, 1 to 20 min each."""
    seed: int = 1


@dataclass(slots=True)
class Seen:
    """What a controller can know now."""

    at: float
    fresh: bool
    """The meter has reported now."""
    grid: float | None
    """W, import positive, as reported last."""
    age: float
    """s since it was reported."""
    powers: Sequence[float]
    """W of each car, as its charger measured."""
    battery: float = 0.0
    """W, discharge positive; reported together with the grid."""
    charge: float | None = None
    """% of the battery."""


class Controller(Protocol):
    """What decides about the offers."""

    every: int
    """s between two looks; it is also asked at each report."""
    every_report: bool

    def measured(self, at: float, powers: Sequence[float]) -> None:
        """Take what the chargers have measured now, W."""

    def look(self, seen: Seen) -> Sequence[float]:
        """Return the current to offer to each car, A; 0: pause."""


@dataclass(slots=True)
class Outcome:
    """What the cars have taken in all days."""

    days: int = 0
    sun: float = 0.0
    """Ws from the sun."""
    other: float = 0.0
    """Ws from the grid, or from the battery."""
    available: float = 0.0
    """Ws of sun that the cars could have taken."""
    starts: int = 0

    def count(self, surplus: float, power: float, most: float) -> None:
        """Count a second: what the house left over, and what the cars took, W."""
        there = max(surplus, 0.0)
        self.available += min(there, most)
        self.sun += min(there, power)
        self.other += max(0.0, power - there)

    @property
    def figures(self) -> tuple[float, float, float]:
        """Return sun %, grid % of the cars, and starts a day."""
        taken = self.sun + self.other
        return (
            100 * self.sun / self.available,
            100 * self.other / taken if taken else 0.0,
            self.starts / self.days,
        )


@dataclass(slots=True)
class _Charging:
    """One car during a day."""

    car: Car
    offered: float = 0.0
    current: float = 0.0
    since: int = 0
    starts: int = 0
    measured: float = 0.0
    powers: list[float] = field(default_factory=list)

    def offer(self, current: float, second: int) -> None:
        """Change the offer."""
        if current and not self.offered:
            self.starts += 1
            self.since = second
        self.offered = current

    def step(self, second: int, every: int) -> float:
        """Return the power in this second, W."""
        car = self.car
        target = min(self.offered, car.most)
        refuses = car.refuses_after is not None and self.starts > car.refuses_after
        if refuses or second - self.since < car.delay:
            target = 0.0
        if target != self.current:
            self.current = min(target, self.current + car.slew)
        power = self.current * VOLTS * car.phases
        if not second % every:
            self.measured = power
        return power


class _Battery:
    """The home battery during a day."""

    def __init__(self, battery: Battery) -> None:
        self._battery = battery
        self._full = battery.capacity * 3600
        self._stored = battery.first / 100 * self._full
        self.flow = 0.0
        """W, discharge positive."""

    @property
    def charge(self) -> float:
        """Return its state of charge, %."""
        return 100 * self._stored / self._full

    def step(self, grid: float) -> float:
        """Follow the grid with a delay; return the discharge, W."""
        battery = self._battery
        wanted = self.flow + (grid - self.flow) / battery.delay
        wanted = max(-battery.most, min(battery.most, wanted))
        self.flow = max(min(wanted, self._stored), self._stored - self._full)
        self._stored -= self.flow
        return self.flow


class _Meter:
    """The meter during a day: it reports in its period, mostly."""

    def __init__(self, cell: Cell, dice: Random, length: int) -> None:
        self._cell = cell
        self._silent = _times(dice, cell.dropouts, length)
        self._frozen = _times(dice, cell.freezes, length)
        self._offset = dice.randrange(cell.period)
        self._values: list[tuple[float, float]] = []
        self.grid: float | None = None
        self.battery = 0.0
        self.at = 0

    def step(self, second: int, grid: float, battery: float) -> bool:
        """Return whether it reports in this second."""
        self._values.append((grid, battery))
        if (second + self._offset) % self._cell.period or second in self._silent:
            return False
        self.at = second
        if self.grid is None or second not in self._frozen:
            self.grid, self.battery = self._values[max(0, second - self._cell.lag)]
        return True


def run_day(
    cell: Cell, day: Day, controller: Controller, start: float, outcome: Outcome
) -> None:
    """Run one day; the cars come at its beginning and leave at its end."""
    dice = Random(f"{cell.seed} {start}")  # noqa: S311 - repeatable on purpose
    cars = [_Charging(one) for one in cell.cars]
    meter = _Meter(cell, dice, len(day.surplus))
    battery = _Battery(cell.battery) if cell.battery is not None else None
    most = sum(one.most * VOLTS * one.phases for one in cell.cars)
    for second, surplus in enumerate(day.surplus):
        power = 0.0
        for one in cars:
            power += one.step(second, cell.measured_every)
        grid = power - surplus
        flow = battery.step(grid) if battery is not None else 0.0
        fresh = meter.step(second, grid - flow, flow)
        outcome.count(surplus, power, most)
        if not second % cell.measured_every:
            controller.measured(start + second, [one.measured for one in cars])
        if (fresh and controller.every_report) or not second % controller.every:
            seen = Seen(
                at=start + second,
                fresh=fresh,
                grid=meter.grid,
                age=second - meter.at,
                powers=[one.measured for one in cars],
                battery=meter.battery,
                charge=battery.charge if battery is not None else None,
            )
            for one, current in zip(cars, controller.look(seen), strict=True):
                if current != one.offered:
                    one.offer(current, second)
    outcome.days += 1
    outcome.starts += sum(one.starts for one in cars)


def _times(dice: Random, count: int, length: int) -> set[int]:
    found: set[int] = set()
    for _ in range(count):
        begin = dice.randrange(length)
        found |= set(range(begin, begin + int(60 * 20 ** dice.random())))
    return found
