"""The six dialects of a SmartEVSE: registers, states and habits, as tables.

Source: README of v2 (registers 0x00A*, 0x00C*, 0x00E*), for 2.17 to HEAD corrected by
the recorded replies of the firmwares, for 3.x its source as read, and PROTOCOLS.md, 3.
All registers are unsigned words; currents offered to the car are in 0.1 A, limits of a
box or an installation in A.

A word that a firmware newer than these tables may use differently is ``None`` where its
value is not known, and stays visible in the details. Only what distinguishes a status
from other contents (the state of 2.17 and 2.20, a minimum, a setting) is required.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import inf
from typing import Final, override

from ..fields import Choice, Flag, Number, Numeric, Scaled, known
from ..modbus import READ_HOLDING_REGISTERS, READ_INPUT_REGISTERS
from ..model import Fault, Mode, Setting
from ..registers import Block, Registers, Word

UNITS: Final = range(9)
"""Addresses: 0 (2.17 without load balancing), 1 master, 2 to 8 slaves."""
SLAVES: Final = range(2, 9)
"""Addresses of boxes with a master; a dialect may have fewer (`Balancing.units`)."""


class Dialect(StrEnum):
    """The register layout and the habits of a firmware."""

    V2_17 = "2.17"
    V2_20 = "2.20"
    V2_30 = "2.30"
    V2_HEAD = "2.30+"
    """After 2.30, never released; its display says 2.30 as well."""
    V3_OLD = "3.x-26"
    """3.x with a block 0x0200 of 26 words; perhaps without a time-out of its own."""
    V3 = "3.x"
    """3.x with a block 0x0200 of 22 words."""


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
_FAULTS_3: Final = {
    bit: fault for bit, fault in FAULTS.items() if fault is not Fault.NO_SUN
}
"""3.x: 32 is the test of the residual current monitor in newer ones, no sun in older
ones; which one cannot be told."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """Contents of a status block."""

    raw_state: str
    """``A`` to ``D``, ``E`` to ``H`` waiting for a master, ``T``, ``B1``, ``C1``; the
    number of a state that is not known."""
    error: int
    """Bits, see `FAULTS`."""
    current: float
    """In force while a car charges, A; ``A6`` / ``0002``."""
    access: bool | None
    """``None``: a value that is not known."""
    mode: Mode | None = None
    maximum: int | None = None
    """Of cable or box, A; ``None``: no cable was measured yet."""
    minimum: int | None = None
    """A"""
    temperature: int | None = None
    """Degrees Celsius; ``None``: no sensor, or its value is not possible."""
    serial: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Digits(Numeric[str]):
    """A number that is shown as a text."""

    @override
    def value(self, raw: int) -> str:
        return str(raw)

    @override
    def raw(self, value: object) -> int:
        raise self.refused("cannot be written")


@dataclass(frozen=True, slots=True, kw_only=True)
class _StateName(Numeric[str]):
    """The number of a state; one without a name keeps its number."""

    names: Mapping[int, str]

    @override
    def value(self, raw: int) -> str:
        return self.names.get(raw, str(raw))

    @override
    def raw(self, value: object) -> int:
        raise self.refused("cannot be written")


_LETTERS: Final = "ABCDEFGH"
ASKS_FOR_B: Final = "E"
"""From 2.20 on: it waits for its master, and has its contactor open."""
ASKS_FOR_C: Final = "G"
"""Likewise: a car wants current."""
_LETTER_STATES: Final = {ord(letter): letter for letter in f"{_LETTERS}T"}
_NUMBER_STATES: Final = {**dict(enumerate(_LETTERS)), 8: "T"}
_LATER_STATES: Final = {**_NUMBER_STATES, 9: "B1", 10: "C1"}
STATE_NUMBERS: Final[Mapping[str, int]] = {
    name: number for number, name in _LATER_STATES.items()
}
"""From 2.20 on."""
MODEM_STATES: Final = range(11, 15)
"""3.x with a modem (ISO 15118): requests, waits, done, denied."""

_ERROR: Final = Number()
_CURRENT: Final = Scaled(unit="A", divisor=10)
_MAXIMUM: Final = known(Number(unit="A"), range(1, 161))
_MODE: Final = known(Choice(values=dict(enumerate(MODES))), range(len(MODES)))
_ACCESS: Final = known(Flag(), range(2))
_ACCESS_3: Final = known(Choice(values={0: False, 1: True, 2: False}), range(3))
"""2: paused, which waits for a new 1 as 0 does."""
_POSSIBLE: Final = range(-60, 151)
"""Temperatures in degrees C."""
_KELVIN: Final = known(
    Number(unit="degrees C", offset=273),
    range(273 + _POSSIBLE.start, 273 + _POSSIBLE.stop),
)
_SERIAL: Final = known(_Digits(), range(1, 0x10000))
_BALANCING: Final = Number(possible=UNITS)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Celsius(Numeric[int | None]):
    """A signed temperature; the first 3.x report it in K, from 213."""

    @override
    def value(self, raw: int) -> int | None:
        if raw in _KELVIN.within:
            return raw - 273
        signed = raw - 0x10000 if raw >> 15 else raw
        return signed if signed in _POSSIBLE else None

    @override
    def raw(self, value: object) -> int:
        raise self.refused("cannot be written")


def _status_a0(states: Mapping[int, str], words: int = 9) -> Registers[Status]:
    """Return the status block of 2.17 and 2.20, which differ in the state only.

    ``words``: its length; the meter address and the solar timer, at the end of a
    longer one, are not used.
    """
    return Registers(
        Status,
        "README of v2, 0x00A*",
        _read(0xA0, words),
        {
            "raw_state": Word(0xA0, Choice(values=states)),
            "error": Word(0xA1, _ERROR),
            "maximum": Word(0xA2, _MAXIMUM),
            "minimum": Word(0xA3, _amperes(6, 16)),
            "current": Word(0xA6, _CURRENT),
            "access": Word(0xA7, _ACCESS),
            "mode": Word(0xA8, _MODE),
        },
    )


def _status_0000(
    temperature: Numeric[int | None], access: Numeric[bool | None], words: int = 12
) -> Registers[Status]:
    """Return the status block of 2.30 and later, or so many words of it."""
    table: dict[str, Word[Numeric[object]]] = {
        "raw_state": Word(0x0000, _StateName(names=_LATER_STATES)),
        "error": Word(0x0001, _ERROR),
        "current": Word(0x0002, _CURRENT),
        "mode": Word(0x0003, _MODE),
        "access": Word(0x0005, access),
        "maximum": Word(0x0007, _MAXIMUM),
        "temperature": Word(0x000A, temperature),
        "serial": Word(0x000B, _SERIAL),
    }
    return Registers(
        Status,
        "README of later versions, 0x0000",
        _read(0x0000, words),
        {name: word for name, word in table.items() if word.register < words},
    )


def _amperes(lowest: int, highest: int) -> Number:
    return Number(unit="A", possible=range(lowest, highest + 1))


def _minutes(lowest: int, highest: int) -> Number:
    return Number(unit="min", possible=range(lowest, highest + 1))


# -- Load balancing ----------------------------------------------------------------

STOPS_ALONE: Final = 12.0
"""Time without a broadcast after which a box has stopped by itself, s (seen after
10.7 to 11.1, counted from the last broadcast on the line)."""
STOPS_GENTLY: Final = 20.0
"""Likewise, where NO_COMM comes after up to 12 s, and C1 holds the contactor of a car that
keeps its request for up to 7 s more."""
OPENS_WITHIN: Final = 3.0
"""Time in which a box that receives a stop obeys it, s (seen after 0.4 s)."""
OPENS_GENTLY_WITHIN: Final = 9.0
"""Likewise, with C1."""


class Family(StrEnum):
    """The dialects that one broadcast of currents is for.

    One master has boxes of one family: the broadcast of 2.20 covers error, mode and
    access of a later box.
    """

    V2_17 = "2.17"
    V2_20 = "2.20"
    LATER = "2.30"
    """2.30, what came after it, and 3.x."""


class Handshake(StrEnum):
    """How a box that wants current asks its master for it."""

    REQUESTS = "requests"
    """It writes to its master (`balancing.SlaveRequest`)."""
    POLLED = "polled"
    """It waits in a state (4 for B, 6 for C) until the master has read that."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Balancing:
    """The habits of a dialect as a node of a load-balancing master.

    Source: sections ``node*``, ``two_nodes`` and ``makers_master`` of the recorded
    firmwares; for 3.x its source as read. PROTOCOLS.md, 3.
    """

    family: Family
    units: range
    """Addresses of its nodes."""
    broadcast_unit: int
    broadcast_register: int
    currents: int
    """Values of a broadcast, for units 1, 2 and so on."""
    handshake: Handshake
    status: Registers[Status]
    """The block that its master polls; a longer one (`Map.status`) has more."""
    zero_stops: bool
    """A 0 in the broadcast opens its contactor; else it offers 6 A then."""
    opens_within: float
    """Longest time from a stop that it has received to an open contactor, s."""
    stops_after: float
    """Longest time without a broadcast after which no current flows, s; inf: it may go
    on for ever."""
    access_ends_request: bool
    """Without access it does not go on asking."""
    access_is_volatile: bool
    """Access is on again after a power failure. Else it is in the flash memory, and
    not written for a pause."""

    @property
    def fail_safe_proven(self) -> bool:
        """Return whether it is known to stop without a broadcast."""
        return self.stops_after < inf


