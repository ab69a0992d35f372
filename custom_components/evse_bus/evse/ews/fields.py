"""Fields of the structs in messages: what bytes mean, and what cannot be.

All numbers are big-endian. What cannot be raises ImplausibleReplyError when it is
read, and RefusedOrderError when it is to be written; no message tells the value of a
text, since names and passwords are texts.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, datetime, time
from enum import IntFlag
from ipaddress import IPv4Address
from typing import Final, override

from ..errors import ImplausibleReplyError, RefusedOrderError


@dataclass(frozen=True, slots=True, kw_only=True)
class Field[V](ABC):
    """One field of a struct."""

    name: str
    width: int
    """Bytes."""
    unit: str = ""

    @abstractmethod
    def decode(self, data: bytes) -> V:
        """Return the value of these bytes; raises ImplausibleReplyError."""

    @abstractmethod
    def encode(self, value: object) -> bytes:
        """Return the bytes of a value; raises RefusedOrderError."""

    def rewrite(self, data: bytes, value: object) -> bytes:  # noqa: ARG002
        """Return the bytes of a value in the place of these; as `encode`."""
        return self.encode(value)

    def impossible(self, what: object) -> ImplausibleReplyError:
        """Return the error for a reply that says what cannot be."""
        message = f"{self.name} cannot be {what}"
        return ImplausibleReplyError(f"{message} {self.unit}".rstrip())

    def refused(self, why: str) -> RefusedOrderError:
        """Return the error for a value that cannot be written."""
        return RefusedOrderError(f"{self.name} {why}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Number(Field[int]):
    """A whole number from 0."""

    possible: Sequence[int] | None = None
    """What it may be when it is read; ``None``: anything."""
    valid: Sequence[int] | None = None
    """What it may be when it is written; ``None``: what is possible."""

    @override
    def decode(self, data: bytes) -> int:
        value = int.from_bytes(data)
        if self.possible is not None and value not in self.possible:
            raise self.impossible(value)
        return value

    @override
    def encode(self, value: object) -> bytes:
        valid = self.valid or self.possible or range(1 << 8 * self.width)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.refused("is no whole number")
        if value not in valid:
            raise self.refused(f"cannot be {value} {self.unit}".rstrip())
        return value.to_bytes(self.width)


@dataclass(frozen=True, slots=True, kw_only=True)
class Flag(Field[bool]):
    """A byte of which the manual knows 1 and the absence of it."""

    width: int = 1

    @override
    def decode(self, data: bytes) -> bool:
        if data not in (b"\0", b"\1"):
            raise self.impossible(data[0])
        return data == b"\1"

    @override
    def encode(self, value: object) -> bytes:
        if not isinstance(value, bool):
            raise self.refused("is on or off")
        return b"\1" if value else b"\0"


_BYTE: Final = range(256)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bits(Field[IntFlag]):
    """A byte of bits; bits that the manual does not know are kept."""

    width: int = 1
    kind: type[IntFlag]
    """With boundary KEEP."""

    @override
    def decode(self, data: bytes) -> IntFlag:
        return self.kind(data[0])

    @override
    def encode(self, value: object) -> bytes:
        if not isinstance(value, self.kind) or value not in _BYTE:
            raise self.refused(f"is a {self.kind.__name__}")
        return bytes((value,))

    @override
    def rewrite(self, data: bytes, value: object) -> bytes:
        # `flags & ~bit` drops what is no member, so those bits come from the box.
        known = sum(self.kind)
        return bytes((data[0] & ~known | self.encode(value)[0] & known,))


@dataclass(frozen=True, slots=True, kw_only=True)
class Centivolts(Field[float | None]):
    """A voltage in 1/100 V, signed: a control pilot goes down to -12 V.

    The manual does not say whether it is signed: what lies beyond 15 V either way is
    not told, and holds nothing back.
    """

    width: int = 2
    unit: str = "V"

    @override
    def decode(self, data: bytes) -> float | None:
        value = int.from_bytes(data, signed=True)
        return value / 100 if abs(value) <= _HIGHEST_CENTIVOLTS else None

    @override
    def encode(self, value: object) -> bytes:
        if value is None:
            return _NO_CENTIVOLTS
        if not isinstance(value, float) or not abs(value) <= _HIGHEST_CENTIVOLTS / 100:
            raise self.refused("is -15 to 15 V")
        return round(100 * value).to_bytes(2, signed=True)


_HIGHEST_CENTIVOLTS: Final = 1500
_NO_CENTIVOLTS: Final = b"\x7f\xff"


@dataclass(frozen=True, slots=True, kw_only=True)
class Text(Field[str]):
    """A text up to the first zero byte, as Latin-1 (the manual names no code page)."""

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
            raise self.refused("has signs that the box does not know") from None
        if len(data) > self.width:
            raise self.refused(f"is longer than {self.width} signs")
        return data.ljust(self.width, b"\0")


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity(Text):
    """A text by which a box is told from others: never empty, letters and digits."""

    @override
    def decode(self, data: bytes) -> str:
        text = data.split(b"\0", 1)[0].decode("latin-1").strip()
        if not (text.isascii() and text.isalnum()):
            raise self.impossible("empty or unreadable")
        return text


@dataclass(frozen=True, slots=True, kw_only=True)
class Ascii(Text):
    """A text of ASCII signs, exactly as long as the field; empty: none."""

    @override
    def encode(self, value: object) -> bytes:
        if not isinstance(value, str) or not value.isascii():
            raise self.refused("is no ASCII text")
        if len(value) not in (0, self.width):
            raise self.refused(f"has {self.width} signs")
        return Text.encode(self, value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Raw(Field[bytes]):
    """Bytes as they are."""

    @override
    def decode(self, data: bytes) -> bytes:
        return bytes(data)

    @override
    def encode(self, value: object) -> bytes:
        if not isinstance(value, bytes) or len(value) != self.width:
            raise self.refused(f"is {self.width} bytes")
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class Address(Field[IPv4Address]):
    """An IPv4 address."""

    width: int = 4

    @override
    def decode(self, data: bytes) -> IPv4Address:
        return IPv4Address(data)

    @override
    def encode(self, value: object) -> bytes:
        if not isinstance(value, IPv4Address):
            raise self.refused("is an IPv4 address")
        return value.packed


@dataclass(frozen=True, slots=True, kw_only=True)
class Moment(Field[datetime | None]):
    """Year (16 bits), month, day, hour, minute, second; in the box's own time zone.

    ``None``: the clock or the event has no time yet (month or day 0, or erased).
    """

    width: int = 7

    @override
    def decode(self, data: bytes) -> datetime | None:
        year = int.from_bytes(data[:2])
        month, day, hour, minute, second = data[2:]
        if month == 0 or day == 0 or data == _ERASED:
            return None
        try:
            return datetime.combine(date(year, month, day), time(hour, minute, second))
        except ValueError:
            raise self.impossible(data.hex(" ")) from None

    @override
    def encode(self, value: object) -> bytes:
        if value is None:
            return bytes(self.width)
        if not isinstance(value, datetime) or value.tzinfo is not None:
            raise self.refused("is a time without a zone")
        return value.year.to_bytes(2) + bytes(
            (value.month, value.day, value.hour, value.minute, value.second)
        )


_ERASED: Final = b"\xff" * 7


@dataclass(frozen=True, slots=True, kw_only=True)
class Untold(Field[None]):
    """A field that means nothing here; 0 when it is written."""

    @override
    def decode(self, data: bytes) -> None:
        return None

    @override
    def encode(self, value: object) -> bytes:
        if value is not None:
            raise self.refused("is not told here")
        return bytes(self.width)
