"""Every struct encoded and decoded, its length, and values that no field takes."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from enum import IntFlag
from ipaddress import IPv4Address
from typing import Any

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import (
    ImplausibleReplyError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.ews.wire import (
    box_status,
    cards,
    commands,
    info,
    parameters,
    status,
)
from custom_components.evse_bus.evse.ews.wire.fields import (
    Address,
    Ascii,
    Centivolts,
    Identity,
    Moment,
)
from custom_components.evse_bus.evse.fields import (
    Field,
    Flag,
    Flags,
    Number,
    Raw,
    Text,
    Unused,
)
from custom_components.evse_bus.evse.structs import Struct
from tests.evse.field_values import VALUES, value_of, value_of_struct

LENGTHS: dict[int, list[Struct[Any]]] = {
    9: [info.INFO],
    12: [cards.ACCEPTED_CARD],
    27: [parameters.SYSTEM],
    28: [box_status.DHCP],
    34: [parameters.USER],
    48: [commands.LEDS],
    54: [status.PORT, status.PORT_MODE_1],
    56: [status.DETAILS],
    64: [parameters.EXTRA],
    105: [box_status.BOX],
    130: [parameters.INSTALLATION],
    256: [cards.CARD_LIST],
}
STRUCTS = [struct for same in LENGTHS.values() for struct in same]

_letters = st.characters(min_codepoint=0x21, max_codepoint=0x7E)


VALUES.update(
    {
        Centivolts: lambda _: (
            st.none() | st.integers(-1500, 1500).map(lambda value: value / 100)
        ),
        Identity: lambda field: st.from_regex(
            rf"[0-9A-Za-z]{{1,{field.width}}}", fullmatch=True
        ),
        Ascii: lambda field: (
            st.just("") | st.text(_letters, min_size=field.width, max_size=field.width)
        ),
        Address: lambda _: st.integers(0, 0xFFFFFFFF).map(IPv4Address),
        Moment: lambda _: (
            st.none() | st.datetimes().map(lambda now: now.replace(microsecond=0))
        ),
    }
)


@pytest.mark.parametrize(
    ("length", "struct"),
    [(length, struct) for length, same in LENGTHS.items() for struct in same],
    ids=lambda value: value.source if isinstance(value, Struct) else None,
)
def test_lengths(length: int, struct: Struct[Any]) -> None:
    assert struct.length == length
    assert len({field.name for field in struct.fields}) == len(struct.fields)
    assert is_dataclass(struct.make)
    for wrong in (0, length - 1, length + 1, 2 * length):
        with pytest.raises(ImplausibleReplyError, match=f"{wrong} bytes, not {length}"):
            struct.decode(bytes(wrong))
        with pytest.raises(ImplausibleReplyError, match=f"not {length}"):
            struct.changed(bytes(wrong), {})


@pytest.mark.parametrize("struct", STRUCTS, ids=lambda struct: struct.source)
@given(data=st.data())
def test_there_and_back(struct: Struct[Any], data: st.DataObject) -> None:
    value = data.draw(value_of_struct(struct))
    wire = struct.encode(value)
    assert len(wire) == struct.length
    assert struct.decode(wire) == value
    assert struct.encode(struct.decode(wire)) == wire


@pytest.mark.parametrize("struct", STRUCTS, ids=lambda struct: struct.source)
@given(data=st.data())
def test_a_change_changes_only_its_field(
    struct: Struct[Any], data: st.DataObject
) -> None:
    """Whatever the other bytes are, known or not."""
    before = data.draw(st.binary(min_size=struct.length, max_size=struct.length))
    assert struct.changed(before, {}) == before
    at = data.draw(st.integers(0, len(struct.fields) - 1))
    field = struct.fields[at]
    value = data.draw(value_of(field))
    after = struct.changed(before, {field.name: value})
    start = sum(one.width for one in struct.fields[:at])
    end = start + field.width
    assert after[:start] == before[:start]
    assert after[end:] == before[end:]
    if isinstance(field, Flags):
        known = sum(field.kind)
        assert after[start] == value & known | before[start] & ~known
    else:
        assert field.decode(after[start:end]) == value


@pytest.mark.parametrize("struct", STRUCTS, ids=lambda struct: struct.source)
@given(data=st.data())
def test_any_bytes_are_read_or_held_back(
    struct: Struct[Any], data: st.DataObject
) -> None:
    wire = data.draw(st.binary(min_size=struct.length, max_size=struct.length))
    try:
        value = struct.decode(wire)
    except ImplausibleReplyError:
        return
    assert {field.name for field in struct.fields} <= {
        field.name for field in fields(value)
    }


def test_a_field_that_there_is_not() -> None:
    with pytest.raises(RefusedOrderError, match=r"3\.2\.4 sz has no speed, weight"):
        parameters.EXTRA.changed(bytes(64), {"weight": 1, "speed": 2, "voltage_1": 3})


# -- What cannot be ------------------------------------------------------------------


class _Lights(IntFlag):
    RED = 1


_OTHER = parameters.SystemMode.SERVER
CANNOT_BE_WRITTEN: list[tuple[Field[Any], list[object]]] = [
    (
        Number(name="x", width=1, unit="A", valid=range(6, 81)),
        [5, 81, -6, 256, 6.0, True, "6", None, float("nan")],
    ),
    (Number(name="x", width=2), [-1, 0x10000, 1.5, False]),
    (Flag(name="x"), [0, 1, None, "yes"]),
    (Flags(name="x", kind=_Lights), [1, True, _OTHER, None]),
    (Centivolts(name="x"), [15.01, -15.01, float("nan"), float("inf"), "5"]),
    (Text(name="x", width=4), ["abcde", "äöüßx", "€", "a\0b", "a\nb", b"ab", 5, None]),
    (Ascii(name="x", width=4), ["123", "12345", "12 €", "ä234", 1234, "12\x003"]),
    (Raw(name="x", width=2), [b"", b"1", b"123", "12", None]),
    (Address(name="x"), ["192.168.0.1", 0, None]),
    (Moment(name="x"), [datetime(2020, 1, 1, tzinfo=UTC), "2020-01-01", 0]),
    (Unused(name="x", width=2), [0, False, b"\0\0"]),
    (status.PORT.fields[-1], ["card", 0, cards.AcceptedCard(group=1, number=1)]),
    (cards.CARD_LIST.fields[0], [(), [cards.CardEntry(raw=0)] * 64, (0,) * 64]),
]


@pytest.mark.parametrize(
    ("field", "value"),
    [(field, value) for field, values in CANNOT_BE_WRITTEN for value in values],
    ids=lambda value: type(value).__name__ if isinstance(value, Field) else repr(value),
)
def test_values_that_cannot_be_written(field: Field[Any], value: object) -> None:
    with pytest.raises(RefusedOrderError):
        field.encode(value)


@pytest.mark.parametrize(
    ("field", "wire"),
    [
        (Number(name="x", width=1, unit="A", possible=range(81)), "51"),
        (Flag(name="x"), "02"),
        (Flag(name="x"), "ff"),
        (Identity(name="x", width=3), "000000"),
        (Identity(name="x", width=3), "202020"),
        (Identity(name="x", width=3), "31ff32"),
        (Identity(name="x", width=3), "310a32"),
        (Moment(name="x"), "07de 0d 01 00 00 00"),
        (Moment(name="x"), "07de 02 1d 00 00 00"),
        (Moment(name="x"), "07de 01 01 18 00 00"),
        (Moment(name="x"), "07de 01 01 00 3c 00"),
        (Moment(name="x"), "0000 01 01 00 00 00"),
        (status.PORT.fields[-1], "02" + 12 * "00"),
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_bytes_that_cannot_be_read(field: Field[Any], wire: str) -> None:
    with pytest.raises(ImplausibleReplyError, match=f"^{field.name} cannot be"):
        field.decode(bytes.fromhex(wire))


@pytest.mark.parametrize(
    ("read", "wire", "value"),
    [
        (Text(name="x", width=6).decode, "4dfc 6c00 5a5a", "Mül"),
        (Text(name="x", width=4).decode, "41 42 20 20", "AB"),
        (Text(name="x", width=3).decode, "41 07 42", "A\ufffdB"),
        (Identity(name="x", width=4).decode, "3132 2000", "12"),
        (Moment(name="x").decode, "0000 00 00 00 00 00", None),
        (Moment(name="x").decode, "07d0 00 00 00 00 00", None),
        (Moment(name="x").decode, "ffff ff ff ff ff ff", None),
        (Centivolts(name="x").decode, "fb50", -12.0),
        (Centivolts(name="x").decode, "05dc", 15.0),
        (Centivolts(name="x").decode, "05dd", None),
        (Centivolts(name="x").decode, "fa23", None),
        (Centivolts(name="x").decode, "8000", None),
        (Flags(name="x", kind=parameters.CableMode).decode, "f8", 0xF8),
        (Unused(name="x", width=2).decode, "ffff", None),
    ],
)
def test_values_that_are_read(
    read: Callable[[bytes], object], wire: str, value: object
) -> None:
    assert read(bytes.fromhex(wire)) == value


def test_no_error_has_a_text_in_it() -> None:
    for field, wish in (
        (Text(name="password", width=4), "secret"),
        (Text(name="password", width=12), "secret\0"),
        (Text(name="password", width=12), "secret€"),
        (Ascii(name="pin", width=4), "secret"),
    ):
        with pytest.raises(RefusedOrderError) as caught:
            field.encode(wish)
        assert "secret" not in str(caught.value)
        assert caught.value.__cause__ is None
        assert caught.value.__suppress_context__ or caught.value.__context__ is None
