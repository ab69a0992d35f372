"""Messages of MCS binary, the protocol of the EWS-Box. Pure functions.

A message is ``STX length message-id parameters BCC``; the length, 16 bits big-endian,
is that of the parameters alone. The parameters of a command, of its answer and of an
info record begin with its name, two letters (manual, 3.2.2, 3.2.3).
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from enum import Enum, IntEnum, StrEnum
from functools import reduce
from heapq import heapify, heappop, heappush
from itertools import accumulate
from operator import xor
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
    return reduce(xor, content, 0)


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
    is_whole = _length(raw[:_HEAD]) == len(raw) <= LONGEST_FRAME
    if not is_whole or raw[3] not in _NAMED or _INFO_HEAD[:_SURE] in raw[1:]:
        return bytes(len(raw))
    if _bcc(reduce(xor, raw[1:]), raw[3]) is None:
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
_MOST_RECORDS: Final = 3
_NAMES: Final = frozenset(command.encode() for command in CommandId)
_TRUSTED_INSIDE: Final = (MessageId.ANSWER, MessageId.COMMAND)
"""Messages that are believed inside an incomplete one, if a command has their name."""


class EwsFramer(Framer[EwsFrame]):
    """Finds messages by their head, length and checksum.

    An incomplete message is kept, but not at the cost of others: an info record inside
    it is taken out, and an answer or a command inside it shows that it will never be
    completed. Debug messages and those of applications are skipped whole.

    Memory and time per byte are bounded, whatever comes. A message is given up when it
    is longer than any; each possible one is looked at when its head is complete, when
    its last byte has arrived, and when no other before it is left. Any part's checksum
    follows from two of those that run on through all bytes.
    """

    unsolicited: ClassVar = True

    # Places count from the first byte ever, without the info records taken out.

    def __init__(self) -> None:
        """Start empty."""
        super().__init__()
        self._buffer = bytearray()
        self._sums = bytearray(1)
        """XOR of all bytes before each one of the buffer, and of all."""
        self._dropped = 0
        """Place of the first byte of the buffer."""
        self._records: list[int] = []
        """Where info records begin, ascending: incomplete, or with one inside."""
        self._noted = 0
        """Places before this one are noted in `_ends`, if a trusted message begins."""
        self._ends: list[tuple[int, int]] = []
        """Heap of possible trusted messages: where they end and begin."""
        self._inside: list[int] = []
        """Heap of the good ones among them: where they begin."""

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
            self._receive(data[at : at + LONGEST_FRAME], found)
            self._decide(found)
        return found

    # -- Info records ----------------------------------------------------------------

    def _receive(self, data: bytes, found: list[EwsFrame]) -> None:
        """Append bytes, and take info records out."""
        at = 0
        while at < len(data):
            if not self._records:
                stx = data.find(STX_BYTE, at)
                end = len(data) if stx < 0 else stx
                self._append(data[at:end])
                at = end
            self._append(data[at : at + 1])
            at += 1
            self._follow_records(found)

    def _append(self, data: bytes) -> None:
        self._buffer += data
        self._sums += bytes(accumulate(data, xor, initial=self._sums.pop()))

    def _follow_records(self, found: list[EwsFrame]) -> None:
        """Look what the last byte makes of info records that have begun."""
        records, end = self._records, self._end
        length = end - records[-1] if records else 0
        if 0 < length <= _HEAD and self._buffer[-1] != _INFO_HEAD[length - 1]:
            records.pop()
        if self._buffer[-1] == STX:
            records.append(end - 1)
            # More than a few, each inside the one before it, are none.
            del records[:-_MOST_RECORDS]
        ended = end - _INFO_LENGTH
        if ended in records and self._bcc(ended, _INFO_LENGTH) is None:
            records.remove(ended)
        while records:
            # The last one may be the end of a record before it.
            last = records[-1]
            if self._end - last < _SURE and len(records) > 1:
                last = records[-2]
            if self._end - last < _INFO_LENGTH:
                return
            self._take_out(last, found)

    def _take_out(self, record: int, found: list[EwsFrame]) -> None:
        """Take a good info record out: what surrounds it is joined."""
        at = record - self._dropped
        frame = self._frame(record, _INFO_LENGTH)
        behind = bytes(self._buffer[at + _INFO_LENGTH :])
        del self._buffer[at:]
        del self._sums[at + 1 :]
        # One that had begun may go on behind it.
        begins = max(record - _INFO_LENGTH + 1, self._dropped)
        del self._records[bisect_left(self._records, begins) :]
        begin = self._find(begins)
        while begin is not None:
            if _INFO_HEAD.startswith(self._head(begin)):
                self._records.append(begin)
            begin = self._find(begin + 1)
        if self._noted > begins:
            self._noted = begins
            self._ends = [one for one in self._ends if one[1] < begins]
            heapify(self._ends)
        self._decide(found)
        if frame is not None:
            found.append(frame)
        self._receive(behind, found)

    def _record_inside(self, begin: int, end: int, least: int) -> bool:
        """Return whether an info record begins inside a message.

        ``least``: the bytes of it that must have been received.
        """
        place = bisect_right(self._records, begin)
        return place < len(self._records) and (
            self._records[place] < end and self._end - self._records[place] >= least
        )

    # -- Messages --------------------------------------------------------------------

    def _decide(self, found: list[EwsFrame]) -> None:
        """Take the complete messages out, and drop what belongs to none."""
        taken = at = self._dropped
        while (begin := self._find(at)) is not None:
            at = begin
            good = self._is_good(at)
            if good is False:
                self.bad += self._length(at) is not None
                at += 1
                continue
            if good is None:
                inside = self._find_inside(at)
                if inside is None:
                    break
                self.bad += 1
                at = inside
            self.noise += at - taken
            length = self._length(at) or 0
            if (frame := self._frame(at, length)) is not None:
                found.append(frame)
            taken = at = at + length
        else:
            at = self._end
        self.noise += at - taken
        self._drop(at - self._dropped)

    def _is_good(self, at: int) -> bool | None:
        """Return whether a good message begins here; ``None``: it may, later."""
        length = self._length(at)
        received = self._end - at
        if length is not None and length <= LONGEST_FRAME:
            if received < length:
                return None
            # With an info record inside, its checksum is right by chance only.
            if not self._record_inside(at, at + length, _SURE) and self._bcc(
                at, length
            ):
                return True
        # It seems broken, but may be good except for an info record inside it.
        end = at + (_HEAD if length is None else min(length, LONGEST_FRAME))
        waits = received <= _LONGEST_KEPT and self._record_inside(at, end, 1)
        return None if waits else False

    def _find_inside(self, outer: int) -> int | None:
        """Return where the first good and trusted message inside another begins."""
        self._note(outer)
        # The others have an info record inside, or seem to.
        limit = self._records[0] if self._records else self._end
        while self._ends and self._ends[0][0] <= limit:
            end, at = heappop(self._ends)
            if at > outer and self._bcc(at, end - at):
                heappush(self._inside, at)
        while self._inside and self._inside[0] <= outer:
            heappop(self._inside)
        if self._inside:
            return self._inside[0]
        begin = self._find(max(self._noted, outer + 1))
        while begin is not None:
            if self._is_trusted(begin) and self._is_good(begin):
                return begin
            begin = self._find(begin + 1)
        return None

    def _note(self, outer: int) -> None:
        """Note the ends of messages, up to the first info record that has begun."""
        limit = (self._records[0] if self._records else self._end) - _HEAD
        begin: int | None = self._find(max(self._noted, outer + 1))
        while begin is not None and begin <= limit:
            if self._is_trusted(begin):
                heappush(self._ends, (begin + (self._length(begin) or 0), begin))
            begin = self._find(begin + 1)
        self._noted = max(self._noted, limit + 1)

    # -- The bytes kept --------------------------------------------------------------

    @property
    def _end(self) -> int:
        return self._dropped + len(self._buffer)

    def _find(self, at: int) -> int | None:
        """Return the first place, from this one on, where a message may begin."""
        found = self._buffer.find(STX, at - self._dropped)
        return None if found < 0 else found + self._dropped

    def _head(self, at: int) -> bytes:
        at -= self._dropped
        return bytes(self._buffer[at : at + _HEAD])

    def _length(self, at: int) -> int | None:
        return _length(self._head(at))

    def _is_trusted(self, at: int) -> bool:
        """Return whether the head is one that is believed inside another message."""
        head = self._head(at)
        if head[4:] not in _NAMES or head[3] not in _TRUSTED_INSIDE:
            return False
        length = _length(head)
        return length is not None and length <= LONGEST_FRAME

    def _bcc(self, at: int, length: int) -> Bcc | None:
        """Return the kind of checksum that is right for a message; ``None``: none."""
        at -= self._dropped
        return _bcc(self._sums[at + 1] ^ self._sums[at + length], self._buffer[at + 3])

    def _frame(self, at: int, length: int) -> EwsFrame | None:
        """Return the frame of a good message; ``None``: one to skip."""
        bcc = self._bcc(at, length)
        at -= self._dropped
        raw = bytes(self._buffer[at : at + length])
        if raw[3] not in _NAMED or bcc is None:
            return None
        return EwsFrame(
            raw=raw,
            message_id=MessageId(raw[3]),
            name=raw[4:_HEAD].decode("ascii"),
            data=raw[_HEAD:-1],
            bcc=bcc,
        )

    def _drop(self, length: int) -> None:
        """Drop bytes from the front of the buffer."""
        del self._buffer[:length]
        del self._sums[:length]
        self._dropped += length
        del self._records[: bisect_left(self._records, self._dropped)]
        if not self._buffer:
            self._ends.clear()
            self._inside.clear()


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


def _bcc(total: int, message_id: int) -> Bcc | None:
    """Return which checksum is right; ``None``: neither.

    ``total``: XOR of everything behind the STX, the checksum included.
    """
    if total == 0:
        return Bcc.ALL
    return Bcc.WITHOUT_MESSAGE_ID if total == message_id else None
