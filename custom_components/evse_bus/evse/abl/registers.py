"""Registers of ABL EVCC2/3: decoding, requests and replies. Pure functions.

Source: manual "EVCC2/3, API subset for external applications" (05 0015 20 Rev. B),
chapter 2, by the number of the first register; PROTOCOLS.md, 2. The first byte of a
block repeats that number. Bits are numbered as in the manual: over the whole block,
0 being the lowest bit of the last register.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, override

from ..errors import ExchangeRefusedError, RefusedOrderError
from ..fields import Choice, Field, Number, Scaled, known
from ..modbus import (
    READ_HOLDING_REGISTERS,
    WRITE_MULTIPLE_REGISTERS,
    ModbusFrame,
    ascii_frame,
    exception_code,
    is_written,
    read_registers,
    registers_read,
    write_registers,
)
from ..model import Phases
from ..registers import Block, Registers
from ..safety import Setpoint
from ..structs import bit, bits, phases, record
from .duty import PAUSE, duty_for

ADDRESSES: Final = range(1, 17)
"""Valid device-IDs (1.2). 0 is the broadcast, which is never used."""
LONGEST_REPLY: Final = 43
"""Bytes of the reply to a read of eight registers (1.4.1)."""
LONGEST_REQUEST: Final = 23
"""Bytes of the request that writes one register (1.4.2)."""

_BOARDS: Final = dict(enumerate(("pcba 141215", "pcba 160307", "pcba 170725", None)))
_VERSIONS: Final = {raw: f"{raw >> 4}.{raw & 0xF}" for raw in range(0x100)}
_ENABLE_INPUTS: Final = dict(
    enumerate(("none", "closed_for_b2", "closed_for_enabled", "invalid"))
)
_CHINA: Final = {0b00: False, 0b01: False, 0b10: True, 0b11: False}
_OVERCURRENTS: Final = {0b000: 0, 0b001: 100, 0b101: 105, 0b011: 110, 0b111: 120}
_SETTINGS: Final = {0b11: None, 0b10: True, 0b01: False}

HIGHEST_CURRENT: Final = 0x0320
"""80 A in 0.1 A. Above: no current (0x03E8 by the manual, others are undefined)."""
_CURRENT: Final = known(
    Scaled(width=2, unit="A", divisor=10), range(HIGHEST_CURRENT + 1)
)


# -- Blocks that are read ----------------------------------------------------------


@record
class Info:
    """Identity, firmware and configuration."""

    hardware: str | None = bits(23, 22, Choice(values=_BOARDS))
    """Circuit board."""
    device_id: int = bits(21, 16, Number())
    """1 to 16."""
    firmware: str = bits(15, 8, Choice(values=_VERSIONS))
    """Major and minor revision, such as ``1.2``."""
    coding_resistor: bool = bit(7)
    """The socket reads the rated current of the cable."""
    upstream_timeout: bool = bit(6)
    """The fail-safe of the box: F4 or F14 when polling stops."""
    meter: bool = bit(5)
    """It measures phase currents."""
    rdc_md: bool = bit(4)
    """It detects DC residual current."""
    socket: bool = bit(3)
    """A socket, no attached cable."""
    welding_detection: bool = bit(2)
    enable_input: str = bits(1, 0, Choice(values=_ENABLE_INPUTS))
    """Function of the enable input: none, closed_for_b2, closed_for_enabled."""


INFO: Final = Registers(Info, "0x0001", Block(0x0001, 2))


@record
class Flags:
    """System flags."""

    pointer: int = bits(23, 16, Number())
    """Pointer of the state machine."""
    triggers_f4: bool = bit(15)
    """The upstream time-out ends in F4, not F14."""
    needs_enable: bool = bit(14)
    """A plugged car must be enabled anew after a power cycle."""
    china: bool = bits(13, 12, Choice(values=_CHINA))
    """Limits for China."""
    upstream_lost: bool = bit(9)
    """BC6"""
    imbalance: bool = bit(8)
    """BC3"""
    hot: bool = bit(7)
    """BC5: between 60 and 80 degrees Celsius on the board."""
    meter_failed: bool = bit(6)
    """BC4"""
    e0_a1_disabled: bool = bit(5)
    b1_b2_disabled: bool = bit(4)
    a1_b1_disabled: bool = bit(3)
    overcurrent: int | None = bits(
        2, 0, known(Choice(values=_OVERCURRENTS, unit="%"), _OVERCURRENTS)
    )
    """The car draws more than this share of Ic, % (0: not more than Ic)."""


FLAGS: Final = Registers(Flags, "0x0006", Block(0x0006, 2))


@record
class Icmax:
    """Icmax as written, and the box's own limits; the bits above each are unknown."""

    rated: int = bits(59, 48, Number(unit="0.1 %"))
    """Rated current of the box."""
    default: int = bits(43, 32, Number(unit="0.1 %"))
    """Idefault: the highest Icmax that is followed."""
    duty: int = bits(27, 16, Number(unit="0.1 %"))
    """Icmax, 0.1 %; a pause shows here and nowhere else."""
    # Word 4 is what is offered; once seen as 0 on a box that offered 14 A: not used.


ICMAX: Final = Registers(Icmax, "PROTOCOLS.md, 2: 0x000F", Block(0x000F, 5))
"""Not in the manual; most boxes in the field answer (docs/abl.md)."""