# -- Dialects ----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Map:
    """The registers of a dialect."""

    status: Registers[Status]
    balancing: Balancing
    socket: Word[Flag]
    """0 socket, 1 fixed cable."""
    load_balancing: Word[Number]
    """0 disabled, 1 master, else slave."""
    configuration: tuple[Block, ...]
    """Read once per connect and then rarely."""
    settings: Mapping[Setting, Word[Number]]
    """In the EEPROM of the box."""
    faults: Mapping[int, Fault] = field(default_factory=lambda: FAULTS)
    """By bit of the error register."""
    needs_quiet: bool = False
    """A request on the line, to any address, suspends its own cycle."""
    search_time: float = 0.0
    """Without a master, it ignores its limit for this long from the first charge of
    each car, s: it searches for the smallest current."""
    search_current: float = 0.0
    """The highest current of this search, A."""
    reports_maximum: bool = False
    """Its status has the smaller of cable and MAX, not that of the cable alone."""
    begins_at_0: bool = False
    """Without a master, a charge begins at the maximum while the current reads 0."""
    shows_plug: bool = False
    """A plugged car without access is B1, and one that an error has stopped too; the
    others report A for both."""

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

PROBE_HEAD: Final = _read(0x021A, 1)
"""Refused by 2.30, answered by what came after it."""
PROBE_V3_OLD: Final = _read(0x0216, 1)
"""Refused by 3.x with a block 0x0200 of 22 words, answered by those with 26."""


