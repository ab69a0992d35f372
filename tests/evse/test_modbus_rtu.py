"""Modbus RTU frames: found by length and checksum, whatever surrounds them."""

from itertools import accumulate, pairwise
import json
from pathlib import Path
from typing import TYPE_CHECKING

from hypothesis import assume, example, given, strategies as st
from pymodbus.framer import FramerRTU
from pymodbus.pdu import DecodePDU
import pytest
from tmodbus.utils.crc import calculate_crc16

from custom_components.evse_bus.evse.modbus import (
    ModbusFrame,
    RtuFramer,
    crc,
    exception_code,
    is_written,
    malformed_exception_code,
    read_input_registers,
    read_registers,
    registers_read,
    rtu_frame,
    write_register,
    write_registers,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

READ = bytes.fromhex("000400a0000931ff")
STATUS = bytes.fromhex("0004120043000000100006000000000082000100009f06")
PERHAPS = bytes.fromhex("0010033c01")
WRITE = bytes.fromhex("001000a6000102008cb2a3")
WRITTEN = bytes.fromhex("001000a70001b1fb")
SINGLE = bytes.fromhex("000600a70001f838")
BROADCAST = bytes.fromhex("0010000100040800000000000000008ab9")
ENDS_IN_00 = bytes.fromhex("000304" + "00000184" + "eb00")
"""An answer of two words; without its last byte a request with a good checksum."""
TRACE = json.loads(
    (Path(__file__).parents[1] / "traces" / "smartevse_v2_17.json").read_text()
)

FUNCTIONS = (3, 4, 6, 16)

_units = st.integers(0, 247)
_words = st.integers(0, 0xFFFF)


def _lengths(data: bytes) -> set[int]:
    """Return the lengths of all frames that data may begin with, by their shape."""
    if len(data) < 2 or data[1] & 0x7F not in FUNCTIONS:
        return set()
    if data[1] & 0x80:
        return {5}
    counts = {3: 2, 4: 2, 16: 6}
    place = counts.get(data[1])
    counted = {place + 3 + data[place]} if place and place < len(data) else set()
    return {5, 8} | counted


def has_two_readings(raws: Sequence[bytes]) -> bool:
    """Return whether good checksums show other frames than these in a stream.

    A checksum stays good when 00 follows, and frames of unit 0 begin with it.
    """
    stream = b"".join(raws) + b"\0"
    ends = list(accumulate(map(len, raws)))
    meant = set(zip([0, *ends], ends, strict=False))
    found = {
        (start, start + length)
        for start in range(len(stream))
        for length in _lengths(stream[start:])
        if start + length <= len(stream)
        if crc(stream[start : start + length]) == b"\0\0"
    }
    return not found <= meant


def _counted(function: int) -> st.SearchStrategy[bytes]:
    return st.builds(
        lambda unit, values: rtu_frame(
            unit,
            bytes((function, 2 * len(values)))
            + b"".join(value.to_bytes(2, "big") for value in values),
        ),
        _units,
        st.lists(_words, min_size=1, max_size=20),
    )


_frames = st.one_of(
    st.builds(
        lambda u, r, n: rtu_frame(u, read_registers(r, n)),
        _units,
        _words,
        st.integers(1, 20),
    ),
    st.builds(
        lambda u, r, n: rtu_frame(u, read_input_registers(r, n)),
        _units,
        _words,
        st.integers(1, 20),
    ),
    st.builds(
        lambda u, r, v: rtu_frame(u, write_register(r, v)), _units, _words, _words
    ),
    st.builds(
        lambda u, r, v: rtu_frame(u, write_registers(r, v)),
        _units,
        _words,
        st.lists(_words, min_size=1, max_size=8),
    ),
    st.builds(
        lambda u, r, n: rtu_frame(u, b"\x10" + r.to_bytes(2) + n.to_bytes(2)),
        _units,
        _words,
        st.integers(1, 20),
    ),
    st.builds(
        lambda u, f, c: rtu_frame(u, bytes((f, c))),
        _units,
        st.sampled_from((3, 4, 6, 16, 0x83, 0x84, 0x86, 0x90)),
        st.integers(1, 11),
    ),
    _counted(3),
    _counted(4),
).filter(lambda raw: not has_two_readings([raw]))


def feed(*chunks: bytes) -> tuple[list[ModbusFrame], RtuFramer]:
    framer = RtuFramer()
    return [frame for chunk in chunks for frame in framer.feed(chunk)], framer


def cut(data: bytes, places: Sequence[int]) -> list[bytes]:
    edges = [0, *sorted(place % (len(data) + 1) for place in places), len(data)]
    return [data[start:end] for start, end in pairwise(edges)]


@pytest.mark.parametrize(
    "raw", [READ, STATUS, PERHAPS, WRITE, WRITTEN, SINGLE, BROADCAST]
)
def test_a_recorded_frame(raw: bytes) -> None:
    (frame,), framer = feed(raw)
    assert frame.raw == raw
    assert frame.is_reply is None
    assert (frame.unit, frame.function) == (raw[0], raw[1])
    assert frame.data == raw[2:-2]
    assert (framer.noise, framer.bad, framer.pending) == (0, 0, 0)


@pytest.mark.parametrize("raw", [READ, STATUS, PERHAPS, WRITE, BROADCAST])
def test_byte_by_byte(raw: bytes) -> None:
    frames, framer = feed(*(raw[i : i + 1] for i in range(len(raw))))
    assert [frame.raw for frame in frames] == [raw]
    assert framer.pending == 0


def test_what_the_frames_say() -> None:
    ((read,), _), ((perhaps,), _), ((written,), _) = map(
        feed, (STATUS, PERHAPS, WRITTEN)
    )
    data = registers_read(read, 9, 4)
    assert data is not None
    assert data[:2] == b"\x00C"
    assert registers_read(read, 9) is None
    assert malformed_exception_code(perhaps, 0x10) == 3
    assert exception_code(perhaps, 0x10) is None
    assert is_written(written, 0xA7, 1)
    ((proper,), _) = feed(rtu_frame(1, b"\x90\x02"))
    assert exception_code(proper, 0x10) == 2


def test_an_answer_may_equal_its_request() -> None:
    """Function 0x06: an echo and an answer are two equal frames."""
    frames, _ = feed(SINGLE + SINGLE)
    assert [frame.raw for frame in frames] == [SINGLE, SINGLE]


def test_a_good_frame_behind_a_broken_one() -> None:
    broken = bytes((*STATUS[:-1], STATUS[-1] ^ 1))
    frames, framer = feed(broken + WRITTEN)
    assert [frame.raw for frame in frames] == [WRITTEN]
    assert framer.noise == len(broken)
    assert framer.bad == 1


def test_a_good_frame_behind_one_that_was_cut_short() -> None:
    """What was promised never comes; the next frame does."""
    frames, framer = feed(STATUS[:12], WRITTEN, STATUS)
    assert [frame.raw for frame in frames] == [WRITTEN, STATUS]
    assert framer.noise == 12


def test_a_frame_that_ends_too_soon_waits_and_is_forgotten() -> None:
    frames, framer = feed(STATUS[:-1])
    assert frames == []
    assert framer.pending == len(STATUS) - 1
    framer.reset()
    assert framer.pending == 0
    assert framer.noise == len(STATUS) - 1


@given(_frames)
@example(WRITE)
def test_any_frame_is_found(raw: bytes) -> None:
    frames, framer = feed(raw)
    assert [frame.raw for frame in frames] == [raw]
    assert framer.pending == 0


@given(st.lists(_frames, min_size=1, max_size=5), st.lists(st.integers(0, 999)))
def test_frames_in_any_lumps(raws: list[bytes], places: list[int]) -> None:
    assume(not has_two_readings(raws))
    frames, framer = feed(*cut(b"".join(raws), places))
    assert [frame.raw for frame in frames] == raws
    assert (framer.noise, framer.pending) == (0, 0)


REQUESTS = bytes.fromhex("00030400000184eb" + "00030000000185db")
"""Read a register at 0x0400 of unit 0, then one at 0x0000."""


@pytest.mark.parametrize("place", range(17))
@pytest.mark.parametrize("stream", [ENDS_IN_00, ENDS_IN_00 + WRITE, REQUESTS])
def test_an_answer_of_two_words_wins_over_a_request(stream: bytes, place: int) -> None:
    """`REQUESTS` (found by the test above) has two readings, with good checksums.

    The 00 of the second request fits the first: ``000304 00000184 eb00`` is an answer
    of two words. No dialect has a register at 0x04xx (PROTOCOLS.md, 3), so nobody
    sends the first; and whether an answer is found must depend neither on its value
    nor on how an adapter cuts it.
    """
    frames, framer = feed(*cut(stream, [place]))
    assert [frame.raw for frame in frames][:1] == [ENDS_IN_00]
    assert registers_read(frames[0], 2, 3) == bytes.fromhex("00000184")
    framer.reset()
    assert sum(len(frame.raw) for frame in frames) + framer.noise == len(stream)
    assert stream == REQUESTS or framer.noise == 0


def test_a_request_that_may_be_an_answer_waits_for_the_next_byte() -> None:
    request = rtu_frame(1, read_registers(0x0400, 1))
    frames, framer = feed(request)
    assert (frames, framer.pending) == ([], 8)
    assert [frame.raw for frame in framer.feed(b"\x01")] == [request]


# Bytes that are no function, so that no frame begins in them.
_noise = st.binary(max_size=12).map(lambda data: bytes(0x20 | (b & 0x1F) for b in data))


@given(_noise, _frames, _noise, st.lists(st.integers(0, 99), max_size=6))
def test_noise_around_a_frame(
    before: bytes, raw: bytes, after: bytes, places: list[int]
) -> None:
    # A byte before it makes a longer frame that may still come of a weak one.
    weak = len(raw) == 5 and not raw[1] & 0x80
    assume(not (before and weak and raw[0] & 0x7F in FUNCTIONS))
    frames, framer = feed(*cut(before + raw + after, places))
    assert raw in [frame.raw for frame in frames]
    framer.reset()
    assert framer.noise == len(before) + len(after)


@given(st.lists(st.binary(max_size=40), max_size=6))
def test_any_bytes_at_all(chunks: list[bytes]) -> None:
    """No byte is counted twice or lost, and what is found has its checksum."""
    frames, framer = feed(*chunks)
    for frame in frames:
        assert crc(frame.raw[:-2]) == frame.raw[-2:]
    framer.reset()
    found = sum(len(frame.raw) for frame in frames)
    assert found + framer.noise == sum(map(len, chunks))
    assert framer.pending == 0


@given(_frames, st.data())
def test_a_flipped_bit_is_no_frame(raw: bytes, data: st.DataObject) -> None:
    bit = data.draw(st.integers(0, 8 * len(raw) - 1))
    broken = bytearray(raw)
    broken[bit // 8] ^= 1 << bit % 8
    frames, _ = feed(bytes(broken))
    assert raw not in [frame.raw for frame in frames]
    assert all(len(frame.raw) < len(raw) for frame in frames)


@given(st.binary(min_size=1, max_size=60))
def test_the_checksum_is_everybodys(data: bytes) -> None:
    assert crc(data) == calculate_crc16(data)


def _pymodbus(raw: bytes, *, server: bool) -> tuple[int, bytes] | None:
    used, unit, _, pdu = FramerRTU(DecodePDU(server)).decode(raw)
    return (unit, bytes(pdu)) if used == len(raw) and pdu else None


@given(_units, _words, st.integers(1, 20))
def test_pymodbus_reads_our_requests(unit: int, register: int, count: int) -> None:
    for pdu in (
        read_input_registers(register, count),
        read_registers(register, count),
        write_register(register, count),
        write_registers(register, [count] * 4),
    ):
        assert _pymodbus(rtu_frame(unit, pdu), server=True) == (unit, pdu)


@given(_counted(4))
def test_pymodbus_reads_the_answers_we_read(raw: bytes) -> None:
    (frame,), _ = feed(raw)
    pdu = bytes((frame.function,)) + frame.data
    assert _pymodbus(raw, server=False) == (frame.unit, pdu)


def test_pymodbus_does_not_understand_the_malformed_exception() -> None:
    """Why finding frames is ours: it waits for more than will ever come."""
    assert _pymodbus(PERHAPS, server=False) is None
    assert [frame.raw for frame in feed(PERHAPS)[0]] == [PERHAPS]


def test_a_refusal_in_the_midst_of_an_answer_is_none() -> None:
    """Too hot, 11.5 A: ``00 04 00 73 00`` has a good checksum of its own."""
    words = (8, 4, 115, 2, 0, 0, 0, 13, 3, 0, 303, 3870)
    data = b"".join(word.to_bytes(2, "big") for word in words)
    raw = rtu_frame(1, bytes((4, len(data))) + data)
    assert bytes.fromhex("0004007300") in raw
    framer = RtuFramer()
    found = [
        frame.raw
        for index in range(len(raw))
        for frame in framer.feed(raw[index : index + 1])
    ]
    assert found == [raw]


# -- Requests ----------------------------------------------------------------------


@given(
    unit=_units,
    pdu=st.one_of(
        st.builds(read_registers, _words, st.integers(1, 125)),
        st.builds(read_input_registers, _words, st.integers(1, 125)),
        st.builds(write_registers, _words, st.lists(_words, min_size=1, max_size=20)),
    ),
)
def test_only_a_master_sends_it(unit: int, pdu: bytes) -> None:
    assert _frame(rtu_frame(unit, pdu)).is_request


@given(
    unit=_units,
    function=st.sampled_from((3, 4)),
    values=st.lists(_words, min_size=1, max_size=40),
    register=_words,
)
def test_a_reply_is_no_request(
    unit: int, function: int, values: list[int], register: int
) -> None:
    words = b"".join(value.to_bytes(2, "big") for value in values)
    replies = (
        bytes((function, len(words))) + words,
        bytes((16,)) + register.to_bytes(2, "big") + len(values).to_bytes(2, "big"),
        bytes((function, 2)),
        bytes((function | 0x80, 2)),
        # Its reply is equal to it.
        write_register(register, values[0]),
    )
    for reply in replies:
        assert not _frame(rtu_frame(unit, reply)).is_request


def _frame(raw: bytes) -> ModbusFrame:
    return ModbusFrame(
        raw=raw, is_reply=None, unit=raw[0], function=raw[1], data=raw[2:-2]
    )
