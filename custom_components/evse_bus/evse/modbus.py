"""Modbus frames in ASCII and RTU: finding them in a stream, building requests.

pymodbus builds the contents of requests (PDU) and the checksums. Frames are found
here, because the devices break rules that pymodbus' and other frame splitters rely on
(ABL replies with ``>``, a SmartEVSE omits the 0x80 of its exceptions), and because a
good frame behind a broken one must not be lost.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import re
from typing import Final, override

from pymodbus.framer import FramerAscii, FramerRTU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from .framing import Frame, Framer

READ_HOLDING_REGISTERS: Final = 0x03
READ_INPUT_REGISTERS: Final = 0x04
WRITE_SINGLE_REGISTER: Final = 0x06
WRITE_MULTIPLE_REGISTERS: Final = 0x10
EXCEPTION: Final = 0x80
"""Added to the function of a request that is refused."""

_END: Final = b"\r\n"
_SHORTEST: Final = 3
"""Minimum length of a frame, bytes: unit, function, checksum."""
_LONGEST: Final = 255
"""Maximum length of a frame, bytes (Modbus over serial line, 2.5.2.1)."""
_FRAME: Final = re.compile(rb"[>:]([0-9A-Fa-f]{0,%d})(\r\n?)?" % (2 * _LONGEST))
"""A start and the hex digits behind it, with the end if it has arrived."""


@dataclass(frozen=True, slots=True)
class ModbusFrame(Frame):
    """One frame with a good checksum."""

    raw: bytes
    is_reply: bool | None
    """ASCII: it starts with ``>``, not ``:``. ``None``: RTU does not mark replies."""
    unit: int
    function: int
    data: bytes
    """Contents between function and checksum."""


def lrc(data: bytes) -> int:
    """Return the Modbus ASCII checksum over these bytes."""
    return FramerAscii.compute_LRC(data)


def ascii_frame(unit: int, pdu: bytes, *, start: bytes = b":") -> bytes:
    """Return a complete ASCII frame; ``start``: ``:`` for a request, ``>`` a reply."""
    content = bytes((unit,)) + pdu
    body = content + bytes((lrc(content),))
    return start + body.hex().upper().encode() + _END


def read_registers(register: int, count: int) -> bytes:
    """Return the PDU that reads holding registers.

    Raises ValueError for a register or count out of range.
    """
    request = ReadHoldingRegistersRequest(address=register, count=count)
    return bytes((request.function_code,)) + request.encode()


def read_input_registers(register: int, count: int) -> bytes:
    """Return the PDU that reads input registers (function 0x04).

    Raises ValueError for a register or count out of range.
    """
    request = ReadInputRegistersRequest(address=register, count=count)
    return bytes((request.function_code,)) + request.encode()


def write_register(register: int, value: int) -> bytes:
    """Return the PDU that writes one register with function 0x06."""
    request = WriteSingleRegisterRequest(address=register, registers=[value])
    return bytes((request.function_code,)) + request.encode()


def write_registers(register: int, values: Sequence[int]) -> bytes:
    """Return the PDU that writes holding registers with function 0x10."""
    request = WriteMultipleRegistersRequest(address=register, registers=list(values))
    return bytes((request.function_code,)) + request.encode()


def registers_read(
    frame: ModbusFrame, count: int, function: int = READ_HOLDING_REGISTERS
) -> bytes | None:
    """Return the bytes of ``count`` registers; ``None``: not a reply with these."""
    length = 2 * count
    if frame.function != function or len(frame.data) != 1 + length:
        return None
    return frame.data[1:] if frame.data[0] == length else None


def is_written(frame: ModbusFrame, register: int, count: int) -> bool:
    """Return whether a frame confirms that these registers were written."""
    confirmed = register.to_bytes(2, "big") + count.to_bytes(2, "big")
    return frame.function == WRITE_MULTIPLE_REGISTERS and frame.data == confirmed


def exception_code(frame: ModbusFrame, function: int) -> int | None:
    """Return the code of an exception reply; ``None``: not an exception."""
    if frame.function != function | EXCEPTION or len(frame.data) != 1:
        return None
    return frame.data[0]


def malformed_exception_code(frame: ModbusFrame, function: int) -> int | None:
    """Return the code of an exception without the 0x80 (SmartEVSE), or ``None``.

    No valid reply to any function here has one byte of contents (PROTOCOLS.md, 3).
    """
    if frame.function != function or len(frame.data) != 1:
        return None
    return frame.data[0]


class AsciiFramer(Framer[ModbusFrame]):
    """Finds frames of Modbus ASCII; ``>`` starts a reply.

    ``:`` starts a request: of another master, or an echo of our own.
    """

    def __init__(self) -> None:
        """Start with an empty buffer."""
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
                # The end has not arrived yet.
                self._buffer = found[0]
                return frames
            elif buffer[position : position + 1] in (b">", b":"):
                # The next frame starts before the end of this one.
                self.noise += len(found[0])
            else:
                self.bad += 1
        self.noise += len(buffer) - position
        self._buffer = b""
        return frames


def _decode(raw: bytes, digits: bytes) -> ModbusFrame | None:
    """Return the frame of these digits; ``None``: not a valid one."""
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


# -- RTU -------------------------------------------------------------------------

_RTU_CHECKSUM: Final = 2
_RTU_EXCEPTION: Final = 5
_RTU_FIXED: Final = 8
"""Bytes of every request to read, and of every write of one register."""
_RTU_READ_HEAD: Final = 3
"""Bytes of a reply to a read, up to and including its byte count."""
_RTU_WRITE_HEAD: Final = 7
"""Bytes of a request to write several registers, up to and including its byte count."""
_RTU_LONGEST: Final = 256
"""Maximum length of a frame, bytes (Modbus over serial line, 2.5.1)."""
_READS: Final = (READ_HOLDING_REGISTERS, READ_INPUT_REGISTERS)
_KNOWN: Final = (*_READS, WRITE_SINGLE_REGISTER, WRITE_MULTIPLE_REGISTERS)


def crc(data: bytes) -> bytes:
    """Return the Modbus RTU checksum over these bytes, in wire order."""
    return FramerRTU.compute_CRC(data).to_bytes(2, "big")


def rtu_frame(unit: int, pdu: bytes) -> bytes:
    """Return a complete RTU frame."""
    content = bytes((unit,)) + pdu
    return content + crc(content)


class RtuFramer(Framer[ModbusFrame]):
    """Finds frames of Modbus RTU by their length and checksum.

    The pauses between frames do not survive an adapter, so they are not used. A frame
    may be a request or a reply of any device; exceptions are recognised with the 0x80
    in their function and without.
    """

    def __init__(self) -> None:
        """Start with an empty buffer."""
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
        taken = position = 0
        begun: int | None = None
        while position < len(buffer):
            lengths = _rtu_lengths(buffer, position)
            frame = _rtu_decode(buffer, position, lengths)
            if begun is not None and frame is not None and _is_weak(frame):
                # The unfinished frame before it may contain the same bytes.
                frame = None
            if frame is not None:
                self._lose(buffer[taken:position])
                frames.append(frame)
                position += len(frame.raw)
                taken, begun = position, None
                continue
            if begun is None and any(position + n > len(buffer) for n in lengths):
                begun = position
            position += 1
        kept = len(buffer) if begun is None else begun
        self._lose(buffer[taken:kept])
        self._buffer = buffer[kept:]
        return frames

    def _lose(self, data: bytes) -> None:
        """Count bytes that belong to no frame."""
        self.noise += len(data)
        self.bad += len(data) >= _RTU_EXCEPTION


def _is_weak(frame: ModbusFrame) -> bool:
    """Return whether the checksum is the only evidence that this is a frame."""
    return len(frame.raw) == _RTU_EXCEPTION and not frame.function & EXCEPTION


def _rtu_lengths(buffer: bytes, start: int) -> tuple[int, ...]:
    """Return the possible lengths of a frame that starts here; none: no start.

    Before the bytes that decide it have arrived: the shortest frame with them.
    """
    if start + 1 == len(buffer):
        return (_RTU_EXCEPTION,)
    function = buffer[start + 1]
    if function & ~EXCEPTION not in _KNOWN:
        return ()
    if function & EXCEPTION:
        return (_RTU_EXCEPTION,)
    counted = _rtu_counted(function, buffer[start : start + _RTU_FIXED])
    if counted == (_RTU_FIXED + 1,) and len(buffer) - start == _RTU_FIXED:
        # A request to read a register at 0x04xx, or a reply of two words without its
        # last byte: if that is 00, both checksums are good. No charger has such a
        # register (PROTOCOLS.md, 3), so this waits for the byte.
        return (*counted, _RTU_EXCEPTION)
    return (*counted, _RTU_FIXED, _RTU_EXCEPTION)


def _rtu_counted(function: int, head: bytes) -> tuple[int, ...]:
    """Return the length of a frame with a byte count, if this can be one."""
    if function in _READS:
        before, count = _RTU_READ_HEAD, head[_RTU_READ_HEAD - 1 : _RTU_READ_HEAD]
    elif function == WRITE_MULTIPLE_REGISTERS:
        before, count = _RTU_WRITE_HEAD, head[_RTU_WRITE_HEAD - 1 : _RTU_WRITE_HEAD]
    else:
        return ()
    length = before + sum(count) + _RTU_CHECKSUM
    possible = sum(count) > 0 and sum(count) % 2 == 0 and length <= _RTU_LONGEST
    return (length,) if possible else ()


def _rtu_decode(
    buffer: bytes, start: int, lengths: tuple[int, ...]
) -> ModbusFrame | None:
    """Return the complete frame that starts here; ``None``: there is none."""
    for length in lengths:
        raw = buffer[start : start + length]
        if len(raw) == length and crc(raw[:-_RTU_CHECKSUM]) == raw[-_RTU_CHECKSUM:]:
            return ModbusFrame(
                raw=raw,
                is_reply=None,
                unit=raw[0],
                function=raw[1],
                data=raw[2:-_RTU_CHECKSUM],
            )
    return None
