"""Readings common to all protocols, made from the registers of a SmartEVSE. Pure."""

from typing import Final

from ..model import Capability, Setting, Status as OcppStatus
from ..readings import ChargerInfo, ChargerReading, ConnectorReading
from .dialects import MAPS, VERSION_3, Dialect, Status
from .registers import Configuration
from .states import (
    UNKNOWN,
    faults_of,
    ocpp_status,
    offered,
    state_of,
)

_MASTER: Final = 1
"""The setting of load balancing of a master; that of a node is its address."""

_CAPABILITIES: Final = frozenset(
    {
        Capability.STATUS,
        Capability.RAW_STATE,
        Capability.PLUGGED,
        Capability.CHARGING,
        Capability.OFFERED_CURRENT,
        Capability.MAXIMUM_CURRENT,
        Capability.MINIMUM_CURRENT,
        Capability.FAULTS,
        Capability.MODE,
    }
)
_FIRMWARE: Final = {
    Dialect.V2_17: "2.17",
    Dialect.V2_20: "2.20",
    Dialect.V2_30: "2.30",
    Dialect.V2_HEAD: "2.30, development version",
    Dialect.V3_OLD: "3.x, before November 2025",
    Dialect.V3: "3.x",
}


def capabilities_of(dialect: Dialect | None) -> frozenset[Capability]:
    """Return the capabilities of a dialect; ``None``: those that all have."""
    if dialect is not None and "temperature" in MAPS[dialect].status.words:
        return _CAPABILITIES | {Capability.TEMPERATURE}
    return _CAPABILITIES


def charger_info(dialect: Dialect, serial: str | None) -> ChargerInfo:
    """Return the identity of a box; its firmware is inferred from its dialect."""
    return ChargerInfo(
        manufacturer="Stegen Electronics",
        model="SmartEVSE v3" if dialect in VERSION_3 else "SmartEVSE v2",
        serial=serial,
        firmware=_FIRMWARE[dialect],
    )


def charger_reading(
    dialect: Dialect,
    status: Status,
    configuration: Configuration | None,
    *,
    plugged: bool | None,
    waits: bool = False,
) -> ChargerReading:
    """Return the reading of a status.

    ``plugged``: see `plug`. ``waits``: paused by us for lack of current.
    """
    state = state_of(dialect, status.raw_state)
    settings = configuration.settings if configuration is not None else {}
    maxima = [status.maximum, settings.get(Setting.MAXIMUM_CURRENT)]
    if configuration is None and not MAPS[dialect].reports_maximum:
        # The cable's alone is not the maximum.
        maxima = []
    minimum = status.minimum or settings.get(Setting.MINIMUM_CURRENT)
    ocpp = ocpp_status(dialect, status)
    if ocpp is OcppStatus.OUT_OF_SERVICE and waits:
        ocpp = OcppStatus.SUSPENDED_EVSE
    has_master = configuration is not None and configuration.load_balancing > _MASTER
    connector = ConnectorReading(
        status=ocpp,
        raw_state=status.raw_state,
        plugged=plugged,
        charging=state.charging,
        minimum_current=None if minimum is None else float(minimum),
    )
    return ChargerReading(
        connectors={1: connector},
        allowed=status.access,
        offered_current=(
            None
            if state is UNKNOWN
            else offered(dialect, status, has_master=has_master)
        ),
        maximum_current=min(
            (float(one) for one in maxima if one is not None), default=None
        ),
        mode=status.mode,
        temperature=None if status.temperature is None else float(status.temperature),
        settings=settings,
        faults=faults_of(dialect, status),
        fault_codes=(f"0x{status.error:02X}",) if status.error else (),
        details={
            "dialect": dialect.value,
            "load_balancing": (
                configuration.load_balancing if configuration is not None else None
            ),
            "current_in_force": status.current,
            "cable_current": status.maximum,
        },
    )
