"""Blocks of bytes with a table of fields: the one way in which structs are read.

A table's order is the order on the wire. Errors as in `fields`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, override

from ..errors import ImplausibleReplyError, RefusedOrderError
from .fields import Field


@dataclass(frozen=True, slots=True)
class Struct[T]:
    """A table of fields, and what is made of them."""

    make: type[T]
    """A dataclass with a field for each of the table, by the same name."""
    source: str
    """Where in the manual the table stands."""
    fields: tuple[Field[Any], ...]

    @property
    def length(self) -> int:
        """Return its length, bytes."""
        return sum(field.width for field in self.fields)

    def decode(self, data: bytes, *, longer: bool = False) -> T:
        """Return what these bytes say.

        ``longer``: later versions of the firmware may append to it. Raises
        ImplausibleReplyError for another length and for what cannot be.
        """
        if len(data) < self.length or (len(data) > self.length and not longer):
            message = f"{self.source}: {len(data)} bytes, not {self.length}"
            raise ImplausibleReplyError(message)
        values, at = {}, 0
        for field in self.fields:
            values[field.name] = field.decode(data[at : at + field.width])
            at += field.width
        return self.make(**values)

    def encode(self, value: T) -> bytes:
        """Return the bytes of a value; raises RefusedOrderError."""
        return b"".join(
            field.encode(getattr(value, field.name)) for field in self.fields
        )

    def changed(self, data: bytes, changes: Mapping[str, object]) -> bytes:
        """Return the same bytes with some fields written anew, and nothing else.

        Raises RefusedOrderError for a field that there is not and for a value that
        cannot be, ImplausibleReplyError for bytes of another length.
        """
        if len(data) != self.length:
            message = f"{self.source}: {len(data)} bytes, not {self.length}"
            raise ImplausibleReplyError(message)
        if unknown := changes.keys() - {field.name for field in self.fields}:
            message = f"{self.source} has no {', '.join(sorted(unknown))}"
            raise RefusedOrderError(message)
        parts, at = [], 0
        for field in self.fields:
            old = data[at : at + field.width]
            if field.name in changes:
                parts.append(field.rewrite(old, changes[field.name]))
            else:
                parts.append(old)
            at += field.width
        return b"".join(parts)


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
    """A byte that says whether the struct behind it means anything."""

    struct: Struct[T]

    @override
    def decode(self, data: bytes) -> T | None:
        if data[0] not in (0, 1):
            raise self.impossible(data[0])
        return self.struct.decode(data[1:]) if data[0] else None

    @override
    def encode(self, value: object) -> bytes:
        if value is None:
            return bytes(self.width)
        return b"\1" + part(self.name, self.struct).encode(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Many[V](Field[tuple[V, ...]]):
    """The same field several times; a pair is for port 1 and port 2."""

    field: Field[V]
    count: int

    @override
    def decode(self, data: bytes) -> tuple[V, ...]:
        step = self.field.width
        return tuple(
            self.field.decode(data[at : at + step]) for at in range(0, self.width, step)
        )

    @override
    def encode(self, value: object) -> bytes:
        if not isinstance(value, tuple) or len(value) != self.count:
            raise self.refused(f"are {self.count}")
        return b"".join(self.field.encode(one) for one in value)


def part[T](name: str, struct: Struct[T]) -> Part[T]:
    """Return a field that holds a struct."""
    return Part(name=name, width=struct.length, struct=struct)


def optional[T](name: str, struct: Struct[T]) -> Optional[T]:
    """Return a field that holds a struct, or says that it means nothing."""
    return Optional(name=name, width=1 + struct.length, struct=struct)


def many[V](field: Field[V], count: int = 2) -> Many[V]:
    """Return a field that holds another so many times, without anything between."""
    return Many(
        name=field.name,
        width=count * field.width,
        unit=field.unit,
        field=field,
        count=count,
    )
