"""Frames of the EVBox Protocol Max v4: commands 68 and 69. Pure functions.

A frame is ``STX destination source command data SUM XOR ETX``; everything
between STX and ETX is upper-case ASCII hex. Both checksums are over those ASCII
characters, not over the bytes they stand for (PROTOCOLS.md section 1: only so
the manual's command 69 request gives its printed F703).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import xor
from string import hexdigits
from typing import Final, Literal, override

from ..errors import GarbledReplyError
from ..framing import Frame, Framer
from ..model import Phases
from ..safety import Setpoint

type CommandNumber = Literal[68, 69]

STX: Final = 0x02
ETX: Final = 0x03

CHARGEPOINT: Final = "80"
SMARTGRID: Final = "A0"
"""Our own address (manual, "Addresses")."""

ANY_SERIAL: Final = 0
"""Every ChargePoint listens to this serial number (manual, command 68)."""
LARGEST_SERIAL: Final = 99_999_999
INFORMATION_LENGTH: Final = 16
MAXIMUM_MODULES: Final = 20

_HEX: Final = frozenset(hexdigits.upper())
_HEADER: Final = 6
_CHECKSUMS: Final = 4


@dataclass(frozen=True, slots=True)
class Field:
    """One number in a message."""

    name: str
    width: int
    """Bytes; each is two characters on the wire."""
    unit: str
    divisor: int = 1
    """The number on the wire is the value times this."""
    signed: bool = False

    @property
    def characters(self) -> int:
        """Return its length on the wire."""
        return 2 * self.width

    def encode(self, value: float) -> str:
        """Return the characters; ValueError for what does not fit."""
        # Currents come from the clamp and are on the step: nothing is rounded up.
        raw = round(value * self.divisor)
        try:
            return raw.to_bytes(self.width, signed=self.signed).hex().upper()
        except OverflowError as error:
            message = f"{self.name} {value} {self.unit} does not fit"
            raise ValueError(message) from error

    def decode(self, text: str) -> float:
        """Return the value of these characters."""
        raw = int.from_bytes(bytes.fromhex(text), signed=self.signed)
        return raw / self.divisor if self.divisor > 1 else raw


def _phases(name: str, unit: str, divisor: int = 1, *, signed: bool = False) -> _Fields:
    return tuple(
        Field(f"{name} {phase}", 2, unit, divisor, signed)
        for phase in ("L1", "L2", "L3")
    )


type _Fields = tuple[Field, ...]

# The source of all that follows: manual, "Command 68" and "Command 69", tables
# "Request" and "Response"; notes * (tenths of an ampere) and *** (cos phi / 1000).
ORDER: Final[_Fields] = (
    *_phases("maximum", "A", 10),
    Field("time-out", 2, "s"),
    *_phases("maximum after time-out", "A", 10),
)
SERIAL_CHARACTERS: Final = 8
"""Eight decimal digits as they read: 1923054 is ``01923054`` (68 only)."""
HEAD: Final[_Fields] = (
    Field("minimum interval", 2, "s"),
    Field("maximum of connection", 2, "A", 10),
    Field("modules", 1, ""),
)
MODULE_69: Final[_Fields] = (
    Field("minimum required", 2, "A", 10),
    *_phases("used", "A", 10),
    *_phases("cos phi", "", 1000, signed=True),
    Field("meter", 4, "Wh"),
)
MODULE_68: Final[_Fields] = (*MODULE_69, *_phases("voltage", "V"))
MODULE: Final[Mapping[int, _Fields]] = {68: MODULE_68, 69: MODULE_69}


def _length(fields: _Fields) -> int:
    return sum(field.characters for field in fields)


_FRAME_EXTRA: Final = 1 + _HEADER + _CHECKSUMS + 1
LONGEST_REQUEST: Final[Mapping[int, int]] = {
    68: _FRAME_EXTRA + SERIAL_CHARACTERS + 2 * INFORMATION_LENGTH + _length(ORDER),
    69: _FRAME_EXTRA + _length(ORDER),
}
LONGEST_FRAME: Final = (
    _FRAME_EXTRA
    + SERIAL_CHARACTERS
    + _length(HEAD)
    + MAXIMUM_MODULES * _length(MODULE_68)
)
"""A reply 68 of 20 modules: 990 bytes."""


def checksums(text: str) -> str:
    """Return SUM and XOR over the characters, each as two hex digits."""
    data = text.encode("ascii")
    return f"{sum(data) & 0xFF:02X}{reduce(xor, data, 0):02X}"


def frame(text: str) -> bytes:
    """Return a whole frame around a text (addresses, command and data)."""
    return bytes((STX, *(text + checksums(text)).encode("ascii"), ETX))


# -- Requests ----------------------------------------------------------------------


def encode_68(
    setpoint: Setpoint, *, serial: int = ANY_SERIAL, information: bytes
) -> bytes:
    """Return a request 68; ValueError for a serial or information that cannot be."""
    if not 0 <= serial <= LARGEST_SERIAL:
        message = f"serial number {serial} has no 8 digits"
        raise ValueError(message)
    if len(information) != INFORMATION_LENGTH:
        message = f"information module of {len(information)} bytes, not 16"
        raise ValueError(message)
    return frame(
        f"{CHARGEPOINT}{SMARTGRID}68{serial:08d}"
        f"{information.hex().upper()}{_order(setpoint)}"
    )


def encode_69(setpoint: Setpoint) -> bytes:
    """Return a request 69: to every ChargePoint on the bus."""
    return frame(f"{CHARGEPOINT}{SMARTGRID}69{_order(setpoint)}")


def _order(setpoint: Setpoint) -> str:
    if setpoint.fail_safe_timeout < 1:
        raise ValueError("a time-out of 0 is not allowed")
    values = (*setpoint.currents, setpoint.fail_safe_timeout, *setpoint.fail_safe)
    return "".join(
        field.encode(value) for field, value in zip(ORDER, values, strict=True)
    )


# -- Replies -----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class ModuleReply:
    """What a reply says of one ChargeBox module."""

    minimum_current: float
    """Minimum required phase current, A."""
    currents: Phases[float]
    """Used phase currents, A."""
    cos_phi: Phases[float]
    energy: int
    """Meter total, Wh."""
    voltages: Phases[float] | None = None
    """V; command 68 only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """The answer of a ChargePoint to command 68 or 69."""

    command: int
    serial: str | None = None
    """Eight digits as they came; command 68 only."""
    minimum_interval: int
    """Minimum allowed interval time, s."""
    maximum_current: float
    """Maximum phase current of the connection, A."""
    modules: tuple[ModuleReply, ...] = ()


