"""Kinds of fields that only an EWS-Box has: identities, addresses, times, voltages."""

from dataclasses import dataclass
from datetime import date, datetime, time
from ipaddress import IPv4Address
from typing import Final, override

from ...fields import Field, Text


@dataclass(frozen=True, slots=True, kw_only=True)
class Centivolts(Field[float | None]):
    """A voltage in 1/100 V, signed: a control pilot goes down to -12 V.

    The manual does not state the sign, so a value beyond +-15 V is ``None`` instead of
    an error.
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
class Identity(Text):
    """A text that identifies a box: letters and digits, never empty."""

    @override
    def decode(self, data: bytes) -> str:
        text = data.split(b"\0", 1)[0].decode("latin-1").strip()
        if not (text.isascii() and text.isalnum()):
            raise self.impossible("empty or unreadable")
        return text


@dataclass(frozen=True, slots=True, kw_only=True)
class Ascii(Text):
    """An ASCII text exactly as long as the field, or empty."""

    @override
    def encode(self, value: object) -> bytes:
        if not isinstance(value, str) or not value.isascii():
            raise self.refused("is no ASCII text")
        if len(value) not in (0, self.width):
            raise self.refused(f"has {self.width} characters")
        return Text.encode(self, value)


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
    """Year (16 bits), month, day, hour, minute, second in the box's own time zone.

    ``None``: no time has been set or recorded yet (month or day 0, or erased flash).
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
