"""The frames of SmartEVSE load balancing: broadcasts, requests, and their answers.

Pure functions. Source: README of v2, registers 0x00* and 0x008*, the recorded masters of
2.20 and later, and PROTOCOLS.md, 3: a master broadcasts currents every 2 s. A slave of
2.17 with a request writes to a register of its own address, each second until the master
writes the answer there; later ones wait in a state until the master has polled that.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from ..errors import RefusedOrderError
from ..modbus import (
    READ_INPUT_REGISTERS,
    WRITE_MULTIPLE_REGISTERS,
    WRITE_SINGLE_REGISTER,
    ModbusFrame,
    rtu_frame,
    write_register,
    write_registers,
)
from ..safety import Setpoint
from .dialects import (
    ASKS_FOR_B,
    ASKS_FOR_C,
    FAMILIES,
    MAPS,
    SLAVES,
    STATE_NUMBERS,
    Dialect,
    Family,
    Handshake,
    Status,
)
from .registers import tenths, write_answer

_ACKNOWLEDGE: Final = 0x80
"""Added to the register of a request."""
_REFUSED: Final = 1
"""Bit of the error register: less than 6 A (`Fault.LESS_6A`)."""
_GRANTED: Final = {ASKS_FOR_B: 5, ASKS_FOR_C: 7}
"""The state that grants what a box asks for."""
_CLEARED_IN: Final = ("A", "B1")
"""The states in which a box is recorded to have its refusal cleared."""
_STATE_AND_ERROR: Final = 2
"""Words at the beginning of a status."""

_BROADCASTS: Final = {(0, 0x0001), (9, 0x0001), (9, 0x0020), (0, 0x0020)}
"""Unit and register of a broadcast of currents, in any dialect."""
_WRITE_HEAD: Final = 5
"""Bytes of a request to write several registers, before the values."""


_REQUESTING: Final = FAMILIES[Family.V2_17].units
_POLLS: Final = frozenset(
    row.status.block.register.to_bytes(2, "big")
    + row.status.block.words.to_bytes(2, "big")
    for row in FAMILIES.values()
    if row.handshake is Handshake.POLLED
)
"""Registers and number of words in the polls of masters."""


class RequestKind(IntEnum):
    """The request of a slave; its value is the register that it writes."""

    A = 1
    """The car has left: to state A."""
    B = 2
    """A car was plugged in: to state B; the value is the box's maximum."""
    C = 3
    """The car wants current: to state C; the value is the box's maximum."""
    CB = 4
    """The car has ended: from C to state B."""


@dataclass(frozen=True, slots=True)
class SlaveRequest:
    """A slave's request; it stands until it is answered."""

    unit: int
    kind: RequestKind
    wanted: float = 0.0
    """A, of requests for B and C."""


def broadcast(family: Family, setpoints: Mapping[int, Setpoint]) -> bytes:
    """Return the broadcast of currents, by unit; all others get 0 A.

    What 0 A does depends on the dialect (`Balancing.zero_stops`).
    """
    row = FAMILIES[family]
    units = range(1, row.currents + 1)
    if not setpoints.keys() <= set(units):
        message = f"a broadcast of {family} is for units 1 to {row.currents}"
        raise RefusedOrderError(message)
    values = [tenths(setpoints[one]) if one in setpoints else 0 for one in units]
    return rtu_frame(
        row.broadcast_unit, write_registers(row.broadcast_register, values)
    )


def acknowledge(request: SlaveRequest, setpoint: Setpoint | None) -> bytes:
    """Return the answer to a request; ``None``: 0 A, no current is granted."""
    if request.unit not in _REQUESTING:
        message = f"{request.unit} is no address of a slave of 2.17 (2 to 4)"
        raise RefusedOrderError(message)
    value = 0 if setpoint is None else tenths(setpoint)
    return rtu_frame(request.unit, write_register(_ACKNOWLEDGE | request.kind, value))


