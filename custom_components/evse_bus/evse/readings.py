"""Readings of a charger and of its connectors.

Units throughout: ampere, volt, watt, watt-hour, second. ``None`` means "not known".
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime

from .model import UNKNOWN_PHASES, Fault, Mode, Phases, SessionResult, Setting, Status


@dataclass(frozen=True, slots=True, kw_only=True)
class ConnectorReading:
    """The reading of one connector (EVBox: one ChargeBox module)."""

    status: Status | None = None
    raw_state: str | None = None
    """The charger's own state, such as ``C2`` of IEC 61851."""
    plugged: bool | None = None
    charging: bool | None = None
    current: Phases[float | None] = UNKNOWN_PHASES
    """Used current, A."""
    unconfirmed_current: Phases[float | None] = UNKNOWN_PHASES
    """Used current by one more reply, which no other agrees with yet, A. It is not
    shown, and counts in `drawn_at_most` until the next reply decides."""
    voltage: Phases[float | None] = UNKNOWN_PHASES
    cos_phi: Phases[float | None] = UNKNOWN_PHASES
    power: float | None = None
    """Power from measured voltage, current and cos phi, W."""
    energy: float | None = None
    """Meter total, Wh."""
    meter_generation: int = 0
    """Counts up when another meter may be behind this number (EVBox: modules have
    no identity): a total must not be carried over such a change."""
    estimated_power: float | None = None
    """Power from measured current and a configured voltage, W."""
    estimated_energy: float | None = None
    """Estimated power integrated since the library was started, Wh."""
    minimum_current: float | None = None
    """Current below which this connector cannot charge, A."""
    session_energy: float | None = None
    """Of the charge under way, Wh."""
    session_time: int | None = None
    """Of the charge under way, s."""
    last_session_energy: float | None = None
    """Of the last charge, Wh."""
    last_session_time: int | None = None
    """Of the last charge, s."""
    last_result: SessionResult | None = None
    """How the last charge ended."""
    last_end: datetime | None = None
    """When the last charge ended, by the clock of the box, without a zone."""
    user: str | None = field(default=None, repr=False)
    """The user who has logged in with a card."""
    cable_current: float | None = None
    """Rated current of the cable, A."""
    locked: bool | None = None
    """The plug is locked."""
    contactor: bool | None = None
    """The contactor is closed."""
    optimised: bool | None = None
    """The next start is an optimised one."""
    start_requested: bool | None = None
    """A start was requested at the box; it waits for our permission."""
    rcd_tripped: bool | None = None
    ventilation_requested: bool | None = None
    """The car requests ventilation of the room."""
    pilot_low: float | None = None
    """Lowest level of the control pilot, V."""
    pilot_high: float | None = None
    """Highest level of the control pilot, V."""
    proximity_voltage: float | None = None
    """At the proximity contact of the cable, V."""

    @property
    def drawn_at_most(self) -> Phases[float | None]:
        """Return the highest current of each phase that any reply has shown now, A.

        For whatever must not be late: a guard of a fuse, a shared supply, the search
        for a car that ignores its limit. `current` waits until a second reply agrees
        with a change; this does not. ``None``: not measured.
        """
        one, two, three = (
            _larger(shown, other)
            for shown, other in zip(self.current, self.unconfirmed_current, strict=True)
        )
        return one, two, three

    def exceeded_by(self, currents: Phases[float]) -> bool:
        """Return whether currents (A) are above the highest known so far."""
        return any(
            known is None or current > known
            for known, current in zip(self.drawn_at_most, currents, strict=True)
        )


def _larger(one: float | None, other: float | None) -> float | None:
    if one is None or other is None:
        return other if one is None else one
    return max(one, other)


@dataclass(frozen=True, slots=True, kw_only=True)
class ChargerReading:
    """The reading of a charger and of its connectors."""

    connectors: Mapping[int, ConnectorReading] = field(default_factory=dict)
    """By number, 1..n."""
    allowed: bool | None = None
    """Whether the charger lets a car charge, by its own report."""
    offered_current: float | None = None
    """Current offered to the car now, A; 0: charging is paused."""
    maximum_current: float | None = None
    """Maximum of the connection or the box, A."""
    minimum_interval: float | None = None
    """Shortest time between two requests that the charger accepts, s."""
    outlet_enabled: bool | None = None
    mode: Mode | None = None
    server_connected: bool | None = None
    """The box reports a connection to its server."""
    ventilating: bool | None = None
    temperature: float | None = None
    """Inside the box, degrees Celsius."""
    settings: Mapping[Setting, int] = field(default_factory=dict)
    """Settings in its own memory, as far as they were read."""
    faults: frozenset[Fault] = frozenset()
    fault_codes: tuple[str, ...] = ()
    """The charger's own codes for its faults, raw (``F9``)."""
    details: Mapping[str, str | int | float | bool | None] = field(default_factory=dict)
    """Further values that it reports, for diagnostics only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ChargerInfo:
    """Identity and type of a charger; constant while it runs."""

    manufacturer: str
    model: str
    serial: str | None = None
    firmware: str | None = None
    hardware: str | None = None
    options: Mapping[str, str | int | bool | None] = field(default_factory=dict)
    """Configuration bits reported by the charger, by name."""
