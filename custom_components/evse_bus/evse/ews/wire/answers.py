"""Answers to commands: matching, decoding, and the reasons of a refusal.

Source: manual, 3.2.4. Most commands are answered by one byte: 0 is OK, as far as it is
defined; only ``sl`` has codes for reasons. For other commands the reason is taken from
the conditions in their descriptions.
"""

from collections.abc import Callable, Mapping
from enum import StrEnum
from typing import Final

from ...errors import ExchangeRefusedError, ImplausibleReplyError
from .frames import Bcc, CommandId, EwsFrame

OK: Final = 0


class Refusal(StrEnum):
    """Why a box refuses a command."""

    # `sl`, by code.
    INVALID_PARAMETER = "invalid_parameter"
    INVALID_CONFIGURATION = "invalid_configuration"
    WAITING_FOR_UNPLUG = "waiting_for_unplug"
    CABLE_CURRENT = "cable_current"
    LOCK = "lock"
    CONTACTOR = "contactor"
    NOT_READY = "not_ready"
    CARD_READER = "card_reader"
    RCD = "rcd"
    PORT_BLOCKED = "port_blocked"
    UNKNOWN = "unknown"
    # The other commands, by command.
    METER = "meter"
    FIRMWARE = "firmware"
    CARD = "card"
    CARD_READER_COMMAND = "card_reader_command"
    ROM_ERASE = "rom_erase"
    ROM_WRITE = "rom_write"
    CLOCK = "clock"
    LEDS = "leds"
    CARD_LIST = "card_list"
    INSTALLATION_INFO = "installation_info"
    SYSTEM_PARAMETERS = "system_parameters"
    LIMIT = "limit"
    USER_PARAMETERS = "user_parameters"
    EXTRA_PARAMETERS = "extra_parameters"


START_STOP_CODES: Final[Mapping[int, Refusal]] = {
    1: Refusal.INVALID_PARAMETER,
    2: Refusal.INVALID_PARAMETER,
    3: Refusal.INVALID_CONFIGURATION,
    4: Refusal.WAITING_FOR_UNPLUG,
    5: Refusal.CABLE_CURRENT,
    6: Refusal.LOCK,
    7: Refusal.CONTACTOR,
    9: Refusal.NOT_READY,
    10: Refusal.CARD_READER,
    11: Refusal.RCD,
    12: Refusal.PORT_BLOCKED,
}
"""Answers to ``sl``; 8, and those from 13, are not in the manual."""

COMMAND_REFUSALS: Final[Mapping[CommandId, Refusal]] = {
    CommandId.SET_METER: Refusal.METER,
    CommandId.ACTIVATE_FIRMWARE: Refusal.FIRMWARE,
    CommandId.ACCEPT_CARD: Refusal.CARD,
    CommandId.CARD_READER: Refusal.CARD_READER_COMMAND,
    CommandId.ERASE_ROM: Refusal.ROM_ERASE,
    CommandId.WRITE_ROM: Refusal.ROM_WRITE,
    CommandId.SET_CLOCK: Refusal.CLOCK,
    CommandId.SET_LEDS: Refusal.LEDS,
    CommandId.WRITE_CARDS: Refusal.CARD_LIST,
    CommandId.WRITE_INSTALLATION: Refusal.INSTALLATION_INFO,
    CommandId.WRITE_SYSTEM: Refusal.SYSTEM_PARAMETERS,
    CommandId.SET_LIMIT: Refusal.LIMIT,
    CommandId.WRITE_USER: Refusal.USER_PARAMETERS,
    CommandId.WRITE_EXTRA: Refusal.EXTRA_PARAMETERS,
}
"""Commands answered by one byte of which only 0 is defined."""

