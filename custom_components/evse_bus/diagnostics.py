"""Diagnostics: all that helps to find a fault, without what identifies a house."""

from collections.abc import Mapping, Sequence, Set as AbstractSet
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from math import isfinite
from typing import Any, Final

from homeassistant.components.diagnostics import REDACTED, async_redact_data
from homeassistant.const import CONF_ADDRESS, CONF_DEVICE, CONF_HOST
from homeassistant.core import HomeAssistant
from homeassistant.helpers.device_registry import ChildDeviceEntry, DeviceEntry

from .connections import ListenerLines
from .const import CONF_SERIAL, DOMAIN
from .coordinator import BusCoordinator, EvseBusConfigEntry
from .evse.bus import Bus
from .evse.smartevse import Master
from .evse.statistics import Direction
from .redaction import on_wire, without_serial
from .unit import ChargerUnit

# An adapter's path and a network address name the house as a serial number does.
# An EVBox is addressed by its serial number.
_PRIVATE: Final = {
    CONF_DEVICE,
    CONF_HOST,
    CONF_SERIAL,
    "information",
    "serials",
    "user",
}
_PRIVATE_ADDRESS: Final = {"evbox"}


async def async_get_config_entry_diagnostics(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
) -> dict[str, Any]:
    """Return a bus, its last frames and its chargers."""
    set_up = async_redact_data(dict(entry.data), _PRIVATE)
    if not _was_set_up(entry):
        return {"set_up": set_up}
    coordinator = entry.runtime_data
    units = coordinator.units.values()
    data = {
        "set_up": set_up,
        "master": _master(coordinator),
        "chargers": [_charger(coordinator, unit) for unit in units],
    }
    if isinstance(lines := coordinator.lines, ListenerLines):
        return data | {
            "listener": {
                "networks_allowed": len(lines.listener.allowed),
                **plain(lines.listener.statistics),
            },
            "boxes": [
                _bus(coordinator, unit.bus, [unit]) for unit in units if unit.leads
            ],
        }
    return data | _bus(coordinator, lines.only, list(units)) if lines.only else data


def _was_set_up(entry: EvseBusConfigEntry) -> bool:
    """Return whether there is more to tell: not of one that is disabled or ignored."""
    return hasattr(entry, "runtime_data")


def _bus(
    coordinator: BusCoordinator, bus: Bus, units: Sequence[ChargerUnit]
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
            **plain(bus.wire.statistics),
        },
        "frames": _frames(coordinator, bus, units),
    }


async def async_get_device_diagnostics(
    hass: HomeAssistant,
    entry: EvseBusConfigEntry,
    device: DeviceEntry | ChildDeviceEntry,
) -> dict[str, Any]:
    """Return one charger and the bus's last frames; for the bus: all."""
    if not _was_set_up(entry):
        return await async_get_config_entry_diagnostics(hass, entry)
    coordinator = entry.runtime_data
    keys = {key for domain, key in device.identifiers if domain == DOMAIN}
    units = tuple(coordinator.units.values())
    mine = [unit for unit in units if unit.key in keys] or [
        unit
        for unit in units
        if unit.subentry_id == device.config_subentry_id or unit.subentry_id in keys
    ]
    if not mine:
        return await async_get_config_entry_diagnostics(hass, entry)
    told = [_charger(coordinator, unit) for unit in mine]
    return {
        **({"charger": told[0]} if len(told) == 1 else {"chargers": told}),
        "frames": _frames(coordinator, mine[0].bus, units),
    }


def _master(coordinator: BusCoordinator) -> dict[str, Any] | None:
    """Return what the master of a bus does; ``None``: the bus has none."""
    duty = coordinator.lines.duty
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


def _frames(
    coordinator: BusCoordinator, bus: Bus, units: Sequence[ChargerUnit]
) -> list[dict[str, str]]:
    protocol = coordinator.protocol.key
    chargers = [unit.charger for unit in units]
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
        for frame in bus.wire.frames
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
