"""The three dialects of a SmartEVSE v2: which register has what.

Tables. Source: README of v2 (registers 0x00A*, 0x00C*, 0x00E*), for the dialect 2.17
corrected by what its firmware really answered, and PROTOCOLS.md, 3. All registers are
unsigned words; currents that go to the car are in 0.1 A, those that limit a box or an
installation in A.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from ..errors import RefusedOrderError
from ..modbus import READ_HOLDING_REGISTERS, READ_INPUT_REGISTERS
from ..model import Fault, Mode, Range, Setting


class Dialect(StrEnum):
    """What the registers of a firmware look like."""

    V2_17 = "2.17"
    V2_20 = "2.20"
    LATER = "later"
    """FollowUp 2.x, and 3.x."""


@dataclass(frozen=True, slots=True)
class Block:
    """Registers that are read in one request."""

    register: int
    count: int
    function: int = READ_INPUT_REGISTERS
    """All dialects know 0x04; 2.17 does not know 0x03."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """A setting in the box's EEPROM."""

    register: int
    minimum: int
    """Lowest word it takes."""
    maximum: int
    """Highest word it takes."""
    offset: int = 0
    sign: int = 1

    def value(self, word: int) -> int:
        """Return what a word means."""
        return self.sign * (word - self.offset)

    def word(self, value: int) -> int:
        """Return the word that means a value; RefusedOrderError: none does."""
        word = self.sign * value + self.offset
        if not self.minimum <= word <= self.maximum:
            span = self.range
            message = f"{value} is not within {span.minimum} to {span.maximum}"
            raise RefusedOrderError(message)
        return word

    @property
    def range(self) -> Range:
        """Return from where to where it can be set."""
        ends = sorted((self.value(self.minimum), self.value(self.maximum)))
        return Range(*ends)


@dataclass(frozen=True, slots=True, kw_only=True)
class Map:
    """Where a dialect has what: words of the status block, registers to write."""

    status: Block
    states: Mapping[int, str]
    """By the word that tells the state."""
    error: int
    current: int
    access: int
    mode: int
    maximum: int
    minimum: int | None = None
    temperature: int | None = None
    serial: int | None = None
    current_register: int
    access_register: int
    mode_register: int
    socket: int
    """Register: 0 socket, 1 fixed cable."""
    load_balancing: int
    """Register: 0 disabled, 1 master, else slave."""
    configuration: tuple[Block, ...]
    """What is read once per connect and then rarely."""
    settings: Mapping[Setting, Kept]


_LETTERS: Final = "ABCDEFGH"
_NUMBERS: Final = {
    **dict(enumerate(_LETTERS)),
    8: "T",
}

_A0: Final = 0xA0

PROBE_A0: Final = Block(_A0, 9)
"""Status of 2.17 and 2.20; the state as a letter or as a number tells which."""
PROBE_A9: Final = Block(0xA9, 3, READ_HOLDING_REGISTERS)
"""Only 2.20 has these, and only from 2.20 on 0x03 is answered."""

MAPS: Final[Mapping[Dialect, Map]] = {
    # Confirmed by the defaults that its firmware answers; the README's own tables
    # 0x00C* and 0x00E* are shifted against them from 0xC3 and 0xE5 on.
    Dialect.V2_17: Map(
        status=PROBE_A0,
        states={ord(letter): letter for letter in f"{_LETTERS}T"},
        error=1,
        maximum=2,
        minimum=3,
        current=6,
        access=7,
        mode=8,
        current_register=0xA6,
        access_register=0xA7,
        mode_register=0xA8,
        socket=0xC0,
        load_balancing=0xC1,
        configuration=(Block(0xC0, 9), Block(0xE0, 3)),
        settings={
            Setting.MINIMUM_CURRENT: Kept(register=0xC2, minimum=6, maximum=16),
            Setting.MAXIMUM_CURRENT: Kept(register=0xE0, minimum=6, maximum=80),
            Setting.MAINS_CURRENT: Kept(register=0xE2, minimum=10, maximum=100),
        },
    ),
    Dialect.V2_20: Map(
        status=PROBE_A0,
        states=_NUMBERS,
        error=1,
        maximum=2,
        minimum=3,
        current=6,
        access=7,
        mode=8,
        current_register=0xA6,
        access_register=0xA7,
        mode_register=0xA8,
        socket=0xC0,
        load_balancing=0xC1,
        configuration=(Block(0xC0, 10), Block(0xE0, 3)),
        settings={
            Setting.MINIMUM_CURRENT: Kept(register=0xC2, minimum=6, maximum=16),
            Setting.MAXIMUM_CURRENT: Kept(register=0xC3, minimum=6, maximum=80),
            Setting.CIRCUIT_CURRENT: Kept(register=0xE0, minimum=10, maximum=160),
            Setting.MAINS_CURRENT: Kept(register=0xE2, minimum=10, maximum=200),
            Setting.MODE_AT_START: Kept(register=0xE1, minimum=0, maximum=2),
            Setting.SOLAR_START_CURRENT: Kept(register=0xC5, minimum=1, maximum=16),
            Setting.SOLAR_STOP_TIME: Kept(register=0xC6, minimum=0, maximum=60),
            Setting.SOLAR_IMPORT_CURRENT: Kept(register=0xC9, minimum=0, maximum=6),
        },
    ),
    Dialect.LATER: Map(
        status=Block(0x0000, 12),
        states={**_NUMBERS, 9: "B1", 10: "C1"},
        error=1,
        current=2,
        mode=3,
        access=5,
        maximum=7,
        temperature=10,
        serial=11,
        current_register=0x0002,
        access_register=0x0005,
        mode_register=0x0003,
        socket=0x0100,
        load_balancing=0x0104,
        configuration=(Block(0x0100, 5), Block(0x0200, 8)),
        settings={
            Setting.MINIMUM_CURRENT: Kept(register=0x0102, minimum=6, maximum=16),
            Setting.MAXIMUM_CURRENT: Kept(register=0x0103, minimum=6, maximum=80),
            Setting.CIRCUIT_CURRENT: Kept(register=0x0201, minimum=10, maximum=160),
            Setting.MAINS_CURRENT: Kept(register=0x0204, minimum=10, maximum=200),
            Setting.MODE_AT_START: Kept(register=0x0200, minimum=0, maximum=2),
            # The word less 16 is an import; ours is an export, as in 2.20.
            Setting.SOLAR_START_CURRENT: Kept(
                register=0x0205, minimum=0, maximum=32, offset=16, sign=-1
            ),
            Setting.SOLAR_STOP_TIME: Kept(register=0x0206, minimum=0, maximum=60),
            Setting.SOLAR_IMPORT_CURRENT: Kept(
                register=0x0207, minimum=0, maximum=96, offset=48
            ),
        },
    ),
}

MODES: Final = (Mode.NORMAL, Mode.SMART, Mode.SOLAR)
"""By the word that tells the mode."""

FAULTS: Final[Mapping[int, Fault]] = {
    1: Fault.LESS_6A,
    2: Fault.NO_COMM,
    4: Fault.TEMP_HIGH,
    8: Fault.NO_CURRENT,
    16: Fault.RCD,
    32: Fault.NO_SUN,
}
"""By bit of the error register; 64 and 128 are its test and its back light."""
