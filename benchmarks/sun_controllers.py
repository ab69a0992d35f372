"""The sun account, and what it is compared with: evcc's PV mode, a plain automation.

The others by description, not by their code: evcc sets present current + surplus / (V
phases) in each interval; it enables when the surplus has covered the minimum for 60 s,
and disables at the minimum after an import of 180 s. Without a meter it leaves the offer
as it is. The automation offers the floor of the surplus every 20 s.
"""

from collections.abc import Sequence
from math import floor, inf
from typing import Final

from custom_components.evse_bus.house.composition import House
from custom_components.evse_bus.house.fuse import Guarded
from custom_components.evse_bus.house.readings import (
    BatteryReport,
    ChargerReport,
    ChargerSettings,
    GridReport,
    Mode,
)

from .sun_plant import MAXIMUM, MINIMUM, VOLTS, Cell, Seen

ENABLE: Final = 60.0
DISABLE: Final = 180.0
PATIENCE: Final = 60.0
"""evcc takes no value of a meter that is so late, s."""
NIGHT: Final = 3600.0
"""A longer time without a look was a night: the cars were away."""


class Account:
    """The controller of the house, without a fuse."""

    every = 10
    every_report = True

    def __init__(self, cell: Cell, mode: Mode = Mode.SUN) -> None:
        """Begin with all cars paused."""
        self._house = House(cell.battery and cell.battery.priority)
        settings = [
            ChargerSettings(
                charger=str(at),
                mode=mode,
                minimum=MINIMUM,
                maximum=MAXIMUM,
                step=car.step,
                volts=VOLTS,
                wired=car.phases,
            )
            for at, car in enumerate(cell.cars)
        ]
        self._phases = {one.charger: one.wired for one in settings}
        guarded = (Guarded(settings=one) for one in settings)
        self._house.configure(guarded, {}, 0.0)
        self._last = -inf

    def measured(self, at: float, powers: Sequence[float]) -> None:
        """Take what the chargers have measured."""
        if at - self._last > NIGHT:
            for name in self._phases:
                away = ChargerReport(at=at, power=0.0, plugged=False)
                self._house.charger(name, away, at)
            self._house.look(at)
        self._last = at
        for (name, phases), power in zip(self._phases.items(), powers, strict=True):
            current = power / VOLTS / phases
            two, three = (current if phases > other else 0.0 for other in (1, 2))
            currents = (current, two, three)
            report = ChargerReport(at=at, power=power, currents=currents, plugged=True)
            self._house.charger(name, report, at)

    def look(self, seen: Seen) -> Sequence[float]:
        """Decide at a report of the meter, and every 10 s."""
        now = seen.at
        if seen.fresh and seen.grid is not None:
            if seen.charge is not None:
                battery = BatteryReport(at=now, power=seen.battery, charge=seen.charge)
                self._house.battery(battery, now)
            self._house.grid(GridReport(at=now, power=seen.grid), now)
        return [one.current for one in self._house.look(now).values()]


def _down(current: float, step: float) -> float:
    return floor(current / step + 1e-6) * step


def _surplus(cell: Cell, seen: Seen) -> float:
    """Return the surplus, W, with the battery's part where it has no priority."""
    assert seen.grid is not None  # noqa: S101
    battery = seen.battery
    if cell.battery is not None and (seen.charge or 0.0) < cell.battery.priority:
        battery = max(battery, 0.0)
    return -seen.grid - battery


class Evcc:
    """The PV mode of evcc with one or more loadpoints, one in each interval."""

    every_report = False

    def __init__(self, cell: Cell, every: int) -> None:
        """Begin with all cars paused; ``every``: its interval, s."""
        self.every = every
        self._cell = cell
        self._offers = [0.0] * len(cell.cars)
        self._since: list[float | None] = [None] * len(cell.cars)
        self._turn = 0

    def measured(self, at: float, powers: Sequence[float]) -> None:
        """Look only at the last."""

    def look(self, seen: Seen) -> Sequence[float]:
        """Update one loadpoint."""
        if seen.grid is None or seen.age > self._cell.period + PATIENCE:
            return self._offers
        at = self._turn = (self._turn + 1) % len(self._cell.cars)
        car = self._cell.cars[at]
        ampere = VOLTS * car.phases
        surplus = _surplus(self._cell, seen)
        target = (seen.powers[at] + surplus) / ampere
        if not self._offers[at]:
            if self._lasts(at, surplus >= MINIMUM * ampere, seen.at, ENABLE):
                self._offers[at] = MINIMUM
            return self._offers
        self._offers[at] = _down(max(MINIMUM, min(MAXIMUM, target)), car.step)
        short = target < MINIMUM and surplus < 0
        if self._lasts(at, short, seen.at, DISABLE):
            self._offers[at] = 0.0
        return self._offers

    def _lasts(self, at: int, is_so: bool, now: float, seconds: float) -> bool:  # noqa: FBT001
        since = self._since[at]
        if not is_so:
            self._since[at] = None
        elif since is None:
            self._since[at] = now
        elif now - since >= seconds:
            self._since[at] = None
            return True
        return False


class Automation:
    """The floor of the surplus every 20 s, once for each charger."""

    every = 20
    every_report = False

    def __init__(self, cell: Cell) -> None:
        """Begin with all cars paused."""
        self._cell = cell

    def measured(self, at: float, powers: Sequence[float]) -> None:
        """Look only at the last."""

    def look(self, seen: Seen) -> Sequence[float]:
        """Offer the floor of the surplus to each, as if it were alone."""
        if seen.grid is None:
            return [0.0] * len(seen.powers)
        offers = []
        for car, power in zip(self._cell.cars, seen.powers, strict=True):
            current = _down((power - seen.grid) / VOLTS / car.phases, car.step)
            offers.append(0.0 if current < MINIMUM else min(MAXIMUM, current))
        return offers
