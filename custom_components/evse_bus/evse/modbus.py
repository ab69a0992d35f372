"""Modbus frames in ASCII and RTU: finding them in a stream, building requests.

pymodbus builds the contents of requests (PDU) and the checksums. Frames are found
here, because the devices break rules that pymodbus' and other frame splitters rely on
(ABL replies with ``>``, a SmartEVSE omits the 0x80 of its exceptions), and because a
good frame behind a broken one must not be lost.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
import re
from typing import Final, override

from pymodbus.framer import FramerAscii, FramerRTU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadInputRegistersRequest,
    WriteMultipleRegistersRequest,
    WriteSingleRegisterRequest,
)

from .crc16 import RunningCrc
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
_LONGEST_TEXT: Final = 1 + 2 * _LONGEST
"""Characters of such a frame before its end."""
_START: Final = re.compile(rb"[>:]")
_NO_DIGIT: Final = re.compile(rb"[^0-9A-Fa-f]")


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

    @property
    @override
    def is_request(self) -> bool:
        if self.is_reply is not None:
            return not self.is_reply
        if self.function in _READS:
            # A reply has a byte count and an even number of bytes.
            return len(self.data) == 2 * 2
        # The reply to a write of several registers has no values; that to a write of
        # one register is equal to its request.
        is_long = len(self.data) > 2 * 2
        return self.function == WRITE_MULTIPLE_REGISTERS and is_long


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
        self._buffer = bytearray()

    @property
    @override
    def pending(self) -> int:
        return len(self._buffer)

    @override
    def reset(self) -> None:
        self.noise += len(self._buffer)
        self._buffer.clear()

    @override
    def feed(self, data: bytes) -> list[ModbusFrame]:
        frames: list[ModbusFrame] = []
        at = 0
        while at < len(data):
            if self._buffer:
                at = self._go_on(data, at, frames)
                continue
            start = _START.search(data, at)
            if start is None:
                self.noise += len(data) - at
                break
            self.noise += start.start() - at
            self._buffer += start[0]
            at = start.end()
        return frames

    def _go_on(self, data: bytes, at: int, frames: list[ModbusFrame]) -> int:
        """Go on with the frame that has begun; return the place of what is left."""
        buffer = self._buffer
        if not buffer.endswith(_END[:1]):
            most = min(at + _LONGEST_TEXT - len(buffer), len(data))
            other = _NO_DIGIT.search(data, at, most)
            end = most if other is None else other.start()
            buffer += data[at:end]
            at = end
            if data[at : at + 1] == _END[:1]:
                buffer += _END[:1]
                at += 1
            if at == len(data):
                return at
        if buffer.endswith(_END[:1]) and data[at : at + 1] == _END[1:]:
            at += 1
            frame = _decode(bytes(buffer + _END[1:]))
            if frame is not None:
                frames.append(frame)
            self.bad += frame is None
        elif _START.match(data, at):
            # The next frame starts before the end of this one.
            self.noise += len(buffer)
        else:
            self.bad += 1
        buffer.clear()
        return at


def _decode(raw: bytes) -> ModbusFrame | None:
    """Return the frame of these characters; ``None``: not a valid one."""
    digits = raw[1 : -len(_END)]
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
_RTU_PIECE: Final = 4 * _RTU_LONGEST
"""So many bytes are searched for frames at once."""
_READS: Final = (READ_HOLDING_REGISTERS, READ_INPUT_REGISTERS)
_KNOWN: Final = (*_READS, WRITE_SINGLE_REGISTER, WRITE_MULTIPLE_REGISTERS)
_RTU_COUNTED: Final = (
    (_READS, _RTU_READ_HEAD),
    ((WRITE_MULTIPLE_REGISTERS,), _RTU_WRITE_HEAD),
)
"""Functions with a byte count, and where it is: at the end of so many bytes."""
_COUNTED_RANK, _FIXED_RANK, _EXCEPTION_RANK = range(3)


def crc(data: bytes) -> bytes:
    """Return the Modbus RTU checksum over these bytes, in wire order."""
    return FramerRTU.compute_CRC(data).to_bytes(2, "big")


def rtu_frame(unit: int, pdu: bytes) -> bytes:
    """Return a complete RTU frame."""
    content = bytes((unit,)) + pdu
    return content + crc(content)


@dataclass(slots=True)
class _Start:
    """A byte that may be the first of a frame; places count from the first byte ever.

    Of the lengths that a frame may have here, the one of the lowest rank is believed.
    """

    at: int
    open_until: int
    """Where the longest of these frames ends."""
    rank: int = _EXCEPTION_RANK
    length: int = 0
    """Length of the frame with a good checksum; 0: there is none."""


class RtuFramer(Framer[ModbusFrame]):
    """Finds frames of Modbus RTU by their length and checksum.

    The pauses between frames do not survive an adapter, so they are not used. A frame
    may be a request or a reply of any device; exceptions are recognised with the 0x80
    in their function and without.

    No more than the longest frame is kept, and a byte costs the same whatever came
    before it: each possible frame is checked once, when its last byte arrives.
    """

    def __init__(self) -> None:
        """Start with an empty buffer."""
        super().__init__()
        self._buffer = bytearray()
        self._crc = RunningCrc()
        self._starts: list[_Start] = []
        """One for each byte of the buffer."""
        self._dropped = 0
        """Place of the first byte of the buffer."""
        self._due: dict[int, list[tuple[_Start, int, int]]] = {}
        """Possible frames (start, rank, length) by the place where they end."""

    @property
    @override
    def pending(self) -> int:
        return len(self._buffer)

    @override
    def reset(self) -> None:
        self.noise += len(self._buffer)
        self._drop(len(self._buffer))

    @override
    def feed(self, data: bytes) -> list[ModbusFrame]:
        frames: list[ModbusFrame] = []
        for at in range(0, len(data), _RTU_PIECE):
            sure: list[_Start] = []
            for byte in data[at : at + _RTU_PIECE]:
                self._append(byte)
                sure += self._checked()
            frames += self._take(sorted(sure, key=attrgetter("at")))
        return frames

    def _append(self, byte: int) -> None:
        """Take a byte, and what it decides about the frames that it may belong to."""
        self._buffer.append(byte)
        self._crc.append(byte)
        end = self._dropped + len(self._buffer)
        # Until its function arrives, any byte may be the first of a frame.
        self._starts.append(_Start(end - 1, open_until=end + 1))
        if len(self._buffer) > 1:
            self._expect(self._starts[-2], byte)
        for functions, head in _RTU_COUNTED:
            if len(self._buffer) >= head and self._buffer[1 - head] in functions:
                self._expect_counted(self._starts[-head], head, byte)

    def _expect(self, start: _Start, function: int) -> None:
        """Expect the frames with this function."""
        start.open_until = start.at
        if function & ~EXCEPTION not in _KNOWN:
            return
        self._expect_frame(start, _EXCEPTION_RANK, _RTU_EXCEPTION)
        if not function & EXCEPTION and function not in _READS:
            self._expect_frame(start, _FIXED_RANK, _RTU_FIXED)
        elif not function & EXCEPTION:
            # When its third byte has come, before any of these frames can end.
            start.open_until = start.at + _RTU_FIXED

    def _expect_counted(self, start: _Start, head: int, count: int) -> None:
        """Expect the frames with this byte count at the end of their head."""
        length = head + count + _RTU_CHECKSUM
        possible = count > 0 and count % 2 == 0 and length <= _RTU_LONGEST
        if possible:
            self._expect_frame(start, _COUNTED_RANK, length)
        if head == _RTU_READ_HEAD:
            # A request to read a register at 0x04xx, or a reply of two words without
            # its last byte: if that is 00, both checksums are good. No charger has
            # such a register (PROTOCOLS.md, 3), so this waits for the byte.
            waits = possible and length == _RTU_FIXED + 1
            self._expect_frame(start, _FIXED_RANK, _RTU_FIXED, waits=waits)

    def _expect_frame(
        self, start: _Start, rank: int, length: int, *, waits: bool = False
    ) -> None:
        end = start.at + length
        start.open_until = max(start.open_until, end)
        self._due.setdefault(end + waits, []).append((start, rank, length))

    def _checked(self) -> Iterator[_Start]:
        """Check the frames that end here; yield the starts of good ones, if sure."""
        for start, rank, length in self._due.pop(self._dropped + len(self._buffer), ()):
            at = start.at - self._dropped
            if at < 0 or (start.length and start.rank < rank):
                continue
            if self._crc.is_good(at, at + length):
                start.rank, start.length = rank, length
                if rank != _EXCEPTION_RANK or self._buffer[at + 1] & EXCEPTION:
                    yield start

    def _take(self, sure: Iterable[_Start]) -> Iterator[ModbusFrame]:
        """Yield the frames; what can belong to none is lost.

        ``sure``: the frames that are believed inside an unfinished one, too. Others
        have only a checksum as evidence, and may be the contents of that one.
        """
        inside = deque(sure)
        end = self._dropped + len(self._buffer)
        taken = at = 0
        while at < len(self._buffer):
            start = self._starts[at]
            if not start.length:
                if start.open_until <= end:
                    at += 1
                    continue
                while inside and inside[0].at < start.at:
                    inside.popleft()
                if not inside:
                    break
                start = inside[0]
                at = start.at - self._dropped
            self._lose(at - taken)
            taken = at + start.length
            raw = bytes(self._buffer[at:taken])
            at = taken
            yield ModbusFrame(
                raw=raw,
                is_reply=None,
                unit=raw[0],
                function=raw[1],
                data=raw[2:-_RTU_CHECKSUM],
            )
        self._lose(at - taken)
        self._drop(at)

    def _lose(self, count: int) -> None:
        """Count bytes that belong to no frame."""
        self.noise += count
        self.bad += count >= _RTU_EXCEPTION

    def _drop(self, count: int) -> None:
        """Drop bytes from the front of the buffer."""
        del self._buffer[:count]
        del self._starts[:count]
        self._crc.drop(count)
        self._dropped += count
