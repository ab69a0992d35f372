"""Kinds of fields: how bytes on the wire stand for a value.

Numbers are big-endian. Reading a value that is not possible raises
ImplausibleReplyError, writing one raises RefusedOrderError. No message contains the
value of a text, because names and passwords are texts.
"""

from abc import ABC, abstractmethod
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import Self, override

from .errors import ImplausibleReplyError, RefusedOrderError


@dataclass(frozen=True, slots=True, kw_only=True)
class Field[V](ABC):
    """A field of fixed width, and the conversion of its bytes."""

    name: str = ""
    """Set by the table that the field belongs to."""
    width: int = 0
    """Bytes; a number at bits of a `structs.BitStruct` has that of its place."""
    unit: str = ""

    @abstractmethod
    def decode(self, data: bytes) -> V:
        """Return the value of these bytes; raises ImplausibleReplyError."""

    @abstractmethod
    def encode(self, value: object) -> bytes:
        """Return the bytes of a value; raises RefusedOrderError."""

    def value(self, raw: int) -> V:
        """Return the value of the bytes, given as a number."""
        return self.decode(raw.to_bytes(self.width))

    def raw(self, value: object) -> int:
        """Return the bytes of a value, as a number."""
        return int.from_bytes(self.encode(value))

    def rewrite(self, data: bytes, value: object) -> bytes:  # noqa: ARG002
        """Return the bytes that replace ``data``; raises RefusedOrderError."""
        return self.encode(value)

    def named(self, name: str) -> Self:
        """Return the same field by another name."""
        return replace(self, name=name)

    def impossible(self, value: object) -> ImplausibleReplyError:
        """Return the error for a value that was read."""
        message = f"{self.name} cannot be {value}"
        return ImplausibleReplyError(f"{message} {self.unit}".rstrip())

    def refused(self, reason: str) -> RefusedOrderError:
        """Return the error for a value that was to be written."""
        return RefusedOrderError(f"{self.name} {reason}")


# -- Numbers -------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Numeric[V](Field[V]):
    """A field that is one unsigned number on the wire."""

    @abstractmethod
    @override
    def value(self, raw: int) -> V:
        """Return the value of a number; raises ImplausibleReplyError."""

    @abstractmethod
    @override
    def raw(self, value: object) -> int:
        """Return the number for a value; raises RefusedOrderError."""

    @override
    def decode(self, data: bytes) -> V:
        return self.value(int.from_bytes(data))

    @override
    def encode(self, value: object) -> bytes:
        try:
            return self.raw(value).to_bytes(self.width)
        except OverflowError:
            raise self.does_not_fit(value) from None

    def does_not_fit(self, value: object) -> RefusedOrderError:
        """Return the error for a value that is too large or negative."""
        return self.refused(" ".join(f"{value} {self.unit}".split()) + " does not fit")


