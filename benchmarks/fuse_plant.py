"""Meter, boxes and cars behind a main fuse, second by second, and what controls them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from random import Random
from typing import Final, Protocol

from custom_components.evse_bus.house.fuse import Fuse, Guarded, PhaseReport
from custom_components.evse_bus.house.guard import Guard
from custom_components.evse_bus.house.phases import Rotation
from custom_components.evse_bus.house.readings import (
    ChargerReport,
    ChargerSettings,
    Phases,
)

from .fuse_house import DAY, HOUR, Trace

RATING: Final = 25.0
ABOVE: Final = (25.0, 31.0)
"""A; the seconds above are counted. 31 A is what a gG fuse holds for an hour."""
CURRENT: Final = 16.0
"""A; what a car takes at most."""
ARRIVES, LEAVES = 17 * HOUR, 7 * HOUR
"""A car is there from the evening to the morning, and takes what it is offered."""


@dataclass(frozen=True, slots=True)
class Box:
    """A kind of charger: how soon it and its car follow."""

    name: str
    interval: float
    """From request to request, s: a ceiling is sent, and the current read, with each."""
    applies: float
    """Longest time from the request until the pilot has it, s."""
    car: float
    """Longest time until the car follows, s."""

    @property
    def reaction(self) -> float:
        """Return the worst time that it says of itself, s."""
        return self.interval + self.applies + self.car


@dataclass(frozen=True, slots=True)
class Meter:
    """A meter: how often it reports, and how it fails."""

    period: float
    drop_outs: float = 0.0
    """A day; nothing is reported for 20 s to 5 min."""
    freezes: float = 0.0
    """A day; the values stay for 20 s to 5 min, and are reported all the same."""


@dataclass(frozen=True, slots=True)
class Car:
    """A car on a box, and what was set for that box."""

    phases: int = 3
    order: Sequence[int] = (0, 1, 2)
    """The house's phases at the box, in truth."""
    rotation: Rotation = Rotation.RST
    """The same, as the user has set it."""
    measured: bool = True


@dataclass(slots=True)
class Outcome:
    """What has happened at the fuse."""

    days: float
    seconds: list[int] = field(default_factory=lambda: [0, 0])
    """Above 25 A and above 31 A, on any phase."""
    longest: list[int] = field(default_factory=lambda: [0, 0])
    lasted: list[int] = field(default_factory=lambda: [0, 0])
    energy: float = 0.0
    """Share of what the cars would have taken without a fuse."""
    pauses: int = 0

    def count(self, current: float) -> None:
        """Count a second with this current on the worst phase, A."""
        for at, above in enumerate(ABOVE):
            if current > above:
                self.seconds[at] += 1
                self.lasted[at] += 1
                self.longest[at] = max(self.longest[at], self.lasted[at])
            else:
                self.lasted[at] = 0


class Controller(Protocol):
    """What orders currents."""

    def arrived(self) -> None:
        """Take note of new cars."""

    def charger(self, name: str, report: ChargerReport, now: float) -> None:
        """Take what a box reports."""

    def meter(self, currents: Phases[float], now: float) -> None:
        """Take what the meter reports."""

    def look(self, now: float) -> Mapping[str, float]:
        """Return the currents."""


class OurGuard:
    """The guard of the integration."""

    def __init__(self, box: Box, cars: Sequence[Car], safe: float) -> None:
        """Guard a fuse with these boxes behind it."""
        self._guard = Guard(Fuse(rating=RATING, safe=safe))
        self._guard.configure(
            [
                Guarded(
                    settings=ChargerSettings(
                        charger=str(at), maximum=CURRENT, step=0.1
                    ),
                    rotation=car.rotation,
                    reaction=box.reaction,
                )
                for at, car in enumerate(cars)
            ],
            {},
            0,
        )

    def arrived(self) -> None:
        """Take note of new cars."""
        for name in self._guard.kept:
            self._guard.begin_visit(name)

    def charger(self, name: str, report: ChargerReport, now: float) -> None:
        """Take what a box reports."""
        self._guard.charger(name, report, now)

    def meter(self, currents: Phases[float], now: float) -> None:
        """Take what the meter reports."""
        self._guard.meter(PhaseReport(at=now, currents=currents), now)

    def look(self, now: float) -> Mapping[str, float]:
        """Return the currents."""
        return {name: one.current for name, one in self._guard.look(now).items()}


class Automation:
    """The rival: "set 6 A when L1 rises above 23 A".

    It must be raised again, or the car charges with 6 A for the night: to 16 A once L1
    has been below 13 A for ten minutes.
    """

    def __init__(self, names: Iterable[str]) -> None:
        """Begin with all that the car can take."""
        self._names = tuple(names)
        self._current = CURRENT
        self._above = False
        self._low: float | None = None

    def arrived(self) -> None:
        """Take note of new cars."""

    def charger(self, name: str, report: ChargerReport, now: float) -> None:
        """Take what a box reports."""

    def meter(self, currents: Phases[float], now: float) -> None:
        """Take what the meter reports."""
        current = currents[0]
        if current > 23 and not self._above:  # noqa: PLR2004
            self._current = 6.0
        self._above = current > 23  # noqa: PLR2004
        if current >= 13:  # noqa: PLR2004
            self._low = None
        elif self._low is None:
            self._low = now
        if self._low is not None and now - self._low >= 600:  # noqa: PLR2004
            self._current = CURRENT

    def look(self, now: float) -> Mapping[str, float]:  # noqa: ARG002
        """Return the currents."""
        return dict.fromkeys(self._names, self._current)


