"""The vocabulary of all parts: orders, limits, commands, configuration.

Units throughout: ampere, volt, watt, watt-hour, second. ``None`` means "not known":
no value is made up for what is not on the wire, and 0 is always a measured 0.

This module imports nothing of the project and nothing of Home Assistant.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from typing import ClassVar

MINIMUM_CURRENT = 6.0
"""Lowest current a charger can offer a car, A (IEC 61851-1, annex A)."""

MAXIMUM_CURRENT = 80.0
"""Highest current a control pilot can offer a car, A (IEC 61851-1, annex A)."""

type Phases[T] = tuple[T, T, T]
"""One value for each of L1, L2, L3."""

UNKNOWN_PHASES: Phases[float | None] = (None, None, None)


class Status(StrEnum):
    """Status of a connector, as in OCPP 1.6."""

    AVAILABLE = "available"
    PREPARING = "preparing"
    CHARGING = "charging"
    SUSPENDED_EV = "suspended_ev"
    SUSPENDED_EVSE = "suspended_evse"
    FINISHING = "finishing"
    OUT_OF_SERVICE = "out_of_service"
    """OCPP's *Unavailable*: that word is reserved for states in Home Assistant."""
    FAULTED = "faulted"


class Fault(StrEnum):
    """A fault that a charger reports, or that this library has found."""

    # Reported by the charger (names after ABL EVCC2/3, annex 3.4 and register 0x06).
    CONTACTOR_WELDED = "contactor_welded"
    CONTACTOR_OPEN = "contactor_open"
    INTERNAL = "internal"
    DC_RESIDUAL_CURRENT = "dc_residual_current"
    UPSTREAM_TIMEOUT = "upstream_timeout"
    SOCKET_LOCK = "socket_lock"
    CABLE_CODE = "cable_code"
    VENTILATION_REQUESTED = "ventilation_requested"
    PILOT = "pilot"
    OVERCURRENT = "overcurrent"
    TEMPERATURE = "temperature"
    LOAD_IMBALANCE = "load_imbalance"
    METER = "meter"
    REDUCED_CURRENT = "reduced_current"
    UNRECOGNISED = "unrecognised"
    """Reported by a code that the manual does not list."""
    # Reported by a SmartEVSE, under its own names (README of v2, register 0xA1).
    LESS_6A = "less_6a"
    """Less than 6 A is left for it: it waits."""
    NO_COMM = "no_comm"
    """No message from its master or its meter for 10 s: it has stopped."""
    TEMP_HIGH = "temp_high"
    NO_CURRENT = "no_current"
    """Its master had no current for it: it waits for a minute."""
    RCD = "rcd"
    NO_SUN = "no_sun"
    # Reported by a P-CHARGE EWS-Box (manual, 3.2.4: status byte and last result of rc).
    SOCKET_UNLOCK = "socket_unlock"
    """The plug cannot be unlocked."""
    CONFIGURATION = "configuration"
    CARD_READER = "card_reader"
    CABLE_LOST = "cable_lost"
    """The contact of the cable was lost while charging."""
    # Found by this library.
    UNSUPPORTED_FIRMWARE = "unsupported_firmware"
    SECOND_MASTER = "second_master"
    MIXED_DIALECTS = "mixed_dialects"
    """The boxes of one bus need different broadcasts: nothing is written."""
    CHARGES_ALTHOUGH_PAUSED = "charges_although_paused"
    LIMIT_EXCEEDED = "limit_exceeded"
    LIMIT_NOT_TAKEN = "limit_not_taken"
    WRONG_CHARGER = "wrong_charger"
    DUPLICATE_ADDRESS = "duplicate_address"
    IMPLAUSIBLE = "implausible"
    NO_SUCH_PORT = "no_such_port"
    """The box has fewer ports than are configured."""


class SessionResult(StrEnum):
    """How a charge has ended (P-CHARGE EWS-Box, 3.2.4 rc)."""

    STOPPED = "stopped"
    """By the user or by us."""
    PILOT_LOST = "pilot_lost"
    """The cable was pulled at the car: not a fault."""
    CABLE_LOST = "cable_lost"
    RCD = "rcd"
    METER = "meter"
    SERVER_TIMEOUT = "server_timeout"
    VENTILATION = "ventilation"
    PILOT_UNSTABLE = "pilot_unstable"