_NODE: Final = Balancing(
    family=Family.LATER,
    units=SLAVES,
    broadcast_unit=9,
    broadcast_register=0x0020,
    currents=8,
    handshake=Handshake.POLLED,
    status=_status_0000(_KELVIN, _ACCESS, words=8),
    zero_stops=True,
    opens_within=OPENS_WITHIN,
    stops_after=STOPS_ALONE,
    access_ends_request=True,
    access_is_volatile=True,
)
_GENTLE_NODE: Final = replace(
    _NODE,
    opens_within=OPENS_GENTLY_WITHIN,
    stops_after=STOPS_GENTLY,
    # Only B and C are left for B1 and C1.
    access_ends_request=False,
)
_NODE_3: Final = replace(
    _GENTLE_NODE,
    status=_status_0000(_KELVIN, _ACCESS_3, words=8),
    access_is_volatile=False,
)


def _later(
    status: Registers[Status],
    balancing: Balancing,
    *,
    start: Number,
    imported: Number,
) -> Map:
    """Return the row of a dialect whose status is at 0x0000.

    ``start``, ``imported``: the words of START and IMPORT.
    """
    return Map(
        status=status,
        balancing=balancing,
        socket=Word(0x0100, Flag()),
        load_balancing=Word(0x0104, _BALANCING),
        configuration=(_read(0x0100, 5), _read(0x0200, 8)),
        settings={
            Setting.MINIMUM_CURRENT: Word(0x0102, _amperes(6, 16)),
            Setting.MAXIMUM_CURRENT: Word(0x0103, _amperes(6, 80)),
            Setting.CIRCUIT_CURRENT: Word(0x0201, _amperes(10, 160)),
            Setting.MAINS_CURRENT: Word(0x0204, _amperes(10, 200)),
            Setting.MODE_AT_START: Word(0x0200, Number(possible=range(3))),
            Setting.SOLAR_START_CURRENT: Word(0x0205, start),
            Setting.SOLAR_STOP_TIME: Word(0x0206, _minutes(0, 60)),
            Setting.SOLAR_IMPORT_CURRENT: Word(0x0207, imported),
        },
        needs_quiet=True,
    )


