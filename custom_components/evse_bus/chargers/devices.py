"""The devices of a bus: the bus, the chargers connected via it, their connectors."""

from typing import Any

from homeassistant.config_entries import ConfigEntry
from homeassistant.core import HomeAssistant
from homeassistant.helpers import device_registry as dr, entity_registry as er
from homeassistant.helpers.device_registry import (
    ChildDeviceEntry,
    ChildDeviceInfo,
    DeviceInfo,
)

from ..const import DOMAIN, MANUFACTURER
from .managed import ManagedCharger


class BusDevices:
    """The devices of one config entry in the device registry."""

    def __init__(
        self, hass: HomeAssistant, entry: ConfigEntry, protocol_name: str
    ) -> None:
        """Register nothing yet."""
        self._hass = hass
        self._entry = entry
        self._protocol_name = protocol_name
        self._registry = dr.async_get(hass)
        self._bus_id = ""

    def register_bus(self) -> None:
        """Register the bus; chargers refer to it, so it comes first."""
        device = self._registry.async_get_or_create(
            config_entry_id=self._entry.entry_id,
            identifiers={(DOMAIN, self._entry.entry_id)},
            manufacturer=MANUFACTURER,
            model=self._protocol_name,
            name=self._entry.title,
        )
        self._bus_id = device.id

    def has(self, key: str) -> bool:
        """Return whether the bus or a box is registered, by its identifier."""
        find = self._registry.async_get_device_by_identifier
        return find((DOMAIN, key), self._entry.entry_id) is not None

    def has_charger(self, identity: str, port: int | None) -> bool:
        """Return whether a charger is registered: a box, or one port of it.

        The first port counts as registered with its box.
        """
        if port in (None, 1):
            return self.has(identity)
        return self._child(f"{identity}_{port}") is not None

    def registered_identity(self, subentry_id: str) -> str | None:
        """Return the identity under which a box is registered; ``None``: it is not."""
        for device in dr.async_entries_for_config_entry(
            self._registry, self._entry.entry_id
        ):
            if device.config_subentry_id == subentry_id:
                return next(
                    key for domain, key in device.identifiers if domain == DOMAIN
                )
        return None

    def hand_over(self, subentry_id: str, old: str, new: str) -> None:
        """Give the devices and entities of a box to the box that replaces it.

        Names, areas, entity ids and history stay as they are.
        """

        def renamed(key: str) -> str:
            return f"{new}{key.removeprefix(old)}"

        registry, entry_id = self._registry, self._entry.entry_id
        for child in dr.async_child_entries_for_config_entry(registry, entry_id):
            if child.config_subentry_id == subentry_id:
                identifiers = {
                    (domain, renamed(key)) for domain, key in child.identifiers
                }
                registry.async_update_child_device(
                    child.id, new_identifiers=identifiers
                )
        for device in dr.async_entries_for_config_entry(registry, entry_id):
            if device.config_subentry_id == subentry_id:
                registry.async_update_device(device.id, new_identifiers={(DOMAIN, new)})
        entities = er.async_get(self._hass)
        for entity in er.async_entries_for_config_entry(entities, entry_id):
            key = renamed(entity.unique_id)
            taken = entities.async_get_entity_id(entity.domain, DOMAIN, key)
            if entity.config_subentry_id == subentry_id and taken is None:
                entities.async_update_entity(entity.entity_id, new_unique_id=key)

    def _child(self, key: str) -> ChildDeviceEntry | None:
        return self._registry.async_get_child_device_by_identifier(
            (DOMAIN, key), self._entry.entry_id
        )

    def register_charger(self, managed: ManagedCharger) -> None:
        """Register the device of a charger, or update it."""
        info = managed.charger.info
        details: dict[str, Any] = {}
        if info is not None:
            details = {
                "manufacturer": info.manufacturer,
                "model": info.model,
                "sw_version": info.firmware,
                "hw_version": info.hardware,
            }
        elif not self.has(managed.identity):
            # Otherwise the details read in an earlier run stay: it may be off.
            details = {"model": self._protocol_name}
        device = self._registry.async_get_or_create(
            config_entry_id=self._entry.entry_id,
            config_subentry_id=managed.subentry_id,
            identifiers={(DOMAIN, managed.identity)},
            name=managed.subentry.title,
            via_device_id=self._bus_id,
            serial_number=(info and info.serial) or managed.charger.config.serial,
            **details,
        )
        managed.device_id = device.id
        if managed.has_child_devices:
            return
        number = managed.port_number or 1
        if (
            managed.port_count > 1
            or len(managed.connector_numbers) > 1
            or self._child(managed.connector_key(number)) is not None
        ):
            managed.has_child_devices = True
            self._move_to_child_device(managed, number)

    def _move_to_child_device(self, managed: ManagedCharger, number: int) -> None:
        """Move the entities of a connector from the box to a device of its own."""
        child = self._registry.async_get_or_create_child(
            config_entry_id=self._entry.entry_id,
            config_subentry_id=managed.subentry_id,
            **connector_info(managed, number),
        )
        entities = er.async_get(self._hass)
        prefix = f"{managed.connector_key(number)}_"
        for entity in er.async_entries_for_device(
            entities, managed.device_id, include_disabled_entities=True
        ):
            if entity.unique_id.startswith(prefix):
                entities.async_update_entity(entity.entity_id, device_id=child.id)

    def remove_port(self, managed: ManagedCharger) -> None:
        """Remove the device of a port that is no longer used, with its entities."""
        if (
            managed.port_number is not None
            and (child := self._child(managed.unique_key)) is not None
        ):
            self._registry.async_remove_device(child.id)


def charger_info(managed: ManagedCharger) -> DeviceInfo:
    """Return the device info that links an entity to its charger."""
    return DeviceInfo(identifiers={(DOMAIN, managed.identity)})


def connector_info(managed: ManagedCharger, number: int) -> ChildDeviceInfo:
    """Return the device info of a connector or port, a child of its box."""
    return ChildDeviceInfo(
        identifiers={(DOMAIN, managed.connector_key(number))},
        parent_device_id=managed.device_id,
        translation_key="connector" if managed.port_number is None else "port",
        translation_placeholders={"number": str(number)},
    )
