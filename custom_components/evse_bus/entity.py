"""Base classes of the entities: their devices, and when they write their state.

An entity writes its state only when a value it shows has changed: most updates from a
busy bus repeat the previous values.
"""

from abc import abstractmethod
from collections.abc import Callable, Hashable, Iterable
from functools import partial
from typing import Final, Protocol, override

from homeassistant.config_entries import ConfigEntryState
from homeassistant.core import callback
from homeassistant.helpers import entity_registry as er
from homeassistant.helpers.device_registry import DeviceInfo
from homeassistant.helpers.entity import Entity, EntityDescription
from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback
from homeassistant.helpers.update_coordinator import BaseCoordinatorEntity

from .chargers.devices import charger_info, connector_info
from .chargers.managed import ManagedCharger
from .const import DOMAIN
from .coordinator import BUS, BusCoordinator, Context, EvseBusConfigEntry
from .evse.charger import Charger
from .evse.model import Capability, Range, Setting
from .evse.readings import ConnectorReading

_ADDING_STATES: Final = (ConfigEntryState.SETUP_IN_PROGRESS, ConfigEntryState.LOADED)


class CapabilityDescription(Protocol):
    """A description of an entity that only some chargers have."""

    @property
    def capability(self) -> Capability | None:
        """Return the capability a charger must have; ``None``: all chargers have it."""


def supported[D: CapabilityDescription](
    managed: ManagedCharger, descriptions: Iterable[D]
) -> Iterable[D]:
    """Return the descriptions from a table that apply to a charger.

    A description of a whole box (``of_box``) applies to its primary port only.
    """
    capabilities = managed.charger.capabilities
    return (
        description
        for description in descriptions
        if (description.capability is None or description.capability in capabilities)
        and (managed.is_primary_port or not getattr(description, "of_box", False))
    )


@callback
def add_charger_entities(
    domain: str,
    entry: EvseBusConfigEntry,
    async_add_entities: AddConfigEntryEntitiesCallback,
    make: Callable[[BusCoordinator, ManagedCharger], Iterable[Entity]],
    obsolete: Callable[[ManagedCharger], Iterable[str]] = lambda _managed: (),
) -> None:
    """Add the entities of a platform for each charger, now and as more are found.

    ``obsolete`` returns the keys of entities that a charger's configuration rules
    out; existing ones are removed from the registry.
    """
    coordinator = entry.runtime_data
    registry = er.async_get(coordinator.hass)

    @callback
    def add(managed: ManagedCharger) -> None:
        if entry.state not in _ADDING_STATES:
            # The bus still polls while the platforms are being unloaded.
            return
        for key in obsolete(managed):
            unique_id = f"{managed.unique_key}_{key}"
            managed.added_entities.discard((domain, unique_id))
            if known := registry.async_get_entity_id(domain, DOMAIN, unique_id):
                registry.async_remove(known)
        new = [
            entity
            for entity in make(coordinator, managed)
            if (domain, entity.unique_id) not in managed.added_entities
        ]
        if not new:
            return
        managed.added_entities.update(
            (domain, entity.unique_id or "") for entity in new
        )
        async_add_entities(new, config_subentry_id=managed.subentry_id)

    coordinator.async_add_platform(add)


