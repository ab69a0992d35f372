"""Reading and writing the registers of a SmartEVSE v2, in any of its dialects.

Pure functions; the tables are in `dialects`, load balancing is in `balancing`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from ..errors import ExchangeRefusedError, ImplausibleReplyError, RefusedOrderError
from ..modbus import (
    EXCEPTION,
    READ_HOLDING_REGISTERS,
    WRITE_MULTIPLE_REGISTERS,
    ModbusFrame,
    is_written,
    malformed_exception_code,
    read_input_registers,
    read_registers,
    registers_read,
    rtu_frame,
    write_registers,
)
from ..model import Fault, Mode, Setting
from ..safety import Setpoint
from .dialects import FAULTS, MAPS, MODES, Block, Dialect, Map

LONGEST_REQUEST: Final = 17
"""Bytes: the broadcast of four currents."""
LONGEST_REPLY: Final = 64

UNITS: Final = range(9)
"""Addresses: 0 (2.17 without load balancing), 1 master, 2 to 8 slaves."""

ILLEGAL_ADDRESS: Final = 2
"""Exception: there is no such register."""
ILLEGAL_VALUE: Final = 3
"""Exception: out of range; 2.17 also says so for an override that it takes."""


_ERRORS: Final = 0xFF
_MAXIMA: Final = 160
_MINIMA: Final = range(6, 17)
_KELVIN: Final = 273
_TEMPERATURES: Final = range(-60, 151)
_ZERO_OR_ONE: Final = (0, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """What a status block told."""

    raw_state: str
    """``A`` to ``D``, ``E`` to ``H`` waiting for a master, ``T``, ``B1``, ``C1``."""
    error: int
    """Bits, see `FAULTS`."""
    current: float
    """In force while a car charges, A; ``A6`` / ``0002``."""
    access: bool
    mode: Mode | None = None
    maximum: int | None = None
    """Of cable or box, A; ``None``: no cable was measured yet."""
    minimum: int | None = None
    temperature: int | None = None
    """Degrees Celsius."""
    serial: str | None = None

    @property
    def faults(self) -> frozenset[Fault]:
        """Return the error bits by name."""
        return frozenset(fault for bit, fault in FAULTS.items() if self.error & bit)


# -- Reading -----------------------------------------------------------------------


def words_of(data: bytes) -> tuple[int, ...]:
    """Return registers as numbers."""
    return tuple(
        int.from_bytes(data[index : index + 2], "big")
        for index in range(0, len(data) - 1, 2)
    )


def dialect_of_a0(data: bytes) -> Dialect | None:
    """Return which dialect answered `PROBE_A0`; ``None``: neither of the two.

    A letter is 2.17; a number may be 2.20, which `PROBE_A9` must confirm.
    """
    for dialect in (Dialect.V2_17, Dialect.V2_20):
        try:
            decode_status(dialect, data)
        except ImplausibleReplyError:
            continue
        return dialect
    return None


def decode_status(dialect: Dialect, data: bytes) -> Status:
    """Return what a status block of this dialect tells.

    Raises ImplausibleReplyError for what no SmartEVSE of this dialect says.
    """
    layout = MAPS[dialect]
    words = words_of(data)
    if len(data) != 2 * layout.status.count:
        message = f"{len(data)} bytes are no status block"
        raise ImplausibleReplyError(message)
    minimum = None if layout.minimum is None else words[layout.minimum]
    maximum = words[layout.maximum]
    possible = (
        words[0] in layout.states
        and words[layout.error] <= _ERRORS
        and words[layout.access] in _ZERO_OR_ONE
        and words[layout.mode] < len(MODES)
        and maximum <= _MAXIMA
        and (minimum is None or minimum in _MINIMA)
    )
    if not possible:
        message = f"not the status of a SmartEVSE ({dialect}): {data.hex()}"
        raise ImplausibleReplyError(message)
    serial = 0 if layout.serial is None else words[layout.serial]
    return Status(
        raw_state=layout.states[words[0]],
        error=words[layout.error],
        current=words[layout.current] / 10,
        access=words[layout.access] == 1,
        mode=MODES[words[layout.mode]],
        maximum=maximum or None,
        minimum=minimum,
        temperature=_temperature(layout, words),
        serial=str(serial) if serial else None,
    )


def _temperature(layout: Map, words: tuple[int, ...]) -> int | None:
    """Return the temperature; ``None`` where its sensor cannot be right."""
    if layout.temperature is None:
        return None
    celsius = words[layout.temperature] - _KELVIN
    return celsius if celsius in _TEMPERATURES else None


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """What a box keeps in its own memory, as far as we know its meaning."""

    settings: Mapping[Setting, int]
    load_balancing: int
    """0 disabled, 1 master, else slave."""


def decode_configuration(
    dialect: Dialect, blocks: Mapping[Block, bytes]
) -> Configuration:
    """Return what all blocks of a dialect's configuration tell.

    Raises ImplausibleReplyError when one value cannot be: then none is believed.
    """
    layout = MAPS[dialect]
    words = {
        block.register + index: word
        for block, data in blocks.items()
        for index, word in enumerate(words_of(data))
    }
    settings: dict[Setting, int] = {}
    try:
        for setting, kept in layout.settings.items():
            word = words[kept.register]
            if not kept.minimum <= word <= kept.maximum:
                message = f"{setting} cannot be {word} (register {kept.register:#06x})"
                raise ImplausibleReplyError(message)
            settings[setting] = kept.value(word)
        load_balancing = words[layout.load_balancing]
        socket = words[layout.socket]
    except KeyError as error:
        message = f"register {error} was not told"
        raise ImplausibleReplyError(message) from error
    if socket not in _ZERO_OR_ONE:
        # In 2.17 a status that comes late is as long, and looks like settings else.
        message = f"a box has a socket or a fixed cable, not {socket}"
        raise ImplausibleReplyError(message)
    if load_balancing not in UNITS:
        message = f"load balancing cannot be {load_balancing}"
        raise ImplausibleReplyError(message)
    return Configuration(settings=settings, load_balancing=load_balancing)


def read_request(unit: int, block: Block) -> bytes:
    """Return the frame that reads a block."""
    read = (
        read_registers
        if block.function == READ_HOLDING_REGISTERS
        else read_input_registers
    )
    return rtu_frame(checked_unit(unit), read(block.register, block.count))


def read_answer(unit: int, block: Block) -> Callable[[ModbusFrame], bytes | None]:
    """Return what knows the answer to a read: the registers' bytes.

    It raises ExchangeRefusedError for an exception, well or malformed.
    """

    def accept(frame: ModbusFrame) -> bytes | None:
        if frame.unit != unit:
            return None
        if (code := refusal_code(frame, block.function)) is not None:
            message = f"the box refused to read {block.register:#06x}: exception {code}"
            raise ExchangeRefusedError(message, code)
        return registers_read(frame, block.count, block.function)

    return accept


def refusal_code(frame: ModbusFrame, function: int) -> int | None:
    """Return the code of an exception, with the 0x80 in its function or without."""
    if frame.function == function | EXCEPTION and len(frame.data) == 1:
        return frame.data[0]
    return malformed_exception_code(frame, function)


# -- Writing -----------------------------------------------------------------------


def write_current(unit: int, dialect: Dialect, setpoint: Setpoint) -> bytes:
    """Return the frame that sets the charging current.

    Raises RefusedOrderError for a pause: 0 would give back the box's own maximum.
    """
    if setpoint.paused or setpoint.current <= 0:
        message = "a current of 0 A does not pause a SmartEVSE"
        raise RefusedOrderError(message)
    return _write(unit, MAPS[dialect].current_register, tenths(setpoint))


def write_access(unit: int, dialect: Dialect, allowed: bool) -> bytes:  # noqa: FBT001
    """Return the frame that sets the access bit."""
    return _write(unit, MAPS[dialect].access_register, int(allowed))


def write_mode(unit: int, dialect: Dialect, mode: Mode) -> bytes:
    """Return the frame that sets the mode, which a restart forgets."""
    return _write(unit, MAPS[dialect].mode_register, MODES.index(mode))


def write_setting(unit: int, dialect: Dialect, setting: Setting, value: int) -> bytes:
    """Return the frame that sets something in the box's EEPROM.

    Raises RefusedOrderError for a value out of its range, KeyError for a setting
    that the dialect does not have.
    """
    kept = MAPS[dialect].settings[setting]
    return _write(unit, kept.register, kept.word(value))


def write_answer(unit: int, register: int) -> Callable[[ModbusFrame], bool | None]:
    """Return what knows the answer to a write of one register.

    True: taken. False: perhaps, for 2.17 answers ``00 10 03 3c 01`` to an override
    that it takes; a read-back must tell. It raises ExchangeRefusedError for any other
    exception.
    """

    def accept(frame: ModbusFrame) -> bool | None:
        if frame.unit != unit:
            return None
        code = refusal_code(frame, WRITE_MULTIPLE_REGISTERS)
        if code is None:
            return True if is_written(frame, register, 1) else None
        if code == ILLEGAL_VALUE:
            return False
        message = f"the box refused to write {register:#06x}: exception {code}"
        raise ExchangeRefusedError(message, code)

    return accept


def tenths(setpoint: Setpoint) -> int:
    """Return a set-point's one current in 0.1 A; it is a multiple of that."""
    return round(setpoint.current * 10)


def checked_unit(unit: int) -> int:
    """Return an address; RefusedOrderError where no SmartEVSE can be."""
    if unit not in UNITS:
        message = f"{unit} is no address of a SmartEVSE (0 to 8)"
        raise RefusedOrderError(message)
    return unit


def _write(unit: int, register: int, value: int) -> bytes:
    # Function 0x10: every second 0x06 in a row would be dropped without a word.
    return rtu_frame(checked_unit(unit), write_registers(register, (value,)))
