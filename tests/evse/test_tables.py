"""Tables of fields of any kind, there and back; the tables of all protocols."""

from dataclasses import FrozenInstanceError, fields, make_dataclass
from enum import KEEP, IntFlag
from itertools import pairwise
import re
from typing import Any

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.abl import registers as abl
from custom_components.evse_bus.evse.errors import (
    ImplausibleReplyError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.evbox import frames as evbox
from custom_components.evse_bus.evse.fields import (
    Choice,
    Field,
    Flag,
    Flags,
    Number,
    Raw,
    Scaled,
    Text,
    Unused,
    known,
)
from custom_components.evse_bus.evse.registers import Block, Registers, Word, words_of
from custom_components.evse_bus.evse.smartevse.dialects import MAPS
from custom_components.evse_bus.evse.structs import (
    Bits,
    BitStruct,
    Struct,
    bit,
    bits,
    coded,
    many,
    optional,
    pair,
    part,
    phases,
    record,
)

from .field_values import value_of, value_of_struct


class Lights(IntFlag, boundary=KEEP):
    RED = 1
    GREEN = 1 << 9


@record
class Place:
    row: int = coded(Number(width=2, unit="m", possible=range(1000)))
    name: str = coded(Text(width=6), secret=True, default="")


PLACE = Struct(Place, "here, 1.1")

KINDS: list[Field[Any]] = [
    Number(width=1),
    Number(width=4, unit="Wh"),
    Number(width=2, possible=range(5, 99), valid=range(7, 9)),
    Number(width=2, possible=range(97), offset=48),
    Number(width=1, possible=range(33), offset=16, sign=-1),
    Scaled(width=2, unit="A", divisor=10),
    Scaled(width=2, divisor=1000, signed=True),
    Choice(width=1, values={0: "no", 7: "yes", 200: None}),
    Flag(),
    Flag(width=2),
    Flags(kind=Lights, width=2),
    known(Number(width=2, unit="A"), range(1, 100)),
    Text(width=5),
    Raw(width=3),
    Unused(width=2),
    part(PLACE),
    optional(PLACE),
    many(Number(width=2), 4),
    pair(optional(PLACE)),
    phases(Scaled(width=2, divisor=10)),
]


@st.composite
def structs(draw: st.DrawFn) -> Struct[Any]:
    kinds = draw(st.lists(st.sampled_from(KINDS), min_size=1, max_size=8))
    named = tuple(kind.named(f"field_{at}") for at, kind in enumerate(kinds))
    make = make_dataclass("Anything", [(one.name, object) for one in named])
    return Struct(make, "any", named)


@given(struct=structs(), data=st.data())
def test_there_and_back(struct: Struct[Any], data: st.DataObject) -> None:
    value = data.draw(value_of_struct(struct))
    wire = struct.encode(value)
    assert len(wire) == struct.length == sum(one.width for one in struct.fields)
    assert struct.decode(wire) == value
    assert struct.decode(wire + b"more", longer=True) == value
    with pytest.raises(ImplausibleReplyError, match="any: "):
        struct.decode(wire + b"more")
    with pytest.raises(ImplausibleReplyError, match="any: "):
        struct.decode(wire[:-1], longer=True)


@given(struct=structs(), data=st.data())
def test_a_change_changes_only_its_field(
    struct: Struct[Any], data: st.DataObject
) -> None:
    before = data.draw(st.binary(min_size=struct.length, max_size=struct.length))
    at = data.draw(st.integers(0, len(struct.fields) - 1))
    field = struct.fields[at]
    after = struct.changed(before, {field.name: data.draw(value_of(field))})
    start = sum(one.width for one in struct.fields[:at])
    assert after[:start] == before[:start]
    assert after[start + field.width :] == before[start + field.width :]


@given(struct=structs(), data=st.data())
def test_any_bytes_are_decoded_or_implausible(
    struct: Struct[Any], data: st.DataObject
) -> None:
    wire = data.draw(st.binary(min_size=struct.length, max_size=struct.length))
    message = "field_0 cannot be"
    try:
        struct.decode(wire)
    except ImplausibleReplyError as error:
        message = str(error)
    # The message names the field, however deep it lies.
    assert re.match(r"(field_\d|row) cannot be", message)


@given(raw=st.integers(0, 0xFFFF), value=st.integers(0, 0xFFFF))
def test_bits_without_a_name_stay(raw: int, value: int) -> None:
    field = Flags(name="lights", kind=Lights, width=2)
    after = int.from_bytes(field.rewrite(raw.to_bytes(2), Lights(value)))
    assert after & 0x201 == value & 0x201
    assert after & ~0x201 == raw & ~0x201


# -- Records -------------------------------------------------------------------------


def test_a_record() -> None:
    place = Place(row=5, name="secret")
    assert repr(place) == "Place(row=5)"
    assert Place(row=5).name == ""
    with pytest.raises(FrozenInstanceError):
        place.row = 6  # type: ignore[misc]
    with pytest.raises(TypeError):
        Place(5)  # type: ignore[misc]
    assert not hasattr(place, "__dict__")
    assert PLACE.encode(place) == b"\x00\x05secret"


def test_errors_name_the_field() -> None:
    with pytest.raises(ImplausibleReplyError, match=r"^row cannot be 1000 m$"):
        PLACE.decode(b"\x03\xe8" + bytes(6))
    with pytest.raises(RefusedOrderError, match=r"^row cannot be -1 m$"):
        PLACE.encode(Place(row=-1))
    with pytest.raises(RefusedOrderError, match=r"^name is longer than 6 characters$"):
        PLACE.encode(Place(row=1, name="secrets"))
    with pytest.raises(RefusedOrderError, match=r"^here, 1\.1 has no colour$"):
        PLACE.changed(bytes(8), {"colour": 1})


# -- Fields --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "raw", "value"),
    [
        (Number(width=1, offset=16, sign=-1), 4, 12),
        (Number(width=2, offset=273), 0, -273),
        (Scaled(width=2, divisor=10), 267, 26.7),
        (Scaled(width=2, divisor=1000, signed=True), 0xFF32, -0.206),
        (Choice(width=1, values={3: "three"}), 3, "three"),
        (known(Scaled(width=2, divisor=10), range(801)), 800, 80.0),
    ],
)
def test_numbers(field: Field[Any], raw: int, value: object) -> None:
    wire = raw.to_bytes(field.width)
    assert field.value(raw) == field.decode(wire) == value
    assert field.raw(value) == raw
    assert field.encode(value) == wire


