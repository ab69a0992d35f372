"""The sun account, and what it is compared with: evcc's PV mode, a plain automation.

The others by description, not by their code: evcc sets present current + surplus / (V
phases) in each interval; it enables when the surplus has covered the minimum for 60 s,
and disables at the minimum after an import of 180 s. Without a meter it leaves the offer
as it is. The automation offers the floor of the surplus every 20 s.
"""

from collections.abc import Sequence
from math import floor, inf
from typing import Final

from custom_components.evse_bus.house.allotment import Allotment
from custom_components.evse_bus.house.readings import (
    BatteryReport,
    ChargerReport,
    ChargerSettings,
    GridReport,
    Mode,
)
from custom_components.evse_bus.house.surplus import Surplus

from .sun_plant import MAXIMUM, MINIMUM, VOLTS, Cell, Seen

ENABLE: Final = 60.0
DISABLE: Final = 180.0
PATIENCE: Final = 60.0
"""evcc takes no value of a meter that is so late, s."""
NIGHT: Final = 3600.0
"""A longer time without a look was a night: the cars were away."""


class Account:
    """The controller of the house."""

    every = 10
    every_report = True

    def __init__(self, cell: Cell, mode: Mode = Mode.SUN) -> None:
        """Begin with all cars paused."""
        self._surplus = Surplus(cell.battery and cell.battery.priority)
        self._allotment = Allotment()
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
        self._allotment.configure(settings, {}, 0.0)
        self._offers = [0.0] * len(settings)
        self._last = -inf

    def measured(self, at: float, powers: Sequence[float]) -> None:
        """Take what the chargers have measured."""
        self._surplus.cars(at, sum(powers))

    def look(self, seen: Seen) -> Sequence[float]:
        """Decide at a report of the meter, and every 10 s."""
        now = seen.at
        if now - self._last > NIGHT:
            for one in self._allotment.contenders.values():
                one.take(ChargerReport(at=now, power=0.0, plugged=False), now)
            self._decide(now)
        self._last = now
        for one, power in zip(
            self._allotment.contenders.values(), seen.powers, strict=True
        ):
            phases = one.settings.wired
            current = power / VOLTS / phases
            two, three = (current if phases > at else 0.0 for at in (1, 2))
            currents = (current, two, three)
            report = ChargerReport(at=now, power=power, currents=currents, plugged=True)
            one.take(report, now)
        if seen.fresh and seen.grid is not None:
            if seen.charge is not None:
                battery = BatteryReport(at=now, power=seen.battery, charge=seen.charge)
                self._surplus.battery(battery, now)
            self._surplus.grid(GridReport(at=now, power=seen.grid), now)
        offers = self._decide(now)
        if offers != self._offers:
            self._surplus.moved(now)
        self._offers = offers
        return offers

    def _decide(self, now: float) -> list[float]:
        surplus = self._surplus
        decisions = self._allotment.look(
            now, surplus.power, surplus.take_elapsed(now), surplus.silence(now)
        )
        return [one.current for one in decisions.values()]


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
