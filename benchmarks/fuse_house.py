"""A winter house on 3 x 25 A, synthetic: its current on each phase, second by second.

There is no published trace of three phase currents at 1 s that may be used here. So the
appliances of a house with a heat pump are drawn at random, by a seed: how often, for how
long and with how much is in `_day`. The counts are such that the house alone is above
25 A for some 41 s a day.
"""

from array import array
from dataclasses import dataclass
from random import Random
from typing import Final

DAY: Final = 86400
HOUR: Final = 3600
SEED: Final = 12
"""Of 15 seeds the one whose ten days come nearest to 41 s a day above 25 A."""


@dataclass(frozen=True, slots=True)
class Trace:
    """Currents of the house without cars, A, each second."""

    phases: tuple[array[float], array[float], array[float]]

    @property
    def seconds(self) -> int:
        """Return how long it is."""
        return len(self.phases[0])


class _Day:
    def __init__(self, chance: Random, trace: Trace, start: int) -> None:
        self.chance = chance
        self._phases = trace.phases
        self._start = start

    def run(self, phase: int, at: float, seconds: float, current: float) -> None:
        """Switch something on for some time."""
        first = self._start + max(0, int(at))
        last = self._start + min(DAY, int(at + seconds))
        values = self._phases[phase]
        for second in range(first, last):
            values[second] += current

    def cycles(  # noqa: PLR0913 - one row of a table
        self,
        phase: int,
        at: float,
        seconds: float,
        current: float,
        *,
        on: float,
        off: float,
    ) -> None:
        """Switch something on and off again and again, as a thermostat does."""
        end = at + seconds
        while at < end:
            length = on * self.chance.uniform(0.7, 1.3)
            self.run(phase, at, min(length, end - at), current)
            at += length + off * self.chance.uniform(0.7, 1.3)

    def hour(self, first: float, last: float) -> float:
        """Return a time of the day, s."""
        return self.chance.uniform(first * HOUR, last * HOUR)

    def minutes(self, least: float, most: float) -> float:
        """Return a duration, s."""
        return 60 * self.chance.uniform(least, most)


def house(days: int, seed: int = SEED) -> Trace:
    """Return some days of the house."""
    length = days * DAY
    trace = Trace(
        (
            array("d", [0.7]) * length,
            array("d", [0.9]) * length,
            array("d", [0.5]) * length,
        )
    )
    for day in range(days):
        _day(_Day(Random(f"{seed}/{day}"), trace, day * DAY))  # noqa: S311
    return trace


def _day(day: _Day) -> None:  # noqa: C901, PLR0912 - a list of appliances
    chance = day.chance
    # A heat pump on three phases, 2 kW, in long runs.
    at = day.minutes(0, 40)
    while at < DAY:
        length = day.minutes(25, 50)
        for phase in range(3):
            day.run(phase, at, length, 3.0)
        at += length + day.minutes(20, 40)
    for phase in range(3):
        # Light, consumer electronics, a freezer.
        day.run(phase, day.hour(16, 17.5), day.minutes(300, 400), 1.1)
        day.cycles(phase, 0, DAY, 0.5, on=700, off=1500)
    # Kettle and microwave, 2.2 kW and 1.3 kW, on L1.
    for _ in range(chance.randint(3, 6)):
        day.run(0, day.hour(6, 22), day.minutes(1.5, 3.5), 9.5)
        day.run(0, day.hour(6, 22), day.minutes(1, 4), 5.6)
    # The hob: two zones, on L2 and L3, which switch themselves on and off.
    for at in (day.hour(11.5, 12.5), day.hour(17.5, 19)):
        for phase, current in ((1, 7.8), (2, 6.5)):
            day.run(phase, at, day.minutes(2, 4), current)
            day.cycles(phase, at + 240, day.minutes(10, 25), current, on=8, off=12)
    # The oven on L3, 2.3 kW.
    if chance.random() < 0.5:  # noqa: PLR2004
        at = day.hour(17, 19)
        day.run(2, at, day.minutes(8, 12), 10.0)
        day.cycles(2, at + 700, day.minutes(25, 50), 10.0, on=50, off=110)
    # Dishwasher on L1, washing machine on L2.
    if chance.random() < 0.9:  # noqa: PLR2004
        at = day.hour(19, 22)
        for _ in range(2):
            day.run(0, at, day.minutes(7, 11), 8.2)
            at += day.minutes(35, 50)
    for _ in range(chance.randint(0, 2)):
        day.run(1, day.hour(8, 18), day.minutes(12, 18), 8.7)
    # Hair dryer and vacuum cleaner, on L2.
    for _ in range(chance.randint(1, 3)):
        day.run(1, day.hour(6, 22), day.minutes(2, 6), 6.9)
    # An instantaneous water heater, 16 kW on three phases, for hands and cups: mostly
    # in the daytime.
    times = [day.hour(7, 17) for _ in range(chance.randint(4, 7))]
    times += [day.hour(17, 22) for _ in range(chance.randint(0, 2))]
    for at in times:
        length = chance.uniform(4, 12)
        for phase in range(3):
            day.run(phase, at, length, 22.8)