class EvseBusEntity(BaseCoordinatorEntity[BusCoordinator]):
    """An entity of a bus, a charger or a connector."""

    _attr_has_entity_name = True

    def __init__(
        self,
        coordinator: BusCoordinator,
        context: Context,
        description: EntityDescription,
    ) -> None:
        """Initialize the entity, which listens in this context."""
        super().__init__(coordinator, context)
        self.entity_description = description
        self._last_shown: Hashable = None

    @override
    async def async_added_to_hass(self) -> None:
        """Start listening, and show the current values."""
        await super().async_added_to_hass()
        self._update()

    @callback
    @override
    def _handle_coordinator_update(self) -> None:
        """Write the state if anything shown has changed."""
        if self._update():
            self.async_write_ha_state()

    def _update(self) -> bool:
        """Update the attributes; return whether any of them has changed."""
        available = self.is_available()
        shown = (available, self.update_attributes() if available else None)
        if shown == self._last_shown:
            return False
        self._last_shown = shown
        self._attr_available = available
        return True

    @abstractmethod
    def is_available(self) -> bool:
        """Return whether the entity has values to show."""

    @abstractmethod
    def update_attributes(self) -> Hashable:
        """Set the entity's attributes; return their values, to detect changes."""

    @override
    async def async_update(self) -> None:
        """Do nothing: the bus schedules its polls itself."""


class BusEntity(EvseBusEntity):
    """An entity of the bus itself."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        description: EntityDescription,
        context: Context = BUS,
    ) -> None:
        """Attach the entity to the device of the bus."""
        super().__init__(coordinator, context, description)
        entry_id = coordinator.config_entry.entry_id
        self._attr_unique_id = f"{entry_id}_{description.key}"
        self._attr_device_info = DeviceInfo(identifiers={(DOMAIN, entry_id)})

    @override
    def is_available(self) -> bool:
        """Return true: the state of a bus is known even while its port is closed."""
        return True


class ChargerEntity(EvseBusEntity):
    """An entity of a whole charger."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: EntityDescription,
        context: Context | None = None,
        *,
        of_box: bool = False,
    ) -> None:
        """Attach the entity to the charger's device; ``of_box``: to that of its box."""
        super().__init__(coordinator, context or (managed.key, None), description)
        self.managed = managed
        owner = managed.identity if of_box else managed.unique_key
        self._attr_unique_id = f"{owner}_{description.key}"
        self._attr_device_info = (
            connector_info(managed, managed.port_number)
            if managed.port_number is not None
            and managed.has_child_devices
            and not of_box
            else charger_info(managed)
        )

    @override
    async def async_added_to_hass(self) -> None:
        """Register with the charger, which may be replaced by another box."""
        await super().async_added_to_hass()
        self.managed.entities.add(self)
        self.async_on_remove(partial(self.managed.entities.discard, self))

    @property
    def charger(self) -> Charger:
        """Return the charger of the library; a changed configuration may replace it."""
        return self.managed.charger

    @override
    def is_available(self) -> bool:
        """Return whether the charger answers."""
        return self.charger.available


class SettingEntity(ChargerEntity):
    """A setting that a box stores in its own memory."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: EntityDescription,
        setting: Setting,
    ) -> None:
        """Attach the entity to the charger's device."""
        super().__init__(coordinator, managed, description)
        self.setting = setting

    @property
    def stored_value(self) -> int | None:
        """Return the value read from the box; ``None``: not read yet."""
        reading = self.charger.reading
        return None if reading is None else reading.settings.get(self.setting)

    @property
    def value_range(self) -> Range:
        """Return the range in which it can be set."""
        return self.charger.settings[self.setting]

    @override
    def is_available(self) -> bool:
        """Return whether the charger answers and still has this setting."""
        return super().is_available() and self.setting in self.charger.settings


class ConnectorEntity(ChargerEntity):
    """An entity of one connector."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        number: int,
        description: EntityDescription,
    ) -> None:
        """Attach the entity to the connector's device; a single one has none."""
        super().__init__(
            coordinator, managed, description, context=(managed.key, number)
        )
        self.number = number
        self._attr_unique_id = f"{managed.connector_key(number)}_{description.key}"
        if managed.has_child_devices:
            self._attr_device_info = connector_info(managed, number)

    @property
    def reading(self) -> ConnectorReading | None:
        """Return the connector's last reading; ``None``: not available."""
        return self.managed.connector(self.number)

    @override
    def is_available(self) -> bool:
        """Return whether the charger answers and still has this connector."""
        return self.reading is not None