class PauseReason(StrEnum):
    """Why no car can charge: the orders first, then the state of the charger."""

    NOT_ALLOWED = "not_allowed"
    """The user has switched charging off, here or at the charger."""
    LIMIT_TOO_LOW = "limit_too_low"
    """The limit is below the charger's minimum; a higher one lifts the pause."""
    MAXIMUM_TOO_LOW = "maximum_too_low"
    """Installation, charger or cable carry less than the charger's minimum."""
    SUPPLY_TOO_LOW = "supply_too_low"
    """Its part of the shared supply is below the minimum."""
    OTHER_NOT_READ = "other_not_read"
    """Another box of the bus was not read yet, and might be charging for ever."""
    CEILING_TOO_LOW = "ceiling_too_low"
    """The house permits less than the minimum: its sun, or its main fuse."""
    WAITS_FOR_USER = "waits_for_user"
    """Paused by a ceiling before a restart, and the same car is not proved to be there:
    the user allows it again."""
    LIMIT_NOT_FOLLOWED = "limit_not_followed"
    """It was stopped because it offered more than its limit."""
    CHARGE_ENDED = "charge_ended"
    """The charge has ended, and no command starts it again: plug in anew."""
    OUTLET_DISABLED = "outlet_disabled"
    """The outlet is switched off, here or at the charger."""
    OUT_OF_SERVICE = "out_of_service"
    """The charger starts, is set up, or is blocked."""
    FAULTED = "faulted"
    """The charger reports a fault that keeps it from charging."""


class OrderState(StrEnum):
    """Evidence of the registers for the order that stands."""

    CONFIRMED = "confirmed"
    NOT_READ_BACK = "not_read_back"
    """Sent or stored; no register shows it (yet)."""
    NOT_TAKEN = "not_taken"
    """Sent again and again, and not followed."""
    LOWER_THAN_ORDERED = "lower_than_ordered"
    PAUSED_ELSEWHERE = "paused_elsewhere"
    """Paused, not by us: only the user's permission ends it."""


class Capability(StrEnum):
    """A feature of a charger; an entity exists only for a capability."""

    STATUS = "status"
    RAW_STATE = "raw_state"
    PLUGGED = "plugged"
    CHARGING = "charging"
    CURRENT = "current"
    VOLTAGE = "voltage"
    COS_PHI = "cos_phi"
    POWER = "power"
    ENERGY = "energy"
    ESTIMATED_POWER = "estimated_power"
    ESTIMATED_ENERGY = "estimated_energy"
    OFFERED_CURRENT = "offered_current"
    ORDER_STATE = "order_state"
    MAXIMUM_CURRENT = "maximum_current"
    MINIMUM_CURRENT = "minimum_current"
    FAULTS = "faults"
    PHASE_LIMITS = "phase_limits"
    FAIL_SAFE_CURRENT = "fail_safe_current"
    FAIL_SAFE_TIMEOUT = "fail_safe_timeout"
    UPSTREAM_TIMEOUT = "upstream_timeout"
    ENABLE_AFTER_POWER_CYCLE = "enable_after_power_cycle"
    OUTLET_ENABLED = "outlet_enabled"
    RESET = "reset"
    WAKE = "wake"
    MODE = "mode"
    STORED_ACCESS = "stored_access"
    """Its access is in a memory that wears out, so it is no pause."""
    TEMPERATURE = "temperature"
    SESSION = "session"
    """Energy and time of the charge under way, and of the last one."""
    CABLE_CURRENT = "cable_current"
    LOCK = "lock"
    CONTACTOR = "contactor"
    OPTIMISED = "optimised"
    START_REQUEST = "start_request"
    RCD = "rcd"
    VENTILATION = "ventilation"
    PILOT_VOLTAGE = "pilot_voltage"
    CARDS = "cards"
    KEYS = "keys"
    """It reports each press of a key."""
    SERVER = "server"
    """It reports whether it is connected to its server."""


class FailSafe(StrEnum):
    """Reaction of a charger to missing messages of its controller."""

    NOTHING = "nothing"
    """The last limit stays in effect."""
    FORGETS = "forgets"
    """Likewise, until a power failure of the charger: then nothing limits it but its own
    maximum, and charging is allowed."""
    FALLS_BACK = "falls_back"
    """It charges with its fail-safe current after its time-out."""
    STOPS = "stops"
    UNPROVEN = "unproven"
    """It stops, or the last limit stays in effect: which one cannot be read."""
    ENDS = "ends"
    """It ends the charge after 10 min, and unlocks the plug (EWS-Box)."""


