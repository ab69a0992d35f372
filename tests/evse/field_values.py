"""Strategies for the values that a field of a table accepts."""

from collections.abc import Callable
from typing import Any

from hypothesis import strategies as st

from custom_components.evse_bus.evse.fields import (
    Choice,
    Field,
    Flag,
    Flags,
    Known,
    Number,
    Raw,
    Scaled,
    Text,
    Unused,
)
from custom_components.evse_bus.evse.structs import Many, Optional, Part, Struct


def _number(field: Number) -> st.SearchStrategy[int]:
    numbers = field.valid or field.possible or range(1 << 8 * field.width)
    return st.sampled_from(numbers).map(
        lambda raw: field.sign * (raw - field.offset),
    )


def _scaled(field: Scaled) -> st.SearchStrategy[float]:
    size = 1 << 8 * field.width
    numbers = st.integers(-size // 2, size // 2 - 1)
    if not field.signed:
        numbers = st.integers(0, size - 1)
    return numbers.map(lambda raw: raw / field.divisor)


VALUES: dict[type[Field[Any]], Callable[[Any], st.SearchStrategy[Any]]] = {
    Number: _number,
    Scaled: _scaled,
    Choice: lambda field: st.sampled_from(list(field.values.values())),
    Flag: lambda _: st.booleans(),
    Flags: lambda field: st.integers(0, (1 << 8 * field.width) - 1).map(field.kind),
    Known: lambda field: (
        st.sampled_from(field.within)
        .filter(lambda raw: raw < 1 << 8 * field.width)
        .map(field.field.value)
    ),
    Text: lambda field: st.text("aZ09*-.äöüßÄÖÜé", max_size=field.width),
    Raw: lambda field: st.binary(min_size=field.width, max_size=field.width),
    Unused: lambda _: st.none(),
    Part: lambda field: value_of_struct(field.struct),
    Optional: lambda field: st.none() | value_of(field.part),
    Many: lambda field: st.tuples(*field.count * [value_of(field.field)]),
}


def value_of(field: Field[Any]) -> st.SearchStrategy[Any]:
    """Return the values of a field, by its kind."""
    return VALUES[type(field)](field)


def value_of_struct(struct: Struct[Any]) -> st.SearchStrategy[Any]:
    return st.builds(
        struct.make, **{field.name: value_of(field) for field in struct.fields}
    )