def asks(status: Status) -> bool:
    """Return whether a box that is polled waits for current."""
    return status.raw_state in _GRANTED


def grant_current(unit: int, dialect: Dialect, status: Status) -> bytes:
    """Return the answer to a box that asks for B or C: it may.

    In C it offers the current of the last broadcast that it has received. ``status``:
    as just read. Raises RefusedOrderError for a box that does not ask.
    """
    if not asks(status):
        raise _not_asking(status)
    return _write_state(
        unit, dialect, _GRANTED[status.raw_state], status.error & ~_REFUSED
    )


def refuse_current(unit: int, dialect: Dialect, status: Status) -> bytes:
    """Return the answer to a box that asks for B or C: there is no current.

    It does not ask again before the refusal was cleared; ``status``: as just read.
    Raises RefusedOrderError for a box that does not ask.
    """
    if not asks(status):
        raise _not_asking(status)
    state = STATE_NUMBERS[status.raw_state]
    return _write_state(unit, dialect, state, status.error | _REFUSED)


def is_refused(status: Status) -> bool:
    """Return whether a refusal keeps a box from asking, and can be cleared now."""
    return bool(status.error & _REFUSED) and status.raw_state in _CLEARED_IN


def clear_refusal(unit: int, dialect: Dialect, status: Status) -> bytes:
    """Return the frame after which a refused box asks again, 60 s later.

    ``status``: as just read. Raises RefusedOrderError for one that is not refused.
    """
    if not is_refused(status):
        message = f"a box in state {status.raw_state} has no refusal to be cleared"
        raise RefusedOrderError(message)
    state = STATE_NUMBERS[status.raw_state]
    return _write_state(unit, dialect, state, status.error & ~_REFUSED)


def answer_to_state(
    unit: int, dialect: Dialect
) -> Callable[[ModbusFrame], bool | None]:
    """Return a matcher for the reply to a grant, a refusal, or its clearing."""
    register = MAPS[dialect].balancing.status.block.register
    return write_answer(unit, register, _STATE_AND_ERROR)


def _write_state(unit: int, dialect: Dialect, state: int, error: int) -> bytes:
    row = MAPS[dialect].balancing
    if row.handshake is not Handshake.POLLED or unit not in row.units:
        message = f"the state of unit {unit} ({dialect}) is not to be written"
        raise RefusedOrderError(message)
    return rtu_frame(unit, write_registers(row.status.block.register, (state, error)))


def _not_asking(status: Status) -> RefusedOrderError:
    return RefusedOrderError(f"a box in state {status.raw_state} asks for nothing")


def decode_request(frame: ModbusFrame) -> SlaveRequest | None:
    """Return the request of a slave in a frame; ``None``: it is no request."""
    if (
        frame.function != WRITE_SINGLE_REGISTER
        or frame.unit not in _REQUESTING
        or len(frame.data) != 2 * 2
    ):
        return None
    register = int.from_bytes(frame.data[:2], "big")
    try:
        kind = RequestKind(register)
    except ValueError:
        return None
    wanted = int.from_bytes(frame.data[2:], "big") / 10
    return SlaveRequest(frame.unit, kind, wanted)


def is_poll_of_node(frame: ModbusFrame) -> bool:
    """Return whether a frame is the poll of a slave by its master, from 2.20 on."""
    return (
        frame.function == READ_INPUT_REGISTERS
        and frame.unit in SLAVES
        and frame.data in _POLLS
    )


def is_foreign_broadcast(frame: ModbusFrame) -> bool:
    """Return whether a frame is a master's broadcast of currents.

    That includes our own, received as an echo: the caller knows which it has sent.
    """
    return (
        frame.function == WRITE_MULTIPLE_REGISTERS
        and len(frame.data) > _WRITE_HEAD
        and (frame.unit, int.from_bytes(frame.data[:2], "big")) in _BROADCASTS
    )
