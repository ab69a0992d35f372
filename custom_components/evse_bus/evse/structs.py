"""Tables of fields, and the dataclasses that they are decoded to.

A record is a frozen dataclass whose fields state how they are coded; a struct is a
record in the order of the wire, a bit struct one whose fields lie at numbered bits:

    @record
    class Clock:
        hour: int = coded(Number(width=1, possible=range(24)))
        name: str = coded(Text(width=8), secret=True)

    CLOCK = Struct(Clock, "manual, 4.2")

The type of a field is checked against its kind. Errors as in `fields`.
"""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from typing import Any, Final, Self, dataclass_transform, override

from .errors import ImplausibleReplyError, RefusedOrderError
from .fields import Field, Flag, Numeric

_CODING: Final = "coding"
_BITS: Final = "bits"


# -- Records -------------------------------------------------------------------------


def coded[V](kind: Field[V], *, secret: bool = False, default: object = MISSING) -> V:
    """Return a field of a record in a struct.

    ``secret``: not part of the repr.
    """
    coding: Any = field(default=default, repr=not secret, metadata={_CODING: kind})
    return coding  # type: ignore[no-any-return]


def bits[V](high: int, low: int, kind: Field[V]) -> V:
    """Return a field of a record in a bit struct.

    Bit 0 is the last bit of the struct; ``high`` and ``low`` are included.
    """
    width = (high - low) // 8 + 1
    if isinstance(kind, Numeric):
        kind = replace(kind, width=width)
    elif kind.width != width:
        message = f"bits {high} to {low} are not {kind.width} bytes"
        raise ValueError(message)
    coding: Any = field(metadata={_CODING: kind, _BITS: (high, low)})
    return coding  # type: ignore[no-any-return]


def bit(number: int) -> bool:
    """Return a field of a record in a bit struct that is one bit."""
    return bits(number, number, Flag())


@dataclass_transform(
    frozen_default=True,
    kw_only_default=True,
    field_specifiers=(field, coded, bits, bit),
)
def record[T](cls: type[T]) -> type[T]:
    """Make a class a frozen dataclass with slots; all arguments by keyword."""
    return dataclass(frozen=True, slots=True, kw_only=True)(cls)


def codings(make: type) -> tuple[Field[Any], ...]:
    """Return the fields of a record that are on the wire, in their order."""
    return tuple(
        one.metadata[_CODING].named(one.name)
        for one in fields(make)
        if _CODING in one.metadata
    )


# -- Tables --------------------------------------------------------------------------


class Struct[T]:
    """Fields one after the other."""

    def __init__(
        self, make: type[T], source: str, fields: tuple[Field[Any], ...] | None = None
    ) -> None:
        """Take a record, and where the manual has its table.

        ``fields``: in place of those that the record states, by the same names.
        """
        self.make: Final = make
        self.source = source
        self.fields = codings(make) if fields is None else fields
        ends = [0]
        for one in self.fields:
            ends.append(ends[-1] + one.width)
        self.length = ends[-1]
        """Bytes."""
        self._places = tuple(
            (one, slice(start, end))
            for one, start, end in zip(self.fields, ends, ends[1:], strict=False)
        )

    def decode(self, data: bytes, *, longer: bool = False) -> T:
        """Return the record of these bytes.

        ``longer``: bytes that follow are ignored, as later firmware appends to it.
        Raises ImplausibleReplyError for another length and an impossible value.
        """
        if len(data) < self.length or (len(data) > self.length and not longer):
            raise self._another_length(data)
        return self.make(
            **{one.name: one.decode(data[place]) for one, place in self._places}
        )

    def encode(self, value: object) -> bytes:
        """Return the bytes of a record; raises RefusedOrderError."""
        return b"".join([one.encode(getattr(value, one.name)) for one in self.fields])

    def changed(self, data: bytes, changes: Mapping[str, object]) -> bytes:
        """Return the same bytes with some fields replaced, and nothing else.

        Raises RefusedOrderError for an unknown field and a value that is not
        possible, ImplausibleReplyError for bytes of another length.
        """
        if len(data) != self.length:
            raise self._another_length(data)
        if unknown := changes.keys() - {one.name for one in self.fields}:
            message = f"{self.source} has no {', '.join(sorted(unknown))}"
            raise RefusedOrderError(message)
        return b"".join(
            one.rewrite(data[place], changes[one.name])
            if one.name in changes
            else data[place]
            for one, place in self._places
        )

    def _another_length(self, data: bytes) -> ImplausibleReplyError:
        message = f"{self.source}: {len(data)} bytes, not {self.length}"
        return ImplausibleReplyError(message)


