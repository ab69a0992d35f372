"""A month of sun and of a household: real irradiance, drawn appliances.

The irradiance is that of the BSRN station Payerne in June 2016, a value a minute, as it
comes with pvlib 0.11.2 (`requirements_bench.txt`); of pvlib only that file is read.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
import gzip
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import Final

DAYS: Final = 30
MINUTES: Final = 1440
PLUGGED: Final = (4 * 60, 20 * 60)
"""Minutes of a day (UTC, two hours behind the clocks of June) with the car at home."""
PEAK: Final = 9800.0
"""W of the panels at 1000 W/m2."""
PERFORMANCE: Final = 0.85
"""What reaches the meter of that."""
_RECORD: Final = "*U0100"
_MISSING: Final = -99.0
_SEED: Final = 2016


@dataclass(frozen=True, slots=True)
class Day:
    """One day while the car is at home, a value a second."""

    surplus: Sequence[float]
    """W of the sun that the house leaves over; negative: it takes from the grid."""


@cache
def month(days: int = DAYS) -> tuple[Day, ...]:
    """Return so many days of the month, spread over it."""
    chosen = [at * DAYS // days for at in range(days)]
    sun = irradiance()
    dice = Random(_SEED)  # noqa: S311 - repeatable on purpose
    houses = [household(dice) for _ in range(DAYS)]
    return tuple(_day(sun[at], houses[at]) for at in chosen)


def irradiance() -> list[list[float]]:
    """Return the global irradiance of each minute of each day, W/m2."""
    spec = find_spec("pvlib")
    if spec is None or not spec.submodule_search_locations:
        raise RuntimeError("pvlib is missing: scripts/setup --bench")
    folder = Path(next(iter(spec.submodule_search_locations)))
    with gzip.open(folder / "data/bsrn-pay0616.dat.gz", "rt", encoding="ascii") as file:
        return parsed(file)


def parsed(lines: Iterator[str]) -> list[list[float]]:
    """Return the values of a BSRN file, a list for each day.

    Source: BSRN, logical record 0100: day, minute, global irradiance (mean), ...; each
    minute has two lines, of which the second is not needed. A missing value is -999 and
    becomes the one before it.
    """
    days = [[0.0] * MINUTES for _ in range(DAYS)]
    inside = False
    last = 0.0
    for line in lines:
        if line.startswith("*"):
            inside = line.strip() == _RECORD
            continue
        if not inside:
            continue
        day, minute, value = line.split()[:3]
        next(lines)
        last = last if float(value) < _MISSING else max(0.0, float(value))
        days[int(day) - 1][int(minute)] = last
    return days


def _day(sun: Sequence[float], house: Sequence[float]) -> Day:
    """Return the surplus of each second; the sun changes evenly within a minute."""
    surplus: list[float] = []
    factor = PEAK * PERFORMANCE / 1000
    for minute in range(*PLUGGED):
        now, then = sun[minute] * factor, sun[minute + 1] * factor
        surplus += [
            now + (then - now) * second / 60 - house[minute * 60 + second]
            for second in range(60)
        ]
    return Day(surplus)


class _Household:
    """The power of a day, to which appliances are added."""

    def __init__(self, dice: Random) -> None:
        self.power = [220.0] * (MINUTES * 60)
        self._dice = dice

    def add(self, start: float, length: float, watts: float) -> None:
        """Let an appliance run, s."""
        for at in range(int(start), min(int(start + length), len(self.power))):
            self.power[at] += watts

    def cycles(
        self,
        span: tuple[float, float],
        on: tuple[float, float],
        off: tuple[float, float],
        watts: float,
    ) -> None:
        """Let an appliance switch on and off, from the begin to the end of a span."""
        at, end = span
        while at < end:
            length = self._dice.uniform(*on)
            self.add(at, length, watts)
            at += length + self._dice.uniform(*off)

    def happens(self, chance: float) -> bool:
        """Return whether something happens today."""
        return self._dice.random() < chance


def household(dice: Random) -> list[float]:
    """Return the power of an invented household in each second of a day, W."""
    house = _Household(dice)
    # Refrigerator, kettle, hob, washing machine, dishwasher, and odds and ends.
    fridge = (dice.uniform(0, 3600), MINUTES * 60.0)
    house.cycles(fridge, (900, 1500), (1800, 3000), 90)
    for hour, chance in ((5, 0.9), (7, 0.5), (10, 0.4), (14, 0.6), (18, 0.4)):
        if house.happens(chance):
            house.add((hour + dice.random()) * 3600, dice.uniform(90, 240), 2000)
    for hour, chance in ((9.8, 0.5), (16.5, 0.8)):
        if house.happens(chance):
            start = hour * 3600 + dice.uniform(0, 1800)
            meal = (start, start + dice.uniform(900, 2700))
            house.cycles(meal, (10, 60), (20, 60), 1800)
    if house.happens(0.5):
        start = dice.uniform(7, 15) * 3600
        house.add(start, 900, 2100)
        house.add(start + 900, 3600, 180)
    if house.happens(0.6):
        start = dice.uniform(11, 18) * 3600
        for later in (300, 3000):
            house.add(start + later, 900, 1900)
    for _ in range(dice.randint(0, 6)):
        start = dice.uniform(4, 20) * 3600
        house.add(start, dice.uniform(20, 900), dice.uniform(300, 1500))
    return house.power