def test_a_number_without_a_meaning_is_none() -> None:
    assert known(Number(width=2), range(1, 5)).value(5) is None


@pytest.mark.parametrize(
    ("field", "value"),
    [
        (Number(width=1, possible=range(33), offset=16, sign=-1), 17),
        (Number(width=1, possible=range(33), offset=16, sign=-1), -17),
        (Number(width=1, offset=16), -17),
        (Number(width=1), 256),
        (Number(width=1), True),
        (Number(width=1), 1.0),
        (Scaled(width=2, divisor=10), 6553.6),
        (Scaled(width=2, divisor=10), -0.1),
        (Scaled(width=2, divisor=10), float("nan")),
        (Scaled(width=2, divisor=10), float("inf")),
        (Scaled(width=2, divisor=10), "16"),
        (Scaled(width=2, divisor=10), True),
        (Scaled(width=2, divisor=1000, signed=True), 32.768),
        (Scaled(width=2, divisor=1000, signed=True), -32.769),
        (Choice(width=1, values={0: "no"}), "yes"),
        (Flag(), 1),
        (Flags(kind=Lights), Lights.GREEN),
        (Flags(kind=Lights, width=2), 1),
        (known(Number(width=2), range(1, 5)), 0),
        (Unused(width=1), 0),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Field) else repr(value),
)
def test_values_that_are_refused(field: Field[Any], value: object) -> None:
    with pytest.raises(RefusedOrderError):
        field.named("x").encode(value)


@pytest.mark.parametrize(
    ("field", "raw"),
    [
        (Number(width=1, possible=range(33), offset=16), 33),
        (Choice(width=1, values={0: "no"}), 1),
        (Flag(width=2), 2),
        (known(Number(width=2, possible=range(3)), range(1, 9)), 4),
    ],
)
def test_numbers_that_are_implausible(field: Field[Any], raw: int) -> None:
    with pytest.raises(ImplausibleReplyError, match=f"^x cannot be {raw}$"):
        field.named("x").value(raw)


def test_the_span_of_a_setting() -> None:
    assert Number(width=1).span == (0, 255)
    assert Number(width=2, possible=range(6, 17)).span == (6, 16)
    assert Number(width=2, possible=range(33), offset=16, sign=-1).span == (-16, 16)


# -- Bits ----------------------------------------------------------------------------


@st.composite
def bit_structs(draw: st.DrawFn) -> BitStruct[Any]:
    length = draw(st.integers(1, 20))
    edges = draw(
        st.lists(st.integers(0, 8 * length), unique=True, min_size=2, max_size=8).map(
            sorted
        )
    )
    # Some of the ranges between two edges; the others are gaps.
    places = [
        Bits(Number(name=f"bits_{low}"), high=end - 1, low=low)
        for low, end in pairwise(edges)
        if draw(st.booleans()) or low == edges[0]
    ]
    make = make_dataclass("Anything", [(one.field.name, int) for one in places])
    return BitStruct(make, "any", length, tuple(places))


