"""The devices of a bus: the bus, its chargers behind it, their connectors."""

from typing import TYPE_CHECKING, Any

from homeassistant.helpers import device_registry as dr, entity_registry as er
from homeassistant.helpers.device_registry import (
    ChildDeviceEntry,
    ChildDeviceInfo,
    DeviceInfo,
)

from .const import DOMAIN, MANUFACTURER

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigEntry
    from homeassistant.core import HomeAssistant

    from .unit import ChargerUnit


class BusDevices:
    """The device registry's part of one config entry."""

    def __init__(
        self, hass: HomeAssistant, entry: ConfigEntry, protocol_name: str
    ) -> None:
        """Register nothing yet."""
        self._hass = hass
        self._entry = entry
        self._protocol_name = protocol_name
        self._registry = dr.async_get(hass)
        self._bus_id = ""

    def show_bus(self) -> None:
        """Register the bus; chargers can hang on it only when it is there."""
        device = self._registry.async_get_or_create(
            config_entry_id=self._entry.entry_id,
            identifiers={(DOMAIN, self._entry.entry_id)},
            manufacturer=MANUFACTURER,
            model=self._protocol_name,
            name=self._entry.title,
        )
        self._bus_id = device.id

    def has(self, key: str, subentry_id: str | None = None) -> bool:
        """Return whether a charger was set up before, by its key.

        The first port of a box is there as long as the box of this subentry.
        """
        find = self._registry.async_get_device_by_identifier
        if subentry_id is not None and key in (subentry_id, f"{subentry_id}_1"):
            return find((DOMAIN, subentry_id), self._entry.entry_id) is not None
        return self._child(key) is not None or (
            find((DOMAIN, key), self._entry.entry_id) is not None
        )

    def _child(self, key: str) -> ChildDeviceEntry | None:
        return self._registry.async_get_child_device_by_identifier(
            (DOMAIN, key), self._entry.entry_id
        )

    def show_charger(self, unit: ChargerUnit) -> None:
        """Register a charger, or what has been learnt of it."""
        info = unit.charger.info
        told: dict[str, Any] = {}
        if info is not None:
            told = {
                "manufacturer": info.manufacturer,
                "model": info.model,
                "sw_version": info.firmware,
                "hw_version": info.hardware,
            }
        elif not self.has(unit.subentry_id):
            # What it told before stands: it may only be switched off.
            told = {"model": self._protocol_name}
        device = self._registry.async_get_or_create(
            config_entry_id=self._entry.entry_id,
            config_subentry_id=unit.subentry_id,
            identifiers={(DOMAIN, unit.subentry_id)},
            name=unit.subentry.title,
            via_device_id=self._bus_id,
            serial_number=(info and info.serial) or unit.charger.config.serial,
            **told,
        )
        unit.device_id = device.id
        number = unit.part or 1
        was_split = self._child(connector_key(unit, number)) is not None
        if not unit.split and (unit.parts > 1 or len(unit.numbers) > 1 or was_split):
            unit.split = True
            self._move_connector(unit, number)

    def _move_connector(self, unit: ChargerUnit, number: int) -> None:
        """Give a connector a device of its own, now that there are more."""
        child = self._registry.async_get_or_create_child(
            config_entry_id=self._entry.entry_id,
            config_subentry_id=unit.subentry_id,
            **connector_info(unit, number),
        )
        entities = er.async_get(self._hass)
        prefix = f"{connector_key(unit, number)}_"
        for entity in er.async_entries_for_device(
            entities, unit.device_id, include_disabled_entities=True
        ):
            if entity.unique_id.startswith(prefix):
                entities.async_update_entity(entity.entity_id, device_id=child.id)

    def forget_port(self, unit: ChargerUnit) -> None:
        """Delete the device of a port that is no longer used, and its entities."""
        if unit.part is not None and (child := self._child(unit.key)) is not None:
            self._registry.async_remove_device(child.id)


def connector_key(unit: ChargerUnit, number: int) -> str:
    """Return what a connector's identifiers and unique ids begin with."""
    return f"{unit.subentry_id}_{number}"


def charger_info(unit: ChargerUnit) -> DeviceInfo:
    """Return what links an entity to its charger's device."""
    return DeviceInfo(identifiers={(DOMAIN, unit.subentry_id)})


def connector_info(unit: ChargerUnit, number: int) -> ChildDeviceInfo:
    """Return a connector's device, as a part of its charger's."""
    return ChildDeviceInfo(
        identifiers={(DOMAIN, connector_key(unit, number))},
        parent_device_id=unit.device_id,
        translation_key="connector" if unit.part is None else "port",
        translation_placeholders={"number": str(number)},
    )
