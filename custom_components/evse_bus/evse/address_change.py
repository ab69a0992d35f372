"""Giving a charger another address on its bus, over the wire."""

from dataclasses import dataclass
from enum import StrEnum
from typing import override

from .errors import EvseError


@dataclass(frozen=True, slots=True, kw_only=True)
class AddressChange:
    """The charger that answers alone at one address gets another one."""

    old: int
    new: int
    serial: str | None = None
    """Serial number of the charger that is meant; ``None``: whichever answers."""
    unplugged: bool = False
    """The user has confirmed that no car is plugged in; counts only where the charger
    itself cannot show it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AddressChanged:
    """What has become of an address change that has succeeded."""

    serial: str
    """Serial number of the charger."""
    old_in_use: bool = False
    """Another charger answers at the old address now."""
    enabled: bool = False
    """Its outlet was disabled before, and could not be disabled again."""


class Problem(StrEnum):
    """Why a charger has not got another address, and what state it is in."""

    # Nothing was written.
    NO_REPLY = "no_reply"
    SEVERAL = "several"
    """More than one charger answers, or the line is bad."""
    NO_SERIAL = "no_serial"
    """Without a serial number it cannot be told from another one."""
    OTHER_CHARGER = "other_charger"
    """Another one than the one that is meant."""
    IN_USE = "in_use"
    """Something answers at the new address."""
    PLUGGED = "plugged"
    CAR_UNKNOWN = "car_unknown"
    """It cannot show whether a car is plugged in: the user has to confirm it."""
    STATE = "state"
    """Its state allows no change."""
    GIVEN_UP = "given_up"
    # It was written to, and works at its old address.
    REFUSED = "refused"
    NOT_TAKEN = "not_taken"
    # It was written to, and may be out of order until the change is repeated.
    IN_SET_UP = "in_set_up"
    """It stays in set-up."""
    SECOND_CHARGER = "second_charger"
    """Another one was switched on in the middle; the first stays in set-up."""
    BOTH = "both"
    """It answers at both addresses."""
    SEVERAL_AT_NEW = "several_at_new"
    LOST = "lost"
    """It answers at neither."""
    INTERRUPTED = "interrupted"
    """The line was lost, or the bus stopped."""


class AddressChangeError(EvseError):
    """A charger has not got another address."""

    def __init__(self, message: str, problem: Problem, **details: str) -> None:
        """``details``: values that a translated message can contain."""
        super().__init__(message)
        self.problem = problem
        self._details = details

    @property
    @override
    def details(self) -> dict[str, str]:
        return self._details
