"""What comes in: reports of the meter, of the home battery and of the chargers.

Signs: import from the grid and discharge of the battery are positive.
"""

from dataclasses import dataclass
from enum import StrEnum
from math import isfinite
from typing import Final

type Phases[T] = tuple[T, T, T]
"""Values of L1, L2, L3."""

LARGEST: Final = 100_000.0
"""W; a greater power is no reading of a house (a wrong unit, a broken message)."""
FLOWING: Final = 1.0
"""A on a phase from which it counts as in use."""
WIRES: Final = 3
"""Phases of a supply."""


class Mode(StrEnum):
    """How a charger uses the sun; the user chooses it."""

    FAST = "fast"
    """The order alone."""
    MINIMUM_AND_SUN = "minimum_and_sun"
    MOST_SUN = "most_sun"
    SUN = "sun"
    SUN_ONLY = "sun_only"


@dataclass(frozen=True, slots=True, kw_only=True)
class GridReport:
    """One report of the grid meter, also one with the value of before."""

    at: float
    """Its own time, not that of its processing."""
    power: float
    """W, import positive."""
    restored: bool = False
    """It is a state of before a restart, which is no report."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BatteryReport:
    """One report of the home battery."""

    at: float
    power: float
    """W, discharge positive."""
    charge: float | None = None
    """State of charge, %; ``None``: not known."""
    restored: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ChargerReport:
    """What is known of a charger now; ``None``: not known."""

    at: float
    """Time of the measurement."""
    power: float | None = None
    """W, measured by the charger or by a meter of its own."""
    currents: Phases[float | None] = (None, None, None)
    """A, measured."""
    volts: float | None = None
    """V between a phase and neutral, measured."""
    offered: float | None = None
    """A that the box offers a car; 0: it is paused."""
    plugged: bool | None = None
    session: str | None = None
    """What the box reports of the visit (a session number, a card): another one is
    another visit."""

    @property
    def phases(self) -> int:
        """Return on how many phases current flows."""
        return sum(
            one is not None and isfinite(one) and one >= FLOWING
            for one in self.currents
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ChargerSettings:
    """What does not change by itself: the installation, and the user's choices."""

    charger: str
    """Its name in all results; two boxes never share one."""
    serial: str | None = None
    mode: Mode = Mode.SUN
    minimum: float = 6.0
    """A; the least with which a car charges."""
    maximum: float = 16.0
    """A; the most that the order, the charger and its cable allow now, 0: nothing."""
    step: float = 1.0
    """A; the least change that its protocol can send."""
    volts: float = 230.0
    wired: int = 3
    """Phases that the box is wired to."""
    phases: int | None = None
    """Phases that the user has set for its car."""
    unplug_is_reported_in_a_pause: bool = True
    """False: a box that we have paused reports "unplugged" with a car at it, too."""

    def __post_init__(self) -> None:
        """Raise ValueError for numbers with which nothing can be computed."""
        numbers = (self.minimum, self.maximum, self.step, self.volts)
        if not all(isfinite(one) for one in numbers):
            raise ValueError("a setting is not a finite number")
        if min(self.minimum, self.step, self.volts) <= 0 or self.maximum < 0:
            raise ValueError("minimum, step and voltage are above 0")
        if not 1 <= self.wired <= WIRES or not 1 <= (self.phases or 1) <= WIRES:
            raise ValueError("a charger has 1 to 3 phases")


def plausible(power: float | None) -> bool:
    """Return whether this can be a power of a house, W."""
    return power is not None and isfinite(power) and abs(power) <= LARGEST
