"""The three dialects of a SmartEVSE v2: the contents of their registers, as tables.

Source: README of v2 (registers 0x00A*, 0x00C*, 0x00E*), for the dialect 2.17
corrected by the recorded replies of its firmware, and PROTOCOLS.md, 3. All registers
are unsigned words; currents offered to the car are in 0.1 A, limits of a box or an
installation in A.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, override

from ..fields import Choice, Flag, Number, Numeric, Scaled, known
from ..modbus import READ_HOLDING_REGISTERS, READ_INPUT_REGISTERS
from ..model import Fault, Mode, Setting
from ..registers import Block, Registers, Word

UNITS: Final = range(9)
"""Addresses: 0 (2.17 without load balancing), 1 master, 2 to 8 slaves."""


class Dialect(StrEnum):
    """The register layout of a firmware."""

    V2_17 = "2.17"
    V2_20 = "2.20"
    LATER = "later"
    """Later 2.x, and 3.x."""


# -- Contents ----------------------------------------------------------------------

MODES: Final = (Mode.NORMAL, Mode.SMART, Mode.SOLAR)
"""By the word of the mode."""

FAULTS: Final[Mapping[int, Fault]] = {
    1: Fault.LESS_6A,
    2: Fault.NO_COMM,
    4: Fault.TEMP_HIGH,
    8: Fault.NO_CURRENT,
    16: Fault.RCD,
    32: Fault.NO_SUN,
}
"""By bit of the error register; 64 and 128 are its self-test and back light."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """Contents of a status block."""

    raw_state: str
    """``A`` to ``D``, ``E`` to ``H`` waiting for a master, ``T``, ``B1``, ``C1``."""
    error: int
    """Bits, see `FAULTS`."""
    current: float
    """In force while a car charges, A; ``A6`` / ``0002``."""
    access: bool
    mode: Mode | None = None
    maximum: int | None = None
    """Of cable or box, A; ``None``: no cable was measured yet."""
    minimum: int | None = None
    """A"""
    temperature: int | None = None
    """Degrees Celsius; ``None``: no sensor, or its value is not possible."""
    serial: str | None = None

    @property
    def faults(self) -> frozenset[Fault]:
        """Return the error bits by name."""
        return frozenset(fault for bit, fault in FAULTS.items() if self.error & bit)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Digits(Numeric[str]):
    """A number that is shown as a text."""

    @override
    def value(self, raw: int) -> str:
        return str(raw)

    @override
    def raw(self, value: object) -> int:
        raise self.refused("cannot be written")


_LETTERS: Final = "ABCDEFGH"
_LETTER_STATES: Final = {ord(letter): letter for letter in f"{_LETTERS}T"}
_NUMBER_STATES: Final = {**dict(enumerate(_LETTERS)), 8: "T"}
_LATER_STATES: Final = {**_NUMBER_STATES, 9: "B1", 10: "C1"}

_ERROR: Final = Number(possible=range(0x100))
_CURRENT: Final = Scaled(unit="A", divisor=10)
_MAXIMUM: Final = known(Number(unit="A", possible=range(161)), range(1, 0x10000))
_MODE: Final = Choice(values=dict(enumerate(MODES)))
_KELVIN: Final = known(Number(unit="degrees C", offset=273), range(273 - 60, 273 + 151))
_SERIAL: Final = known(_Digits(), range(1, 0x10000))
_BALANCING: Final = Number(possible=UNITS)


def _status_a0(states: Mapping[int, str]) -> Registers[Status]:
    """Return the status block of 2.17 and 2.20, which differ in the state only."""
    return Registers(
        Status,
        "README of v2, 0x00A*",
        PROBE_A0,
        {
            "raw_state": Word(0xA0, Choice(values=states)),
            "error": Word(0xA1, _ERROR),
            "maximum": Word(0xA2, _MAXIMUM),
            "minimum": Word(0xA3, _amperes(6, 16)),
            "current": Word(0xA6, _CURRENT),
            "access": Word(0xA7, Flag()),
            "mode": Word(0xA8, _MODE),
        },
    )


def _amperes(lowest: int, highest: int) -> Number:
    return Number(unit="A", possible=range(lowest, highest + 1))


def _minutes(lowest: int, highest: int) -> Number:
    return Number(unit="min", possible=range(lowest, highest + 1))


# -- Dialects ----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Map:
    """The registers of a dialect."""

    status: Registers[Status]
    socket: Word[Flag]
    """0 socket, 1 fixed cable."""
    load_balancing: Word[Number]
    """0 disabled, 1 master, else slave."""
    configuration: tuple[Block, ...]
    """Read once per connect and then rarely."""
    settings: Mapping[Setting, Word[Number]]
    """In the EEPROM of the box."""

    @property
    def current_register(self) -> int:
        """Return the register of the charging current."""
        return self.status.words["current"].register

    @property
    def access_register(self) -> int:
        """Return the register of the access bit."""
        return self.status.words["access"].register

    @property
    def mode_register(self) -> int:
        """Return the register of the mode."""
        return self.status.words["mode"].register


def _read(register: int, words: int) -> Block:
    """Return a block; all dialects know 0x04, 2.17 does not know 0x03."""
    return Block(register, words, READ_INPUT_REGISTERS)


PROBE_A0: Final = _read(0xA0, 9)
"""Status of 2.17 and 2.20; the type of the state, letter or number, differs."""
PROBE_A9: Final = Block(0xA9, 3, READ_HOLDING_REGISTERS)
"""Only 2.20 has these, and only from 2.20 on is 0x03 answered."""

MAPS: Final[Mapping[Dialect, Map]] = {
    # Confirmed by the defaults in the replies of its firmware; the README's own tables
    # 0x00C* and 0x00E* are shifted against them from 0xC3 and 0xE5 on.
    Dialect.V2_17: Map(
        status=_status_a0(_LETTER_STATES),
        socket=Word(0xC0, Flag()),
        load_balancing=Word(0xC1, _BALANCING),
        configuration=(_read(0xC0, 9), _read(0xE0, 3)),
        settings={
            Setting.MINIMUM_CURRENT: Word(0xC2, _amperes(6, 16)),
            Setting.MAXIMUM_CURRENT: Word(0xE0, _amperes(6, 80)),
            Setting.MAINS_CURRENT: Word(0xE2, _amperes(10, 100)),
        },
    ),
    Dialect.V2_20: Map(
        status=_status_a0(_NUMBER_STATES),
        socket=Word(0xC0, Flag()),
        load_balancing=Word(0xC1, _BALANCING),
        configuration=(_read(0xC0, 10), _read(0xE0, 3)),
        settings={
            Setting.MINIMUM_CURRENT: Word(0xC2, _amperes(6, 16)),
            Setting.MAXIMUM_CURRENT: Word(0xC3, _amperes(6, 80)),
            Setting.CIRCUIT_CURRENT: Word(0xE0, _amperes(10, 160)),
            Setting.MAINS_CURRENT: Word(0xE2, _amperes(10, 200)),
            Setting.MODE_AT_START: Word(0xE1, Number(possible=range(3))),
            Setting.SOLAR_START_CURRENT: Word(0xC5, _amperes(1, 16)),
            Setting.SOLAR_STOP_TIME: Word(0xC6, _minutes(0, 60)),
            Setting.SOLAR_IMPORT_CURRENT: Word(0xC9, _amperes(0, 6)),
        },
    ),
    Dialect.LATER: Map(
        status=Registers(
            Status,
            "README of later versions, 0x0000",
            _read(0x0000, 12),
            {
                "raw_state": Word(0x0000, Choice(values=_LATER_STATES)),
                "error": Word(0x0001, _ERROR),
                "current": Word(0x0002, _CURRENT),
                "mode": Word(0x0003, _MODE),
                "access": Word(0x0005, Flag()),
                "maximum": Word(0x0007, _MAXIMUM),
                "temperature": Word(0x000A, _KELVIN),
                "serial": Word(0x000B, _SERIAL),
            },
        ),
        socket=Word(0x0100, Flag()),
        load_balancing=Word(0x0104, _BALANCING),
        configuration=(_read(0x0100, 5), _read(0x0200, 8)),
        settings={
            Setting.MINIMUM_CURRENT: Word(0x0102, _amperes(6, 16)),
            Setting.MAXIMUM_CURRENT: Word(0x0103, _amperes(6, 80)),
            Setting.CIRCUIT_CURRENT: Word(0x0201, _amperes(10, 160)),
            Setting.MAINS_CURRENT: Word(0x0204, _amperes(10, 200)),
            Setting.MODE_AT_START: Word(0x0200, Number(possible=range(3))),
            # The word less 16 is an import; ours is an export, as in 2.20.
            Setting.SOLAR_START_CURRENT: Word(
                0x0205, Number(unit="A", possible=range(33), offset=16, sign=-1)
            ),
            Setting.SOLAR_STOP_TIME: Word(0x0206, _minutes(0, 60)),
            Setting.SOLAR_IMPORT_CURRENT: Word(
                0x0207, Number(unit="A", possible=range(97), offset=48)
            ),
        },
    ),
}
