"""The frames of SmartEVSE load balancing: broadcast, requests, acknowledgements.

Pure functions. Source: README of v2, registers 0x00* and 0x008*, and PROTOCOLS.md, 3:
a master broadcasts currents every 2 s; a slave with a request writes to a register of
its own address, each second until the master writes the answer there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from ..errors import RefusedOrderError
from ..modbus import (
    WRITE_MULTIPLE_REGISTERS,
    WRITE_SINGLE_REGISTER,
    ModbusFrame,
    rtu_frame,
    write_register,
    write_registers,
)
from ..safety import Setpoint
from .registers import tenths

BROADCAST: Final = 0
"""The unit at which all boxes of the dialect 2.17 listen."""
SLAVES: Final = range(2, 5)
CURRENTS: Final = 4
"""Values of a broadcast, for units 1 to 4."""
_CURRENTS_REGISTER: Final = 0x0001
_ACKNOWLEDGE: Final = 0x80
"""Added to the register of a request."""

_BROADCASTS: Final = {(0, 0x0001), (9, 0x0001), (9, 0x0020), (0, 0x0020)}
"""Unit and register of a broadcast of currents, in any dialect."""
_WRITE_HEAD: Final = 5
"""Bytes of a request to write several registers, before the values."""


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


def broadcast(setpoints: Sequence[Setpoint | None]) -> bytes:
    """Return the broadcast of currents for units 1 to 4; ``None``: 0 A.

    0 A is no stop: a charging slave then offers 6 A (PROTOCOLS.md, 3).
    """
    if len(setpoints) != CURRENTS:
        message = f"a broadcast has {CURRENTS} currents, not {len(setpoints)}"
        raise RefusedOrderError(message)
    values = [0 if one is None else tenths(one) for one in setpoints]
    return rtu_frame(BROADCAST, write_registers(_CURRENTS_REGISTER, values))


def acknowledge(request: SlaveRequest, setpoint: Setpoint | None) -> bytes:
    """Return the answer to a request; ``None``: 0 A, no current is granted."""
    if request.unit not in SLAVES:
        message = f"{request.unit} is no address of a slave (2 to 4)"
        raise RefusedOrderError(message)
    value = 0 if setpoint is None else tenths(setpoint)
    return rtu_frame(request.unit, write_register(_ACKNOWLEDGE | request.kind, value))


def decode_request(frame: ModbusFrame) -> SlaveRequest | None:
    """Return the request of a slave in a frame; ``None``: it is no request."""
    if (
        frame.function != WRITE_SINGLE_REGISTER
        or frame.unit not in SLAVES
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


def is_foreign_broadcast(frame: ModbusFrame) -> bool:
    """Return whether a frame is a master's broadcast of currents.

    That includes our own, received as an echo: the caller knows which it has sent.
    """
    return (
        frame.function == WRITE_MULTIPLE_REGISTERS
        and len(frame.data) > _WRITE_HEAD
        and (frame.unit, int.from_bytes(frame.data[:2], "big")) in _BROADCASTS
    )
