"""Diagnostics of a bus and its chargers, without data that identifies a house."""

from collections.abc import Mapping, Sequence, Set as AbstractSet
from dataclasses import fields, is_dataclass, replace
from datetime import UTC, datetime
from math import isfinite
from typing import Any, Final

from homeassistant.components.diagnostics import REDACTED, async_redact_data
from homeassistant.const import CONF_ADDRESS, CONF_DEVICE, CONF_HOST
from homeassistant.core import HomeAssistant
from homeassistant.helpers.device_registry import ChildDeviceEntry, DeviceEntry

from .chargers.managed import ManagedCharger
from .connections import ListenerConnections
from .const import CONF_SERIAL, DOMAIN
from .coordinator import BusCoordinator, EvseBusConfigEntry
from .evse.bus import Bus
from .evse.statistics import Direction

_PRIVATE: Final = frozenset({CONF_DEVICE, CONF_HOST, CONF_SERIAL, "user"})
"""Keys that identify a person or house, in any protocol.

The path of an adapter and a network address do, as a serial number does.
"""


async def async_get_config_entry_diagnostics(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
) -> dict[str, Any]:
    """Return diagnostics for a config entry: its bus or buses and all chargers."""
    configuration = async_redact_data(dict(entry.data), _PRIVATE)
    if not _has_run(entry):
        return {"set_up": configuration}
    coordinator = entry.runtime_data
    chargers = list(coordinator.chargers.values())
    data = {
        "set_up": configuration,
        "master": _master(coordinator),
        "chargers": [_charger(coordinator, managed) for managed in chargers],
    }
    if isinstance(connections := coordinator.connections, ListenerConnections):
        listener = connections.listener
        data["listener"] = {
            "networks_allowed": len(listener.allowed),
            **plain(listener.statistics),
        }
        data["boxes"] = [
            _bus(coordinator, managed.bus, [managed])
            for managed in chargers
            if managed.is_primary_port
        ]
    elif coordinator.bus is not None:
        data |= _bus(coordinator, coordinator.bus, chargers)
    return data


async def async_get_device_diagnostics(
    hass: HomeAssistant,
    entry: EvseBusConfigEntry,
    device: DeviceEntry | ChildDeviceEntry,
) -> dict[str, Any]:
    """Return diagnostics for a charger and its bus; for the bus device: for all."""
    if not _has_run(entry):
        return await async_get_config_entry_diagnostics(hass, entry)
    coordinator = entry.runtime_data
    keys = {key for domain, key in device.identifiers if domain == DOMAIN}
    chargers = tuple(coordinator.chargers.values())
    selected = [managed for managed in chargers if managed.unique_key in keys] or [
        managed
        for managed in chargers
        if managed.subentry_id == device.config_subentry_id or managed.identity in keys
    ]
    if not selected:
        return await async_get_config_entry_diagnostics(hass, entry)
    data = [_charger(coordinator, managed) for managed in selected]
    return {
        **({"charger": data[0]} if len(data) == 1 else {"chargers": data}),
        "frames": _frames(coordinator, selected[0].bus, chargers),
    }


def _has_run(entry: EvseBusConfigEntry) -> bool:
    """Return whether a coordinator exists: not for a disabled or ignored entry."""
    return hasattr(entry, "runtime_data")


def _bus(
    coordinator: BusCoordinator, bus: Bus, chargers: Sequence[ManagedCharger]
) -> dict[str, Any]:
    """Return a line, the bus on it, and its last frames."""
    return {
        "line": {
            "settings": str(bus.line.settings),
            "echoes": bus.line.echoes,
            **plain(bus.line.statistics),
        },
        "bus": {
            "connected": bus.connected,
            "utilisation": bus.wire.statistics.utilisation(bus.now),
            "reply_timeout": round(bus.wire.round_trip.timeout, 3),
            "round_trip": bus.wire.round_trip.mean,
            **plain(bus.wire.statistics),
        },
        "frames": _frames(coordinator, bus, chargers),
    }


def _master(coordinator: BusCoordinator) -> dict[str, Any] | None:
    """Return the state of the bus master; ``None``: the protocol has none."""
    master = coordinator.connections.master
    if master is None:
        return None
    details: dict[str, Any] = plain(master.details)
    return {
        "silent": master.silent,
        "noticed": plain(master.noticed),
        "order": plain(coordinator.supply and coordinator.supply.order),
        "statistics": plain(master.statistics),
        **details,
    }


def _charger(coordinator: BusCoordinator, managed: ManagedCharger) -> dict[str, Any]:
    charger = managed.charger
    config: dict[str, Any] = plain(charger.config)
    # The name given by the user may be that of a person or a place.
    config |= {"key": REDACTED, "name": REDACTED}
    protocol = coordinator.protocol
    if protocol.address.is_serial and protocol.ports == 1:
        config[CONF_ADDRESS] = REDACTED
    data = {
        "config": config,
        "available": charger.available,
        "misses": charger.misses,
        "faults": plain(charger.faults),
        "noticed": plain(charger.noticed),
        "orders": plain(replace(charger.orders, remembered={})),
        "orders_expired": charger.orders_expired,
        "setpoint": plain(charger.setpoint),
        "limits": plain(charger.limits),
        "capabilities": plain(charger.capabilities),
        "info": plain(charger.info),
        "reading": plain(charger.reading),
        "statistics": plain(charger.statistics),
    }
    return async_redact_data(data, _PRIVATE | protocol.private)


def _frames(
    coordinator: BusCoordinator, bus: Bus, chargers: Sequence[ManagedCharger]
) -> list[dict[str, str | int]]:
    """Return the last frames of a bus, with the serial numbers hidden."""
    numbers = coordinator.protocol.serials
    known: set[str | None] = set()
    for managed in chargers:
        known.add(managed.charger.config.serial)
        if managed.charger.info is not None:
            known.add(managed.charger.info.serial)
    serials = numbers.encoded(known)
    return [
        {
            "time": datetime.fromtimestamp(frame.when, UTC).isoformat(),
            "direction": str(frame.direction),
            "bytes": frame.length,
            "hex": numbers.hide(
                frame.data,
                serials,
                whole=frame.direction is not Direction.UNREADABLE,
            ).hex(),
        }
        for frame in bus.wire.frames
    ]


def plain(value: object) -> Any:  # noqa: ANN401 - JSON has no better type
    """Return a value of the library as JSON data: a dataclass as a dict, and so on."""
    result: Any = value
    if is_dataclass(value):
        result = {
            field.name: plain(getattr(value, field.name))
            for field in fields(value)
            if not field.name.startswith("_")
        }
    elif isinstance(value, Mapping):
        result = {str(key): plain(item) for key, item in value.items()}
    elif isinstance(value, AbstractSet):
        result = sorted(plain(item) for item in value)
    elif isinstance(value, (list, tuple)):
        result = [plain(item) for item in value]
    elif isinstance(value, bytes):
        result = value.hex()
    elif isinstance(value, float) and not isfinite(value):
        result = None
    elif value is not None and not isinstance(value, (bool, int, float)):
        result = str(value)
    return result
