"""ABL EVCC2/3 on the wire: the box's view of its Modbus ASCII dialect.

Requests begin with `:`, replies with `>` (manual, 1.3); LRC; CR LF. The first byte of a
read answer is the register number (manual, 1.4.1).
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import TYPE_CHECKING

from .faults import opposite_flips

if TYPE_CHECKING:
    from collections.abc import Iterable
    from random import Random

    from .log import Entry
    from .wire import Segment

READ = 0x03
WRITE = 0x10
FAILURE = 0x90
WRITE_FAILED = 0x04
BROADCAST = 0
NO_CURRENT = 0x3E8
LOWEST_DUTY = 0x50
# Codes below are taken as this one, and a 5 % pilot begins at 50 (abl_field.md, "What
# 0x14 takes", firmware 4.1; the manual refuses below 0x50).
SIX_AMPS = 100
LOWEST_PILOT = 50
# Modbus ASCII: a pause of more than a second inside a frame ends it.
LONGEST_PAUSE = 1.0
LONGEST = 600


def lrc(data: bytes) -> int:
    """Return the two's complement of the sum."""
    return -sum(data) & 0xFF


def line(start: str, data: bytes) -> bytes:
    """Return a whole frame."""
    body = data + bytes((lrc(data),))
    return (start + body.hex().upper() + "\r\n").encode("ascii")


def duty_of(amps: float) -> int:
    """Return the duty cycle in 0.1 %, rounded down as in the manual (16 A = 0x10A).

    Annex 3.2. A current between 51 A and 52.5 A has no code: 51 A then.
    """
    if amps <= 0:
        return NO_CURRENT
    if amps < 52.5:
        # Without the 1e-9, 6 A / 0.06 would be 99.
        return min(850, math.floor(amps / 0.06 + 1e-9))
    return min(960, math.floor((amps / 2.5 + 64) * 10 + 1e-9))


def amps_of(duty: int) -> float:
    """Return the current that a duty cycle in 0.1 % allows (annex 3.2)."""
    if duty < LOWEST_DUTY or duty > 970:
        return 0.0
    if duty <= 100:
        return 6.0
    if duty <= 850:
        return duty * 0.06
    return min(80.0, (duty / 10 - 64) * 2.5)


def twin_errors(reply: bytes, rng: Random) -> bytes:
    """Flip two bits in the contents of a line; its LRC still fits."""
    # Stray bytes may come first.
    stray, begin, text = reply.rpartition(b">")
    data = bytes.fromhex(text.decode("ascii"))
    damaged = data[:3] + opposite_flips(data[3:-1], rng) + data[-1:]
    return stray + begin + damaged.hex().upper().encode("ascii") + b"\r\n"


@dataclass(frozen=True, slots=True)
class Request:
    """A request with a correct LRC. `t` is the real time of its end on the wire."""

    t: float
    device_id: int
    function: int
    data: bytes

    @property
    def register(self) -> int:
        """Return the first register (or -1 if the request is too short)."""
        return int.from_bytes(self.data[:2], "big") if len(self.data) > 1 else -1

    @property
    def quantity(self) -> int:
        """Return the number of registers (or -1)."""
        return int.from_bytes(self.data[2:4], "big") if len(self.data) > 3 else -1

    @property
    def value(self) -> int | None:
        """Return the value of a well-formed write of one register."""
        if self.function != WRITE or len(self.data) != 7:
            return None
        if self.quantity != 1 or self.data[4] != 2:
            return None
        return int.from_bytes(self.data[5:7], "big")


class LineFinder:
    """Finds request lines in received bytes."""

    def __init__(self) -> None:
        """Start with an empty buffer."""
        self._line: bytearray | None = None
        self.bad = 0

    def feed(self, segment: Segment) -> list[Request]:
        """Return the requests that this segment completes."""
        data = segment.data
        if self._line is not None and segment.silence_before > LONGEST_PAUSE:
            self._line = None
        if self._line is None and b":" not in data:
            return []
        result: list[Request] = []
        for index, byte in enumerate(data):
            if byte == ord(":"):
                self.bad += self._line is not None
                self._line = bytearray()
            elif self._line is None:
                continue
            elif byte == ord("\n"):
                end = segment.start + (index + 1) * segment.byte_time
                request = parse(bytes(self._line), end)
                self._line = None
                if request is None:
                    self.bad += 1
                else:
                    result.append(request)
            else:
                self._line.append(byte)
                if len(self._line) > LONGEST:
                    self._line = None
        return result


def parse(text: bytes, t: float) -> Request | None:
    """Return the request between `:` and LF, or None if it is malformed."""
    if not text.endswith(b"\r") or not _HEX.issuperset(text[:-1]):
        return None
    if len(text) % 2 == 0 or len(text) < 7:
        return None
    data = bytes.fromhex(text[:-1].decode("ascii"))
    if lrc(data[:-1]) != data[-1]:
        return None
    return Request(t, data[0], data[1], data[2:-1])


def requests_in(entries: Iterable[Entry]) -> list[Request]:
    """Return all well-formed requests in logged traffic, for any address.

    Use it as the oracle for a log: `requests_in(bus.log.bursts())`.
    """
    result: list[Request] = []
    for entry in entries:
        for part in entry.data.split(b":")[1:]:
            text, found, _ = part.partition(b"\n")
            request = parse(text, entry.end) if found else None
            if request is not None:
                result.append(request)
    return result


_HEX = frozenset(b"0123456789ABCDEF")
