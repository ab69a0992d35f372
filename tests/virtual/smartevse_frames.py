"""Modbus RTU as a SmartEVSE implements it: pure functions.

A box finds the end of a frame by silence alone, and the kind of a frame by its length.
A write of one register is a request or a reply: that depends on the frame before.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from .bus import VirtualBus
    from .log import Entry

READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_SEVERAL = 0x03, 0x04, 0x06, 0x10
READS = (READ_HOLDING, READ_INPUT)
LONGEST = 50
SHORTEST = 8
# More silence than this ends a frame, s; and the silence before a reply, s.
FRAME_GAP = 0.003
ANSWER_SILENCE = 0.006

Kind = Literal["request", "answer", "either"]


def crc16(data: bytes) -> bytes:
    """Return the checksum, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return crc.to_bytes(2, "little")


def words(*values: int) -> bytes:
    """Return 16-bit words, high byte first."""
    return b"".join(value.to_bytes(2, "big") for value in values)


def frame(unit: int, function: int, data: bytes) -> bytes:
    """Return a frame with its checksum."""
    body = bytes((unit, function)) + data
    return body + crc16(body)


def read_frame(unit: int, register: int, count: int, function: int = 4) -> bytes:
    """Return a request to read."""
    return frame(unit, function, words(register, count))


def write_frame(unit: int, register: int, value: int) -> bytes:
    """Return a request to write one register (06), or the reply to it."""
    return frame(unit, WRITE_ONE, words(register, value))


def write_several_frame(unit: int, register: int, *values: int) -> bytes:
    """Return a request to write registers (10)."""
    head = words(register, len(values)) + bytes((2 * len(values),))
    return frame(unit, WRITE_SEVERAL, head + words(*values))


def values_frame(unit: int, function: int, values: list[int]) -> bytes:
    """Return the reply to a read; the length byte is left out if it would be 0."""
    length = bytes((2 * len(values),)) if values else b""
    return frame(unit, function, length + words(*values))


def exception_frame(unit: int, function: int, code: int) -> bytes:
    """Return a refusal; the boxes of v2 send it without the 0x80 in the function."""
    return frame(unit, function, bytes((code,)))


@dataclass(frozen=True, slots=True)
class Packet:
    """A frame with a good checksum, as a box decodes it.

    `values`: the words of a write, or of the reply to a read, whose register is not
    known.
    """

    unit: int
    function: int
    kind: Kind
    register: int = 0
    count: int = 0
    values: tuple[int, ...] = ()


def decode(
    data: bytes, functions: tuple[int, ...], longest: int = LONGEST
) -> Packet | None:
    """Return a frame as a box decodes it, or None if the box ignores it."""
    if not SHORTEST <= len(data) <= longest or crc16(data[:-2]) != data[-2:]:
        return None
    unit, function = data[0], data[1]
    if function not in functions:
        return None
    if len(data) > SHORTEST:
        return _decode_long(unit, function, data)
    register = int.from_bytes(data[2:4], "big")
    number = int.from_bytes(data[4:6], "big")
    if function in READS:
        return Packet(unit, function, "request", register, number)
    if function == WRITE_ONE:
        return Packet(unit, function, "either", register, 1, (number,))
    return Packet(unit, function, "answer", register, number)


def _decode_long(unit: int, function: int, data: bytes) -> Packet | None:
    """Return a reply to a read, or a request to write several."""
    if function in READS and data[2] == len(data) - 5:
        return Packet(unit, function, "answer", values=_split(data[3:-2]))
    if function == WRITE_SEVERAL and data[6] == len(data) - 9:
        register = int.from_bytes(data[2:4], "big")
        count = int.from_bytes(data[4:6], "big")
        return Packet(unit, function, "request", register, count, _split(data[7:-2]))
    return None


def _split(data: bytes) -> tuple[int, ...]:
    pairs = range(0, len(data) - 1, 2)
    return tuple(int.from_bytes(data[i : i + 2], "big") for i in pairs)


@dataclass(frozen=True, slots=True)
class SmartEvseRequest:
    """A well-formed request on the wire: real times of its first byte and its end.

    `count` registers; `values` are empty for a read.
    """

    t: float
    end: float
    unit: int
    function: int
    register: int
    count: int
    values: tuple[int, ...]


def smartevse_requests_in(
    traffic: VirtualBus | Iterable[Entry],
) -> list[SmartEvseRequest]:
    """Return all well-formed requests of a client, for any address.

    Use it as the oracle: `smartevse_requests_in(bus)`, or with logged entries as
    `bus.log.bursts("injected")`. Frames with 3 ms or less between them are one
    malformed frame, to a box and here.
    """
    entries = traffic if isinstance(traffic, Iterable) else traffic.log.bursts()
    result = []
    for entry in entries:
        packet = decode(entry.data, (*READS, WRITE_ONE, WRITE_SEVERAL))
        if packet is None or packet.kind == "answer":
            continue
        result.append(
            SmartEvseRequest(
                entry.t,
                entry.end,
                packet.unit,
                packet.function,
                packet.register,
                packet.count,
                packet.values,
            )
        )
    return result