@given(struct=bit_structs(), data=st.data())
def test_bits_are_where_the_manual_counts_them(
    struct: BitStruct[Any], data: st.DataObject
) -> None:
    wire = data.draw(st.binary(min_size=struct.length, max_size=struct.length))
    digits = "".join(f"{byte:08b}" for byte in wire)[::-1]
    value = struct.decode(wire)
    for place in struct.fields:
        expected = digits[place.low : place.high + 1][::-1]
        assert getattr(value, place.field.name) == int(expected, 2)
    again = struct.encode(value)
    assert struct.decode(again) == value
    covered = sum(place.mask << place.low for place in struct.fields)
    assert int.from_bytes(again) == int.from_bytes(wire) & covered
    with pytest.raises(ImplausibleReplyError, match="any: "):
        struct.decode(wire + b"x")


@record
class Port:
    mode: int = bits(11, 8, Number())
    amperes: tuple[float, float, float] = bits(
        63, 16, phases(Scaled(width=2, divisor=10))
    )
    on: bool = bit(0)


PORT = BitStruct(Port, "here, 1.2", 8)


def test_a_record_of_bits() -> None:
    port = Port(mode=5, amperes=(1.0, 2.0, 3.0), on=True)
    wire = bytes.fromhex("000a 0014 001e 0501")
    assert PORT.encode(port) == wire
    assert PORT.decode(wire) == port


def test_what_does_not_fit_its_bits() -> None:
    with pytest.raises(RefusedOrderError, match=r"^mode 16 does not fit$"):
        PORT.encode(Port(mode=16, amperes=(0.0, 0.0, 0.0), on=False))
    with pytest.raises(ValueError, match="beyond 4 bytes"):
        BitStruct(Port, "here", 4)
    with pytest.raises(ValueError, match="not 3 bytes"):
        bits(15, 0, Raw(width=3))


# -- Registers -----------------------------------------------------------------------


@given(
    first=st.integers(0, 0xFF00), data=st.binary(min_size=2, max_size=24), at=st.data()
)
def test_words_are_where_their_registers_are(
    first: int, data: bytes, at: st.DataObject
) -> None:
    data = data[: len(data) // 2 * 2]
    block = Block(first, len(data) // 2)
    registers = at.draw(
        st.sets(st.sampled_from(range(first, first + block.words)), min_size=1)
    )
    words = {f"at_{register}": Word(register, Number()) for register in registers}
    make = make_dataclass("Anything", [(name, int) for name in words])
    value = Registers(make, "any", block, words).decode(data)
    expected = words_of(block, data)
    assert list(expected) == list(range(first, first + block.words))
    for name, word in words.items():
        offset = 2 * (word.register - first)
        assert getattr(value, name) == int.from_bytes(data[offset : offset + 2])
        assert getattr(value, name) == expected[word.register]


@pytest.mark.parametrize("register", [0x0F, 0x12])
def test_a_word_outside_its_block(register: int) -> None:
    words = {"row": Word(register, Number())}
    with pytest.raises(ValueError, match="beyond 4 bytes"):
        Registers(Place, "here", Block(0x10, 2), words)


# -- The tables of the protocols -----------------------------------------------------

REGISTERS: list[Registers[Any]] = [
    abl.INFO,
    abl.FLAGS,
    abl.ICMAX,
    abl.READING,
    abl.SERIAL,
    abl.CONFIGURATION,
    *(layout.status for layout in MAPS.values()),
]


@pytest.mark.parametrize("table", REGISTERS, ids=lambda table: table.source)
def test_tables_of_registers(table: Registers[Any]) -> None:
    names = {one.field.name for one in table.fields}
    assert len(names) == len(table.fields)
    assert names <= {one.name for one in fields(table.make)}
    taken = 0
    for one in table.fields:
        place = one.mask << one.low
        assert not taken & place, f"{one.field.name} lies over another field"
        taken |= place


@pytest.mark.parametrize("dialect", MAPS)
def test_settings_lie_in_the_blocks_that_are_read(dialect: str) -> None:
    layout = MAPS[dialect]
    read = {
        register
        for block in layout.configuration
        for register in range(block.register, block.register + block.words)
    }
    words = [layout.socket, layout.load_balancing, *layout.settings.values()]
    registers = [word.register for word in words]
    assert read.issuperset(registers)
    assert len(set(registers)) == len(registers)


@pytest.mark.parametrize(
    ("struct", "length"),
    [
        (evbox.ORDER, 14),
        (evbox.HEAD, 5),
        (evbox.MODULE[69], 18),
        (evbox.MODULE[68], 24),
    ],
)
@given(data=st.data())
def test_tables_of_evbox(struct: Struct[Any], length: int, data: st.DataObject) -> None:
    assert struct.length == length
    value = data.draw(value_of_struct(struct))
    assert struct.decode(struct.encode(value)) == value
