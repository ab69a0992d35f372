"""Messages of MCS binary, the protocol of the EWS-Box. Pure functions.

A message is ``STX length message-id parameters BCC``; the length, 16 bits big-endian,
is that of the parameters alone. The parameters of a command, of its answer and of an
info record begin with its name, two letters (manual, 3.2.2, 3.2.3).
"""

from bisect import bisect_right
from dataclasses import dataclass, field
from enum import Enum, IntEnum, StrEnum
from typing import ClassVar, Final, override

from ...errors import RefusedOrderError
from ...framing import Frame, Framer

STX: Final = 0x02
STX_BYTE: Final = b"\x02"
MAXIMUM_PARAMETERS: Final = 1040
"""Most bytes of parameters in a message (3.2.2)."""
_EXTRA: Final = 5
"""Bytes of a message beside its parameters: STX, length, message-id, BCC."""
LONGEST_FRAME: Final = MAXIMUM_PARAMETERS + _EXTRA
_HEAD: Final = 6
"""Bytes up to the end of the name."""
_LETTERS: Final = frozenset(b"abcdefghijklmnopqrstuvwxyz")


class Bcc(Enum):
    """Bytes that the checksum covers; the manual allows two readings.

    3.2.2: "length + payload", and its table calls the parameters payload; in 3.2.3
    the message-id is payload too. No message is valid under both.
    """

    ALL = "all"
    """Everything between STX and BCC."""
    WITHOUT_MESSAGE_ID = "without_message_id"


class MessageId(IntEnum):
    """Kinds of messages (3.2.2)."""

    ANSWER = ord("A")
    COMMAND = ord("C")
    DEBUG = ord("D")
    INFO = ord("I")


_APPLICATION: Final = 0x80
"""Message-ids from here on are free for applications."""
_NAMED: Final = (MessageId.ANSWER, MessageId.COMMAND, MessageId.INFO)


class CommandId(StrEnum):
    """The commands of the manual's reference (3.2.4)."""

    SET_METER = "cr"
    ACTIVATE_FIRMWARE = "fw"
    READ_FIRMWARE_ID = "id"
    ACCEPT_CARD = "ma"
    CARD_READER = "mc"
    ERASE_ROM = "oe"
    WRITE_ROM = "ow"
    READ_PORTS = "rc"
    READ_DETAILS = "rd"
    READ_CARDS = "rf"
    READ_DHCP = "rg"
    READ_INSTALLATION = "ri"
    READ_SYSTEM = "rp"
    READ_BOX = "rs"
    READ_USER = "ru"
    READ_EXTRA = "rz"
    SET_CLOCK = "sc"
    SET_LEDS = "se"
    WRITE_CARDS = "sf"
    WRITE_INSTALLATION = "si"
    START_STOP = "sl"
    WRITE_SYSTEM = "sp"
    SET_LIMIT = "st"
    WRITE_USER = "su"
    WRITE_EXTRA = "sz"
    RESET = "zz"


PRIVATE: Final = frozenset(
    {
        CommandId.ACCEPT_CARD,
        CommandId.CARD_READER,
        CommandId.READ_PORTS,
        CommandId.READ_DETAILS,
        CommandId.READ_CARDS,
        CommandId.READ_DHCP,
        CommandId.READ_INSTALLATION,
        CommandId.READ_SYSTEM,
        CommandId.READ_BOX,
        CommandId.READ_USER,
        CommandId.WRITE_CARDS,
        CommandId.WRITE_INSTALLATION,
        CommandId.WRITE_SYSTEM,
        CommandId.WRITE_USER,
    }
)
"""Commands with names, cards, passwords or network settings in their parameters or
answers, which must not be logged."""
_PRIVATE_NAMES: Final = frozenset(command.encode() for command in PRIVATE)


def checksum(content: bytes, bcc: Bcc) -> int:
    """Return the BCC of the bytes between STX and BCC."""
    if bcc is Bcc.WITHOUT_MESSAGE_ID:
        content = content[:2] + content[3:]
    # Folded in halves, since garbage from a network may be long.
    folded, left = int.from_bytes(content), len(content)
    while left > 1:
        left = (left + 1) // 2
        folded = folded >> 8 * left ^ folded & (1 << 8 * left) - 1
    return folded


def encode(message_id: int, parameters: bytes, bcc: Bcc) -> bytes:
    """Return a whole message; raises RefusedOrderError for too many parameters."""
    if len(parameters) > MAXIMUM_PARAMETERS:
        message = f"{len(parameters)} bytes of parameters, not {MAXIMUM_PARAMETERS}"
        raise RefusedOrderError(message)
    content = len(parameters).to_bytes(2) + bytes((message_id,)) + parameters
    return bytes((STX, *content, checksum(content, bcc)))