class Persistence(StrEnum):
    """How often a command may be sent for one request of the user."""

    STANDING = "standing"
    """Sent again until it is read back, and for as long as it stands."""
    REPEATABLE = "repeatable"
    """Sending it twice does the same as sending it once."""
    ONCE = "once"
    """Never repeated blindly: after a lost answer, read the state, then decide."""


class Command(StrEnum):
    """A command to a charger beside its orders."""

    RESET = "reset"
    WAKE = "wake"
    SET_OUTLET = "set_outlet"
    """Value: bool, outlet enabled."""
    SET_UPSTREAM_TIMEOUT = "set_upstream_timeout"
    """Value: bool, the box's own fail-safe."""
    SET_ENABLE_AFTER_POWER_CYCLE = "set_enable_after_power_cycle"
    """Value: bool, a plugged car may charge after a power failure."""
    STORE_ACCESS = "store_access"
    """Value: bool, charging allowed, in its own memory; it wears out."""
    SET_MODE = "set_mode"
    """Value: a `Mode`; forgotten when the charger restarts."""
    STOP_AND_UNLOCK = "stop_and_unlock"
    REQUEST_START = "request_start"
    """As if the start key of the charger was pressed."""
    LOCK = "lock"
    """Lock the plug of a car that waits for its start."""
    UNLOCK = "unlock"
    """Unlock the plug; a charge under way is ended."""
    SET_OPTIMISED = "set_optimised"
    """Value: bool, the next start is an optimised one."""


class Mode(StrEnum):
    """The source of the current that a charger offers (SmartEVSE, register 0xA8)."""

    NORMAL = "normal"
    """The limit alone."""
    SMART = "smart"
    """The rest of the mains connection, by its own meter."""
    SOLAR = "solar"
    """The solar surplus, by its own meter."""


class Setting(StrEnum):
    """A setting in the own memory of a charger; written rarely, since it wears out."""

    MINIMUM_CURRENT = "minimum_current"
    """A car is not offered less, A."""
    MAXIMUM_CURRENT = "maximum_current"
    """This charger never offers more, A."""
    CIRCUIT_CURRENT = "circuit_current"
    """All chargers of one circuit together, A."""
    MAINS_CURRENT = "mains_current"
    """The mains connection, for modes smart and solar, A."""
    SOLAR_START_CURRENT = "solar_start_current"
    """Export from which solar charging starts, A a phase; negative: import."""
    SOLAR_IMPORT_CURRENT = "solar_import_current"
    """Import allowed while solar charging, A, sum of the phases."""
    SOLAR_STOP_TIME = "solar_stop_time"
    """Solar charging stops after this time at the minimum, minutes; 0: never."""
    MODE_AT_START = "mode_at_start"
    """0, 1, 2: `Mode` normal, smart, solar."""


@dataclass(frozen=True, slots=True)
class Range:
    """The range of a setting, both ends included."""

    minimum: int
    maximum: int


# -- Orders ----------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class CurrentLimit:
    """A limit of the current: a total and, where the protocol has them, phases.

    The limit of a phase is ``min(current, phases[n])``.
    """

    current: float
    """For all phases, A; below the charger's minimum: no charging."""
    phases: Phases[float | None] = UNKNOWN_PHASES
    """For one phase, A; ``None``: only ``current`` counts."""

    def effective(self) -> Phases[float]:
        """Return the limits of L1, L2 and L3, A."""
        one, two, three = (
            self.current if phase is None else min(self.current, phase)
            for phase in self.phases
        )
        return one, two, three


