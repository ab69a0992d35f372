"""MCS binary frames (manual, 3.2.2).

STX (0x02), parameter length (16 bit, big-endian), message id, parameters, BCC.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from .log import Entry
    from .wire import Segment

STX = 0x02
COMMAND, ANSWER, INFO, DEBUG = b"C", b"A", b"I", b"D"
APPLICATION = 0x80
LONGEST_PARAMETERS = 1040
OVERHEAD = 5
RS232_TIMEOUT = 0.1
TCP_TIMEOUT = 2.0

Bcc = Literal["all", "without_msgid"]


def bcc_of(length: bytes, msgid: bytes, parameters: bytes, bcc: Bcc) -> int:
    """Return the XOR over "Laenge + Nutzdaten", with the id or without: unclear."""
    counted = (
        length + parameters
        if bcc == "without_msgid"
        else b"".join((length, msgid, parameters))
    )
    result = 0
    for byte in counted:
        result ^= byte
    return result


def frame(msgid: bytes, parameters: bytes, bcc: Bcc = "all") -> bytes:
    """Make a frame."""
    length = len(parameters).to_bytes(2, "big")
    check = bcc_of(length, msgid, parameters, bcc)
    return b"".join((bytes((STX,)), length, msgid, parameters, bytes((check,))))


def command(name: str, parameters: bytes = b"", bcc: Bcc = "all") -> bytes:
    """Make a command frame."""
    return frame(COMMAND, name.encode("ascii") + parameters, bcc)


@dataclass(frozen=True, slots=True)
class Message:
    """A frame received: real time of its last byte, id, parameters."""

    t: float
    msgid: bytes
    parameters: bytes

    @property
    def name(self) -> str:
        """Return the command id of a command or an answer."""
        return self.parameters[:2].decode("latin-1")

    @property
    def data(self) -> bytes:
        """Return the bytes after the command id."""
        return self.parameters[2:]


@dataclass(slots=True)
class FrameCounters:
    """Counters of errors in the bytes received."""

    bad_bcc: int = 0
    timeouts: int = 0
    too_long: int = 0
    skipped_bytes: int = 0


class FrameReader:
    """Finds messages in bytes; drops a frame with too long a pause in it."""

    def __init__(self, timeout: float = RS232_TIMEOUT, bcc: Bcc = "all") -> None:
        """Wait for an STX."""
        self.timeout = timeout
        self.bcc: Bcc = bcc
        self.counters = FrameCounters()
        self._partial = bytearray()
        self._last_end = float("-inf")

    @property
    def partial(self) -> bytes:
        """Return the bytes of an unfinished frame."""
        return bytes(self._partial)

    def reset(self) -> None:
        """Drop an unfinished frame."""
        self._partial.clear()

    def feed(self, segment: Segment) -> list[Message]:
        """Take bytes received in a row; return the messages complete now."""
        if self._partial and segment.start - self._last_end > self.timeout:
            self.counters.timeouts += 1
            self._partial.clear()
        self._last_end = segment.end
        messages = []
        for index, byte in enumerate(segment.data):
            at = segment.start + (index + 1) * segment.byte_time
            message = self._take(byte, at)
            if message is not None:
                messages.append(message)
        return messages

    def _take(self, byte: int, at: float) -> Message | None:
        partial = self._partial
        if not partial and byte != STX:
            # "Aufwecken mit allen Zeichen != STX": between frames they have no meaning.
            self.counters.skipped_bytes += 1
            return None
        partial.append(byte)
        if len(partial) < OVERHEAD - 2:
            return None
        length = int.from_bytes(partial[1:3], "big")
        if length > LONGEST_PARAMETERS:
            self.counters.too_long += 1
            partial.clear()
            return None
        if len(partial) < length + OVERHEAD:
            return None
        whole = bytes(partial)
        partial.clear()
        msgid, parameters = whole[3:4], whole[4:-1]
        if bcc_of(whole[1:3], msgid, parameters, self.bcc) != whole[-1]:
            self.counters.bad_bcc += 1
            return None
        return Message(at, msgid, parameters)


def messages_in(entries: list[Entry], bcc: Bcc = "all") -> list[Message]:
    """Return the messages in logged transmissions of one source, in their order.

    Malformed frames are left out.
    """
    messages = []
    partial = b""
    for entry in entries:
        partial += entry.data
        while partial:
            start = partial.find(STX)
            if start < 0:
                partial = b""
                break
            partial = partial[start:]
            if len(partial) < OVERHEAD:
                break
            length = int.from_bytes(partial[1:3], "big")
            size = length + OVERHEAD
            if length > LONGEST_PARAMETERS:
                partial = partial[1:]
                continue
            if len(partial) < size:
                break
            msgid, parameters = partial[3:4], partial[4 : size - 1]
            if bcc_of(partial[1:3], msgid, parameters, bcc) != partial[size - 1]:
                partial = partial[1:]
                continue
            messages.append(Message(entry.end, msgid, parameters))
            partial = partial[size:]
    return messages


def ews_commands_in(entries: list[Entry], bcc: Bcc = "all") -> list[Message]:
    """Return the commands among the client's logged transmissions."""
    return [m for m in messages_in(entries, bcc) if m.msgid == COMMAND]