@dataclass(frozen=True, slots=True)
class Bits:
    """A field of a bit struct, and its place."""

    field: Field[Any]
    high: int
    low: int

    @property
    def mask(self) -> int:
        """Return as many set bits as it has."""
        return (1 << self.high - self.low + 1) - 1


class BitStruct[T]:
    """Fields at numbered bits; bit 0 is the last one, gaps are ignored."""

    def __init__(
        self, make: type[T], source: str, length: int, fields: tuple[Bits, ...] = ()
    ) -> None:
        """Take a record, where the manual has its table, and its length in bytes.

        ``fields``: in place of those that the record states, by the same names.
        """
        self.make: Final = make
        self.source = source
        self.length = length
        self.fields = fields or _bit_fields(make)
        if any(not 0 <= one.low <= one.high < 8 * length for one in self.fields):
            message = f"{source}: a field beyond {length} bytes"
            raise ValueError(message)
        self._places = tuple(
            (one.field.name, one.field.value, one.low, one.mask) for one in self.fields
        )

    def decode(self, data: bytes) -> T:
        """Return the record of these bytes.

        Raises ImplausibleReplyError for another length and an impossible value.
        """
        if len(data) != self.length:
            message = f"{self.source}: {len(data)} bytes, not {self.length}"
            raise ImplausibleReplyError(message)
        number = int.from_bytes(data)
        return self.make(
            **{
                name: value(number >> low & mask)
                for name, value, low, mask in self._places
            }
        )

    def encode(self, value: object) -> bytes:
        """Return the bytes of a record, gaps 0; raises RefusedOrderError."""
        number = 0
        for one in self.fields:
            raw = one.field.raw(getattr(value, one.field.name))
            if not 0 <= raw <= one.mask:
                raise one.field.refused(
                    f"{getattr(value, one.field.name)} does not fit"
                )
            number |= raw << one.low
        return number.to_bytes(self.length)


def _bit_fields(make: type) -> tuple[Bits, ...]:
    return tuple(
        Bits(one.metadata[_CODING].named(one.name), *one.metadata[_BITS])
        for one in fields(make)
        if _BITS in one.metadata
    )


# -- Structs in fields ---------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Part[T](Field[T]):
    """A struct inside another."""

    struct: Struct[T]

    @override
    def decode(self, data: bytes) -> T:
        return self.struct.decode(data)

    @override
    def encode(self, value: object) -> bytes:
        if not isinstance(value, self.struct.make):
            raise self.refused(f"is a {self.struct.make.__name__}")
        return self.struct.encode(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Optional[T](Field[T | None]):
    """A struct with a byte before it: 1 where it is valid, 0 where it is not."""

    part: Part[T]

    @override
    def decode(self, data: bytes) -> T | None:
        if data[0] not in (0, 1):
            raise self.impossible(data[0])
        return self.part.decode(data[1:]) if data[0] else None

    @override
    def encode(self, value: object) -> bytes:
        if value is None:
            return bytes(self.width)
        return b"\1" + self.part.encode(value)

    @override
    def named(self, name: str) -> Self:
        return replace(self, name=name, part=self.part.named(name))


@dataclass(frozen=True, slots=True, kw_only=True)
class Many[V](Field[tuple[V, ...]]):
    """The same field several times."""

    field: Field[V]
    count: int

    @override
    def decode(self, data: bytes) -> tuple[V, ...]:
        step, decode = self.field.width, self.field.decode
        return tuple(
            [decode(data[at : at + step]) for at in range(0, self.width, step)]
        )

    @override
    def encode(self, value: object) -> bytes:
        if not isinstance(value, tuple) or len(value) != self.count:
            raise self.refused(f"are {self.count}")
        return b"".join([self.field.encode(one) for one in value])

    @override
    def named(self, name: str) -> Self:
        return replace(self, name=name, field=self.field.named(name))


def part[T](struct: Struct[T]) -> Part[T]:
    """Return a field that holds a struct."""
    return Part(width=struct.length, struct=struct)


def optional[T](struct: Struct[T]) -> Optional[T]:
    """Return a field that holds a struct, or ``None``."""
    return Optional(width=1 + struct.length, part=part(struct))


def many[V](field: Field[V], count: int) -> Many[V]:
    """Return a field that holds another ``count`` times."""
    width = count * field.width
    return Many(width=width, unit=field.unit, field=field, count=count)


def pair[V](field: Field[V]) -> Field[tuple[V, V]]:
    """Return a field that holds another twice."""
    two: Field[Any] = many(field, 2)
    return two


def phases[V](field: Field[V]) -> Field[tuple[V, V, V]]:
    """Return a field that holds another three times, once for each phase."""
    three: Field[Any] = many(field, 3)
    return three
