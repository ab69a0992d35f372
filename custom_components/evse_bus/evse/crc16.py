"""The Modbus CRC of any part of a stream, at a cost that its length does not change.

One byte takes the register r to ``r >> 8 ^ T[(r ^ byte) & 0xFF]`` (Modbus over serial
line, 6.2.2). That is linear over the bits: two registers that take the same bytes
differ at the end by what zero bytes make of their difference at the begin. So the
register of a frame that starts with 0xFFFF follows from one register that runs on
through all bytes.
"""

from functools import cache
from typing import Final

_START: Final = 0xFFFF
_POLYNOMIAL: Final = 0xA001
_BYTE: Final = 0xFF


def _table() -> tuple[int, ...]:
    table: list[int] = []
    for value in range(_BYTE + 1):
        register = value
        for _ in range(8):
            register = register >> 1 ^ (_POLYNOMIAL if register & 1 else 0)
        table.append(register)
    return tuple(table)


_TABLE: Final = _table()


def _after(register: int, byte: int) -> int:
    return register >> 8 ^ _TABLE[(register ^ byte) & _BYTE]


@cache
def _zeros(count: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return what so many zero bytes make of each low and each high byte.

    There are as many of these tables as frames have lengths.
    """
    tables: list[tuple[int, ...]] = []
    for shift in (0, 8):
        table = [0]
        for bit in range(8):
            register = 1 << bit + shift
            for _ in range(count):
                register = _after(register, 0)
            table += [register ^ one for one in table]
        tables.append(tuple(table))
    return tables[0], tables[1]


class RunningCrc:
    """Registers at all places of a stream; places count from the oldest byte kept."""

    def __init__(self) -> None:
        """Start with an empty stream."""
        self._registers = [0]

    def append(self, byte: int) -> None:
        """Take one byte more."""
        self._registers.append(_after(self._registers[-1], byte))

    def drop(self, count: int) -> None:
        """Forget the oldest bytes."""
        del self._registers[:count]

    def is_good(self, start: int, end: int) -> bool:
        """Return whether the last two bytes of this part are the CRC of the others."""
        low, high = _zeros(end - start)
        difference = self._registers[start] ^ _START
        left = low[difference & _BYTE] ^ high[difference >> 8]
        return left == self._registers[end]