class Unguarded(Automation):
    """Nothing guards the fuse."""

    def meter(self, currents: Phases[float], now: float) -> None:
        """Take what the meter reports."""


class _Charger:
    """A box with its car."""

    def __init__(self, name: str, box: Box, car: Car, chance: Random) -> None:
        self.name = name
        self.order = tuple(car.order[: car.phases])
        self.current = 0.0
        """A that the car draws."""
        self.ceiling = 0.0
        self._car = car
        self._box = box
        self._chance = chance
        self._offered = 0.0
        self._next = chance.uniform(0, box.interval)
        self._orders: list[tuple[float, float]] = []
        self._follows: list[tuple[float, float]] = []

    def step(self, now: float, *, present: bool) -> ChargerReport | None:
        """Go on for a second; return what the box reports, when it is asked."""
        report = None
        if now >= self._next:
            self._next += self._box.interval
            report = self._report(now)
            if self.ceiling != (self._orders[-1][1] if self._orders else self._offered):
                after = self._chance.uniform(0, self._box.applies)
                self._orders.append((now + after, self.ceiling))
        while self._orders and now >= self._orders[0][0]:
            self._offered = self._orders.pop(0)[1]
            after = self._chance.uniform(1, self._box.car)
            self._follows.append((now + after, self._offered))
        while self._follows and now >= self._follows[0][0]:
            self._taken = self._follows.pop(0)[1]
        self.current = min(self._taken, CURRENT) if present else 0.0
        return report

    _taken = 0.0

    def _report(self, now: float) -> ChargerReport:
        flows = [0.0, 0.0, 0.0]
        for at in range(self._car.phases):
            flows[at] = self.current
        return ChargerReport(
            at=now,
            currents=(flows[0], flows[1], flows[2])
            if self._car.measured
            else (None, None, None),
            offered=self._offered,
        )


class _Reports:
    """The reports of a meter."""

    def __init__(self, meter: Meter, chance: Random, seconds: int) -> None:
        self._meter = meter
        self._next = chance.uniform(0, meter.period)
        days = seconds / DAY
        self._silent = self._times(chance, meter.drop_outs * days, seconds)
        self._frozen = self._times(chance, meter.freezes * days, seconds)
        self._last: Phases[float] | None = None

    @staticmethod
    def _times(chance: Random, count: float, seconds: int) -> list[tuple[float, float]]:
        starts = sorted(chance.uniform(0, seconds) for _ in range(round(count)))
        return [(start, start + chance.uniform(20, 300)) for start in starts]

    def step(
        self, now: float, currents: Callable[[], Phases[float]]
    ) -> Phases[float] | None:
        """Return what it reports in this second."""
        if now < self._next:
            return None
        self._next += self._meter.period
        if _within(self._silent, now):
            return None
        if self._last is None or not _within(self._frozen, now):
            self._last = currents()
        return self._last


def _within(times: list[tuple[float, float]], now: float) -> bool:
    while times and now >= times[0][1]:
        times.pop(0)
    return bool(times) and now >= times[0][0]


def run(
    trace: Trace,
    controller: Controller,
    meter: Meter,
    box: Box,
    cars: Sequence[Car],
) -> Outcome:
    """Run the house with these cars, and return what happened."""
    chance = Random(1)  # noqa: S311
    chargers = [_Charger(str(at), box, car, chance) for at, car in enumerate(cars)]
    reports = _Reports(meter, chance, trace.seconds)
    outcome = Outcome(trace.seconds / DAY)
    one, two, three = trace.phases
    flows = [0.0, 0.0, 0.0]
    taken = wanted = 0.0
    looked = -inf
    for second in range(trace.seconds):
        now = float(second)
        clock = second % DAY
        if clock == ARRIVES:
            controller.arrived()
        present = clock >= ARRIVES or clock < LEAVES
        flows[:] = (one[second], two[second], three[second])
        due = now - looked >= 10  # noqa: PLR2004
        for charger in chargers:
            report = charger.step(now, present=present)
            if report is not None:
                controller.charger(charger.name, report, now)
                due = True
            for phase in charger.order:
                flows[phase] += charger.current
            taken += charger.current
            wanted += CURRENT if present else 0.0
        found = reports.step(now, lambda: (flows[0], flows[1], flows[2]))
        if found is not None:
            controller.meter(found, now)
            due = True
        if due:
            looked = now
            for name, current in controller.look(now).items():
                charger = chargers[int(name)]
                outcome.pauses += charger.ceiling > 0 and not current
                charger.ceiling = current
        outcome.count(max(flows))
    outcome.energy = taken / wanted if wanted else 0.0
    return outcome
