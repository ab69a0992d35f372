"""Diagnostics: all that helps to find a fault, without what identifies a house."""

from collections.abc import Mapping, Set as AbstractSet
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from math import isfinite
from typing import Any, Final

from homeassistant.components.diagnostics import REDACTED, async_redact_data
from homeassistant.const import CONF_ADDRESS, CONF_DEVICE
from homeassistant.core import HomeAssistant
from homeassistant.helpers.device_registry import ChildDeviceEntry, DeviceEntry

from .const import CONF_SERIAL, DOMAIN
from .coordinator import BusCoordinator, EvseBusConfigEntry
from .evse.smartevse import Master
from .evse.statistics import Direction
from .redaction import on_wire, without_serial
from .unit import ChargerUnit

# An adapter's path and a network address name the house as a serial number does.
# An EVBox is addressed by its serial number.
_PRIVATE: Final = {CONF_DEVICE, CONF_SERIAL, "serials", "information"}
_PRIVATE_ADDRESS: Final = {"evbox"}


async def async_get_config_entry_diagnostics(
    hass: HomeAssistant,
    entry: EvseBusConfigEntry,
) -> dict[str, Any]:
    """Return a bus, its last frames and its chargers."""
    coordinator = entry.runtime_data
    bus = coordinator.bus
    return {
        "set_up": async_redact_data(dict(entry.data), _PRIVATE),
        "line": {
            "settings": str(bus.line.settings),
            "echoes": bus.line.echoes,
            **plain(bus.line.statistics),
        },
        "bus": {
            "connected": bus.connected,
            "utilisation": bus.wire.statistics.utilisation(hass.loop.time()),
            **plain(bus.wire.statistics),
        },
        "master": _master(coordinator),
        "chargers": [
            _charger(coordinator, unit) for unit in coordinator.units.values()
        ],
        "frames": _frames(coordinator),
    }


async def async_get_device_diagnostics(
    hass: HomeAssistant,
    entry: EvseBusConfigEntry,
    device: DeviceEntry | ChildDeviceEntry,
) -> dict[str, Any]:
    """Return one charger and the bus's last frames; for the bus: all."""
    coordinator = entry.runtime_data
    keys = {key for domain, key in device.identifiers if domain == DOMAIN}
    for unit in coordinator.units.values():
        if unit.subentry_id == device.config_subentry_id or unit.subentry_id in keys:
            return {
                "charger": _charger(coordinator, unit),
                "frames": _frames(coordinator),
            }
    return await async_get_config_entry_diagnostics(hass, entry)


def _master(coordinator: BusCoordinator) -> dict[str, Any] | None:
    """Return what the master of a bus does; ``None``: the bus has none."""
    duty = coordinator.bus.duty
    if duty is None:
        return None
    order = coordinator.orders.supply
    data = {
        "silent": duty.silent,
        "noticed": plain(duty.noticed),
        "order": plain(order),
        "statistics": plain(duty.statistics),
    }
    if isinstance(duty, Master):
        shares = duty.shares()
        data["supply"] = plain(duty.supply)
        data["shares"] = {str(unit): share / 10 for unit, share in shares.items()}
    return data


def _charger(coordinator: BusCoordinator, unit: ChargerUnit) -> dict[str, Any]:
    charger = unit.charger
    config: dict[str, Any] = plain(charger.config)
    # What the user calls it may be a person or a place.
    config |= {"key": REDACTED, "name": REDACTED}
    if coordinator.protocol.key in _PRIVATE_ADDRESS:
        config[CONF_ADDRESS] = REDACTED
    data = {
        "config": config,
        "available": charger.available,
        "misses": charger.misses,
        "faults": plain(charger.faults),
        "noticed": plain(charger.noticed),
        "orders": plain(charger.orders),
        "orders_expired": charger.orders_expired,
        "setpoint": plain(charger.setpoint),
        "limits": plain(charger.limits),
        "capabilities": plain(charger.capabilities),
        "info": plain(charger.info),
        "reading": plain(charger.reading),
        "statistics": plain(charger.statistics),
    }
    return async_redact_data(data, _PRIVATE)


def _frames(coordinator: BusCoordinator) -> list[dict[str, str]]:
    protocol = coordinator.protocol.key
    chargers = [unit.charger for unit in coordinator.units.values()]
    told = {one.config.serial for one in chargers}
    told |= {one.info.serial for one in chargers if one.info is not None}
    serials = on_wire(protocol, told)
    return [
        {
            "time": datetime.fromtimestamp(frame.when, UTC).isoformat(),
            "direction": str(frame.direction),
            "hex": without_serial(
                protocol,
                frame.data,
                serials,
                whole=frame.direction is not Direction.UNREADABLE,
            ).hex(),
        }
        for frame in coordinator.bus.wire.frames
    ]


def plain(value: object) -> Any:  # noqa: ANN401 - JSON has no better type
    """Return a value of the library as JSON can say it."""
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
