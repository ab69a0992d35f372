"""Modbus frames, found and checked by us; contents and checksums by pymodbus.

Finding frames is ours because the dialects on these buses break the rules that
pymodbus' and other frame splitters rely on (ABL answers with ``>``), and because a
good frame behind a broken one must not be lost. pymodbus gives what needs no port:
the request contents (PDU) and the checksum.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import re
from typing import Final, override

from pymodbus.framer import FramerAscii
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    WriteMultipleRegistersRequest,
)

from .framing import Frame, Framer

READ_HOLDING_REGISTERS: Final = 0x03
WRITE_MULTIPLE_REGISTERS: Final = 0x10
EXCEPTION: Final = 0x80
"""Added to the function of a request that is refused."""

_END: Final = b"\r\n"
_SHORTEST: Final = 3
"""Unit, function, checksum: bytes that a frame has at least."""
_LONGEST: Final = 255
"""Bytes that a frame has at most (Modbus over serial line, 2.5.2.1: 513 signs)."""
_FRAME: Final = re.compile(rb"[>:]([0-9A-Fa-f]{0,%d})(\r\n?)?" % (2 * _LONGEST))
"""A start, and how far a frame can be made of what follows."""


@dataclass(frozen=True, slots=True)
class ModbusFrame(Frame):
    """One frame with a good checksum."""

    raw: bytes
    is_reply: bool
    """It began with the sign of an answer; otherwise it is somebody's request."""
    unit: int
    function: int
    data: bytes
    """What follows the function, without the checksum."""


def lrc(data: bytes) -> int:
    """Return the checksum of Modbus ASCII over these bytes."""
    return FramerAscii.compute_LRC(data)


def ascii_frame(unit: int, pdu: bytes, *, start: bytes = b":") -> bytes:
    """Return a whole frame in ASCII: a request unless ``start`` says otherwise."""
    content = bytes((unit,)) + pdu
    body = content + bytes((lrc(content),))
    return start + body.hex().upper().encode() + _END


def read_registers(register: int, count: int) -> bytes:
    """Return the PDU that reads holding registers.

    Raises ValueError when there are no such registers.
    """
    request = ReadHoldingRegistersRequest(address=register, count=count)
    return bytes((request.function_code,)) + request.encode()


def write_registers(register: int, values: Sequence[int]) -> bytes:
    """Return the PDU that writes holding registers with function 0x10."""
    request = WriteMultipleRegistersRequest(address=register, registers=list(values))
    return bytes((request.function_code,)) + request.encode()


def registers_read(frame: ModbusFrame, count: int) -> bytes | None:
    """Return the bytes of so many registers, ``None`` if it does not hold them."""
    length = 2 * count
    if frame.function != READ_HOLDING_REGISTERS or len(frame.data) != 1 + length:
        return None
    return frame.data[1:] if frame.data[0] == length else None


def is_written(frame: ModbusFrame, register: int, count: int) -> bool:
    """Return whether a frame confirms that these registers were written."""
    confirmed = register.to_bytes(2, "big") + count.to_bytes(2, "big")
    return frame.function == WRITE_MULTIPLE_REGISTERS and frame.data == confirmed


def exception_code(frame: ModbusFrame, function: int) -> int | None:
    """Return the code with which a request was refused, ``None`` if it was not."""
    if frame.function != function | EXCEPTION or len(frame.data) != 1:
        return None
    return frame.data[0]


class AsciiFramer(Framer[ModbusFrame]):
    """Finds frames of Modbus ASCII, with ``>`` as the sign of an answer.

    ``:`` starts a request: another master's, or an echo of our own.
    """

    def __init__(self) -> None:
        """Start with nothing heard."""
        super().__init__()
        self._buffer = b""

    @property
    @override
    def pending(self) -> int:
        return len(self._buffer)

    @override
    def reset(self) -> None:
        self.noise += len(self._buffer)
        self._buffer = b""

    @override
    def feed(self, data: bytes) -> list[ModbusFrame]:
        buffer = self._buffer + data
        frames: list[ModbusFrame] = []
        position = 0
        while (found := _FRAME.search(buffer, position)) is not None:
            self.noise += found.start() - position
            position = found.end()
            if found[2] == _END:
                if (frame := _decode(found[0], found[1])) is not None:
                    frames.append(frame)
                else:
                    self.bad += 1
            elif position == len(buffer):
                # Its end is still to come.
                self._buffer = found[0]
                return frames
            elif buffer[position : position + 1] in (b">", b":"):
                # The next one begins before this one has ended.
                self.noise += len(found[0])
            else:
                self.bad += 1
        self.noise += len(buffer) - position
        self._buffer = b""
        return frames


def _decode(raw: bytes, digits: bytes) -> ModbusFrame | None:
    """Return the frame of these digits, ``None`` if they do not make one."""
    if len(digits) % 2 or len(digits) < 2 * _SHORTEST:
        return None
    content = bytes.fromhex(digits.decode())
    if lrc(content[:-1]) != content[-1]:
        return None
    return ModbusFrame(
        raw=raw,
        is_reply=raw.startswith(b">"),
        unit=content[0],
        function=content[1],
        data=content[2:-1],
    )
