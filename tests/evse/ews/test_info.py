"""The record a box sends unasked."""

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import ImplausibleReplyError
from custom_components.evse_bus.evse.events import KeyEvent
from custom_components.evse_bus.evse.ews.wire.frames import EwsFramer
from custom_components.evse_bus.evse.ews.wire.info import (
    Change,
    Info,
    decode_info,
)

from .wire import INFO, answer, message


def decode(wire: bytes) -> Info | None:
    (frame,) = EwsFramer().feed(wire)
    return decode_info(frame)


def test_the_record() -> None:
    info = decode(INFO)
    assert info is not None
    assert info.changes == Change.PORT_1 | Change.CARD
    assert info.keys == (255, 0, 0, 1, 0, 0, 0, 254)
    assert info.key_events == (
        KeyEvent(port=1, key=1, held=None),
        KeyEvent(port=1, key=4, held=0.1),
        KeyEvent(port=2, key=4, held=25.4),
    )


@pytest.mark.parametrize(
    ("bit", "change"), [(2, Change.PORT_1), (1, Change.PORT_2), (0, Change.CARD)]
)
def test_the_bits(bit: int, change: Change) -> None:
    info = decode(message("I", b"if" + bytes((1 << bit,)) + bytes(8)))
    assert info == Info(changes=change, keys=8 * (0,))
    assert info.key_events == ()


def test_unknown_bits_are_ignored() -> None:
    info = decode(message("I", b"if\xff" + bytes(8)))
    assert info is not None
    assert Change.PORT_2 in info.changes
    assert int(info.changes) == 0xFF


@given(st.integers(0, 7), st.integers(1, 255))
def test_every_key(at: int, code: int) -> None:
    keys = bytearray(8)
    keys[at] = code
    info = decode(message("I", b"if\0" + bytes(keys)))
    assert info is not None
    (event,) = info.key_events
    assert (event.port, event.key) == (at // 4 + 1, at % 4 + 1)
    if code == 255:
        assert event.held is None
    else:
        assert event.held is not None
        assert event.held * 10 == pytest.approx(code)


def test_other_frames_are_no_record() -> None:
    assert decode(answer("rc", bytes(9))) is None
    assert decode(message("A", b"if" + bytes(9))) is None
    assert decode(message("C", b"if" + bytes(9))) is None
    assert decode(message("I", b"ix" + bytes(9))) is None


@pytest.mark.parametrize("length", [0, 8, 10])
def test_a_record_of_another_length(length: int) -> None:
    with pytest.raises(ImplausibleReplyError):
        decode(message("I", b"if" + bytes(length)))
