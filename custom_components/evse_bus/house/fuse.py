"""The main fuse and the chargers behind it: what the guard is given, and its grants."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import isfinite
from typing import Any, Final, Self

from .phases import Order, Rotation, offered_on
from .readings import LARGEST, ChargerSettings, Phases

PLAUSIBLE: Final = LARGEST / 230
"""A; more on a phase is no reading of a house."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fuse:
    """The main fuse and the meter beside it."""

    rating: float
    """A per phase."""
    safe: float = 6.0
    """A that each charger may have while the meter is silent; 0: it pauses."""
    signed: bool = True
    """The meter's currents are negative where the house exports."""
    feeds_in: bool = True
    """Something in the house can export: sun, a battery, a car."""

    def __post_init__(self) -> None:
        """Raise ValueError for a fuse that cannot be guarded."""
        if not isfinite(self.rating) or self.rating < 0:
            raise ValueError("the rating of a fuse is a number of A")
        if not isfinite(self.safe) or self.safe < 0:
            raise ValueError("the safe current is a number of A")
        if self.feeds_in and not self.signed:
            raise ValueError("unsigned currents do not show whether a phase exports")


@dataclass(frozen=True, slots=True, kw_only=True)
class Guarded:
    """A charger behind the fuse."""

    settings: ChargerSettings
    """Its maximum is the most that all else allows now: 0, if it does not charge."""
    rotation: Rotation = Rotation.UNKNOWN
    reaction: float = 30.0
    """Worst time from a lower ceiling until the car draws less: box and car, s."""

    def __post_init__(self) -> None:
        """Raise ValueError for a reaction that is not a time."""
        if not isfinite(self.reaction) or self.reaction < 0:
            raise ValueError("a reaction is a time in s")

    @property
    def phases(self) -> Order:
        """Return the phases of the house that it may load."""
        return offered_on(self.rotation, self.settings.wired)


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseReport:
    """One report of the currents at the fuse, also one with the values of before."""

    at: float
    """Its own time."""
    currents: Phases[float | None]
    """A, import positive."""
    restored: bool = False
    """It is a state of before a restart, which is no report."""


class Reason(StrEnum):
    """Why a charger has no more than it has."""

    NOTHING = "nothing"
    """The fuse leaves all that the charger can take."""
    MAIN_FUSE = "main_fuse"
    RESTART = "restart"
    """Paused for the fuse; the time until the next start is not over."""
    METER = "meter"
    """The meter is silent, or has not reported twice yet."""
    METER_SLOW = "meter_slow"
    """The meter reports too seldom to guard a fuse with it."""
    REACTION = "reaction"
    """Meter, box and car are together too slow for more than the minimum."""
    NOT_WANTED = "not_wanted"
    """Order, charger or cable allow less than the minimum."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Grant:
    """What a charger may offer as far as the fuse is concerned."""

    current: float
    """A; 0: pause."""
    reason: Reason
    phase: int | None = None
    """The phase of the house, 0 to 2, that leaves least."""
    short: float = 0.0
    """A that are missing for its minimum."""
    seconds: float = 0.0
    """Time until a restart, where that is known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptPauses:
    """What the guard must know of a charger after a restart; plain values."""

    pauses: int = 0
    """Pauses for the fuse in this visit."""
    paused: bool = False

    def as_dict(self) -> dict[str, Any]:
        """Return it for a file."""
        return {"pauses": self.pauses, "paused": self.paused}

    @classmethod
    def from_dict(cls, values: object) -> Self | None:
        """Return what a file has; ``None`` for anything that it cannot be."""
        if not isinstance(values, Mapping):
            return None
        pauses, paused = values.get("pauses"), values.get("paused")
        if type(pauses) is not int or pauses < 0 or not isinstance(paused, bool):
            return None
        return cls(pauses=pauses, paused=paused)
