"""Frames of the EVBox Protocol Max v4: commands 68 and 69. Pure functions.

A frame is ``STX destination source command data SUM XOR ETX``; everything between STX
and ETX is upper-case ASCII hex. Both checksums are over those ASCII characters, not
over the bytes they stand for (PROTOCOLS.md section 1: this gives the F703 printed
under the command 69 request of the manual).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from operator import xor
import re
from string import hexdigits
from typing import Final, Literal, override

from ..errors import GarbledReplyError
from ..fields import Number, Scaled
from ..framing import Frame, Framer
from ..model import Phases
from ..safety import Setpoint
from ..structs import Struct, coded, phases, record

type CommandNumber = Literal[68, 69]

STX: Final = 0x02
ETX: Final = 0x03

CHARGEPOINT: Final = "80"
SMARTGRID: Final = "A0"
"""Our own address (manual, "Addresses")."""

ANY_SERIAL: Final = 0
"""Addresses every ChargePoint (manual, command 68)."""
LARGEST_SERIAL: Final = 99_999_999
INFORMATION_LENGTH: Final = 16
MAXIMUM_MODULES: Final = 20

_HEX: Final = frozenset(hexdigits.upper())
_HEADER: Final = 6
_CHECKSUMS: Final = 4


# -- Tables ------------------------------------------------------------------------
#
# Source: manual, "Command 68" and "Command 69", tables "Request" and "Response", with
# notes * (tenths of an ampere) and *** (cos phi / 1000). A byte is two characters.

_AMPERES: Final = Scaled(width=2, unit="A", divisor=10)


@record
class Order:
    """The set-point in a request."""

    currents: Phases[float] = coded(phases(_AMPERES))
    """A"""
    timeout: int = coded(Number(width=2, unit="s"))
    fail_safe: Phases[float] = coded(phases(_AMPERES))
    """After the time-out, A."""


@record
class Head:
    """The part of a reply before the modules."""

    minimum_interval: int = coded(Number(width=2, unit="s"))
    """Minimum allowed interval time, s."""
    maximum_current: float = coded(_AMPERES)
    """Maximum phase current of the connection, A."""
    modules: int = coded(Number(width=1))


@record
class ModuleReply:
    """The part of a reply for one ChargeBox module."""

    minimum_current: float = coded(_AMPERES)
    """Minimum required phase current, A."""
    currents: Phases[float] = coded(phases(_AMPERES))
    """Used phase currents, A."""
    cos_phi: Phases[float] = coded(phases(Scaled(width=2, divisor=1000, signed=True)))
    energy: int = coded(Number(width=4, unit="Wh"))
    """Meter total, Wh."""
    voltages: Phases[float] | None = coded(
        phases(Number(width=2, unit="V")), default=None
    )
    """V; command 68 only."""


ORDER: Final = Struct(Order, "Request")
HEAD: Final = Struct(Head, "Response")
_MODULE_68: Final = Struct(ModuleReply, "Response 68, module")
MODULE: Final[Mapping[int, Struct[ModuleReply]]] = {
    68: _MODULE_68,
    69: Struct(ModuleReply, "Response 69, module", _MODULE_68.fields[:-1]),
}
SERIAL_CHARACTERS: Final = 8
"""Eight decimal digits as they read: 1923054 is ``01923054`` (68 only)."""

_FRAME_EXTRA: Final = 1 + _HEADER + _CHECKSUMS + 1
LONGEST_REQUEST: Final[Mapping[int, int]] = {
    68: _FRAME_EXTRA + SERIAL_CHARACTERS + 2 * (INFORMATION_LENGTH + ORDER.length),
    69: _FRAME_EXTRA + 2 * ORDER.length,
}
LONGEST_FRAME: Final = (
    _FRAME_EXTRA
    + SERIAL_CHARACTERS
    + 2 * (HEAD.length + MAXIMUM_MODULES * _MODULE_68.length)
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
    """Return a request 68; ValueError for an invalid serial or information module."""
    if not 0 <= serial <= LARGEST_SERIAL:
        message = f"serial number {serial} does not fit 8 digits"
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
    order = Order(
        currents=setpoint.currents,
        timeout=setpoint.fail_safe_timeout,
        fail_safe=setpoint.fail_safe,
    )
    return ORDER.encode(order).hex().upper()


# -- Replies -----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """The reply of a ChargePoint to command 68 or 69."""

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
    """A frame with good checksums, from any device on the bus."""

    raw: bytes
    text: str
    """Addresses, command and data."""

    @property
    def is_reply(self) -> bool:
        """Return whether this is the reply of a ChargePoint to command 68 or 69."""
        return _is_reply(self.text)


def _is_reply(text: str) -> bool:
    return text.startswith(
        (f"{SMARTGRID}{CHARGEPOINT}68", f"{SMARTGRID}{CHARGEPOINT}69")
    )


def _start(command: int) -> int:
    """Return where the `Head` of a reply begins, in characters."""
    return _HEADER + (SERIAL_CHARACTERS if command == 68 else 0)


def _fits(text: str) -> bool:
    """Return whether a reply is hex, and as long as its module count states."""
    if not _HEX.issuperset(text):
        return False
    command = int(text[4:_HEADER])
    end = _start(command) + 2 * HEAD.length
    if len(text) < end:
        return False
    modules = int(text[end - 2 : end], 16)
    wanted = end + 2 * modules * MODULE[command].length
    return modules <= MAXIMUM_MODULES and len(text) == wanted


def decode_reply(received: EvboxFrame) -> Reply | None:
    """Return the contents of a reply 68 or 69; ``None``: not such a reply.

    Raises GarbledReplyError for a reply whose length does not fit its modules.
    """
    text = received.text
    if not _is_reply(text):
        return None
    if not _fits(text):
        message = f"a reply that does not fit its module count: {text[:24]}..."
        raise GarbledReplyError(message)
    command = int(text[4:_HEADER])
    module = MODULE[command]
    data = bytes.fromhex(text[_start(command) :])
    head = HEAD.decode(data[: HEAD.length])
    return Reply(
        command=command,
        serial=text[_HEADER : _start(command)] or None,
        minimum_interval=head.minimum_interval,
        maximum_current=head.maximum_current,
        modules=tuple(
            module.decode(data[at : at + module.length])
            for at in range(HEAD.length, len(data), module.length)
        ),
    )


# -- Finding frames ----------------------------------------------------------------


_MARK: Final = re.compile(bytes((ord("["), STX, ETX, ord("]"))))


class EvboxFramer(Framer[EvboxFrame]):
    """Finds frames; real boxes may begin a new one (STX) before the ETX of the last."""

    def __init__(self) -> None:
        """Start with an empty buffer."""
        super().__init__()
        self._buffer = bytearray()

    @property
    @override
    def pending(self) -> int:
        """Return the number of bytes of an unfinished frame."""
        return len(self._buffer)

    @override
    def reset(self) -> None:
        """Drop an unfinished frame; its bytes count as noise."""
        self.noise += len(self._buffer)
        self._buffer.clear()

    @override
    def feed(self, data: bytes) -> list[EvboxFrame]:
        """Return the whole frames that end within these bytes."""
        found: list[EvboxFrame] = []
        at = 0
        for mark in _MARK.finditer(data):
            self._go_on(data[at : mark.start()])
            at = mark.end()
            if mark[0][0] == STX:
                # An unfinished frame before a new one is lost.
                self.reset()
                self._buffer.append(STX)
            else:
                self._go_on(mark[0])
                self._end(found)
        self._go_on(data[at:])
        return found

    def _go_on(self, data: bytes) -> None:
        """Go on with the frame that has begun, if there is one."""
        if not self._buffer:
            self.noise += len(data)
            return
        self._buffer += data
        if len(self._buffer) > LONGEST_FRAME:
            self.bad += 1
            self.reset()

    def _end(self, found: list[EvboxFrame]) -> None:
        if not self._buffer:
            return
        raw = bytes(self._buffer)
        self._buffer.clear()
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
    # Commands of other devices may contain other characters (a "digit K").
    if not _HEX.issuperset(text[:_HEADER]) or (_is_reply(text) and not _fits(text)):
        return None
    return text
