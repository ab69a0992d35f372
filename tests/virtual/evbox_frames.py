"""EVBox Protocol Max v4 on the wire: the ChargePoint's view.

Frame: STX, upper-case ASCII hex, ETX (manual, "Message format"). The checksums SUM and
XOR are over the ASCII characters, as the manual's command 69 example shows (F703).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .faults import opposite_flips
from .log import CLIENT

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from random import Random

    from .log import Entry
    from .wire import Segment

# Timers of a computer and of a box differ: less silence by this much (s) is accepted.
SILENCE_TOLERANCE = 0.001
STX = 0x02
ETX = 0x03
CHARGEPOINT = "80"
SMARTGRID = "A0"
HEX = frozenset(b"0123456789ABCDEF")
CHECKSUM_CHARS = 4
HEADER_CHARS = 6
LONGEST = 1100
SERIAL_CHARS = 8
INFORMATION_CHARS = 32
LIMITS_CHARS = 7 * 4
BODY_CHARS = {"68": SERIAL_CHARS + INFORMATION_CHARS + LIMITS_CHARS, "69": LIMITS_CHARS}


def checksums(text: str) -> str:
    """Return SUM and XOR over the characters, as four hex digits."""
    total, xor = 0, 0
    for char in text.encode("ascii"):
        total += char
        xor ^= char
    return f"{total & 0xFF:02X}{xor:02X}"


def frame(text: str) -> bytes:
    """Return a whole frame around the text."""
    return bytes((STX,)) + (text + checksums(text)).encode("ascii") + bytes((ETX,))


def twin_errors(reply: bytes, rng: Random) -> bytes:
    """Flip two bits behind the header of a frame; SUM and XOR still fit."""
    begin, end = 1 + HEADER_CHARS, -1 - CHECKSUM_CHARS
    return reply[:begin] + opposite_flips(reply[begin:end], rng, HEX) + reply[end:]


@dataclass(frozen=True, slots=True)
class ReceivedFrame:
    """A text between STX and ETX, with the silence before its STX, and its sender."""

    text: str
    silence: float
    start: float
    end: float
    source: str


@dataclass(frozen=True, slots=True)
class Order:
    """A request 68 or 69, decoded; currents in A, times in s.

    `t` is the real time of its end on the wire. `serial` is None in command 69.
    """

    t: float
    command: int
    serial: str | None
    information: bytes
    limits: tuple[float, float, float]
    timeout: int
    fallback: tuple[float, float, float]


class FrameFinder:
    """Finds frames in received bytes; a new STX drops the bytes before it."""

    def __init__(self) -> None:
        """Start with an empty buffer."""
        self._chars = bytearray()
        self._inside = False
        self._silence = 0.0
        self._start = 0.0
        self.restarts = 0

    def feed(self, segment: Segment) -> list[ReceivedFrame]:
        """Return the frames that this segment completes."""
        data = segment.data
        result: list[ReceivedFrame] = []
        if not self._inside and STX not in data:
            return result
        for index, byte in enumerate(data):
            if byte == STX:
                self.restarts += self._inside
                self._inside = True
                self._chars.clear()
                self._silence = segment.silence_before if index == 0 else 0.0
                self._start = segment.start + index * segment.byte_time
            elif not self._inside:
                continue
            elif byte == ETX:
                self._inside = False
                if HEX.issuperset(self._chars):
                    end = segment.start + (index + 1) * segment.byte_time
                    result.append(
                        ReceivedFrame(
                            self._chars.decode("ascii"),
                            self._silence,
                            self._start,
                            end,
                            segment.sources[0],
                        )
                    )
            else:
                self._chars.append(byte)
                if len(self._chars) > LONGEST:
                    self._inside = False
        return result


def checked(text: str) -> str | None:
    """Return the text without its checksums, or None if they are wrong."""
    body, sums = text[:-CHECKSUM_CHARS], text[-CHECKSUM_CHARS:]
    if len(body) < HEADER_CHARS or checksums(body) != sums:
        return None
    return body


def order(body: str, t: float) -> Order | None:
    """Decode a checked request of the SmartGrid module; None for another text."""
    command = body[4:6]
    data = body[HEADER_CHARS:]
    if body[:2] != CHARGEPOINT or body[2:4] != SMARTGRID:
        return None
    if len(data) != BODY_CHARS.get(command, -1):
        return None
    serial, information = None, b""
    if command == "68":
        serial = data[:SERIAL_CHARS]
        information = bytes.fromhex(
            data[SERIAL_CHARS : SERIAL_CHARS + INFORMATION_CHARS]
        )
    numbers = data[-LIMITS_CHARS:]
    words = [int(numbers[i : i + 4], 16) for i in range(0, LIMITS_CHARS, 4)]
    return Order(
        t,
        int(command),
        serial,
        information,
        _amps(words[:3]),
        words[3],
        _amps(words[4:]),
    )


def orders_in(entries: Iterable[Entry]) -> list[Order]:
    """Return all well-formed requests in logged traffic, for any address.

    Use it as the oracle for a log: `orders_in(bus.log.bursts())`.
    """
    result: list[Order] = []
    for entry in entries:
        for part in entry.data.split(bytes((STX,)))[1:]:
            text, found, _ = part.partition(bytes((ETX,)))
            if not found or not HEX.issuperset(text):
                continue
            body = checked(text.decode("ascii"))
            decoded = order(body, entry.end) if body is not None else None
            if decoded is not None:
                result.append(decoded)
    return result


def requests_without_silence(
    entries: Iterable[Entry], silence: float = 0.1
) -> list[Entry]:
    """Return the client's frames that began without the required silence before.

    "The module needs to verify the bus is available for at least 100 ms" (Topology).
    """
    result: list[Entry] = []
    last_end = float("-inf")
    for entry in sorted(entries, key=lambda e: e.t):
        for index, byte in enumerate(entry.data if entry.source == CLIENT else b""):
            gap = entry.t - last_end if index == 0 else 0.0
            if byte == STX and gap < silence - SILENCE_TOLERANCE:
                result.append(entry)
        last_end = max(last_end, entry.end)
    return result


def word(value: float) -> str:
    """Return a number as four hex digits, two's complement."""
    return f"{round(value) & 0xFFFF:04X}"


def _amps(words: Sequence[int]) -> tuple[float, float, float]:
    return (words[0] / 10, words[1] / 10, words[2] / 10)
