"""Address forms: how people name the place of a charger on a protocol's bus."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import override

from .scan import Address


@dataclass(frozen=True, slots=True, kw_only=True)
class AddressForm(ABC):
    """How an address is typed and shown.

    Subclasses differ in the kind of address; the fields are common to all.
    """

    key: str
    """Key of the form field and of its texts; of several addresses with an ``s``, of
    an invalid one with ``bad_`` in front."""
    any: Address | None = None
    """Address that every charger answers to; for one that is alone on its line."""
    optional: bool = False
    """May be left empty: then the first charger found is kept. Needs `any`."""
    is_serial: bool = False
    """The address is the serial number."""
    has_serial: bool = True
    """A charger reports a serial number, which can be checked."""
    single: bool = False
    """A bus has one charger; no second one is added."""

    @property
    def plural(self) -> str:
        """Return the key of the form field for several addresses."""
        return f"{self.key}s"

    @property
    def error(self) -> str:
        """Return the key of the text for an invalid address."""
        return f"bad_{self.key}"

    @abstractmethod
    def parse(self, text: object) -> Address:
        """Return the address of a typed text; raises ValueError."""

    @abstractmethod
    def show(self, address: Address) -> str:
        """Return an address as it is printed on the charger."""

    def label(self, address: Address) -> str:
        """Return an address as people set it on the charger."""
        return self.show(address)

    def title(self, address: Address) -> str:
        """Return the part of a charger's name that stands for its address."""
        return self.label(address)

    def serial(self, address: Address) -> str | None:
        """Return the serial number that an address stands for, if it is one."""
        if not self.is_serial or address == self.any:
            return None
        return str(address)


@dataclass(frozen=True, slots=True, kw_only=True)
class NumberAddress(AddressForm):
    """A whole number in a range."""

    lowest: int
    highest: int
    digits: int = 1
    """Digits it is shown with, zeros in front."""
    labelled: bool = False
    """Each number has a text of its own, under the key of the form."""
    menu: Mapping[int, tuple[str, ...]] = field(default_factory=dict)
    """Settings in the menu of the charger that stand for numbers: in its firmwares."""

    @override
    def parse(self, text: object) -> int:
        typed = str(text).strip()
        if not typed.isdecimal() or not typed.isascii():
            raise ValueError(typed)
        if not self.lowest <= (address := int(typed)) <= self.highest:
            raise ValueError(typed)
        return address

    @override
    def show(self, address: Address) -> str:
        return f"{address:0{self.digits}d}"

    @override
    def label(self, address: Address) -> str:
        return " / ".join(self.menu.get(int(address), ())) or self.show(address)

    @override
    def title(self, address: Address) -> str:
        return (self.menu.get(int(address)) or (self.show(address),))[-1]


@dataclass(frozen=True, slots=True, kw_only=True)
class TextAddress(AddressForm):
    """A text of ASCII letters and digits."""

    longest: int

    @override
    def parse(self, text: object) -> str:
        typed = str(text).strip()
        if not (typed.isalnum() and typed.isascii() and len(typed) <= self.longest):
            raise ValueError(typed)
        return typed

    @override
    def show(self, address: Address) -> str:
        return str(address)