@dataclass(frozen=True, slots=True)
class EvboxFrame(Frame):
    """A frame with good checksums, from anybody to anybody."""

    raw: bytes
    text: str
    """Addresses, command and data."""

    @property
    def is_reply(self) -> bool:
        """Return whether a ChargePoint answers a SmartGrid module with 68 or 69."""
        return _is_reply(self.text)


def _is_reply(text: str) -> bool:
    return text.startswith(
        (f"{SMARTGRID}{CHARGEPOINT}68", f"{SMARTGRID}{CHARGEPOINT}69")
    )


def _fits(text: str) -> bool:
    """Return whether a reply is hex, and as long as its module count says."""
    if not _HEX.issuperset(text):
        return False
    command = int(text[4:_HEADER])
    start = _HEADER + (SERIAL_CHARACTERS if command == 68 else 0)
    end = start + _length(HEAD)
    if len(text) < end:
        return False
    modules = int(text[end - HEAD[-1].characters : end], 16)
    wanted = end + modules * _length(MODULE[command])
    return modules <= MAXIMUM_MODULES and len(text) == wanted


def decode_reply(received: EvboxFrame) -> Reply | None:
    """Return what a reply 68 or 69 says; ``None``: a frame of somebody else.

    Raises GarbledReplyError for a reply whose length does not fit its modules.
    """
    text = received.text
    if not _is_reply(text):
        return None
    if not _fits(text):
        message = f"a reply that does not fit its module count: {text[:24]}..."
        raise GarbledReplyError(message)
    command = int(text[4:_HEADER])
    at = _HEADER
    serial = None
    if command == 68:
        serial = text[at : at + SERIAL_CHARACTERS]
        at += SERIAL_CHARACTERS
    (interval, maximum, count), at = _read(text, at, HEAD)
    modules = []
    for _ in range(int(count)):
        values, at = _read(text, at, MODULE[command])
        modules.append(_module(values))
    return Reply(
        command=command,
        serial=serial,
        minimum_interval=int(interval),
        maximum_current=maximum,
        modules=tuple(modules),
    )