@dataclass(frozen=True, slots=True, kw_only=True)
class Orders:
    """The orders of the user for one charger. Never filled from a reading."""

    limit: CurrentLimit
    allowed: bool | None = None
    """May charge; ``None``: not set by the user, the charger decides."""
    fail_safe: CurrentLimit = field(
        default_factory=lambda: CurrentLimit(current=MINIMUM_CURRENT)
    )
    """Limit that the charger falls back to without messages; any value from 0."""
    fail_safe_timeout: int = 60
    """Time without messages after which it falls back, s (EVBox only)."""
    remembered: Mapping[str, str] = field(default_factory=dict)
    """State of the protocol that survives a restart, by its own names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderChange:
    """A change of some orders; ``None`` leaves a field as it is."""

    allowed: bool | None = None
    current: float | None = None
    phases: Phases[float | None] = UNKNOWN_PHASES
    """New limits of single phases, A; ``None`` leaves that phase as it is."""
    fail_safe_current: float | None = None
    fail_safe_phases: Phases[float | None] = UNKNOWN_PHASES
    fail_safe_timeout: int | None = None

    def apply(self, orders: Orders) -> Orders:
        """Return the orders with this change made."""
        return replace(
            orders,
            allowed=orders.allowed if self.allowed is None else self.allowed,
            limit=_change_limit(orders.limit, self.current, self.phases),
            fail_safe=_change_limit(
                orders.fail_safe, self.fail_safe_current, self.fail_safe_phases
            ),
            fail_safe_timeout=(
                orders.fail_safe_timeout
                if self.fail_safe_timeout is None
                else self.fail_safe_timeout
            ),
        )

    @property
    def is_about_now(self) -> bool:
        """Return whether it changes how to charge now, not just the fail-safe."""
        values = (self.allowed, self.current, *self.phases)
        return any(value is not None for value in values)

    def merged_with(self, newer: OrderChange) -> OrderChange:
        """Return both changes as one; the newer counts where both set a value."""
        merged = {
            item.name: (
                getattr(self, item.name)
                if getattr(newer, item.name) is None
                else getattr(newer, item.name)
            )
            for item in fields(self)
        }
        for name in ("phases", "fail_safe_phases"):
            merged[name] = tuple(
                old if new is None else new
                for old, new in zip(
                    getattr(self, name), getattr(newer, name), strict=True
                )
            )
        return OrderChange(**merged)


def _change_limit(
    limit: CurrentLimit, current: float | None, phases: Phases[float | None]
) -> CurrentLimit:
    one, two, three = (
        old if new is None else new
        for old, new in zip(limit.phases, phases, strict=True)
    )
    return CurrentLimit(
        current=limit.current if current is None else current,
        phases=(one, two, three),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """The limits of all orders, and the resolution of the protocol."""

    installation: float
    """Limit of the installation, entered by the user, A."""
    reports_maximum: bool = False
    """The charger reports a maximum of its own; 6 A count until it has."""
    reported: float | None = None
    """Smallest maximum that it reports (connection, hardware, cable), A."""
    minimum: float = MINIMUM_CURRENT
    """Lowest current above 0 that this charger can offer, A."""
    step: float = 0.1
    """Resolution of currents in the protocol, A."""
    phases_alone: bool = False
    """A phase below the minimum pauses that phase only, not all of them."""

    @property
    def ceiling(self) -> float:
        """Return the highest current that may reach the wire, A."""
        if self.reported is not None:
            return min(self.installation, self.reported)
        if self.reports_maximum:
            return min(self.installation, MINIMUM_CURRENT)
        return self.installation


# -- Configuration ---------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Fact:
    """Something that a charger reads of its box, kept with its configuration."""

    load: Callable[[str], object]
    """Return the value of the kept text; ``None``: it has no meaning any more."""
    identifies: bool = False
    """The first one read stays: another one is that of another box.

    Otherwise the last one read is kept; it may change with the firmware.
    """


@dataclass(frozen=True, slots=True, kw_only=True)
class ChargerConfig:
    """The configuration of one charger; protocols add their own fields."""

    live: ClassVar[frozenset[str]] = frozenset(
        {"name", "installation_limit", "voltage", "poll_interval", "order_lifetime"}
    )
    """Fields that a charger reads at each use: it can follow a change of these."""
    facts: ClassVar[Mapping[str, Fact]] = {"serial": Fact(str, identifies=True)}
    """Fields that `Charger.facts` has values for, once they were read."""

    key: str
    """Identifies the charger for as long as it is configured; not its address."""
    name: str
    address: int
    """Address on the bus (ABL: device-ID; EVBox: serial number, 0: any)."""
    serial: str | None = None
    """Serial number that must be read there before anything is written."""
    installation_limit: float = MINIMUM_CURRENT
    """Highest current the wiring of this charger may carry, A."""
    voltage: float = 230.0
    """Phase to neutral, V: for estimates where the charger reports none."""
    poll_interval: float = 5.0
    """Time between two readings, s; 0: as fast as the bus allows."""
    order_lifetime: float | None = None
    """Time after which an order that is not renewed becomes the fail-safe, s."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Circuit:
    """The circuit that all chargers of a bus share, where the bus has a master."""

    limit: float = MINIMUM_CURRENT
    """A for each phase, all chargers together."""
    minimum: float = MINIMUM_CURRENT
    """Each charger that charges gets at least this, A; else nothing."""
