"""Registers of ABL EVCC2/3: encode and decode, pure functions.

Source: manual "EVCC2/3, API subset for external applications" (05 0015 20 Rev. B),
chapter 2; PROTOCOLS.md, 2. A block is read whole; its first byte repeats the number
of its first register. Bits are numbered as in the manual, over the whole block, the
last register's bit 0 being 0.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from ..errors import ExchangeRefusedError, RefusedOrderError
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
from ..safety import Setpoint
from .duty import PAUSE, duty_for

ADDRESSES: Final = range(1, 17)
"""Valid device-IDs (1.2). 0 is the broadcast, to which nothing is ever sent."""
LONGEST_REPLY: Final = 43
"""Bytes of the answer to a read of eight registers (1.4.1)."""
LONGEST_REQUEST: Final = 23
"""Bytes of the request that writes one register (1.4.2)."""


@dataclass(frozen=True, slots=True)
class Block:
    """Registers that are read together."""

    register: int
    words: int
    optional: bool = False
    """Not in the manual; seen on real boxes. Others stay silent."""


@dataclass(frozen=True, slots=True)
class Bits:
    """A field of a block, from its highest to its lowest bit."""

    high: int
    low: int

    def of(self, block: int) -> int:
        """Return the field's value."""
        return block >> self.low & (1 << self.high - self.low + 1) - 1


def _flag(bit: int) -> Bits:
    return Bits(bit, bit)


# -- 0x0001 (R2): device-ID, firmware, configuration -------------------------------

INFO: Final = Block(0x0001, 2)
_HARDWARE: Final = Bits(23, 22)  # which circuit board
_DEVICE_ID: Final = Bits(21, 16)  # 1 to 16
_MAJOR: Final = Bits(15, 12)
_MINOR: Final = Bits(11, 8)
_CODING_RESISTOR: Final = _flag(7)
_UPSTREAM_TIMEOUT: Final = _flag(6)
_METER: Final = _flag(5)
_RDC_MD: Final = _flag(4)
_SOCKET: Final = _flag(3)
_WELDING_DETECTION: Final = _flag(2)
_ENABLE_INPUT: Final = Bits(1, 0)

_BOARDS: Final = ("pcba 141215", "pcba 160307", "pcba 170725", None)
_ENABLE_INPUTS: Final = ("none", "closed_for_b2", "closed_for_enabled", "invalid")


@dataclass(frozen=True, slots=True, kw_only=True)
class Info:
    """What a box is and how it is configured."""

    hardware: str | None
    """Circuit board."""
    device_id: int
    firmware: str
    coding_resistor: bool
    """The socket reads the rated current of the cable."""
    upstream_timeout: bool
    """Its own fail-safe: F4 or F14 when polling stops."""
    meter: bool
    """It measures phase currents."""
    rdc_md: bool
    """It detects DC residual current."""
    socket: bool
    """A socket, no attached cable."""
    welding_detection: bool
    enable_input: str
    """What the enable input does: none, closed_for_b2, closed_for_enabled."""


def decode_info(data: bytes) -> Info:
    """Decode block `INFO`."""
    block = int.from_bytes(data)
    return Info(
        hardware=_BOARDS[_HARDWARE.of(block)],
        device_id=_DEVICE_ID.of(block),
        firmware=f"{_MAJOR.of(block)}.{_MINOR.of(block)}",
        coding_resistor=bool(_CODING_RESISTOR.of(block)),
        upstream_timeout=bool(_UPSTREAM_TIMEOUT.of(block)),
        meter=bool(_METER.of(block)),
        rdc_md=bool(_RDC_MD.of(block)),
        socket=bool(_SOCKET.of(block)),
        welding_detection=bool(_WELDING_DETECTION.of(block)),
        enable_input=_ENABLE_INPUTS[_ENABLE_INPUT.of(block)],
    )


# -- 0x0006 (R2): system flags -----------------------------------------------------