@record
class Reading:
    """State, inputs, duty cycle Ic and phase currents."""

    state: int = bits(71, 64, Number())
    """State byte, see `states`."""
    plugged: bool = bit(63)
    """The pilot is at 10 V or below; undefined in Ex and Fx."""
    reduced: bool = bit(62)
    """Ic is reduced because of BC3 to BC6."""
    en2: bool = bit(61)
    """Input EN2 is closed."""
    en1: bool = bit(60)
    """Input EN1 is closed."""
    duty: int = bits(59, 48, Number(unit="0.1 %"))
    """Ic, 0.1 %."""
    currents: Phases[float | None] = bits(47, 0, phases(_CURRENT))
    """Ict1 to Ict3, A; ``None``: no measurement."""


READING: Final = Registers(Reading, "0x002E", Block(0x002E, 5))


@dataclass(frozen=True, slots=True, kw_only=True)
class _SerialNumber(Field[str | None]):
    """An ASCII text with zeros, spaces or erased bytes behind it."""

    @override
    def decode(self, data: bytes) -> str | None:
        text = data.rstrip(b"\x00\xff ").decode("latin-1")
        return text if text and text.isascii() and text.isprintable() else None

    @override
    def encode(self, value: object) -> bytes:
        raise self.refused("cannot be written")


@record
class Serial:
    """Serial number (1.4.1)."""

    number: str | None = bits(111, 0, _SerialNumber(width=14))
    """Up to 14 characters; ``None``: not readable."""


SERIAL: Final = Registers(Serial, "1.4.1: 0x0050", Block(0x0050, 8))


# -- Requests and replies ----------------------------------------------------------


def read_request(address: int, block: Block) -> bytes:
    """Return the frame that reads a block; raises RefusedOrderError for a broadcast."""
    return ascii_frame(_checked(address), read_registers(block.register, block.words))


def read_answer(address: int, block: Block) -> Callable[[ModbusFrame], bytes | None]:
    """Return a matcher for the reply to `read_request` that returns the block's bytes.

    It raises ExchangeRefusedError for an exception.
    """

    def accept(frame: ModbusFrame) -> bytes | None:
        if not frame.is_reply or frame.unit != address:
            return None
        _raise_if_refused(frame, READ_HOLDING_REGISTERS)
        data = registers_read(frame, block.words)
        # The register's number in front catches the reply to another request.
        return data if data is not None and data[0] == block.register else None

    return accept


class StateCode(IntEnum):
    """Values of register 0x0005."""

    RESET = 0x5A5A
    A1 = 0xA1A1
    E0 = 0xE0E0
    E2 = 0xE2E2


STATE_REGISTER: Final = 0x0005
LIMIT_REGISTER: Final = 0x0014
CONFIGURATION_REGISTER: Final = 0x002C


@record
class Configuration:
    """Device-ID and settings; ``None``: no change."""

    upstream_timeout: bool | None = bits(15, 14, Choice(values=_SETTINGS))
    """The upstream time-out and F4 are enabled."""
    needs_enable: bool | None = bits(13, 12, Choice(values=_SETTINGS))
    """A plugged car stops in B1 after a power cycle and must be enabled."""
    device_id: int = bits(7, 0, Number(valid=ADDRESSES))


CONFIGURATION: Final = Registers(
    Configuration, "0x002C", Block(CONFIGURATION_REGISTER, 1)
)
"""Only written."""


def limit_duty(setpoint: Setpoint) -> int:
    """Return the duty cycle Icmax for a set-point, 0.1 %."""
    return PAUSE if setpoint.paused else duty_for(setpoint.current)


def write_limit(address: int, setpoint: Setpoint) -> bytes:
    """Return the frame that sets Icmax (0x0014)."""
    return _write(address, LIMIT_REGISTER, limit_duty(setpoint))


def write_state(address: int, code: StateCode) -> bytes:
    """Return the frame that changes the state of the outlet (0x0005)."""
    return _write(address, STATE_REGISTER, code)


def write_configuration(
    address: int,
    device_id: int,
    *,
    upstream_timeout: bool | None = None,
    needs_enable: bool | None = None,
) -> bytes:
    """Return the frame that writes a `Configuration` (in state E2).

    Raises RefusedOrderError for an invalid device-ID.
    """
    configuration = Configuration(
        upstream_timeout=upstream_timeout,
        needs_enable=needs_enable,
        device_id=device_id,
    )
    value = int.from_bytes(CONFIGURATION.encode(configuration))
    return _write(address, CONFIGURATION_REGISTER, value)


def write_answer(address: int, register: int) -> Callable[[ModbusFrame], bool | None]:
    """Return a matcher for the confirmation of a write.

    It raises ExchangeRefusedError when the box refuses (function 0x90, 1.4.3).
    """

    def accept(frame: ModbusFrame) -> bool | None:
        if not frame.is_reply or frame.unit != address:
            return None
        _raise_if_refused(frame, WRITE_MULTIPLE_REGISTERS)
        return True if is_written(frame, register, 1) else None

    return accept


def _write(address: int, register: int, value: int) -> bytes:
    return ascii_frame(_checked(address), write_registers(register, (value,)))


def _checked(address: int) -> int:
    if address not in ADDRESSES:
        message = f"{address} is no device-ID of one box (1 to 16)"
        raise RefusedOrderError(message)
    return address


_REASONS: Final = {0x04: "writing registers failed"}


def _raise_if_refused(frame: ModbusFrame, function: int) -> None:
    if (code := exception_code(frame, function)) is not None:
        reason = _REASONS.get(code, "no reason known")
        message = f"the box refused: exception {code} ({reason})"
        raise ExchangeRefusedError(message, code)
