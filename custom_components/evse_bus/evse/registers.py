"""Modbus registers that are read together, and the tables of their contents."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from .fields import Numeric
from .modbus import READ_HOLDING_REGISTERS
from .structs import Bits, BitStruct


@dataclass(frozen=True, slots=True)
class Block:
    """Registers that are read in one request."""

    register: int
    """The first one."""
    words: int
    function: int = READ_HOLDING_REGISTERS


@dataclass(frozen=True, slots=True)
class Word[K: Numeric[Any]]:
    """A register that holds one value."""

    register: int
    kind: K


class Registers[T](BitStruct[T]):
    """A block and the table of its contents."""

    def __init__(
        self,
        make: type[T],
        source: str,
        block: Block,
        words: Mapping[str, Word[Any]] | None = None,
    ) -> None:
        """Take a record, where the manual has its table, and the block.

        ``words``: the table by the names of the record's fields, if the record has
        more than one table; else the record states its own bits.
        """
        self.block = block
        self.words = words or {}
        super().__init__(
            make,
            source,
            2 * block.words,
            tuple(self._bits(name, word) for name, word in self.words.items()),
        )

    def _bits(self, name: str, word: Word[Any]) -> Bits:
        last = self.block.register + self.block.words - 1
        low = 16 * (last - word.register)
        return Bits(word.kind.named(name), high=low + 15, low=low)


def words_of(block: Block, data: bytes) -> dict[int, int]:
    """Return the words of a block by their register."""
    return {
        block.register + at // 2: int.from_bytes(data[at : at + 2])
        for at in range(0, len(data) - 1, 2)
    }
