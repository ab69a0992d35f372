"""Framers and hostile bytes: what is kept is bounded, and each byte costs as much.

Work is counted in instructions, and the search for costly bytes is led by that count.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import xor

from hypothesis import given, settings, strategies as st, target
import pytest

from custom_components.evse_bus.evse.evbox.frames import (
    LONGEST_FRAME as LONGEST_EVBOX,
    EvboxFramer,
)
from custom_components.evse_bus.evse.ews.wire.frames import (
    LONGEST_FRAME as LONGEST_EWS,
    EwsFramer,
)
from custom_components.evse_bus.evse.framing import Frame, Framer
from custom_components.evse_bus.evse.modbus import AsciiFramer, RtuFramer

from .work import instructions

STREAM = 1500
"""Bytes of one stream; more than any framer keeps."""
LONG = 0x4000
"""Bytes of a stream after which a framer would show that it keeps more and more."""
SIZES = (1, 5, 64, STREAM)
"""Bytes fed at once."""


@dataclass(frozen=True)
class Kind:
    """A framer, bytes that mean something to it, and its bounds."""

    make: Callable[[], Framer[Frame]]
    pieces: Sequence[bytes]
    most_work: int
    """Instructions per byte; about twice the worst that a long search has found."""
    most_kept: int


RECORD = bytes.fromhex("02 000b 49 6966 00 0000000000000000 4d")
"""A good info record of an EWS-Box."""


def _bytes(text: str) -> list[bytes]:
    return [bytes((byte,)) for byte in bytes.fromhex(text)]


KINDS = {
    "rtu": Kind(RtuFramer, _bytes("00 01 03 04 06 10 83 fa f6 f8 08 02 20"), 1500, 256),
    "ascii": Kind(
        AsciiFramer,
        [b":", b">", b"\r", b"\n", b"\r\n", b"0", b"A", b"x", b"0" * 20, b"0" * 255],
        250,
        512,
    ),
    "evbox": Kind(
        EvboxFramer,
        [b"\x02", b"\x03", b"0", b"A08069", b"80A069", b"\xff", b"0" * 100, b"F" * 495],
        350,
        LONGEST_EVBOX,
    ),
    "ews": Kind(
        EwsFramer,
        [
            *_bytes("02 00 04 05 0b 80 ff"),
            *(b"A", b"C", b"D", b"I", b"if", b"Aid", b"\x02\x00\x0bI"),
            *(b"\x02\x00\x0bIif", b"\x02\x04\x00Aid", b"\x02\x00\x05Aid"),
            *(b"\x02\x00\x02Cid", bytes(9), RECORD),
        ],
        2000,
        LONGEST_EWS + len(RECORD),
    ),
}


def work_per_byte(kind: Kind, pattern: bytes, size: int) -> float:
    """Feed a repeated pattern; return the work per byte."""
    stream = (pattern * (STREAM // len(pattern) + 1))[:STREAM]
    framer = kind.make()

    def feed() -> None:
        for at in range(0, STREAM, size):
            framer.feed(stream[at : at + size])

    work = instructions(feed, kind.most_work * STREAM)
    assert framer.pending <= kind.most_kept
    return work / STREAM


@pytest.mark.parametrize("name", KINDS)
@settings(max_examples=60)
@given(st.data())
def test_no_bytes_are_costly(name: str, data: st.DataObject) -> None:
    kind = KINDS[name]
    pieces = st.lists(st.sampled_from(kind.pieces), min_size=1, max_size=12)
    size = data.draw(st.sampled_from(SIZES))
    target(work_per_byte(kind, b"".join(data.draw(pieces)), size))


COSTLY = {
    "rtu": ["fa10f804f6", "fa04f8", "10f6", "04", "0404fa", "04048310"],
    "ascii": ["3a3e", "3a" + "30" * 600, "3a300d", "3a0d0a"],
    "evbox": ["02", "0203", "02" + "30" * 988, "02" + "30" * 2000 + "03"],
    "ews": [
        "02000b49696600",
        "02" + "000243696402000b496966430200054169640202000b496966",
        "02000243696402000b4969660204004169640002000b49696602000b49696602000b4902",
        "02000b4969660202024902000b4969660202020202024902020202020202024902000b4969",
        "020400416964" + 150 * "020005416964" + 10 * "02000b4969660000000000000000004d",
    ],
}
"""The worst that a long search has found, for these framers and earlier ones."""


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        pytest.param(name, one, id=f"{name}-{number}")
        for name in COSTLY
        for number, one in enumerate(COSTLY[name])
    ],
)
def test_patterns_that_were_costly(name: str, pattern: str, size: int) -> None:
    """In single bytes the first ones cost 74,000 (RTU) and 10,500 (EWS) a byte."""
    work_per_byte(KINDS[name], bytes.fromhex(pattern), size)


def kept(framer: object) -> int:
    """Return how many bytes and objects a framer keeps, in all its collections."""
    return sum(
        sum(len(one) if isinstance(one, list) else 1 for one in value.values())
        if isinstance(value, dict)
        else len(value)
        if isinstance(value, bytearray | list)
        else kept(value)
        if hasattr(value, "__dict__")
        else 0
        for value in vars(framer).values()
    )


@pytest.mark.parametrize("name", KINDS)
@settings(max_examples=40)
@given(st.data())
def test_what_is_kept_does_not_grow(name: str, data: st.DataObject) -> None:
    """Nor does what a framer notes about the bytes."""
    kind = KINDS[name]
    pieces = st.lists(st.sampled_from(kind.pieces), min_size=1, max_size=30)
    begin, pattern = b"".join(data.draw(pieces)), b"".join(data.draw(pieces))
    framer = kind.make()
    framer.feed(begin)
    for _ in range(LONG // len(pattern) + 1):
        framer.feed(pattern)
    target(kept(framer))
    assert kept(framer) <= 5 * kind.most_kept


def test_messages_noted_inside_records_are_forgotten_with_them() -> None:
    """Each round completes two info records, and notes a message inside the outer."""
    framer = EwsFramer()
    framer.feed(b"\x02\x04\x00Aid")
    inside = b"\x02\x04\x00Aid" + bytes(2)
    outer = b"\x02\x00\x0bIif" + inside
    last = bytes((reduce(xor, outer[1:]),))
    for _ in range(300):
        for byte in outer + RECORD + bytes(1) + last:
            framer.feed(bytes((byte,)))
    assert kept(framer) < 100