def _read(text: str, at: int, fields: _Fields) -> tuple[list[float], int]:
    values = []
    for field in fields:
        values.append(field.decode(text[at : at + field.characters]))
        at += field.characters
    return values, at


def _module(values: Sequence[float]) -> ModuleReply:
    return ModuleReply(
        minimum_current=values[0],
        currents=(values[1], values[2], values[3]),
        cos_phi=(values[4], values[5], values[6]),
        energy=int(values[7]),
        voltages=(values[8], values[9], values[10]) if len(values) > 8 else None,
    )


# -- Finding frames ----------------------------------------------------------------


class EvboxFramer(Framer[EvboxFrame]):
    """Finds frames; a new STX before an ETX starts afresh (real boxes do that)."""

    def __init__(self) -> None:
        """Start with nothing heard."""
        super().__init__()
        self._buffer = bytearray()

    @property
    @override
    def pending(self) -> int:
        """Return the number of bytes of a frame begun and not ended."""
        return len(self._buffer)

    @override
    def reset(self) -> None:
        """Forget a frame begun; its bytes count as noise."""
        self._drop(len(self._buffer))

    @override
    def feed(self, data: bytes) -> list[EvboxFrame]:
        """Return the whole frames that end within these bytes."""
        buffer = self._buffer
        buffer += data
        found: list[EvboxFrame] = []
        while (start := buffer.find(STX)) >= 0:
            self._drop(start)
            end = buffer.find(ETX)
            # A half frame before a new one: its bytes are lost.
            restart = buffer.find(STX, 1, end if end >= 0 else len(buffer))
            if restart > 0:
                self._overlong(restart)
                self._drop(restart)
            elif end >= 0:
                self._overlong(end + 1)
                self._end(end + 1, found)
            else:
                if self._overlong(len(buffer)):
                    self._drop(len(buffer))
                return found
        self._drop(len(buffer))
        return found

    def _drop(self, count: int) -> None:
        self.noise += count
        del self._buffer[:count]

    def _overlong(self, length: int) -> bool:
        if length <= LONGEST_FRAME:
            return False
        self.bad += 1
        return True

    def _end(self, length: int, found: list[EvboxFrame]) -> None:
        if length > LONGEST_FRAME:
            self._drop(length)
            return
        raw = bytes(self._buffer[:length])
        del self._buffer[:length]
        text = _checked(raw[1:-1])
        if text is None:
            self.bad += 1
        else:
            found.append(EvboxFrame(raw, text))


def _checked(content: bytes) -> str | None:
    """Return the text without its checksums; ``None``: damaged."""
    if len(content) < _HEADER + _CHECKSUMS or not content.isascii():
        return None
    text = content[:-_CHECKSUMS].decode("ascii")
    if checksums(text) != content[-_CHECKSUMS:].decode("ascii"):
        return None
    # The data of other people's commands may hold other characters (a "digit K").
    if not _HEX.issuperset(text[:_HEADER]) or (_is_reply(text) and not _fits(text)):
        return None
    return text