FLAGS: Final = Block(0x0006, 2)
_POINTER: Final = Bits(23, 16)
_TRIGGERS_F4: Final = _flag(15)
_NEEDS_ENABLE: Final = _flag(14)
_CHINA: Final = Bits(13, 12)
_UPSTREAM_LOST: Final = _flag(9)  # BC6
_IMBALANCE: Final = _flag(8)  # BC3
_HOT: Final = _flag(7)  # BC5
_METER_FAILED: Final = _flag(6)  # BC4
_E0_A1_DISABLED: Final = _flag(5)
_B1_B2_DISABLED: Final = _flag(4)
_A1_B1_DISABLED: Final = _flag(3)
_OVERCURRENT: Final = Bits(2, 0)

_OVERCURRENTS: Final = {0b000: 0, 0b001: 100, 0b101: 105, 0b011: 110, 0b111: 120}


@dataclass(frozen=True, slots=True, kw_only=True)
class Flags:
    """System flags."""

    pointer: int
    """Pointer of the state machine."""
    triggers_f4: bool
    """The upstream time-out ends in F4, not F14."""
    needs_enable: bool
    """A plugged car must be enabled anew after a power cycle."""
    china: bool
    """Limits for China."""
    upstream_lost: bool
    """BC6"""
    imbalance: bool
    """BC3"""
    hot: bool
    """BC5: between 60 and 80 degrees Celsius on the board."""
    meter_failed: bool
    """BC4"""
    e0_a1_disabled: bool
    b1_b2_disabled: bool
    a1_b1_disabled: bool
    overcurrent: int | None
    """The car takes more than this share of Ic, % (0: not more than Ic)."""


def decode_flags(data: bytes) -> Flags:
    """Decode block `FLAGS`."""
    block = int.from_bytes(data)
    return Flags(
        pointer=_POINTER.of(block),
        triggers_f4=bool(_TRIGGERS_F4.of(block)),
        needs_enable=bool(_NEEDS_ENABLE.of(block)),
        china=_CHINA.of(block) == 0b10,
        upstream_lost=bool(_UPSTREAM_LOST.of(block)),
        imbalance=bool(_IMBALANCE.of(block)),
        hot=bool(_HOT.of(block)),
        meter_failed=bool(_METER_FAILED.of(block)),
        e0_a1_disabled=bool(_E0_A1_DISABLED.of(block)),
        b1_b2_disabled=bool(_B1_B2_DISABLED.of(block)),
        a1_b1_disabled=bool(_A1_B1_DISABLED.of(block)),
        overcurrent=_OVERCURRENTS.get(_OVERCURRENT.of(block)),
    )


# -- 0x000F (R5), field: Icmax in the lower 12 bits of the fourth word -------------

ICMAX: Final = Block(0x000F, 5, optional=True)
_ICMAX_DUTY: Final = Bits(27, 16)  # 0.1 %


def decode_icmax(data: bytes) -> int:
    """Decode block `ICMAX`: the duty cycle Icmax, 0.1 %."""
    return _ICMAX_DUTY.of(int.from_bytes(data))


# -- 0x002E (R5): state, inputs, Ic, phase currents --------------------------------

READING: Final = Block(0x002E, 5)
_STATE: Final = Bits(71, 64)
_PLUGGED: Final = _flag(63)
_REDUCED: Final = _flag(62)
_EN2: Final = _flag(61)
_EN1: Final = _flag(60)
_IC: Final = Bits(59, 48)  # 0.1 %
_PHASES: Final = (Bits(47, 32), Bits(31, 16), Bits(15, 0))  # 0.1 A