@dataclass(frozen=True, slots=True, kw_only=True)
class Number(Numeric[int]):
    """A whole number: ``sign`` x (number on the wire - ``offset``)."""

    possible: Sequence[int] | None = None
    """Numbers on the wire that can be read; ``None``: all."""
    valid: Sequence[int] | None = None
    """Numbers on the wire that may be written; ``None``: all that can be read."""
    offset: int = 0
    sign: int = 1
    """1 or -1."""

    @override
    def value(self, raw: int) -> int:
        if self.possible is not None and raw not in self.possible:
            raise self.impossible(raw)
        return self.sign * (raw - self.offset)

    @override
    def raw(self, value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.refused("is no whole number")
        raw = self.sign * value + self.offset
        valid = self.valid or self.possible
        if valid is not None and raw not in valid:
            raise self.refused(f"cannot be {value} {self.unit}".rstrip())
        return raw

    @property
    def span(self) -> tuple[int, int]:
        """Return the lowest and the highest value that can be written."""
        numbers = self.valid or self.possible or range(1 << 8 * self.width)
        values = [self.sign * (raw - self.offset) for raw in (numbers[0], numbers[-1])]
        return min(values), max(values)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scaled(Numeric[float]):
    """A decimal number: number on the wire / ``divisor``."""

    divisor: int
    signed: bool = False

    @override
    def value(self, raw: int) -> float:
        if self.signed and raw >> 8 * self.width - 1:
            raw -= 1 << 8 * self.width
        return raw / self.divisor

    @override
    def raw(self, value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.refused("is no number")
        try:
            # Currents are clamped to the step: rounding raises none of them.
            raw = round(value * self.divisor)
        except OverflowError, ValueError:
            raise self.does_not_fit(value) from None
        if not self.signed:
            return raw
        half = 1 << 8 * self.width - 1
        if not -half <= raw < half:
            raise self.does_not_fit(value)
        return raw % (2 * half)


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice[V](Numeric[V]):
    """A code with a value for each number on the wire."""

    values: Mapping[int, V]

    @override
    def value(self, raw: int) -> V:
        try:
            return self.values[raw]
        except KeyError:
            raise self.impossible(raw) from None

    @override
    def raw(self, value: object) -> int:
        for raw, known in self.values.items():
            if known == value:
                return raw
        raise self.refused(f"cannot be {value}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Flag(Numeric[bool]):
    """A bit or byte that is 1 or 0."""

    width: int = 1

    @override
    def value(self, raw: int) -> bool:
        if raw > 1:
            raise self.impossible(raw)
        return raw == 1

    @override
    def raw(self, value: object) -> int:
        if not isinstance(value, bool):
            raise self.refused("is on or off")
        return int(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Flags[F: IntFlag](Numeric[F]):
    """A set of bits; a bit without a name keeps its value."""

    width: int = 1
    kind: type[F]
    """With boundary KEEP."""

    @override
    def value(self, raw: int) -> F:
        return self.kind(raw)

    @override
    def raw(self, value: object) -> int:
        if not isinstance(value, self.kind):
            raise self.refused(f"is a {self.kind.__name__}")
        return int(value)

    @override
    def rewrite(self, data: bytes, value: object) -> bytes:
        # `flags & ~bit` drops the bits without a name, so they come from the box.
        known = sum(self.kind)
        new = int.from_bytes(self.encode(value)) & known
        return (int.from_bytes(data) & ~known | new).to_bytes(self.width)


@dataclass(frozen=True, slots=True, kw_only=True)
class Known[V](Numeric[V | None]):
    """A number that means something within bounds only; ``None`` outside."""

    field: Numeric[V]
    within: Container[int]
    """Numbers on the wire."""

    @override
    def value(self, raw: int) -> V | None:
        return self.field.value(raw) if raw in self.within else None

    @override
    def raw(self, value: object) -> int:
        if (raw := self.field.raw(value)) not in self.within:
            raise self.refused(f"cannot be {value} {self.unit}".rstrip())
        return raw

    @override
    def named(self, name: str) -> Self:
        return replace(self, name=name, field=self.field.named(name))


def known[V](field: Numeric[V], within: Container[int]) -> Known[V]:
    """Return a field that is ``None`` where the number is not ``within``."""
    return Known(width=field.width, unit=field.unit, field=field, within=within)


# -- Bytes ---------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Text(Field[str]):
    """A Latin-1 text that ends at the first zero byte, without spaces around it."""

    @override
    def decode(self, data: bytes) -> str:
        text = data.split(b"\0", 1)[0].decode("latin-1").strip()
        return "".join(
            sign if sign.isprintable() else "\N{REPLACEMENT CHARACTER}" for sign in text
        )

    @override
    def encode(self, value: object) -> bytes:
        if not isinstance(value, str) or (value and not value.isprintable()):
            raise self.refused("is no text")
        try:
            data = value.encode("latin-1")
        except UnicodeEncodeError:
            raise self.refused("has characters that the box does not know") from None
        if len(data) > self.width:
            raise self.refused(f"is longer than {self.width} characters")
        return data.ljust(self.width, b"\0")


@dataclass(frozen=True, slots=True, kw_only=True)
class Raw(Field[bytes]):
    """Bytes, unchanged."""

    @override
    def decode(self, data: bytes) -> bytes:
        return bytes(data)

    @override
    def encode(self, value: object) -> bytes:
        if not isinstance(value, bytes) or len(value) != self.width:
            raise self.refused(f"is {self.width} bytes")
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class Unused(Field[None]):
    """Bytes without a meaning; written as 0."""

    @override
    def decode(self, data: bytes) -> None:
        return None

    @override
    def encode(self, value: object) -> bytes:
        if value is not None:
            raise self.refused("is not used here")
        return bytes(self.width)
