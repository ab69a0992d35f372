"""Modbus RTU of the virtual SmartEVSE: checksums, kinds of frames."""

from __future__ import annotations

from hypothesis import given, strategies as st
import pytest

from .log import Entry
from .smartevse_frames import (
    READ_INPUT,
    WRITE_ONE,
    WRITE_SEVERAL,
    crc16,
    decode,
    exception_frame,
    frame,
    read_frame,
    smartevse_requests_in,
    values_frame,
    write_frame,
    write_several_frame,
)
from .smartevse_registers import DIALECTS, V2_17, Dialect, Setting

BYTE = st.integers(0, 0xFF)
WORD = st.integers(0, 0xFFFF)


def test_frames_as_recorded() -> None:
    assert read_frame(0, 0xA0, 9).hex() == "000400a0000931ff"
    assert write_frame(2, 0x82, 60).hex() == "02060082003c29c0"
    recorded = "001000010004080064003c00000000ff7a"
    assert write_several_frame(0, 1, 100, 60, 0, 0).hex() == recorded
    assert exception_frame(0, 4, 2).hex() == "000402f2c1"
    assert values_frame(0, 4, [0x41]).hex() == "000402004144c0"


@given(unit=BYTE, register=WORD, values=st.lists(WORD, min_size=1, max_size=20))
def test_writes_are_decoded(unit: int, register: int, values: list[int]) -> None:
    one = decode(write_frame(unit, register, values[0]), V2_17.functions)
    assert one is not None
    assert (one.kind, one.unit, one.register) == ("either", unit, register)
    assert one.values == (values[0],)
    several = decode(write_several_frame(unit, register, *values), V2_17.functions)
    assert several is not None
    assert (several.kind, several.count) == ("request", len(values))
    assert several.values == tuple(values)


@given(st.binary(max_size=60))
def test_any_bytes_are_decoded_or_ignored(data: bytes) -> None:
    assert decode(data, V2_17.functions) is None or crc16(data[:-2]) == data[-2:]
    for function in (READ_INPUT, WRITE_ONE, WRITE_SEVERAL):
        packet = decode(frame(1, function, data), V2_17.functions)
        assert packet is None or packet.function == function


@pytest.mark.parametrize(
    "data",
    [
        read_frame(0, 0xA0, 9, function=3),
        exception_frame(0, 4, 2),
        values_frame(0, 4, [0x41]),
        frame(0, 4, b"\x05" + bytes(6)),
        frame(0, 6, bytes(6)),
        frame(0, 16, bytes.fromhex("00a6 0001 04 0050")),
        read_frame(0, 0xA0, 9)[:-1] + b"\x00",
    ],
)
def test_frames_that_a_217_ignores(data: bytes) -> None:
    assert decode(data, V2_17.functions) is None


def test_replies_are_no_requests() -> None:
    answers = (values_frame(2, 4, [0] * 9), frame(2, 16, bytes.fromhex("00a70001")))
    for data in answers:
        packet = decode(data, V2_17.functions)
        assert packet is not None
        assert packet.kind == "answer"
    entries = [
        Entry(0.0, 0.1, "client", data, data, collided=False) for data in answers
    ]
    assert smartevse_requests_in(entries) == []


@pytest.mark.parametrize("dialect", DIALECTS.values(), ids=lambda d: d.name)
def test_tables(dialect: Dialect) -> None:
    """Every item once, with a default in its range, at its register."""
    names = [
        item.name if isinstance(item, Setting) else item
        for block in dialect.blocks
        for item in block.items
    ]
    assert len(names) == len(set(names))
    for name in names:
        found = dialect.find(dialect.register_of(name), 1)
        assert found is not None
    for setting in dialect.settings.values():
        # In mode normal the meter is 0, although 0 cannot be set.
        assert setting.low <= setting.default <= setting.high or setting.default == 0
    with pytest.raises(KeyError):
        dialect.register_of("nothing")
