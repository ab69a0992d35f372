"""MCS frames against bytes of the manual, and arbitrary bytes."""

from __future__ import annotations

import random

from .ews_frames import FrameReader, bcc_of, command, frame, messages_in
from .log import Entry
from .wire import Segment

# "FW-ID? 0x02 0x0002 'C' "id" BCC"; the BCC is computed, the manual has none.
ID = bytes.fromhex("02 0002 43 6964 4C")
ID_WITHOUT = bytes.fromhex("02 0002 43 6964 0F")


def segment(data: bytes, start: float = 0.0) -> Segment:
    return Segment(start, 0.0001, data, ("client",), 0.0)


def test_the_manuals_example() -> None:
    assert command("id") == ID
    assert command("id", bcc="without_msgid") == ID_WITHOUT
    assert frame(b"A", b"id1.0")[:9] == bytes.fromhex("02 0005 41") + b"id1.0"


def test_bcc_counts_length_id_and_parameters() -> None:
    assert bcc_of(b"\x00\x02", b"C", b"id", "all") == 2 ^ 0x43 ^ 0x69 ^ 0x64
    assert bcc_of(b"\x00\x02", b"C", b"id", "without_msgid") == 2 ^ 0x69 ^ 0x64


def test_only_a_correct_bcc_is_accepted() -> None:
    reader = FrameReader()
    assert not reader.feed(segment(ID_WITHOUT))
    assert reader.counters.bad_bcc == 1
    reader.bcc = "without_msgid"
    assert [m.name for m in reader.feed(segment(ID_WITHOUT))] == ["id"]


def test_frames_cut_anywhere() -> None:
    stream = ID + command("sl", b"\x01\x03")
    for cut in range(len(stream)):
        reader = FrameReader()
        first = reader.feed(segment(stream[:cut]))
        rest = reader.feed(segment(stream[cut:], 0.05))
        assert [m.name for m in first + rest] == ["id", "sl"]


def test_a_pause_inside_a_frame_drops_it() -> None:
    reader = FrameReader(timeout=0.1)
    reader.feed(segment(ID[:4]))
    assert [m.name for m in reader.feed(segment(ID, 0.2))] == ["id"]
    assert reader.counters.timeouts == 1


def test_characters_that_wake_are_skipped() -> None:
    reader = FrameReader()
    assert len(reader.feed(segment(b"\x00\xff\x03" + ID + b"UU"))) == 1
    assert reader.counters.skipped_bytes == 5


def test_longer_than_allowed_is_dropped() -> None:
    reader = FrameReader()
    assert len(reader.feed(segment(frame(b"C", bytes(1040))))) == 1
    # The bytes after the length are noise now, and have no STX.
    assert not reader.feed(segment(frame(b"C", b"\x01" * 1041)))
    assert reader.counters.too_long == 1
    assert [m.name for m in reader.feed(segment(ID))] == ["id"]


def test_noise_never_raises() -> None:
    dice = random.Random(4)  # noqa: S311 - repeatable on purpose
    reader = FrameReader()
    for round_number in range(300):
        data = dice.randbytes(dice.randrange(60))
        reader.feed(segment(data, float(round_number)))
    reader.reset()
    assert [m.name for m in reader.feed(segment(ID, 1000.0))] == ["id"]


def test_messages_in_a_log() -> None:
    whole = ID + command("rc")
    entries = [
        Entry(0, 0, "client", part, part, collided=False)
        for part in (whole[:5], b"", whole[5:9], whole[9:] + b"\x02")
    ]
    assert [m.name for m in messages_in(entries)] == ["id", "rc"]
    broken = bytes((*ID[:-1], 0)) + ID
    entry = Entry(0, 0, "client", broken, broken, collided=False)
    assert [m.name for m in messages_in([entry])] == ["id"]
