"""Options: what the configuration of a protocol's chargers has beside common fields.

An option has three forms: typed (the content of a form field), stored (JSON), and the
value in the protocol's `ChargerConfig`, in the field of the same name.
"""

from abc import ABC
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, override


@dataclass(frozen=True, slots=True, kw_only=True)
class Option(ABC):
    """One option; by default its three forms are the same."""

    name: str
    """Field of the `ChargerConfig`, and key of the form field, texts and stored data.

    An invalid value has the text ``bad_<name>``.
    """
    default: Any
    """Typed form of the field's default."""
    prominent: bool = False
    """Among the first fields of the form and in the summary, not folded away."""
    before_search: bool = False
    """Also asked for before a search that sets limits on an unknown charger."""

    def store(self, typed: Any) -> Any:  # noqa: ANN401 - depends on the option
        """Return the stored form; raises ValueError for an invalid value."""
        return typed

    def show(self, stored: Any) -> Any:  # noqa: ANN401
        """Return the typed form of a stored value."""
        return stored

    def load(self, stored: Any) -> Any:  # noqa: ANN401
        """Return the configuration's value of a stored value."""
        return stored


@dataclass(frozen=True, slots=True, kw_only=True)
class Toggle(Option):
    """On or off."""

    default: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Quantity(Option):
    """A number in a range."""

    lowest: float
    highest: float
    whole: bool = True
    """A whole number; otherwise a float."""
    step: float = 1
    unit: str

    @override
    def store(self, typed: Any) -> float:
        if not self.lowest <= (number := float(typed)) <= self.highest:
            raise ValueError(typed)
        if not self.whole:
            return number
        if not number.is_integer():
            raise ValueError(typed)
        return int(number)


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice(Option):
    """One of several values, each with a text."""

    values: Mapping[str, Any]
    """Stored form by typed form."""
    value: Callable[[Any], Any] = lambda stored: stored
    """Return the configuration's value of a stored one."""
    alone: frozenset[str] = frozenset()
    """Typed forms that require the charger to be the only one on its bus; otherwise
    the text ``<name>_not_alone``."""

    @override
    def store(self, typed: Any) -> Any:
        if typed not in self.values:
            raise ValueError(typed)
        return self.values[typed]

    @override
    def show(self, stored: Any) -> str:
        return next(typed for typed, one in self.values.items() if one == stored)

    @override
    def load(self, stored: Any) -> Any:
        return self.value(stored)

    def needs_solitude(self, stored: Any) -> bool:  # noqa: ANN401
        """Return whether a stored value requires the charger to be alone."""
        return any(self.values[typed] == stored for typed in self.alone)


@dataclass(frozen=True, slots=True, kw_only=True)
class HexBytes(Option):
    """A fixed number of bytes, typed and stored as hexadecimal digits."""

    length: int

    @override
    def store(self, typed: Any) -> str:
        data = bytes.fromhex(typed)
        if len(data) != self.length:
            raise ValueError(typed)
        return data.hex().upper()

    @override
    def load(self, stored: Any) -> bytes:
        return bytes.fromhex(stored)
