"""Messages as the manual prints them, and their bytes for a log."""

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import RefusedOrderError
from custom_components.evse_bus.evse.ews.wire.frames import (
    LONGEST_FRAME,
    MAXIMUM_PARAMETERS,
    PRIVATE,
    Bcc,
    CommandId,
    MessageId,
    Request,
    encode,
    redacted,
)

from .wire import INFO, PORTS, answer, message

# 3.2.2: 0x02 0x0002 'C' "id" BCC. 00^02^43^69^64 = 4c; without the 43: 0f.
ASKED = {
    Bcc.ALL: bytes.fromhex("02 0002 43 6964 4c"),
    Bcc.WITHOUT_MESSAGE_ID: bytes.fromhex("02 0002 43 6964 0f"),
}


@pytest.mark.parametrize("bcc", Bcc)
def test_the_manuals_command_under_both_readings(bcc: Bcc) -> None:
    assert Request(CommandId.READ_FIRMWARE_ID).encode(bcc) == ASKED[bcc]


def test_the_command_names_have_the_manuals_codes() -> None:
    codes = (
        "6372 6677 6964 6d61 6d63 6f65 6f77 7263 7264 7266 7267 7269 7270"
        "7273 7275 727a 7363 7365 7366 7369 736c 7370 7374 7375 737a 7a7a"
    )
    assert [command.encode().hex() for command in CommandId] == [
        codes.replace(" ", "")[at : at + 4] for at in range(0, 104, 4)
    ]


@given(st.sampled_from(MessageId), st.binary(max_size=MAXIMUM_PARAMETERS))
def test_either_checksum_is_right_for_its_kind_only(
    kind: MessageId, parameters: bytes
) -> None:
    for bcc, counts_id in ((Bcc.ALL, True), (Bcc.WITHOUT_MESSAGE_ID, False)):
        assert encode(kind, parameters, bcc) == message(
            chr(kind), parameters, counts_id=counts_id
        )


def test_the_length_is_two_bytes_big_endian() -> None:
    longest = encode(MessageId.COMMAND, bytes(MAXIMUM_PARAMETERS), Bcc.ALL)
    assert longest[:4] == b"\x02\x04\x10C"
    assert len(longest) == LONGEST_FRAME == 1045


def test_too_many_parameters_are_refused() -> None:
    with pytest.raises(RefusedOrderError, match="1041"):
        encode(MessageId.COMMAND, bytes(MAXIMUM_PARAMETERS + 1), Bcc.ALL)
    with pytest.raises(RefusedOrderError):
        Request(CommandId.CARD_READER, bytes(MAXIMUM_PARAMETERS - 1)).encode(Bcc.ALL)


def test_a_request_shows_no_parameters() -> None:
    assert "secret" not in repr(Request(CommandId.WRITE_USER, b"secret"))


@pytest.mark.parametrize("command", sorted(PRIVATE))
def test_private_messages_are_not_logged(command: CommandId) -> None:
    raw = answer(command, b"secret" * 9)
    assert redacted(raw) == raw[:6] + bytes(len(raw) - 6)


def test_addresses_of_the_network_are_not_logged() -> None:
    """In any command: ``rg`` of a box with DHCP as well as ``ru``."""
    address = bytes((192, 0, 2, 17))
    for command in (CommandId.READ_DHCP, CommandId.READ_USER, CommandId.WRITE_USER):
        assert address not in redacted(answer(command, address * 7))


def test_other_messages_are_logged_unchanged() -> None:
    for raw in (INFO, answer("sl", b"\x05"), ASKED[Bcc.ALL], answer("zz")):
        assert redacted(raw) == raw


def test_of_bytes_without_a_message_only_the_length_is_logged() -> None:
    private = answer("ru", b"secret")
    for raw in (
        b"",
        b"\x02",
        private[:-1],
        private[1:],
        INFO + private,
        answer("sl", b"\x05")[:-1] + b"\xff",
        message("D", b"secret"),
        message("\x80", b"secret"),
    ):
        assert redacted(raw) == bytes(len(raw))


@given(st.integers(0, len(PORTS)), st.integers(0, len(PORTS)))
def test_no_piece_of_a_private_answer_is_logged(start: int, end: int) -> None:
    piece = answer("rc", PORTS)[start:end]
    assert b"Max" not in redacted(piece)
