"""From the records of an EWS-Box to capabilities, limits and the reading of a port.

Pure functions. Manual, 3.2.4 (``rc``, ``rd``, ``rs``).
"""

from math import inf
from typing import Final

from ..model import MINIMUM_CURRENT, Capability, Limits, SessionResult
from ..readings import ChargerInfo, ChargerReading, ConnectorReading
from .box import Installation, Snapshot
from .wire.box_status import BoxStatus
from .wire.parameters import SystemMode
from .wire.states import (
    AFTER_OUR_PAUSE,
    RUNNING,
    WAITING,
    box_faults,
    port_state,
)
from .wire.status import ChargeResult, PortFlags, PortStatus, StartRelease

MODE_1_CURRENT: Final = 16
"""Current of a household socket, A: all or nothing (2.2.1)."""

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
    """Return the capabilities of a port; mode 1 has no pilot, a fixed cable no lock.

    There are cards unless the box is set to ask for none; keys are reported only where
    the server has them (3.2.3). Before the parameters are known, capabilities that
    depend on them are left out: entities that were created once would stay.
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
    status: PortStatus | None,
) -> Limits:
    """Return the limits of a port; ``own``: the user's limit for it, A.

    The smallest of jumper (``rs``), parameter (``rp``, ``rz``) and cable (``rc``).
    """
    if installation is None or box is None or not box.maximum_current:
        return Limits(installation=own, reports_maximum=True, step=1.0)
    reported = min(box.maximum_current, installation.maximum[port - 1] or inf)
    minimum = MINIMUM_CURRENT
    if installation.mode_1[port - 1]:
        reported = minimum = MODE_1_CURRENT
    elif not installation.fixed_cable and status is not None and status.cable_current:
        reported = min(reported, status.cable_current)
    return Limits(
        installation=own,
        reports_maximum=True,
        reported=float(reported),
        minimum=float(minimum),
        step=1.0,
    )


def charger_info(box: BoxStatus) -> ChargerInfo:
    """Return manufacturer, model, serial number and versions of a box."""
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


def charger_reading(port: int, box: Snapshot, *, paused: bool | None) -> ChargerReading:
    """Return the reading of a port; its connector has the number of the port.

    ``paused``: it is in a pause of ours; ``None``: it may be.
    """
    at = port - 1
    status, details, installation = box.ports[at], box.details, box.installation
    meter, session = box.meters[at], box.sessions[at]
    fixed = installation.fixed_cable
    state = port_state(status, fixed_cable=fixed, paused=paused is True)
    connector = ConnectorReading(
        status=state.status,
        raw_state=state.raw,
        plugged=state.plugged,
        charging=state.charging,
        power=float(details.power[at]),
        energy=meter.energy,
        meter_generation=meter.generation,
        session_energy=session.energy,
        session_time=session.time,
        last_session_energy=float(status.last_energy),
        last_session_time=status.last_time,
        last_result=session_result(status.result),
        last_end=details.last_end[at],
        user=(status.card.user or None) if status.card is not None else None,
        cable_current=float(status.cable_current) if status.cable_current else None,
        locked=state.locked,
        contactor=status.contactor,
        optimised=status.optimised,
        start_requested=asks_for_start(status),
        rcd_tripped=status.rcd_tripped,
        ventilation_requested=PortFlags.VENTILATION in status.flags,
        pilot_low=status.pwm_minimum,
        pilot_high=status.pwm_maximum,
        proximity_voltage=status.cable_voltage,
    )
    offered = 0 if paused else status.offered_current
    maximum = limits_of(port, inf, box.status, installation, None).reported
    return ChargerReading(
        connectors={port: connector},
        allowed=_allowed(status, paused=paused),
        offered_current=None if offered is None else float(offered),
        maximum_current=maximum,
        server_connected=box.status.server_connected,
        ventilating=box.status.ventilating,
        faults=state.faults | box_faults(box.status),
        details={
            "limit": details.limit[at],
            "pwm_duty": details.pwm_duty[at],
            "pilot_code": details.pilot_code[at],
            "cable_code": details.cable_code[at],
            "start_code": status.start_code,
            "result_code": status.result_code,
            "meter_cycles": status.meter_cycles,
        },
    )


def asks_for_start(status: PortStatus) -> bool:
    """Return whether a car waits for permission to start.

    A start may be requested while the box still searches for the car. Permission given
    then starts nothing and is lost, so that is no request yet.
    """
    return status.start is StartRelease.REQUESTED and status.state == WAITING


def session_result(result: ChargeResult | None) -> SessionResult | None:
    """Return how a charge has ended."""
    return None if result is None else SessionResult[result.name]


def _allowed(status: PortStatus, *, paused: bool | None) -> bool | None:
    """Return whether a car may charge; ``None``: the status does not show it.

    In the status, a pause of the car and one of ours look the same.
    """
    if paused:
        return False
    if paused is None and status.state in AFTER_OUR_PAUSE:
        return None
    if status.state in RUNNING:
        return True
    if status.state == WAITING:
        return status.start is StartRelease.RELEASED
    return None
