"""Matching of answers, and the meaning of each code."""

import pytest

from custom_components.evse_bus.evse.errors import (
    ExchangeRefusedError,
    ImplausibleReplyError,
)
from custom_components.evse_bus.evse.ews.wire.answers import (
    COMMAND_REFUSALS,
    MESSAGES,
    START_STOP_CODES,
    EwsRefusedError,
    Refusal,
    answer,
    confirmed,
    decode_card_reader,
    decode_firmware_id,
    decode_reset,
)
from custom_components.evse_bus.evse.ews.wire.commands import CONFIRMED, READS
from custom_components.evse_bus.evse.ews.wire.frames import (
    Bcc,
    CommandId,
    EwsFrame,
    EwsFramer,
)

from . import wire


def frame(raw: bytes) -> EwsFrame:
    (one,) = EwsFramer().feed(raw)
    return one


# -- Ours ----------------------------------------------------------------------------


def test_only_the_answer_to_the_command_is_taken() -> None:
    accept = answer(CommandId.START_STOP, confirmed(CommandId.START_STOP))
    assert accept(frame(wire.answer("sl", b"\0"))) is True
    for other in (
        wire.answer("st", b"\0"),
        wire.answer("rc", wire.PORTS),
        wire.message("C", b"sl\0"),
        wire.message("I", b"sl\0"),
        wire.INFO,
    ):
        assert accept(frame(other)) is None


def test_once_known_only_one_reading_of_the_checksum_is_taken() -> None:
    one = frame(wire.answer("zz"))
    other = frame(wire.answer("zz", counts_id=False))
    for bcc, mine, not_mine in (
        (Bcc.ALL, one, other),
        (Bcc.WITHOUT_MESSAGE_ID, other, one),
    ):
        accept = answer(CommandId.RESET, decode_reset, bcc)
        assert accept(mine) is True
        assert accept(not_mine) is None
    either = answer(CommandId.RESET, decode_reset)
    assert either(one) is either(other) is True


# -- sl ------------------------------------------------------------------------------

SAID = {
    1: "does not know this port or this order",
    2: "does not know this port or this order",
    3: "not configured",
    4: "the cable must be pulled",
    5: "the cable does not fit",
    6: "could not be locked or unlocked",
    7: "contactor",
    8: "not in the manual",
    9: "not ready yet",
    10: "card reader is missing",
    11: "residual current device has tripped",
    12: "the other port",
    13: "not in the manual",
    255: "not in the manual",
}


def test_every_code_of_sl() -> None:
    for code in range(1, 256):
        with pytest.raises(EwsRefusedError) as caught:
            confirmed(CommandId.START_STOP)(bytes((code,)))
        error = caught.value
        assert isinstance(error, ExchangeRefusedError)
        assert (error.code, error.command) == (code, CommandId.START_STOP)
        assert SAID.get(code, SAID[255]) in str(error)
        assert str(error).endswith(f"(sl: {code})")
        unknown = code not in START_STOP_CODES
        assert (error.reason is Refusal.UNKNOWN) == unknown
        assert unknown == (code == 8 or code > 12)


def test_the_codes_of_sl_have_reasons_of_their_own() -> None:
    # 1 and 2 are one reason in the manual.
    assert len(set(START_STOP_CODES.values())) == len(START_STOP_CODES) - 1


# -- The others ----------------------------------------------------------------------


@pytest.mark.parametrize("command", sorted(CONFIRMED - {CommandId.START_STOP}))
@pytest.mark.parametrize("code", [1, 2, 12, 255])
def test_a_command_that_is_refused(command: CommandId, code: int) -> None:
    assert confirmed(command)(b"\0") is True
    with pytest.raises(EwsRefusedError) as caught:
        confirmed(command)(bytes((code,)))
    assert caught.value.reason is COMMAND_REFUSALS[command]
    assert caught.value.code == code


@pytest.mark.parametrize("command", sorted(CONFIRMED))
@pytest.mark.parametrize("data", [b"", b"\0\0", b"\1\0"])
def test_a_confirmation_is_one_byte(command: CommandId, data: bytes) -> None:
    with pytest.raises(ImplausibleReplyError):
        confirmed(command)(data)


def test_each_command_has_its_own_reason_and_each_reason_its_message() -> None:
    assert len(set(COMMAND_REFUSALS.values())) == len(COMMAND_REFUSALS)
    assert MESSAGES.keys() == set(Refusal)
    assert len(set(MESSAGES.values())) == len(MESSAGES)


def test_every_command_of_the_reference_has_one_kind_of_answer() -> None:
    others = {CommandId.CARD_READER, CommandId.RESET}
    assert CONFIRMED | READS | others == set(CommandId)
    assert not CONFIRMED & READS
    assert COMMAND_REFUSALS.keys() == (
        CONFIRMED - {CommandId.START_STOP} | {CommandId.CARD_READER}
    )


# -- id, zz, mc ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"1.0", "1.0"),  # the manual's example
        (b"M1653001030", "M1653001030"),
        (b"M165300103\0", "M165300103"),
        (b"M16530 1   ", "M16530 1"),
    ],
)
def test_id(data: bytes, text: str) -> None:
    assert decode_firmware_id(data) == text


@pytest.mark.parametrize("data", [b"", bytes(11), b"twelve signs", b"\x01", b"1\n0"])
def test_id_that_cannot_be(data: bytes) -> None:
    with pytest.raises(ImplausibleReplyError):
        decode_firmware_id(data)


def test_zz() -> None:
    assert decode_reset(b"") is True
    with pytest.raises(ImplausibleReplyError):
        decode_reset(b"\0")


def test_mc() -> None:
    assert decode_card_reader(b"\0MCR 6241") == b"MCR 6241"
    assert decode_card_reader(b"\0") == b""
    with pytest.raises(ImplausibleReplyError):
        decode_card_reader(b"")
    with pytest.raises(EwsRefusedError) as caught:
        decode_card_reader(b"\x03MCR")
    assert caught.value.reason is Refusal.CARD_READER_COMMAND
