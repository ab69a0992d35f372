"""What is made of what an EWS-Box tells: one charger's reading for each port.

Pure functions. Manual, 3.2.4 (``rc``, ``rd``, ``rs``).
"""

from math import inf
from typing import Final

from ..model import MINIMUM_CURRENT, Capability, Limits, SessionResult
from ..readings import ChargerInfo, ChargerReading, ConnectorReading
from .box import Installation, Told
from .wire.box_status import BoxStatus
from .wire.parameters import SystemMode
from .wire.states import (
    AFTER_OUR_PAUSE,
    CHARGING,
    PAUSED_OPTIMISED,
    WAITING,
    box_faults,
    port_state,
)
from .wire.status import ChargeResult, PortFlags, PortStatus, StartRelease

MODE_1_CURRENT: Final = 16
"""What a household socket carries, A: all or nothing (2.2.1)."""
RUNNING: Final = range(CHARGING, PAUSED_OPTIMISED + 1)
"""Status bytes of a charge under way, pauses included."""

_MODE_3_ONLY: Final = frozenset(
    {
        Capability.OFFERED_CURRENT,
        Capability.CABLE_CURRENT,
        Capability.LOCK,
        Capability.PILOT_VOLTAGE,
    }
)
_ALL: Final = _MODE_3_ONLY | {
    Capability.STATUS,
    Capability.RAW_STATE,
    Capability.PLUGGED,
    Capability.CHARGING,
    Capability.POWER,
    Capability.ENERGY,
    Capability.MAXIMUM_CURRENT,
    Capability.FAULTS,
    Capability.RESET,
    Capability.SESSION,
    Capability.CONTACTOR,
    Capability.OPTIMISED,
    Capability.START_REQUEST,
    Capability.RCD,
    Capability.VENTILATION,
    Capability.CARDS,
    Capability.SERVER,
}


def capabilities_of(
    port: int, installation: Installation | None
) -> frozenset[Capability]:
    """Return what a port has; mode 1 has no pilot, a fixed cable no lock.

    Cards are there unless the box says that it asks for none; its keys are told only
    where they are the server's to watch (3.2.3). What its parameters may take away is
    left out before they are known: what was shown once would stay.
    """
    if installation is None:
        return _ALL - _MODE_3_ONLY - {Capability.CARDS}
    known = set(_ALL)
    if installation.mode_1[port - 1]:
        known -= _MODE_3_ONLY
    if installation.fixed_cable:
        known.discard(Capability.LOCK)
    mode = installation.mode
    if mode is not None and SystemMode.CARDS not in mode:
        known.discard(Capability.CARDS)
    if mode is not None and SystemMode.MANUAL_IO in mode:
        known.add(Capability.KEYS)
    return frozenset(known)


def limits_of(
    port: int,
    own: float,
    box: BoxStatus | None,
    installation: Installation | None,
    seen: PortStatus | None,
) -> Limits:
    """Return what no order may exceed; ``own``: the user's limit for the port, A.

    The smallest of jumper (``rs``), parameter (``rp``, ``rz``) and cable (``rc``).
    """
    if installation is None or box is None or not box.maximum_current:
        return Limits(installation=own, reports_maximum=True, step=1.0)
    told = min(box.maximum_current, installation.maximum[port - 1] or inf)
    minimum = MINIMUM_CURRENT
    if installation.mode_1[port - 1]:
        told = minimum = MODE_1_CURRENT
    elif not installation.fixed_cable and seen is not None and seen.cable_current:
        told = min(told, seen.cable_current)
    return Limits(
        installation=own,
        reports_maximum=True,
        reported=float(told),
        minimum=float(minimum),
        step=1.0,
    )


def charger_info(box: BoxStatus) -> ChargerInfo:
    """Return what the box is."""
    return ChargerInfo(
        manufacturer="P-CHARGE",
        model="EWS-Box",
        serial=box.serial,
        firmware=box.firmware or None,
        options={
            "website": box.website_version or None,
            "card_reader": box.reader_firmware or None,
        },
    )


def charger_reading(port: int, box: Told, *, paused: bool | None) -> ChargerReading:
    """Return a port's reading; ``paused``: it is our pause that it is in, or may be.

    Its connector has the number of the port: both are parts of one box.
    """
    at = port - 1
    seen, details, installation = box.ports[at], box.details, box.installation
    fixed = installation.fixed_cable
    state = port_state(seen, fixed_cable=fixed, paused=paused is True)
    connector = ConnectorReading(
        status=state.status,
        raw_state=state.raw,
        plugged=state.plugged,
        charging=state.charging,
        power=float(details.power[at]),
        energy=float(seen.total_energy),
        session_energy=float(seen.session_energy),
        session_time=seen.session_time,
        last_session_energy=float(seen.last_energy),
        last_session_time=seen.last_time,
        last_result=_result(seen.result),
        last_end=details.last_end[at],
        user=(seen.card.user or None) if seen.card is not None else None,
        cable_current=float(seen.cable_current) if seen.cable_current else None,
        locked=state.locked,
        contactor=seen.contactor,
        optimised=seen.optimised,
        start_requested=asks_for_start(seen),
        rcd_tripped=seen.rcd_tripped,
        ventilation_requested=PortFlags.VENTILATION in seen.flags,
        pilot_low=seen.pwm_minimum,
        pilot_high=seen.pwm_maximum,
        proximity_voltage=seen.cable_voltage,
    )
    offered = 0 if paused else seen.offered_current
    told = limits_of(port, inf, box.status, installation, None).reported
    return ChargerReading(
        connectors={port: connector},
        allowed=_allowed(seen, paused=paused),
        offered_current=None if offered is None else float(offered),
        maximum_current=told,
        server_connected=box.status.server_connected,
        ventilating=box.status.ventilating,
        faults=state.faults | box_faults(box.status),
        details={
            "limit": details.limit[at],
            "pwm_duty": details.pwm_duty[at],
            "pilot_code": details.pilot_code[at],
            "cable_code": details.cable_code[at],
            "start_code": seen.start_code,
            "result_code": seen.result_code,
            "meter_cycles": seen.meter_cycles,
        },
    )


def asks_for_start(seen: PortStatus) -> bool:
    """Return whether somebody waits for our permission.

    A start may be asked for while the box still looks for the car. A permission would
    start nobody then, and be forgotten: so the car that waits is what asks.
    """
    return seen.start is StartRelease.REQUESTED and seen.status == WAITING


def _result(told: ChargeResult | None) -> SessionResult | None:
    return None if told is None else SessionResult[told.name]


def _allowed(seen: PortStatus, *, paused: bool | None) -> bool | None:
    """Return whether a car may charge, as the box says it; ``None``: it does not.

    The same word of the box is for a pause of the car and for one of ours.
    """
    if paused:
        return False
    if paused is None and seen.status in AFTER_OUR_PAUSE:
        return None
    if seen.status in RUNNING:
        return True
    if seen.status == WAITING:
        return seen.start is StartRelease.RELEASED
    return None