@dataclass(frozen=True, slots=True)
class Request:
    """A command, ready to be sent with either checksum."""

    command: CommandId
    parameters: bytes = field(default=b"", repr=False)

    def encode(self, bcc: Bcc) -> bytes:
        """Return the bytes for the wire."""
        return encode(
            MessageId.COMMAND, self.command.encode("ascii") + self.parameters, bcc
        )


@dataclass(frozen=True, slots=True)
class EwsFrame(Frame):
    """A message with a good checksum: a command, an answer or an info record."""

    raw: bytes = field(repr=False)
    message_id: MessageId
    name: str
    """The two letters at the begin of its parameters."""
    data: bytes = field(repr=False)
    """The parameters after the name."""
    bcc: Bcc
    """The kind of its checksum."""

    def answers(self, command: CommandId) -> bool:
        """Return whether this is an answer to this command."""
        return self.message_id is MessageId.ANSWER and self.name == command


def redacted(raw: bytes) -> bytes:
    """Return bytes for a log, with private ones set to zero.

    A known message that is not private is kept whole; of a private one the head with
    its name is kept; of anything else only the length.
    """
    if _Scan(raw, {}).whole(0) != raw or raw[3] not in _NAMED:
        return bytes(len(raw))
    head = raw[:_HEAD]
    return head + bytes(len(raw) - _HEAD) if head[4:] in _PRIVATE_NAMES else raw


# -- Finding messages --------------------------------------------------------------

_INFO_HEAD: Final = b"\x02\x00\x0bIif"
_INFO_LENGTH: Final = 16
"""Bytes of an info record (3.2.3), which may come at any moment."""
_SURE: Final = 4
"""So many bytes of its head do not occur in another message by chance."""
_LONGEST_KEPT: Final = LONGEST_FRAME + _INFO_LENGTH
"""The longest message with the beginning of an info record inside it, bytes."""


class EwsFramer(Framer[EwsFrame]):
    """Finds messages by their head, length and checksum.

    An incomplete message is kept, but not at the cost of others: an info record inside
    it is taken out, and an answer or a command inside it shows that it will never be
    completed. Debug messages and those of applications are skipped whole.

    Memory and time per byte are bounded, whatever comes: a message is given up when it
    is longer than any, and the kept bytes are searched again only when a message among
    them may be complete.
    """

    unsolicited: ClassVar = True

    def __init__(self) -> None:
        """Start empty."""
        super().__init__()
        self._buffer = b""
        self._search_at = 0
        """Length of the buffer from which on a search may find something new."""
        self._checksums: dict[int, Bcc | None] = {}
        """Kinds of checksum of complete messages, by their place in the buffer."""

    @property
    @override
    def pending(self) -> int:
        return len(self._buffer)

    @override
    def reset(self) -> None:
        self.noise += len(self._buffer)
        self._drop(len(self._buffer))

    @override
    def redacted(self, raw: bytes) -> bytes:
        return redacted(raw)

    @override
    def feed(self, data: bytes) -> list[EwsFrame]:
        found: list[EwsFrame] = []
        for at in range(0, len(data), LONGEST_FRAME):
            received = len(self._buffer)
            self._buffer += data[at : at + LONGEST_FRAME]
            if (begins := self._buffer.find(STX_BYTE, received)) >= 0:
                self._search_at = min(self._search_at, begins + _HEAD - 2)
            if len(self._buffer) >= self._search_at:
                found += self._search()
        return found

    def _search(self) -> list[EwsFrame]:
        scan = _Scan(self._buffer, self._checksums)
        found: list[EwsFrame] = []
        taken = at = 0
        begun: int | None = None
        while (at := scan.buffer.find(STX_BYTE, at)) >= 0:
            whole = scan.whole(at)
            if whole is None:
                if begun is None:
                    if scan.may_end(at):
                        begun = at
                    else:
                        self.bad += _length(scan.buffer[at : at + _HEAD]) is not None
                at += 1
                continue
            frame = _frame(whole)
            if begun is not None:
                if frame is None or frame.name not in _TRUSTED_INSIDE:
                    at += 1
                    continue
                if frame.message_id is MessageId.INFO:
                    found.append(frame)
                    rest = scan.buffer[:at] + scan.buffer[at + len(whole) :]
                    scan = _Scan(rest, {})
                    at, begun = begun, None
                    continue
                self.bad += 1
                begun = None
            if frame is not None:
                found.append(frame)
            self.noise += at - taken
            taken = at = at + len(whole)
        kept = len(scan.buffer) if begun is None else begun
        self.noise += kept - taken
        self._buffer = scan.buffer
        self._checksums = scan.checksums
        self._search_at = 0 if begun is None else scan.changes_at(kept)
        self._drop(kept)
        return found

    def _drop(self, length: int) -> None:
        """Drop bytes from the front of the buffer."""
        self._buffer = self._buffer[length:]
        self._search_at = max(self._search_at - length, 0)
        self._checksums = {
            at - length: bcc for at, bcc in self._checksums.items() if at >= length
        }


