"""Frames of the Sextant S6: ``$`` address letter payload ``*`` checksum CR, in ASCII.

A request has an upper-case letter, its reply the same in lower case; ``e`` refuses. The
checksum is the sum of all characters between ``$`` and ``*``, modulo 256, in two
hexadecimal digits.
"""

from dataclasses import dataclass
import re
from typing import Final, override

from custom_components.evse_bus.evse.errors import ImplausibleReplyError
from custom_components.evse_bus.evse.framing import Frame, Framer
from custom_components.evse_bus.evse.safety import Setpoint

IDENTITY: Final = "I"
STATUS: Final = "R"
LIMIT: Final = "L"
LAMP: Final = "B"
REFUSED: Final = "e"

_FRAME: Final = re.compile(rb"\$(([1-9])([A-Za-z])([^*\r]*))\*([0-9A-F]{2})\r")
_LONGEST: Final = 64
"""bytes"""
_STEP: Final = 10
"""Currents are sent in 0.1 A."""


class SextantFrame(Frame):
    """One frame with the right checksum."""

    __slots__ = ("address", "letter", "payload", "raw")

    def __init__(self, raw: bytes, address: int, letter: str, payload: str) -> None:
        self.raw = raw
        self.address = address
        self.letter = letter
        self.payload = payload


class SextantFramer(Framer[SextantFrame]):
    def __init__(self) -> None:
        super().__init__()
        self._buffer = b""

    @override
    def feed(self, data: bytes) -> list[SextantFrame]:
        self._buffer += data
        frames = []
        while (end := self._buffer.find(b"\r")) >= 0:
            line, self._buffer = self._buffer[: end + 1], self._buffer[end + 1 :]
            found = _FRAME.search(line)
            if found is None or found.end() != len(line):
                self.noise += len(line)
            elif int(found[5], 16) != sum(found[1]) % 256:
                self.bad += 1
            else:
                self.noise += found.start()
                frames.append(
                    SextantFrame(
                        found[0],
                        int(found[2]),
                        found[3].decode(),
                        found[4].decode("latin-1"),
                    )
                )
        if len(self._buffer) > _LONGEST:
            self.reset()
        return frames

    @override
    def reset(self) -> None:
        self.noise += len(self._buffer)
        self._buffer = b""

    @property
    @override
    def pending(self) -> int:
        return len(self._buffer)


def encode(address: int, letter: str, payload: str = "") -> bytes:
    """Return a request."""
    body = f"{address}{letter}{payload}".encode()
    return b"$%b*%02X\r" % (body, sum(body) % 256)


def encode_limit(address: int, setpoint: Setpoint) -> bytes:
    """Return the request that sets the limit; a pause is a limit of 0 A."""
    return encode(address, LIMIT, f"{round(setpoint.current * _STEP)}")


@dataclass(frozen=True, slots=True)
class Identity:
    """Payload of ``i``."""

    serial: str
    firmware: str
    maximum_current: float
    """A"""
    owner: str


@dataclass(frozen=True, slots=True)
class Status:
    """Payload of ``r``."""

    state: str
    """IEC 61851: A, B or C."""
    current: float
    """Of each phase, A."""
    energy: int
    """Meter total, Wh."""
    limit: float
    """A"""
    lamp: int
    """Brightness of the lamp, %."""


def decode_identity(payload: str) -> Identity:
    """Return the payload of ``i``; raises ImplausibleReplyError."""
    try:
        serial, firmware, maximum, owner = payload.split(",")
        return Identity(serial, firmware, int(maximum) / _STEP, owner)
    except ValueError as error:
        raise ImplausibleReplyError(payload) from error


def decode_status(payload: str) -> Status:
    """Return the payload of ``r``; raises ImplausibleReplyError."""
    try:
        state, current, energy, limit, lamp = payload.split(",")
        return Status(
            state,
            int(current) / _STEP,
            int(energy),
            int(limit) / _STEP,
            int(lamp),
        )
    except ValueError as error:
        raise ImplausibleReplyError(payload) from error
