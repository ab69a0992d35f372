"""Finding messages in a stream: lumps, noise, broken ones, records in between."""

from collections.abc import Callable, Sequence
from functools import reduce
from itertools import pairwise
from operator import xor

from hypothesis import assume, given, strategies as st
import pytest

from custom_components.evse_bus.evse.ews.wire import frames as module
from custom_components.evse_bus.evse.ews.wire.frames import (
    LONGEST_FRAME,
    Bcc,
    CommandId,
    EwsFrame,
    EwsFramer,
    MessageId,
)

from .wire import INFO, PORTS, answer, message

FIRMWARE = bytes.fromhex("02 0005 41 6964 312e30 66")
"""3.2.2: "id1.0". 00^05^41^69^64^31^2e^30 = 66."""
FIRMWARE_WITHOUT_ID = FIRMWARE[:-1] + b"\x27"
STATUS = answer("rc", PORTS)

_names = st.sampled_from([*CommandId])
# The head of a record inside is looked at twice; tests of their own have it there.
_answers = st.builds(
    answer, _names, st.binary(max_size=120), counts_id=st.booleans()
).filter(lambda raw: b"\x02\x00\x0bI" not in raw[1:])
_noise = st.binary(max_size=20).map(lambda data: data.replace(b"\x02", b"\x03"))


def feed(*chunks: bytes) -> tuple[list[EwsFrame], EwsFramer]:
    framer = EwsFramer()
    return [one for chunk in chunks for one in framer.feed(chunk)], framer


def single(data: bytes) -> list[bytes]:
    return [bytes((byte,)) for byte in data]


def cut(data: bytes, places: Sequence[int]) -> list[bytes]:
    edges = [0, *sorted(place % (len(data) + 1) for place in places), len(data)]
    return [data[start:end] for start, end in pairwise(edges)]


def raws(frames: Sequence[EwsFrame]) -> list[bytes]:
    return [one.raw for one in frames]


def has_message_to_skip(data: bytes) -> bool:
    """Return whether there is a good debug message, or one of an application."""
    for at, letter in enumerate(data[3:]):
        if data[at] == 2 and (letter == ord("D") or letter >= 0x80):
            length = int.from_bytes(data[at + 1 : at + 3])
            raw = data[at : at + length + 5]
            parameters = raw[4:-1]
            good = (
                message(chr(letter), parameters, counts_id=counts_id)
                for counts_id in (True, False)
            )
            if len(parameters) == length and raw in good:
                return True
    return False


@pytest.mark.parametrize(
    ("wire", "bcc"),
    [(FIRMWARE, Bcc.ALL), (FIRMWARE_WITHOUT_ID, Bcc.WITHOUT_MESSAGE_ID)],
)
def test_the_manuals_answer_and_the_reading_it_checks_by(wire: bytes, bcc: Bcc) -> None:
    (frame,), framer = feed(wire)
    assert frame == EwsFrame(wire, MessageId.ANSWER, "id", b"1.0", bcc)
    assert frame.answers(CommandId.READ_FIRMWARE_ID)
    assert not frame.answers(CommandId.READ_PORTS)
    assert (framer.noise, framer.bad, framer.pending) == (0, 0, 0)


def test_a_record_and_a_command_are_no_answers() -> None:
    info, ours = feed(INFO, message("C", b"rc"))[0]
    assert info == EwsFrame(INFO, MessageId.INFO, "if", INFO[6:-1], Bcc.ALL)
    assert ours.message_id is MessageId.COMMAND
    assert not ours.answers(CommandId.READ_PORTS)
    assert not feed(message("I", b"rc"))[0][0].answers(CommandId.READ_PORTS)


@given(
    st.lists(st.tuples(_noise, st.one_of(_answers, st.just(INFO))), max_size=6),
    _noise,
    st.lists(st.integers(0, 2000), max_size=30),
)
def test_every_message_is_found_however_it_comes(
    parts: list[tuple[bytes, bytes]], end: bytes, places: list[int]
) -> None:
    stream = b"".join(noise + one for noise, one in parts) + end
    frames, framer = feed(*cut(stream, places))
    assert raws(frames) == [one for _, one in parts]
    noise = sum(len(noise) for noise, _ in parts) + len(end)
    assert (framer.noise, framer.bad, framer.pending) == (noise, 0, 0)


