"""Frames in any sequence of bytes."""

from itertools import pairwise

from hypothesis import example, given, strategies as st

from custom_components.evse_bus.evse.evbox.frames import (
    LONGEST_FRAME,
    EvboxFramer,
    decode_reply,
    frame,
)

from .test_frames import FIELD_69, REPLY_68, REPLY_69, REQUEST_69

GOOD = b"\x02" + FIELD_69.encode() + b"\x03"
OTHER = frame("BCA0010203")


def feed(*chunks: bytes) -> tuple[list[bytes], EvboxFramer]:
    framer = EvboxFramer()
    return [one.raw for chunk in chunks for one in framer.feed(chunk)], framer


def test_byte_by_byte_and_all_at_once() -> None:
    wire = REQUEST_69 + GOOD + OTHER
    assert feed(wire)[0] == [REQUEST_69, GOOD, OTHER]
    assert feed(*(bytes((byte,)) for byte in wire))[0] == [REQUEST_69, GOOD, OTHER]


def test_a_half_frame_is_dropped_when_another_begins() -> None:
    frames, framer = feed(GOOD[:30] + GOOD)
    assert frames == [GOOD]
    assert (framer.noise, framer.bad, framer.pending) == (30, 0, 0)


def test_a_frame_without_its_end_is_lost_alone() -> None:
    frames, framer = feed(GOOD[:-1], OTHER, GOOD)
    assert frames == [OTHER, GOOD]
    assert framer.noise == len(GOOD) - 1


def test_wrong_checksums_are_counted() -> None:
    frames, framer = feed(GOOD.replace(b"C47A", b"C47B") + GOOD)
    assert frames == [GOOD]
    assert framer.bad == 1


def test_frames_that_are_not_hex_or_too_short_are_counted() -> None:
    for text in (b"", b"80A0", b"\xff" * 20, b"80A06\x8000"):
        assert feed(b"\x02" + text + b"\x03")[1].bad == 1
    # Its checksums are good.
    assert feed(frame("Z0A069"))[1].bad == 1


def test_an_overlong_frame_is_dropped_and_the_next_one_found() -> None:
    for chunk in (1, 7, 5000):
        wire = b"\x02" + LONGEST_FRAME * b"0" + b"\x03" + GOOD
        chunks = [wire[at : at + chunk] for at in range(0, len(wire), chunk)]
        frames, framer = feed(*chunks)
        assert frames == [GOOD]
        assert framer.bad == 1
        assert framer.noise == LONGEST_FRAME + 2


def test_a_reset_drops_the_half_frame() -> None:
    framer = EvboxFramer()
    framer.feed(GOOD[:10])
    assert framer.pending == 10
    framer.reset()
    assert (framer.pending, framer.noise) == (0, 10)
    assert [one.raw for one in framer.feed(GOOD)] == [GOOD]


pieces = st.lists(
    st.one_of(
        st.sampled_from(
            [
                GOOD,
                OTHER,
                REQUEST_69,
                frame(REPLY_68),
                frame(REPLY_69),
                b"\x02",
                b"\x03",
            ]
        ),
        st.binary(max_size=12),
        st.just(b"\x02" + b"0" * LONGEST_FRAME),
    ),
    max_size=8,
)


@given(pieces, st.lists(st.integers(0, 3000), max_size=8))
@example([b"\x02" + b"0" * LONGEST_FRAME, b"\x02"], [LONGEST_FRAME])
def test_the_chunks_of_bytes_make_no_difference(
    parts: list[bytes], cuts: list[int]
) -> None:
    wire = b"".join(parts)
    borders = [0, *sorted(cut for cut in cuts if cut < len(wire)), len(wire)]
    whole, at_once = feed(wire)
    cut, in_pieces = feed(*(wire[start:end] for start, end in pairwise(borders)))
    assert whole == cut
    assert (at_once.bad, at_once.noise) == (in_pieces.bad, in_pieces.noise)
    assert at_once.pending == in_pieces.pending


@given(st.binary(max_size=300))
def test_a_whole_frame_after_any_noise_is_found(noise: bytes) -> None:
    assert feed(noise, GOOD)[0][-1:] == [GOOD]


@given(st.binary(max_size=200))
def test_no_bytes_raise(data: bytes) -> None:
    framer = EvboxFramer()
    for one in framer.feed(b"\x02" + data + b"\x03"):
        decode_reply(one)


@given(st.integers(1, len(GOOD) - 2), st.integers(0, 7))
def test_one_flipped_bit_never_passes(at: int, bit: int) -> None:
    damaged = bytearray(GOOD)
    damaged[at] ^= 1 << bit
    assert feed(bytes(damaged))[0] == []
