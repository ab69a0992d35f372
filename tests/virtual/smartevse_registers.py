"""The registers of the SmartEVSE dialects, as tables.

The C and E tables of the manual do not match the recorded firmware; the order here is
that of the recording. 3.x was read in its sources (main.h, main.cpp, modbus.cpp), not
recorded; the sources are four lines of versions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from .smartevse_frames import (
    LONGEST,
    READ_HOLDING,
    READ_INPUT,
    WRITE_ONE,
    WRITE_SEVERAL,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

NORMAL, SMART, SOLAR = range(3)
DISABLED, MASTER = range(2)
ACCESS_BUTTON, ACCESS_SWITCH = 1, 2

LESS_6A, NO_COMM, TEMP_HIGH, NO_CURRENT, RCD, NO_SUN = (1 << bit for bit in range(6))


@dataclass(frozen=True, slots=True)
class Setting:
    """A stored setting: name, range and factory value."""

    name: str
    low: int
    high: int
    default: int = 0


@dataclass(frozen=True, slots=True)
class Block:
    """Registers in a row: status (names only) or stored settings."""

    start: int
    items: tuple[str | Setting, ...]

    def find(self, register: int, count: int) -> tuple[str | Setting, ...] | None:
        """Return the items of these registers, or None if not all are in the block."""
        first = register - self.start
        if 0 <= first < len(self.items) and first + count <= len(self.items):
            return self.items[first : first + count]
        return None


@dataclass(frozen=True, slots=True)
class Version3:
    """The habits of one line of 3.x versions, as a node.

    `access_stored`: access is in the flash memory, written at each change;
    `highest_access`: values above it are answered and ignored (None: unchecked);
    `celsius`: else the temperature is in K; `no_comm`: the count of seconds without a
    broadcast, which is checked before it is decremented; `no_comm_in_normal`: also in
    mode normal. What the sources do not settle for each line: `mode_opens_access` (a
    changed mode word), `mode_stored`, `settings_open_access`, `pilot_cut` (seconds that
    B1 cuts the pilot if access is on), `modem` (seconds in each of the states 11, 12
    and 13 of a new car before it asks; 0: none. The newest source has them for boxes
    without a master only).
    """

    access_stored: bool = True
    highest_access: int | None = None
    celsius: bool = True
    no_comm: int = 11
    no_comm_in_normal: bool = True
    mode_opens_access: bool = True
    mode_stored: bool = True
    settings_open_access: bool = False
    pilot_cut: int = 5
    modem: int = 0


@dataclass(frozen=True, slots=True)
class Dialect:
    """The frames and registers of one firmware.

    `unit_when_disabled`: its address without load balancing; `gentle`: it stops the car
    by the pilot (C1, B1) before it opens the contactor; `external_master`: requests of
    another master stop its own cycle; `reports_cable`: its maximum is that of the cable
    alone (traces, `normal`); `measures`: it searches for the smallest current of each
    car first, and ignores the override meanwhile (trace of HEAD, `first_minutes`);
    `balance_register`: for the charge currents that a master broadcasts; `polled`: the
    registers that it reads at its nodes; `silent`: write-only registers without a
    reply; `version3`: 3.x, which differs in much more; `mains_words`: currents of the
    mains that the broadcast of a master has behind those of the nodes; `longest`: frame
    that it receives, in bytes.
    """

    name: str
    functions: tuple[int, ...]
    unit_when_disabled: int
    broadcast_unit: int
    balance_register: int
    units: int
    states: Mapping[str, int]
    blocks: tuple[Block, ...]
    silent: frozenset[int]
    gentle: bool = False
    external_master: bool = False
    status_writable: bool = True
    reports_cable: bool = False
    measures: bool = False
    polled: tuple[int, int] | None = None
    version3: Version3 | None = None
    mains_words: int = 0
    longest: int = LONGEST

    def find(self, register: int, count: int) -> tuple[str | Setting, ...] | None:
        """Return the items of these registers, or None for an unmapped one."""
        for block in self.blocks:
            found = block.find(register, count)
            if found is not None:
                return found
        return None

    @property
    def settings(self) -> dict[str, Setting]:
        """Return all stored settings by name."""
        everything = (item for block in self.blocks for item in block.items)
        return {s.name: s for s in everything if isinstance(s, Setting)}

    def register_of(self, name: str) -> int:
        """Return the register of a status item or a setting."""
        for block in self.blocks:
            for index, item in enumerate(block.items):
                if name == (item.name if isinstance(item, Setting) else item):
                    return block.start + index
        raise KeyError(name)


CONFIG = Setting("config", 0, 1)
MIN_CURRENT = Setting("min_current", 6, 16, 6)
MAX_CURRENT = Setting("max_current", 6, 80, 13)
LOCK = Setting("lock", 0, 2)
STOP_TIME = Setting("stop_time", 0, 60, 10)
STOP_TIME_2_17 = Setting("stop_time", 0, 60)
SWITCH = Setting("switch", 0, 4)
RC_MONITOR = Setting("rc_monitor", 0, 1)
MODE = Setting("mode", 0, 2)
GRID = Setting("grid", 0, 1)
MEASURES = Setting("mains_measures", 0, 1)
ORDER = Setting("custom_order", 0, 3)


def _meter(name: str, address: int, kinds: int, lowest: int) -> tuple[Setting, Setting]:
    return (
        Setting(f"{name}_meter", 0, kinds),
        Setting(f"{name}_address", lowest, 255 if lowest < 10 else 247, address),
    )


def _custom(*names: str) -> tuple[Setting, ...]:
    return tuple(
        Setting(f"custom_{name}", 0, 8 if name.endswith("divisor") else 65530)
        for name in names
    )


_CUSTOM_2_20 = _custom(
    "current",
    "current_divisor",
    "voltage",
    "voltage_divisor",
    "power",
    "power_divisor",
    "energy",
    "energy_divisor",
)
# F and G wait for the master to grant B and C; F+ and G+ are granted.
_LATER_STATES = ("A", "B", "C", "D", "F", "F+", "G", "G+", "T", "B1", "C1")

V2_17 = Dialect(
    name="2.17",
    functions=(READ_INPUT, WRITE_ONE, WRITE_SEVERAL),
    unit_when_disabled=0,
    broadcast_unit=0,
    balance_register=0x01,
    units=4,
    # E to H wait for the master: E for A, F for B, G for C, H for C to B.
    states={letter: ord(letter) for letter in "ABCDEFGHT"},
    blocks=(
        Block(
            0xA0,
            (
                "state",
                "error",
                "cable",
                "minimum",
                "phases",
                "real_current",
                "current",
                "access",
                "mode_now",
            ),
        ),
        Block(
            0xC0,
            (
                CONFIG,
                Setting("load_balance", 0, 4),
                MIN_CURRENT,
                Setting("circuit", 10, 80, 16),
                LOCK,
                Setting("start_current", 1, 16, 4),
                STOP_TIME_2_17,
                Setting("import_current", 0, 6),
                SWITCH,
            ),
        ),
        Block(
            0xE0,
            (
                MAX_CURRENT,
                MODE,
                Setting("mains", 10, 100, 25),
                Setting("calibration", 30, 200, 100),
                Setting("mains_meter", 1, 5, 0),
                GRID,
                Setting("mains_address", 5, 255, 10),
                MEASURES,
                *_meter("pv", 11, 5, 5),
                ORDER,
                Setting("custom_current", 0, 255),
            ),
        ),
    ),
    silent=frozenset((*range(0x01, 0x05), *range(0x81, 0x85))),
    status_writable=False,
)

V2_20 = Dialect(
    name="2.20",
    functions=(READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_SEVERAL),
    unit_when_disabled=0,
    broadcast_unit=9,
    balance_register=0x01,
    units=8,
    states={name: index for index, name in enumerate(_LATER_STATES[:9])},
    blocks=(
        Block(
            0xA0,
            (
                "state",
                "error",
                "cable",
                "minimum",
                "phases",
                "real_current",
                "current",
                "access",
                "mode_now",
                "ev_meter_now",
                "ev_address_now",
                "solar_timer",
            ),
        ),
        Block(
            0xC0,
            (
                CONFIG,
                Setting("load_balance", 0, 8),
                MIN_CURRENT,
                MAX_CURRENT,
                LOCK,
                Setting("start_current", 1, 16, 4),
                STOP_TIME,
                SWITCH,
                RC_MONITOR,
                Setting("import_current", 0, 6),
                Setting("rfid", 0, 4),
                *_meter("ev", 12, 9, 10),
            ),
        ),
        Block(
            0xE0,
            (
                Setting("circuit", 10, 160, 16),
                MODE,
                Setting("mains", 10, 200, 25),
                Setting("calibration", 307, 2048, 1024),
                Setting("mains_meter", 1, 9, 0),
                Setting("mains_address", 10, 247, 10),
                MEASURES,
                *_meter("pv", 11, 9, 10),
                ORDER,
                *_CUSTOM_2_20,
                GRID,
                Setting("custom_double", 0, 1),
            ),
        ),
    ),
    silent=frozenset({0x01}),
    polled=(0xA0, 11),
)

_STATUS_LATER = Block(
    0x0000,
    (
        "state",
        "error",
        "current",
        "mode_now",
        "solar_timer",
        "access",
        "config_changed",
        "maximum",
        "phases",
        "real_current",
        "temperature",
        "serial",
    ),
)
_BOX_LATER = Block(
    0x0100,
    (
        CONFIG,
        LOCK,
        MIN_CURRENT,
        MAX_CURRENT,
        Setting("load_balance", 0, 8),
        SWITCH,
        RC_MONITOR,
        Setting("rfid", 0, 5),
        *_meter("ev", 12, 9, 10),
    ),
)


def _system_later(start: Setting, imported: Setting, *more: Setting) -> Block:
    return Block(
        0x0200,
        (
            MODE,
            Setting("circuit", 10, 160, 16),
            GRID,
            Setting("calibration", 307, 2048, 1024),
            Setting("mains", 10, 200, 25),
            start,
            STOP_TIME,
            imported,
            Setting("mains_meter", 1, 9, 0),
            Setting("mains_address", 10, 247, 10),
            MEASURES,
            *_meter("pv", 11, 9, 10),
            ORDER,
            Setting("custom_type", 0, 2),
            Setting("custom_function", 3, 4, 4),
            *_custom(
                "voltage",
                "voltage_divisor",
                "current",
                "current_divisor",
                "power",
                "power_divisor",
                "energy",
                "energy_divisor",
            ),
            Setting("custom_longest", 3, 255, 0),
            *more,
        ),
    )


V2_30 = Dialect(
    name="2.30",
    functions=(READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_SEVERAL),
    unit_when_disabled=1,
    broadcast_unit=9,
    balance_register=0x20,
    units=8,
    states={name: index for index, name in enumerate(_LATER_STATES[:9])},
    blocks=(
        _STATUS_LATER,
        _BOX_LATER,
        _system_later(
            Setting("start_current", 1, 16, 4), Setting("import_current", 0, 6, 0)
        ),
    ),
    silent=frozenset(),
    external_master=True,
    polled=(0x0000, 8),
    reports_cable=True,
)

HEAD = Dialect(
    name="2.30+",
    functions=(READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_SEVERAL),
    unit_when_disabled=1,
    broadcast_unit=9,
    balance_register=0x20,
    units=8,
    states={name: index for index, name in enumerate(_LATER_STATES)},
    blocks=(
        _STATUS_LATER,
        _BOX_LATER,
        _system_later(
            # Ampere + 16, ampere + 48.
            Setting("start_current", 0, 32, 12),
            Setting("import_current", 0, 96, 48),
            Setting("wifi", 0, 2),
            Setting("capacity", 9, 200, 9),
        ),
    ),
    silent=frozenset(),
    gentle=True,
    external_master=True,
    polled=(0x0000, 8),
    measures=True,
)


# -- 3.x ---------------------------------------------------------------------------

# States 11 to 14: a modem (ISO 15118) requests, waits, is done, was denied.
_MODEM_STATES = ("M1", "M2", "M3", "M4")
_SWITCH_3 = Setting("switch", 0, 7)
# What the words from 0x020A on mean differs between the lines; never used here.
_REST_3 = tuple(Setting(f"rest_{number:02}", 0, 0xFFFF) for number in range(16))


def _system_3(words: int) -> Block:
    """Return the block 0x0200 of 22 or 26 words."""
    block = (
        MODE,
        Setting("circuit", 10, 160, 16),
        GRID,
        Setting("sensorbox_wifi", 0, 2),
        Setting("mains", 10, 200, 25),
        Setting("start_current", 0, 48, 4),
        STOP_TIME,
        Setting("import_current", 0, 48, 0),
        Setting("mains_meter", 0, 0xFF, 0),
        Setting("mains_address", 10, 247, 10),
        *_REST_3,
    )
    return Block(0x0200, block[:words])


def _dialect_3(
    name: str, version3: Version3, *, system: int, broadcast: int
) -> Dialect:
    """Return a line of 3.x; `system`: words of 0x0200; `broadcast`: of its master's."""
    box = tuple(_SWITCH_3 if one is SWITCH else one for one in _BOX_LATER.items)
    return Dialect(
        name=name,
        functions=(READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_SEVERAL),
        unit_when_disabled=1,
        broadcast_unit=9,
        balance_register=0x20,
        units=8,
        states={n: index for index, n in enumerate((*_LATER_STATES, *_MODEM_STATES))},
        blocks=(_STATUS_LATER, Block(0x0100, box), _system_3(system)),
        silent=frozenset(),
        gentle=True,
        polled=(0x0000, 8),
        version3=version3,
        mains_words=broadcast - 8,
        longest=256,
    )


_FIRST_3 = Version3(
    access_stored=False, highest_access=1, celsius=False, no_comm=10, mode_stored=False
)
# The first 3.x; the line of Serkri; 3.5 and 3.6, of which only the time-out was read
# (access and maximum could be as before or after); 3.8; the one of 2026.
V3_00 = replace(
    _dialect_3("3.00", _FIRST_3, system=26, broadcast=8), reports_cable=True
)
V3_SERKRI = replace(
    _dialect_3(
        "3-serkri",
        replace(_FIRST_3, celsius=True, no_comm_in_normal=False),
        system=26,
        broadcast=8,
    ),
    reports_cable=True,
)
V3_6 = _dialect_3(
    "3.6", Version3(no_comm=10, no_comm_in_normal=False), system=26, broadcast=11
)
V3_8 = _dialect_3("3.8", Version3(), system=26, broadcast=11)
V3 = _dialect_3("3", Version3(), system=22, broadcast=11)
LINES_3 = (V3_00, V3_SERKRI, V3_6, V3_8, V3)

DIALECTS = {dialect.name: dialect for dialect in (V2_17, V2_20, V2_30, HEAD, *LINES_3)}