@given(_answers, st.integers(1, 255), st.data())
def test_one_wrong_byte_makes_no_message_but_by_the_other_reading(
    wire: bytes, change: int, data: st.DataObject
) -> None:
    at = data.draw(st.integers(0, len(wire) - 1))
    # An answer read the other way differs by the letter A.
    assume(change != ord("A"))
    # One of the readings does not cover the message-id.
    assume(at != 3)
    broken = wire[:at] + bytes((wire[at] ^ change,)) + wire[at + 1 :]
    frames, framer = feed(broken)
    framer.reset()
    assert broken not in raws(frames)
    # It may contain a message to skip.
    if not has_message_to_skip(broken):
        assert framer.noise + sum(map(len, raws(frames))) == len(broken)


@pytest.mark.parametrize("at", range(6, len(FIRMWARE)))
@pytest.mark.parametrize("behind", [STATUS, INFO])
def test_a_broken_message_costs_only_itself(at: int, behind: bytes) -> None:
    broken = FIRMWARE[:at] + bytes((FIRMWARE[at] ^ 0xFF,)) + FIRMWARE[at + 1 :]
    for chunks in ([broken + behind], single(broken + behind)):
        frames, framer = feed(*chunks)
        assert raws(frames) == [behind]
        assert (framer.bad, framer.noise) == (1, len(broken))


@pytest.mark.parametrize("behind", [FIRMWARE, INFO])
def test_a_truncated_message_does_not_swallow_the_next(behind: bytes) -> None:
    for end in range(1, len(STATUS)):
        stream = STATUS[:end] + behind
        if behind == FIRMWARE and end == len(STATUS) - 6:
            # One in 128 of such checksums is right by chance: this one is, without the A.
            assert reduce(xor, stream[1:3] + stream[4 : len(STATUS)]) == 0
            continue
        for chunks in ([stream], single(stream)):
            frames, framer = feed(*chunks)
            # No time-out was needed for it.
            assert raws(frames) == [behind]
            framer.reset()
            assert framer.noise == end


@pytest.mark.parametrize("counts_id", [True, False])
def test_a_record_at_every_byte_of_an_answer(*, counts_id: bool) -> None:
    for at in range(len(STATUS) + 1):
        status = answer("rc", PORTS, counts_id=counts_id)
        stream = status[:at] + INFO + status[at:]
        for chunks in ([stream], single(stream), [stream[:at], stream[at:]]):
            frames, framer = feed(*chunks)
            assert sorted(raws(frames)) == sorted([INFO, status])
            assert (framer.bad, framer.noise, framer.pending) == (0, 0, 0)


@pytest.mark.parametrize("at", [40, 60, len(STATUS) - 8])
def test_a_checksum_that_is_right_by_chance_with_a_record_inside(at: int) -> None:
    misread = 0
    for chance in range(256):
        # A byte of the time of this charge.
        status = answer("rc", PORTS[:7] + bytes((chance,)) + PORTS[8:])
        stream = status[:at] + INFO + status[at:]
        begun = stream[: len(status)]
        misread += reduce(xor, begun[1:]) == 0
        for chunks in ([stream], single(stream), [begun, stream[len(begun) :]]):
            assert sorted(raws(feed(*chunks)[0])) == sorted([INFO, status])
    assert misread == 1


@given(_answers, st.binary(min_size=9, max_size=9), st.data())
def test_a_record_never_changes_an_answer(
    wire: bytes, content: bytes, data: st.DataObject
) -> None:
    record = message("I", b"if" + content)
    at = data.draw(st.integers(0, len(wire)))
    places = data.draw(st.lists(st.integers(0, len(wire) + 16), max_size=8))
    # Three bytes or less of the record may make up an answer's end by chance.
    assume(not len(wire) - 4 < at < len(wire))
    assume(b"\x02\x00\x0bI" not in content)
    frames, _ = feed(*cut(wire[:at] + record + wire[at:], places))
    assert sorted(raws(frames)) == sorted([record, wire])


