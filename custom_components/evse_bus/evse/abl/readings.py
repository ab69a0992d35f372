"""Conversion of register contents to the neutral model, with estimates."""

from dataclasses import dataclass

from ..model import UNKNOWN_PHASES, Fault, Phases, Status
from ..readings import ChargerInfo, ChargerReading, ConnectorReading
from .duty import current_for
from .registers import Flags, Icmax, Info, Reading
from .states import B1, B2, C3, C4, state_of

SHORTEST_GAP = 10.0
"""Energy is always summed between two readings up to this far apart, s."""
GAP_INTERVALS = 3.0
"""Else energy is summed over at most so many poll intervals."""
FLOOR = 0.1
"""A measured current of so much is none, A."""
TOLERATED = 100
"""% of Ic: up to 105 % has no consequence in the box (0x0006, bits 2..0)."""
_SECONDS_PER_HOUR = 3600.0
_CODES = {C4: "F15"}
_REDUCED_CODES = {C3: "F16/F17"}
"""Codes of errors that show as a state with another name (annex 3.4)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """Everything read from a box so far."""

    reading: Reading
    info: Info
    flags: Flags | None = None
    """``None``: not read yet, or too long ago."""
    icmax: Icmax | None = None
    """``None``: not read, or no register 0x000F."""
    paused: bool | None = None
    """Charging is not allowed; ``None``: unknown."""
    offered: int | None = None
    """Duty cycle that is offered, 0.1 %; ``None``: unknown."""


class EnergyEstimate:
    """Sums estimated power over measured time, never over a gap."""

    def __init__(self, poll_interval: float) -> None:
        """Start at 0 Wh."""
        self.energy = 0.0
        """Wh"""
        self._longest = 0.0
        self._last: tuple[float, float] | None = None
        self.set_interval(poll_interval)

    def set_interval(self, poll_interval: float) -> None:
        """Set the time between readings (s); several times as long is a gap."""
        self._longest = max(GAP_INTERVALS * poll_interval, SHORTEST_GAP)

    def add(self, power: float | None, now: float) -> None:
        """Add a power (W) at a time (s)."""
        last, self._last = self._last, None if power is None else (now, power)
        if last is None or power is None:
            return
        then, before = last
        if 0 < now - then <= self._longest:
            self.energy += (before + power) / 2 * (now - then) / _SECONDS_PER_HOUR

    def interrupt(self) -> None:
        """Start a gap: nothing is summed until the next reading."""
        self._last = None


def phase_currents(snapshot: Snapshot, order: Phases[int]) -> Phases[float | None]:
    """Return the currents of L1, L2 and L3, A.

    ``order``: the phase that each of Ict1 to Ict3 measures. A missing value is 0 A
    only in a state with an open contactor on a box with a working meter
    (PROTOCOLS.md, 2); else it is unknown. 0.1 A is the floor of the meter, which it
    shows on idle phases.
    """
    if not snapshot.info.meter or (
        snapshot.flags is not None and snapshot.flags.meter_failed
    ):
        return UNKNOWN_PHASES
    zero = state_of(snapshot.reading.state).no_current and snapshot.flags is not None
    measured = (
        0.0 if current is not None and current <= FLOOR else current
        for current in snapshot.reading.currents
    )
    by_phase = dict(zip(order, measured, strict=True))
    one, two, three = (
        0.0 if by_phase[phase] is None and zero else by_phase[phase]
        for phase in (1, 2, 3)
    )
    return one, two, three


def power_of(currents: Phases[float | None], voltage: float) -> float | None:
    """Return the estimated power of three currents, W; ``None``: unknown."""
    known = [current for current in currents if current is not None]
    return round(sum(known) * voltage, 1) if len(known) == len(currents) else None


def charger_reading(
    snapshot: Snapshot,
    currents: Phases[float | None],
    power: float | None,
    energy: float | None,
) -> ChargerReading:
    """Return the reading; power (W) and energy (Wh) are estimates."""
    reading = snapshot.reading
    state = state_of(reading.state)
    offered = None if snapshot.offered is None else current_for(snapshot.offered)
    faults, codes = faults_of(snapshot)
    connector = ConnectorReading(
        status=(
            Status.SUSPENDED_EVSE
            if snapshot.paused and reading.state in (B1, B2)
            else state.status
        ),
        raw_state=state.name,
        plugged=reading.plugged if state.plugged_valid else None,
        charging=state.charging,
        current=currents,
        estimated_power=power,
        estimated_energy=None if energy is None else round(energy, 1),
    )
    return ChargerReading(
        connectors={1: connector},
        allowed=_allowed(outlet_enabled=state.outlet_enabled, paused=snapshot.paused),
        # In Ex and Fx the duty cycle has a value, but nothing is offered.
        offered_current=offered if state.outlet_enabled else None,
        outlet_enabled=state.outlet_enabled,
        faults=faults,
        fault_codes=codes,
        details=_details(snapshot),
    )


def _allowed(*, outlet_enabled: bool | None, paused: bool | None) -> bool | None:
    """Return whether a car may charge (neither E0 nor a pause); ``None``: unknown."""
    if outlet_enabled is not True:
        return outlet_enabled
    return None if paused is None else not paused


def faults_of(snapshot: Snapshot) -> tuple[frozenset[Fault], tuple[str, ...]]:
    """Return the faults and the manual's codes for them."""
    state = state_of(snapshot.reading.state)
    found: list[tuple[Fault, str]] = []
    if state.fault is not None:
        found.append((state.fault, _CODES.get(snapshot.reading.state, state.name)))
    if snapshot.reading.reduced:
        code = _REDUCED_CODES.get(snapshot.reading.state, "BC3-BC6")
        found.append((Fault.REDUCED_CURRENT, code))
    if (flags := snapshot.flags) is not None:
        found.extend(
            (fault, code)
            for present, fault, code in (
                (flags.imbalance, Fault.LOAD_IMBALANCE, "BC3"),
                (flags.meter_failed, Fault.METER, "BC4"),
                (flags.hot, Fault.TEMPERATURE, "BC5"),
                (flags.upstream_lost, Fault.UPSTREAM_TIMEOUT, "BC6"),
                ((flags.overcurrent or 0) > TOLERATED, Fault.OVERCURRENT, ">Ic"),
            )
            if present
        )
    return frozenset(fault for fault, _ in found), tuple(code for _, code in found)