HIGHEST_CURRENT: Final = 0x0320
"""80 A. Above: no current (0x03E8 says so, other values say nothing at all)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """State, inputs, duty cycle Ic and phase currents."""

    state: int
    """State byte, see `states`."""
    plugged: bool
    """The pilot is at 10 V or below; means nothing in Ex and Fx."""
    reduced: bool
    """Ic is reduced because of BC3 to BC6."""
    en1: bool
    """Input EN1 is closed."""
    en2: bool
    """Input EN2 is closed."""
    duty: int
    """Ic, 0.1 %."""
    currents: Phases[float | None]
    """Ict1 to Ict3, A; ``None``: the meter tells none."""


def decode_reading(data: bytes) -> Reading:
    """Decode block `READING`."""
    block = int.from_bytes(data)
    one, two, three = (_current(field.of(block)) for field in _PHASES)
    return Reading(
        state=_STATE.of(block),
        plugged=bool(_PLUGGED.of(block)),
        reduced=bool(_REDUCED.of(block)),
        en1=bool(_EN1.of(block)),
        en2=bool(_EN2.of(block)),
        duty=_IC.of(block),
        currents=(one, two, three),
    )


def _current(raw: int) -> float | None:
    return raw / 10 if raw <= HIGHEST_CURRENT else None


# -- 0x0050 (R8): serial number (1.4.1) --------------------------------------------

SERIAL: Final = Block(0x0050, 8)


def decode_serial(data: bytes) -> str | None:
    """Decode block `SERIAL`: 14 signs after its number and a zero byte.

    ``None`` when it holds no readable serial number.
    """
    text = data[2:].rstrip(b"\x00\xff ").decode("latin-1")
    return text if text and text.isascii() and text.isprintable() else None


# -- Reading and writing -----------------------------------------------------------


def read_request(address: int, block: Block) -> bytes:
    """Return the frame that reads a block; raises RefusedOrderError for a broadcast."""
    return ascii_frame(_checked(address), read_registers(block.register, block.words))


def read_answer(address: int, block: Block) -> Callable[[ModbusFrame], bytes | None]:
    """Return what knows the answer to `read_request` and gives its bytes."""

    def accept(frame: ModbusFrame) -> bytes | None:
        if not frame.is_reply or frame.unit != address:
            return None
        _raise_if_refused(frame, READ_HOLDING_REGISTERS)
        data = registers_read(frame, block.words)
        # The register's number in front catches the answer to another request.
        return data if data is not None and data[0] == block.register else None

    return accept


class StateCode(IntEnum):
    """What register 0x0005 takes."""

    RESET = 0x5A5A
    A1 = 0xA1A1
    E0 = 0xE0E0
    E2 = 0xE2E2


STATE_REGISTER: Final = 0x0005
LIMIT_REGISTER: Final = 0x0014
CONFIGURATION_REGISTER: Final = 0x002C

_ON: Final = 0b10
_OFF: Final = 0b01
_NO_CHANGE: Final = 0b11


def limit_duty(setpoint: Setpoint) -> int:
    """Return the duty cycle Icmax for a set-point, 0.1 %."""
    return PAUSE if setpoint.paused else duty_for(setpoint.current)


def write_limit(address: int, setpoint: Setpoint) -> bytes:
    """Return the frame that sets Icmax (0x0014)."""
    return _write(address, LIMIT_REGISTER, limit_duty(setpoint))


def write_state(address: int, code: StateCode) -> bytes:
    """Return the frame that makes the outlet change its state (0x0005)."""
    return _write(address, STATE_REGISTER, code)


def write_configuration(
    address: int,
    device_id: int,
    *,
    upstream_timeout: bool | None = None,
    needs_enable: bool | None = None,
) -> bytes:
    """Return the frame that sets device-ID and settings (0x002C, in state E2).

    Bits 15..14 are the upstream time-out, 13..12 whether a plugged car needs to be
    enabled after a power cycle; ``None``: no change.
    """
    value = (
        _setting(upstream_timeout) << 14
        | _setting(needs_enable) << 12
        | _checked(device_id)
    )
    return _write(address, CONFIGURATION_REGISTER, value)


def write_answer(address: int, register: int) -> Callable[[ModbusFrame], bool | None]:
    """Return what knows the confirmation of a write.

    It raises ExchangeRefusedError when the box refuses (function 0x90, 1.4.3).
    """

    def accept(frame: ModbusFrame) -> bool | None:
        if not frame.is_reply or frame.unit != address:
            return None
        _raise_if_refused(frame, WRITE_MULTIPLE_REGISTERS)
        return True if is_written(frame, register, 1) else None

    return accept


def _setting(value: bool | None) -> int:  # noqa: FBT001
    return _NO_CHANGE if value is None else _ON if value else _OFF


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