def test_records_one_after_the_other_inside_an_answer() -> None:
    for at in range(len(STATUS) - 3):
        stream = STATUS[:at] + 3 * INFO + STATUS[at:]
        for chunks in ([stream], single(stream)):
            frames, framer = feed(*chunks)
            assert sorted(raws(frames)) == sorted([*3 * [INFO], STATUS])
            assert framer.noise == 0


def test_a_broken_record_inside_an_answer_breaks_both() -> None:
    broken = INFO[:-1] + b"\0"
    stream = STATUS[:50] + broken + STATUS[50:] + FIRMWARE
    for chunks in ([stream], single(stream)):
        frames, framer = feed(*chunks)
        assert raws(frames) == [FIRMWARE]
        assert framer.bad


@pytest.mark.parametrize("letter", ["D", "\x80", "\xff"])
def test_messages_of_others_are_skipped_whole(letter: str) -> None:
    # Their contents are no answer.
    other = message(letter, b"text " + FIRMWARE + b" text")
    frames, framer = feed(other + STATUS)
    assert raws(frames) == [STATUS]
    assert (framer.noise, framer.bad) == (0, 0)
    frames, framer = feed(*single(message(letter, b"") + STATUS))
    assert raws(frames) == [STATUS]
    assert (framer.noise, framer.bad) == (0, 0)


@pytest.mark.parametrize("letter", ["", "B", "a", "\0", "\x7f"])
def test_a_message_id_that_there_is_not(letter: str) -> None:
    wrong = message(letter or "\x01", b"id1.0")
    frames, framer = feed(wrong + FIRMWARE)
    assert raws(frames) == [FIRMWARE]
    assert framer.noise == len(wrong)


@pytest.mark.parametrize("params", [b"", b"i", b"ID1", b"\x00\x01abc"])
def test_an_answer_without_a_name_is_none(params: bytes) -> None:
    wrong = message("A", params)
    frames, framer = feed(wrong + FIRMWARE)
    assert raws(frames) == [FIRMWARE]
    assert framer.noise == len(wrong)


def test_the_longest_message() -> None:
    longest = answer("mc", bytes(1038))
    assert len(longest) == LONGEST_FRAME
    for chunks in ([longest], single(longest)):
        frames, framer = feed(*chunks)
        assert raws(frames) == [longest]
        assert framer.noise == 0


@pytest.mark.parametrize("length", [1041, 0x1000, 0xFFFF])
def test_a_message_that_is_too_long_is_not_waited_for(length: int) -> None:
    begun = b"\x02" + length.to_bytes(2) + b"Arc"
    frames, framer = feed(begun)
    assert (frames, framer.bad, framer.pending) == ([], 1, 0)
    assert framer.noise == len(begun)
    assert raws(framer.feed(FIRMWARE)) == [FIRMWARE]


def test_a_message_too_long_is_dropped_despite_its_checksum() -> None:
    frames, framer = feed(answer("mc", bytes(1039)))
    assert not frames
    assert framer.bad == 1


@given(st.lists(st.binary(min_size=1, max_size=600), max_size=20))
def test_garbage_does_not_pile_up(chunks: list[bytes]) -> None:
    framer = EwsFramer()
    for chunk in chunks:
        framer.feed(chunk)
        assert framer.pending < LONGEST_FRAME + 16


