"""Modbus frames: found whatever surrounds them, built as others build them."""

from itertools import pairwise
from typing import TYPE_CHECKING

from hypothesis import given, strategies as st
from pymodbus.framer import FramerAscii
from pymodbus.pdu import DecodePDU
import pytest
from tmodbus.transport.async_ascii import (
    build_ascii_frame,
    decode_ascii_frame,
    validate_ascii_frame,
)
from tmodbus.utils.lrc import calculate_lrc

from custom_components.evse_bus.evse.modbus import (
    AsciiFramer,
    ModbusFrame,
    ascii_frame,
    exception_code,
    is_written,
    lrc,
    read_registers,
    registers_read,
    write_registers,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

ANSWER = b">01030204A155\r\n"
REQUEST = b":0103002E0005C9\r\n"

_contents = st.binary(min_size=2, max_size=60)
_answers = _contents.map(lambda data: ascii_frame(data[0], data[1:], start=b">"))
_requests = _contents.map(lambda data: ascii_frame(data[0], data[1:]))
# What can stand between two frames without ending or beginning one.
_noise = st.binary(max_size=20).map(
    lambda data: data.replace(b">", b"?").replace(b":", b";")
)


def feed(*chunks: bytes) -> tuple[list[ModbusFrame], AsciiFramer]:
    framer = AsciiFramer()
    return [frame for chunk in chunks for frame in framer.feed(chunk)], framer


def cut(data: bytes, places: Sequence[int]) -> list[bytes]:
    edges = [0, *sorted(place % (len(data) + 1) for place in places), len(data)]
    return [data[start:end] for start, end in pairwise(edges)]


def test_an_answer() -> None:
    (frame,), framer = feed(ANSWER)
    assert frame == ModbusFrame(
        raw=ANSWER, is_reply=True, unit=1, function=3, data=b"\x02\x04\xa1"
    )
    assert (framer.noise, framer.bad, framer.pending) == (0, 0, 0)


def test_a_request_on_the_bus_is_no_answer() -> None:
    (frame,), _ = feed(REQUEST)
    assert not frame.is_reply


def test_lower_case_is_read_and_upper_case_written() -> None:
    (frame,), _ = feed(ANSWER.lower())
    assert frame.data == b"\x02\x04\xa1"
    assert ascii_frame(0xAB, b"\x03\xcd") == b":AB03CD85\r\n"


@pytest.mark.parametrize(
    ("broken", "noise", "bad"),
    [
        pytest.param(b">01030204A156\r\n", 0, 1, id="checksum"),
        pytest.param(b">01030204A1", 11, 0, id="half"),
        pytest.param(b">01030204A155\r", 14, 0, id="half end"),
        pytest.param(b">01030204A15\r\n", 0, 1, id="odd number of digits"),
        pytest.param(b">01030204G155\r\n", 6, 1, id="no digit"),
        pytest.param(b">01030204A155\n", 1, 1, id="no carriage return"),
        pytest.param(b">01030204A155\r\r\n", 2, 1, id="end twice"),
        pytest.param(b">\r\n", 0, 1, id="empty"),
        pytest.param(b">0101\r\n", 0, 1, id="too short"),
        pytest.param(b">" + b"0" * 510 + b"00\r\n", 4, 1, id="too long"),
        pytest.param(b"\x00\xff\r\n", 4, 0, id="garbage"),
    ],
)
def test_the_good_frame_behind_a_broken_one(
    broken: bytes, noise: int, bad: int
) -> None:
    frames, framer = feed(broken + ANSWER)
    assert [frame.raw for frame in frames] == [ANSWER]
    assert (framer.noise, framer.bad) == (noise, bad)
    # Byte by byte it is the same.
    frames, framer = feed(*(bytes((byte,)) for byte in broken + ANSWER))
    assert [frame.raw for frame in frames] == [ANSWER]
    assert (framer.noise, framer.bad) == (noise, bad)


def test_a_frame_begun_is_pending_until_it_is_forgotten() -> None:
    frames, framer = feed(ANSWER[:7])
    assert not frames
    assert framer.pending == 7
    framer.reset()
    assert (framer.pending, framer.noise) == (0, 7)
    assert [frame.raw for frame in framer.feed(ANSWER[7:] + ANSWER)] == [ANSWER]


def test_the_longest_frame() -> None:
    longest = ascii_frame(1, bytes(253), start=b">")
    assert len(longest) == 513
    assert [frame.raw for frame in feed(longest)[0]] == [longest]


@given(st.lists(st.binary(max_size=30)))
def test_no_bytes_make_it_fail(chunks: list[bytes]) -> None:
    whole, one = feed(b"".join(chunks))
    parts, other = feed(*chunks)
    assert whole == parts
    assert (one.noise, one.bad, one.pending) == (other.noise, other.bad, other.pending)


@given(
    st.lists(st.tuples(_noise, st.one_of(_answers, _requests)), max_size=6),
    _noise,
    st.lists(st.integers(min_value=0)),
)
def test_good_frames_are_found_in_any_stream_however_it_is_cut(
    parts: list[tuple[bytes, bytes]], tail: bytes, places: list[int]
) -> None:
    stream = b"".join(noise + frame for noise, frame in parts) + tail
    frames, framer = feed(*cut(stream, places))
    assert [frame.raw for frame in frames] == [frame for _, frame in parts]
    assert framer.noise == len(tail) + sum(len(noise) for noise, _ in parts)
    assert framer.bad == 0


@given(_answers, _answers, st.data())
def test_a_damaged_frame_never_costs_the_next(
    first: bytes, second: bytes, data: st.DataObject
) -> None:
    place = data.draw(st.integers(0, len(first) - 1))
    damaged = bytearray(first)
    damaged[place] ^= 1 << data.draw(st.integers(0, 7))
    frames, _ = feed(bytes(damaged) + second)
    # A start sign or a half end may be lost with it, never what comes after.
    assert frames[-1].raw == second
    assert all(frame.raw == second or lrc_holds(frame) for frame in frames)


def lrc_holds(frame: ModbusFrame) -> bool:
    content = bytes.fromhex(frame.raw[1:-2].decode())
    return sum(content) & 0xFF == 0


@given(st.binary(max_size=300))
def test_lrc_is_what_others_compute(data: bytes) -> None:
    assert lrc(data) == calculate_lrc(data) == -sum(data) & 0xFF


@given(st.integers(1, 247), st.binary(min_size=1, max_size=100))
def test_requests_are_what_others_build_and_read(unit: int, pdu: bytes) -> None:
    request = ascii_frame(unit, pdu)
    assert request == build_ascii_frame(unit, pdu)
    assert request == FramerAscii(DecodePDU(is_server=True)).encode(pdu, unit, 0)
    assert validate_ascii_frame(decode_ascii_frame(request))
    (frame,), _ = feed(request)
    assert (frame.unit, bytes((frame.function,)) + frame.data) == (unit, pdu)


@given(_contents)
def test_what_others_accept_we_accept(content: bytes) -> None:
    frame = build_ascii_frame(content[0], content[1:])
    used, unit, _, pdu = FramerAscii(DecodePDU(is_server=False)).decode(frame)
    (ours,), _ = feed(frame)
    assert used == len(frame)
    assert (unit, pdu) == (ours.unit, bytes((ours.function,)) + ours.data)


def test_contents() -> None:
    assert read_registers(0x002E, 5) == bytes.fromhex("03002E0005")
    assert write_registers(0x0014, (266,)) == bytes.fromhex("1000140001 02010A")
    for register, count in ((-1, 1), (0x10000, 1), (0, 0), (0, 126)):
        with pytest.raises(ValueError, match="<"):
            read_registers(register, count)


@given(st.integers(0, 255), st.binary(max_size=40), st.integers(0, 20))
def test_answers_are_only_what_they_say(function: int, data: bytes, count: int) -> None:
    frame = ModbusFrame(raw=b"", is_reply=True, unit=1, function=function, data=data)
    registers = registers_read(frame, count)
    expected = function == 3 and data[:1] == bytes((2 * count,))
    assert (registers is not None) == (expected and len(data) == 1 + 2 * count)
    assert is_written(frame, 20, 1) == (function == 16 and data == b"\0\x14\0\1")
    assert (exception_code(frame, 3) is not None) == (
        function == 0x83 and len(data) == 1
    )
