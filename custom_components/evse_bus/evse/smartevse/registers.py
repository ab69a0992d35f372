"""Requests to a SmartEVSE in any of its dialects, and their replies.

Pure functions. The tables are in `dialects`, load balancing is in `balancing`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from ..errors import ExchangeRefusedError, ImplausibleReplyError, RefusedOrderError
from ..fields import Numeric
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
from ..model import Mode, Setting
from ..registers import Block, Registers, Word, words_of
from ..safety import Setpoint
from .dialects import MAPS, MODES, UNITS, Dialect, Status

LONGEST_REQUEST: Final = 25
"""Bytes: the broadcast of eight currents."""
LONGEST_REPLY: Final = 64

ILLEGAL_ADDRESS: Final = 2
"""Exception: there is no such register."""
ILLEGAL_VALUE: Final = 3
"""Exception: out of range; 2.17 also sends it for an override that it accepts."""


# -- Reading -----------------------------------------------------------------------

_REQUIRED: Final = (Setting.MINIMUM_CURRENT, Setting.MAXIMUM_CURRENT)


class MalformedRefusalError(ExchangeRefusedError):
    """An exception without the 0x80 in its function, as 2.x sends it."""


def decode_status(
    dialect: Dialect, data: bytes, registers: Registers[Status] | None = None
) -> Status:
    """Return the contents of a status block of this dialect.

    ``registers``: the block, if not that of `Map.status`. Raises ImplausibleReplyError
    for contents that no SmartEVSE of this dialect has.
    """
    try:
        return (registers or MAPS[dialect].status).decode(data)
    except ImplausibleReplyError as error:
        message = f"not the status of a SmartEVSE ({dialect}): {error}: {data.hex()}"
        raise ImplausibleReplyError(message) from error


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """Settings in the memory of a box."""

    settings: Mapping[Setting, int]
    load_balancing: int
    """0 disabled, 1 master, else slave."""


def decode_configuration(
    dialect: Dialect, blocks: Mapping[Block, bytes]
) -> Configuration:
    """Return the contents of all blocks of a dialect's configuration.

    A setting with an unknown value is left out, if no limit depends on it. Raises
    ImplausibleReplyError if a word is missing or a required value is impossible.
    """
    layout = MAPS[dialect]
    words: dict[int, int] = {}
    for block, data in blocks.items():
        words |= words_of(block, data)
    settings: dict[Setting, int] = {}
    try:
        for setting, word in layout.settings.items():
            try:
                settings[setting] = _decode(words, word, setting)
            except ImplausibleReplyError:
                if setting in _REQUIRED:
                    raise
        # In 2.17 a status that arrives late is as long, and looks like settings.
        _decode(words, layout.socket, "socket or fixed cable")
        load_balancing = _decode(words, layout.load_balancing, "load balancing")
    except KeyError as error:
        message = f"register {error} was not read"
        raise ImplausibleReplyError(message) from error
    return Configuration(settings=settings, load_balancing=load_balancing)


def has_known_box(dialect: Dialect, words: Mapping[int, int]) -> bool:
    """Return whether words of the configuration are those of a SmartEVSE.

    ``words``: its first block, by register.
    """
    row = MAPS[dialect]
    kinds = (row.socket, row.load_balancing, *(row.settings[one] for one in _REQUIRED))
    try:
        for word in kinds:
            _decode(words, word, "a setting")
    except ImplausibleReplyError, KeyError:
        return False
    return True


def _decode[V](words: Mapping[int, int], word: Word[Numeric[V]], name: str) -> V:
    raw = words[word.register]
    try:
        return word.kind.value(raw)
    except ImplausibleReplyError as error:
        message = f"{name} cannot be {raw} (register {word.register:#06x})"
        raise ImplausibleReplyError(message) from error


def read_request(unit: int, block: Block) -> bytes:
    """Return the frame that reads a block."""
    read = (
        read_registers
        if block.function == READ_HOLDING_REGISTERS
        else read_input_registers
    )
    return rtu_frame(checked_unit(unit), read(block.register, block.words))


def read_answer(unit: int, block: Block) -> Callable[[ModbusFrame], bytes | None]:
    """Return a matcher for the reply to a read; it returns the block's bytes.

    It raises ExchangeRefusedError for an exception, well-formed or malformed.
    """

    def accept(frame: ModbusFrame) -> bytes | None:
        if frame.unit != unit:
            return None
        if (code := refusal_code(frame, block.function)) is not None:
            message = f"the box refused to read {block.register:#06x}: exception {code}"
            if frame.function == block.function:
                raise MalformedRefusalError(message, code)
            raise ExchangeRefusedError(message, code)
        return registers_read(frame, block.words, block.function)

    return accept


def refusal_code(frame: ModbusFrame, function: int) -> int | None:
    """Return the code of an exception, with 0x80 in its function or without."""
    if frame.function == function | EXCEPTION and len(frame.data) == 1:
        return frame.data[0]
    return malformed_exception_code(frame, function)


# -- Writing -----------------------------------------------------------------------


def write_current(unit: int, dialect: Dialect, setpoint: Setpoint) -> bytes:
    """Return the frame that sets the charging current.

    Raises RefusedOrderError for a pause: 0 would restore the maximum of the box.
    """
    if setpoint.paused or setpoint.current <= 0:
        message = "a current of 0 A does not pause a SmartEVSE"
        raise RefusedOrderError(message)
    return _write(unit, MAPS[dialect].current_register, tenths(setpoint))


def write_access(unit: int, dialect: Dialect, allowed: bool) -> bytes:  # noqa: FBT001
    """Return the frame that sets the access bit."""
    return _write(unit, MAPS[dialect].access_register, int(allowed))


def write_mode(unit: int, dialect: Dialect, mode: Mode) -> bytes:
    """Return the frame that sets the mode until the next restart."""
    return _write(unit, MAPS[dialect].mode_register, MODES.index(mode))


def write_setting(unit: int, dialect: Dialect, setting: Setting, value: int) -> bytes:
    """Return the frame that changes a setting in the EEPROM.

    Raises RefusedOrderError for a value out of range, KeyError for a setting that the
    dialect does not have.
    """
    word = MAPS[dialect].settings[setting]
    return _write(unit, word.register, word.kind.named(setting).raw(value))


def write_answer(
    unit: int, register: int, words: int = 1
) -> Callable[[ModbusFrame], bool | None]:
    """Return a matcher for the reply to a write of registers.

    True: accepted. False: unknown until it is read back, since 2.17 answers
    ``00 10 03 3c 01`` to an override that it accepts. It raises ExchangeRefusedError
    for any other exception.
    """

    def accept(frame: ModbusFrame) -> bool | None:
        if frame.unit != unit:
            return None
        code = refusal_code(frame, WRITE_MULTIPLE_REGISTERS)
        if code is None and is_written(frame, register, words):
            return True
        if code is None:
            # It confirms the number of values it took.
            taken = any(is_written(frame, register, n) for n in range(words))
            return False if taken else None
        if code == ILLEGAL_VALUE:
            return False
        message = f"the box refused to write {register:#06x}: exception {code}"
        raise ExchangeRefusedError(message, code)

    return accept


def tenths(setpoint: Setpoint) -> int:
    """Return the current of a set-point in 0.1 A; it is a multiple of that."""
    return round(setpoint.current * 10)


def checked_unit(unit: int) -> int:
    """Return the address; RefusedOrderError for one that no SmartEVSE has."""
    if unit not in UNITS:
        message = f"{unit} is no address of a SmartEVSE (0 to 8)"
        raise RefusedOrderError(message)
    return unit


def _write(unit: int, register: int, value: int) -> bytes:
    # Function 0x10: every second 0x06 in a row would be dropped silently.
    return rtu_frame(checked_unit(unit), write_registers(register, (value,)))