@pytest.fixture
def looks(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Count the looks at a head: the work of a framer, on any machine."""
    count = 0
    length = module._length

    def counted(head: bytes) -> int | None:
        nonlocal count
        count += 1
        return length(head)

    monkeypatch.setattr(module, "_length", counted)
    return lambda: count


@pytest.mark.parametrize(
    "pattern", ["02", "0200", "0203ff80", "0203ff41727302", "02000b496966", "020004"]
)
def test_garbage_costs_a_few_looks_per_byte(
    pattern: str, looks: Callable[[], int]
) -> None:
    """64 KiB of possible heads, as any device on the network may send."""
    garbage = bytes.fromhex(pattern) * (0x10000 * 2 // len(pattern))
    feed(garbage)
    assert looks() < 4 * len(garbage)


def test_a_message_that_another_ends_is_a_bad_one() -> None:
    frames, framer = feed(STATUS[:50] + FIRMWARE)
    assert raws(frames) == [FIRMWARE]
    assert (framer.bad, framer.noise) == (1, 50)


@given(st.integers(1, 6))
def test_records_begun_do_not_pile_up(kept: int) -> None:
    """Heads of records, never ended: each could hold up the one before it."""
    framer = EwsFramer()
    for _ in range(2000):
        framer.feed(INFO[:kept])
        assert framer.pending < LONGEST_FRAME + 16


@given(st.binary(max_size=200))
def test_all_bytes_are_counted_once(data: bytes) -> None:
    frames, framer = feed(*single(data))
    assert framer.noise + framer.pending + sum(map(len, raws(frames))) <= len(data)
    framer.reset()
    assert framer.pending == 0
    if not has_message_to_skip(data):
        assert framer.noise + sum(map(len, raws(frames))) == len(data)


@pytest.mark.parametrize("end", range(1, len(FIRMWARE)))
def test_reset_forgets_a_message_begun(end: int) -> None:
    framer = EwsFramer()
    assert framer.feed(FIRMWARE[:end]) == []
    assert framer.pending == end
    framer.reset()
    assert (framer.pending, framer.noise) == (0, end)
    assert framer.feed(FIRMWARE[end:]) == []
    assert raws(framer.feed(FIRMWARE)) == [FIRMWARE]


def test_a_message_inside_another_that_has_come_whole_is_its_contents() -> None:
    """As a reader of cards may send it."""
    outer = answer("mc", b"\0" + FIRMWARE)
    assert raws(feed(outer)[0]) == [outer]


@pytest.mark.parametrize(
    "inner", [message("A", b"xy1"), message("I", b"xy"), message("D", b"xy1")]
)
def test_an_unknown_message_does_not_end_one_around_it(inner: bytes) -> None:
    outer = answer("ri", inner.ljust(130, b"x"))
    assert raws(feed(*single(outer))[0]) == [outer]


def test_no_repr_shows_contents() -> None:
    (frame,), _ = feed(answer("ru", b"secret"))
    assert "secret" not in repr(frame)
    assert frame.raw.hex() not in repr(frame)


HOSTILE = [
    bytes.fromhex("02000b49696600"),
    b"\x02\x04\x10Arc",
    b"\x02\x00\x0bIif",
    b"\x02",
    b"\x02\x00\x02Cid",
]
"""Patterns in which each message begun seems to hold another one."""


@pytest.mark.parametrize("pattern", HOSTILE, ids=bytes.hex)
@pytest.mark.parametrize("size", [1, 7, 4096])
def test_what_is_kept_is_bounded(pattern: bytes, size: int) -> None:
    """The first of them was kept whole, and searched again with each byte."""
    framer = EwsFramer()
    data = pattern * (3000 // len(pattern))
    for at in range(0, len(data), size):
        framer.feed(data[at : at + size])
        assert framer.pending <= LONGEST_FRAME + 16
    good = message("C", b"id")
    framer.feed(bytes(2 * LONGEST_FRAME))
    assert [frame.raw for frame in framer.feed(good)] == [good]


@pytest.mark.parametrize("pattern", HOSTILE[:2], ids=bytes.hex)
def test_a_long_run_of_garbage_costs_as_much_per_byte(
    pattern: bytes, looks: Callable[[], int]
) -> None:
    counts = []
    for size in (2 * LONGEST_FRAME, 3 * LONGEST_FRAME, 4 * LONGEST_FRAME):
        framer, before = EwsFramer(), looks()
        for byte in (pattern * size)[:size]:
            framer.feed(bytes((byte,)))
        counts.append(looks() - before)
    # The same for each further piece, but for the beginning.
    assert counts[2] - counts[1] <= 1.2 * (counts[1] - counts[0])