MESSAGES: Final[Mapping[Refusal, str]] = {
    Refusal.INVALID_PARAMETER: "the box does not know this port or this order",
    Refusal.INVALID_CONFIGURATION: "the box is not configured for this",
    Refusal.WAITING_FOR_UNPLUG: "charging has ended, the cable must be pulled first",
    Refusal.CABLE_CURRENT: "the cable does not fit the current of the connection",
    Refusal.LOCK: "the plug could not be locked or unlocked",
    Refusal.CONTACTOR: "the contactor failed",
    Refusal.NOT_READY: "the box is starting and not ready yet",
    Refusal.CARD_READER: "the card reader is missing",
    Refusal.RCD: "the residual current device has tripped",
    Refusal.PORT_BLOCKED: "the other port is in use and blocks this one",
    Refusal.UNKNOWN: "the box gives a reason that is not in the manual",
    Refusal.METER: "the meter total was not set",
    Refusal.FIRMWARE: "the firmware was not activated",
    Refusal.CARD: "the card was not accepted",
    Refusal.CARD_READER_COMMAND: "the card reader did not carry out the command",
    Refusal.ROM_ERASE: "the memory for new firmware was not erased",
    Refusal.ROM_WRITE: "the memory for new firmware was not written",
    Refusal.CLOCK: "the clock was not set",
    Refusal.LEDS: "the LEDs were not set: only a box with manual keys and LEDs does so",
    Refusal.CARD_LIST: "the card list was not written",
    Refusal.INSTALLATION_INFO: "the owner's texts were not written",
    Refusal.SYSTEM_PARAMETERS: (
        "the system parameters were not written: not while the box starts or a car "
        "charges, and not the server mode over the network"
    ),
    Refusal.LIMIT: "the current limit was not taken",
    Refusal.USER_PARAMETERS: "the network parameters were not written",
    Refusal.EXTRA_PARAMETERS: "the additional parameters were not written",
}


class EwsRefusedError(ExchangeRefusedError):
    """A command that the box refused, with the reason."""

    def __init__(self, command: CommandId, code: int) -> None:
        """Look up the reason for ``code``, the answer to ``command``."""
        reason = refusal(command, code)
        super().__init__(f"{MESSAGES[reason]} ({command}: {code})", code)
        self.command = command
        self.reason = reason
        self.text_key = f"ews_{reason}"


def refusal(command: CommandId, code: int) -> Refusal:
    """Return the reason for a refusal by the code of the answer (not 0)."""
    if command is CommandId.START_STOP:
        return START_STOP_CODES.get(code, Refusal.UNKNOWN)
    return COMMAND_REFUSALS.get(command, Refusal.UNKNOWN)


def answer[T](
    command: CommandId, decode: Callable[[bytes], T], bcc: Bcc | None = None
) -> Callable[[EwsFrame], T | None]:
    """Return a matcher for the answer to a command, which decodes its data.

    ``bcc``: the checksum that the box uses, once it is known; answers with the other
    one do not match. The matcher raises what ``decode`` raises.
    """

    def accept(frame: EwsFrame) -> T | None:
        if not frame.answers(command) or bcc not in (None, frame.bcc):
            return None
        return decode(frame.data)

    return accept


def confirmed(command: CommandId) -> Callable[[bytes], bool]:
    """Return a decoder for an answer of one byte; it returns ``True`` for OK.

    The decoder raises EwsRefusedError for a refusal, ImplausibleReplyError for an
    answer that is not one byte.
    """

    def decode(data: bytes) -> bool:
        if len(data) != 1:
            message = f"{command}: a confirmation of {len(data)} bytes, not 1"
            raise ImplausibleReplyError(message)
        _raise_if_refused(command, data[0])
        return True

    return decode


def decode_reset(data: bytes) -> bool:
    """Return ``True`` for the answer to ``zz``, which has no data.

    Raises ImplausibleReplyError for one with data.
    """
    if data:
        message = f"zz: an answer of {len(data)} bytes, not 0"
        raise ImplausibleReplyError(message)
    return True


def decode_firmware_id(data: bytes) -> str:
    """Return the firmware id of an answer to ``id``: 11 bytes, in one example 3.

    Raises ImplausibleReplyError for an empty, longer or unreadable one.
    """
    text = data.rstrip(b"\0 ").decode("latin-1")
    if not text or len(data) > FIRMWARE_LENGTH or not text.isprintable():
        message = f"id: {len(data)} bytes that are no firmware id"
        raise ImplausibleReplyError(message)
    return text


FIRMWARE_LENGTH: Final = 11


def decode_card_reader(data: bytes) -> bytes:
    """Return the reply of the card reader in an answer to ``mc``.

    Raises EwsRefusedError, and ImplausibleReplyError for an empty answer.
    """
    if not data:
        raise ImplausibleReplyError("mc: an empty answer")
    _raise_if_refused(CommandId.CARD_READER, data[0])
    return data[1:]


def _raise_if_refused(command: CommandId, code: int) -> None:
    if code != OK:
        raise EwsRefusedError(command, code)