_TRUSTED_INSIDE: Final = frozenset({"if", *CommandId})
"""Names that are accepted inside a possible other message."""


class _Scan:
    """One search through the kept bytes."""

    def __init__(self, buffer: bytes, checksums: dict[int, Bcc | None]) -> None:
        """``checksums`` are those that earlier searches have computed."""
        self.buffer = buffer
        self.checksums = checksums
        self._records = self._find_records()
        """Where good or incomplete info records begin, ascending."""
        self._partial = [
            len(buffer) - length
            for length in range(_HEAD - 1, 0, -1)
            if buffer.endswith(_INFO_HEAD[:length])
        ]
        """Where the head of an info record may begin at the end, ascending."""

    def whole(self, at: int) -> bytes | None:
        """Return the good message that begins here, if it is complete."""
        length = _length(self.buffer[at : at + _HEAD])
        if length is None or length > min(LONGEST_FRAME, len(self.buffer) - at):
            return None
        # With an info record inside, its checksum is right by chance only.
        if self._bcc(at, length) is None or self._record_inside(at, length, _SURE):
            return None
        return self.buffer[at : at + length]

    def may_end(self, at: int) -> bool:
        """Return whether a good message may begin here."""
        length = _length(self.buffer[at : at + _HEAD])
        received = len(self.buffer) - at
        if length is not None and received < length <= LONGEST_FRAME:
            return True
        if received > _LONGEST_KEPT:
            return False
        # It seems broken, but may be good except for an info record inside it.
        inside = _HEAD if length is None else min(length, LONGEST_FRAME)
        return self._record_inside(at, inside, 1)

    def changes_at(self, start: int) -> int:
        """Return the length of the buffer at which a next search may differ.

        ``start``: the bytes before it are dropped.
        """
        length = len(self.buffer)
        if self._partial and self._partial[-1] >= start:
            return length + 1
        nearest = start + _LONGEST_KEPT + 1
        at = start
        while (at := self.buffer.find(STX_BYTE, at)) >= 0:
            whole = _length(self.buffer[at : at + _HEAD])
            if whole is not None:
                # The message-id, then each letter of the name, may rule a head out.
                for end in (at + 4, at + 5, at + _HEAD, at + whole):
                    if length < end < nearest:
                        nearest = end
            at += 1
        return nearest

    def _bcc(self, at: int, length: int) -> Bcc | None:
        if at not in self.checksums:
            self.checksums[at] = _bcc(self.buffer[at : at + length])
        return self.checksums[at]

    def _find_records(self) -> list[int]:
        found: list[int] = []
        at = -1
        while (at := self.buffer.find(_INFO_HEAD, at + 1)) >= 0:
            incomplete = len(self.buffer) - at < _INFO_LENGTH
            if incomplete or self._bcc(at, _INFO_LENGTH) is not None:
                found.append(at)
        return found

    def _record_inside(self, at: int, length: int, least: int) -> bool:
        """Return whether a good info record begins inside a message.

        ``least``: the bytes of it that must have been received.
        """
        end = at + length
        first = bisect_right(self._records, at)
        if first < len(self._records) and self._records[first] < end:
            return True
        received = len(self.buffer)
        return any(
            at < inside < end and received - inside >= least for inside in self._partial
        )


def _length(head: bytes) -> int | None:
    """Return the length of a message with this head; ``None``: no message has it.

    For an incomplete head, the length of the head.
    """
    if len(head) < 4:
        return _HEAD
    message_id = head[3]
    if message_id in _NAMED:
        if head[1:3] < b"\0\2" or not _LETTERS.issuperset(head[4:]):
            return None
        if len(head) < _HEAD:
            return _HEAD
    elif message_id != MessageId.DEBUG and message_id < _APPLICATION:
        return None
    return int.from_bytes(head[1:3]) + _EXTRA


def _bcc(raw: bytes) -> Bcc | None:
    """Return the kind of checksum that is right for a message; ``None``: neither."""
    content = raw[1:-1]
    for bcc in Bcc:
        if checksum(content, bcc) == raw[-1]:
            return bcc
    return None


def _frame(raw: bytes) -> EwsFrame | None:
    """Return the frame of a good message; ``None``: one to skip."""
    bcc = _bcc(raw)
    if raw[3] not in _NAMED or bcc is None:
        return None
    return EwsFrame(
        raw=raw,
        message_id=MessageId(raw[3]),
        name=raw[4:_HEAD].decode("ascii"),
        data=raw[_HEAD:-1],
        bcc=bcc,
    )