def _details(snapshot: Snapshot) -> dict[str, str | int | float | bool | None]:
    reading = snapshot.reading
    details: dict[str, str | int | float | bool | None] = {
        "ic_duty": reading.duty / 10,
        "icmax_duty": None if snapshot.icmax is None else snapshot.icmax.duty / 10,
        "default_duty": (
            None if snapshot.icmax is None else snapshot.icmax.default / 10
        ),
        "reduced": reading.reduced,
        "en1": reading.en1,
        "en2": reading.en2,
    }
    if (flags := snapshot.flags) is not None:
        details |= {
            "state_pointer": flags.pointer,
            "a1_b1_enabled": not flags.a1_b1_disabled,
            "b1_b2_enabled": not flags.b1_b2_disabled,
            "e0_a1_enabled": not flags.e0_a1_disabled,
            "overcurrent": flags.overcurrent,
        }
    return details


def charger_info(info: Info, serial: str | None, flags: Flags | None) -> ChargerInfo:
    """Return identity and options of a box; ``flags`` adds more options."""
    options: dict[str, str | int | bool | None] = {
        "coding_resistor": info.coding_resistor,
        "upstream_timeout": info.upstream_timeout,
        "meter": info.meter,
        "rdc_md": info.rdc_md,
        "socket": info.socket,
        "welding_detection": info.welding_detection,
        "enable_input": info.enable_input,
    }
    if flags is not None:
        options |= {
            "enable_after_power_cycle": not flags.needs_enable,
            "upstream_timeout_state": "F4" if flags.triggers_f4 else "F14",
            "china_limits": flags.china,
        }
    return ChargerInfo(
        manufacturer="ABL",
        model="EVCC2/3",
        serial=serial,
        firmware=info.firmware,
        hardware=info.hardware,
        options=options,
    )
