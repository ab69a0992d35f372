"""From what a box told to the neutral model, and the estimates beside it."""

from dataclasses import dataclass

from ..model import UNKNOWN_PHASES, Fault, Phases, Status
from ..readings import ChargerInfo, ChargerReading, ConnectorReading
from .duty import PAUSE, current_for
from .registers import Flags, Info, Reading
from .states import B1, B2, C3, C4, state_of

SHORTEST_GAP = 10.0
"""Pause between two readings over which energy is always summed, s."""
GAP_INTERVALS = 3.0
"""Poll intervals over which energy is summed at most."""
TOLERATED = 100
"""Above 100 % up to 105 % of Ic nothing ever follows (0x0006, bits 2..0), %."""
_SECONDS_PER_HOUR = 3600.0
_CODES = {C4: "F15"}
_REDUCED_CODES = {C3: "F16/F17"}
"""Errors that show as a state with another name (annex 3.4)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """All that a box told of itself up to now."""

    reading: Reading
    info: Info
    flags: Flags | None = None
    """``None``: not read yet, or too long ago."""
    icmax: int | None = None
    """Duty cycle Icmax, 0.1 %; only some boxes tell it."""


class EnergyEstimate:
    """Sums estimated power over measured time, never over a gap."""

    def __init__(self, poll_interval: float) -> None:
        """Start at 0 Wh."""
        self.energy = 0.0
        """Wh"""
        self._longest = 0.0
        self._last: tuple[float, float] | None = None
        self.expect(poll_interval)

    def expect(self, poll_interval: float) -> None:
        """Take what is much longer than this (s) between two readings for a gap."""
        self._longest = max(GAP_INTERVALS * poll_interval, SHORTEST_GAP)

    def add(self, power: float | None, now: float) -> None:
        """Take a power (W) at a time (s)."""
        last, self._last = self._last, None if power is None else (now, power)
        if last is None or power is None:
            return
        then, before = last
        if 0 < now - then <= self._longest:
            self.energy += (before + power) / 2 * (now - then) / _SECONDS_PER_HOUR

    def interrupt(self) -> None:
        """Sum nothing over what comes between the last reading and the next."""
        self._last = None


def phase_currents(told: Told, order: Phases[int]) -> Phases[float | None]:
    """Return the currents of L1, L2 and L3, A.

    ``order`` says which phase each of Ict1 to Ict3 measures. A missing value is a
    measured 0 only where the state itself says that the contactor is open, on a box
    with a working meter (PROTOCOLS.md, 2); else it is unknown.
    """
    if not told.info.meter or (told.flags is not None and told.flags.meter_failed):
        return UNKNOWN_PHASES
    zero = state_of(told.reading.state).no_current and told.flags is not None
    by_phase = dict(zip(order, told.reading.currents, strict=True))
    one, two, three = (
        0.0 if by_phase[phase] is None and zero else by_phase[phase]
        for phase in (1, 2, 3)
    )
    return one, two, three


def power_of(currents: Phases[float | None], voltage: float) -> float | None:
    """Return the estimated power of three currents at one voltage, W."""
    known = [current for current in currents if current is not None]
    return round(sum(known) * voltage, 1) if len(known) == len(currents) else None


def charger_reading(
    told: Told,
    currents: Phases[float | None],
    power: float | None,
    energy: float | None,
) -> ChargerReading:
    """Return what a box told, in the words of the model."""
    reading = told.reading
    state = state_of(reading.state)
    paused = reading.duty == PAUSE
    offered = current_for(reading.duty)
    faults, codes = faults_of(told)
    connector = ConnectorReading(
        status=(
            Status.SUSPENDED_EVSE
            if paused and reading.state in (B1, B2)
            else state.status
        ),
        raw_state=state.name,
        plugged=reading.plugged if state.tells_plugged else None,
        charging=state.charging,
        current=currents,
        estimated_power=power,
        estimated_energy=None if energy is None else round(energy, 1),
    )
    return ChargerReading(
        connectors={1: connector},
        allowed=_allowed(outlet_enabled=state.outlet_enabled, offered=offered),
        # In Ex and Fx the box still tells a duty cycle, and offers nothing.
        offered_current=offered if state.outlet_enabled else None,
        outlet_enabled=state.outlet_enabled,
        faults=faults,
        fault_codes=codes,
        details=_details(told),
    )


def _allowed(*, outlet_enabled: bool | None, offered: float | None) -> bool | None:
    """Return whether a car may charge: neither E0 nor 100 %, if that can be said."""
    if outlet_enabled is not True:
        return outlet_enabled
    return None if offered is None else offered > 0


def faults_of(told: Told) -> tuple[frozenset[Fault], tuple[str, ...]]:
    """Return the named faults and the box's own codes for them."""
    state = state_of(told.reading.state)
    found: list[tuple[Fault, str]] = []
    if state.fault is not None:
        found.append((state.fault, _CODES.get(told.reading.state, state.name)))
    if told.reading.reduced:
        code = _REDUCED_CODES.get(told.reading.state, "BC3-BC6")
        found.append((Fault.REDUCED_CURRENT, code))
    if (flags := told.flags) is not None:
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


def _details(told: Told) -> dict[str, str | int | float | bool | None]:
    reading = told.reading
    details: dict[str, str | int | float | bool | None] = {
        "ic_duty": reading.duty / 10,
        "icmax_duty": None if told.icmax is None else told.icmax / 10,
        "reduced": reading.reduced,
        "en1": reading.en1,
        "en2": reading.en2,
    }
    if (flags := told.flags) is not None:
        details |= {
            "state_pointer": flags.pointer,
            "a1_b1_enabled": not flags.a1_b1_disabled,
            "b1_b2_enabled": not flags.b1_b2_disabled,
            "e0_a1_enabled": not flags.e0_a1_disabled,
            "overcurrent": flags.overcurrent,
        }
    return details


def charger_info(info: Info, serial: str | None, flags: Flags | None) -> ChargerInfo:
    """Return what a box is."""
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