_VERSION_3: Final = replace(
    _later(
        _status_0000(_Celsius(unit="degrees C"), _ACCESS_3),
        _NODE_3,
        start=_amperes(0, 48),
        imported=_amperes(0, 48),
    ),
    # As a node it has no cycle of its own, but one that is polled may need the quiet.
    # With an ESP32 it answers as a node only.
    faults=_FAULTS_3,
    shows_plug=True,
)

MAPS: Final[Mapping[Dialect, Map]] = {
    # Confirmed by the defaults in the replies of its firmware; the README's own tables
    # 0x00C* and 0x00E* are shifted against them from 0xC3 and 0xE5 on.
    Dialect.V2_17: Map(
        status=_status_a0(_LETTER_STATES),
        balancing=Balancing(
            family=Family.V2_17,
            units=range(2, 5),
            broadcast_unit=0,
            broadcast_register=0x0001,
            currents=4,
            handshake=Handshake.REQUESTS,
            status=_status_a0(_LETTER_STATES),
            zero_stops=False,
            opens_within=OPENS_WITHIN,
            stops_after=STOPS_ALONE,
            access_ends_request=True,
            access_is_volatile=True,
        ),
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
        balancing=replace(
            _NODE,
            family=Family.V2_20,
            broadcast_register=0x0001,
            status=_status_a0(_NUMBER_STATES, words=11),
        ),
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
    Dialect.V2_30: _later(
        _status_0000(_KELVIN, _ACCESS),
        _NODE,
        start=_amperes(1, 16),
        imported=_amperes(0, 6),
    ),
    Dialect.V2_HEAD: replace(
        _later(
            _status_0000(_KELVIN, _ACCESS),
            _GENTLE_NODE,
            # The word less 16 is an import; ours is an export, as in 2.20.
            start=Number(unit="A", possible=range(33), offset=16, sign=-1),
            imported=Number(unit="A", possible=range(97), offset=48),
        ),
        reports_maximum=True,
        search_time=90.0,
        search_current=8.0,
        begins_at_0=True,
        shows_plug=True,
    ),
    # Before 3.7.4 it does not stop without a master in mode normal; which version it is
    # cannot be read.
    Dialect.V3_OLD: replace(_VERSION_3, balancing=replace(_NODE_3, stops_after=inf)),
    Dialect.V3: _VERSION_3,
}
FAMILIES: Final[Mapping[Family, Balancing]] = {
    row.balancing.family: row.balancing for row in MAPS.values()
}
"""A row of each family; what is broadcast is the same in all of them."""
VERSION_3: Final = frozenset({Dialect.V3_OLD, Dialect.V3})
LATER: Final = frozenset(Dialect) - {Dialect.V2_17, Dialect.V2_20}
"""The dialects whose status is at 0x0000."""
