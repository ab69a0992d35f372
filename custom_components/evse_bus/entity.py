"""What all entities share: whose they are, and when they speak.

An entity writes its state only when what it shows has changed: a busy bus tells
much, and most of it is what was told before.
"""

from abc import abstractmethod
from collections.abc import Callable, Hashable, Iterable
from typing import TYPE_CHECKING, Final, Protocol, override

from homeassistant.config_entries import ConfigEntryState
from homeassistant.core import callback
from homeassistant.helpers import entity_registry as er
from homeassistant.helpers.device_registry import DeviceInfo
from homeassistant.helpers.update_coordinator import BaseCoordinatorEntity

from .const import DOMAIN
from .coordinator import (
    BUS,
    BusCoordinator,
    Context,
    EvseBusConfigEntry,
)
from .devices import charger_info, connector_info, connector_key
from .unit import ChargerUnit

if TYPE_CHECKING:
    from homeassistant.helpers.entity import Entity, EntityDescription
    from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback

    from .evse.charger import Charger
    from .evse.model import Capability, Range, Setting
    from .evse.readings import ConnectorReading


_GROWING: Final = (ConfigEntryState.SETUP_IN_PROGRESS, ConfigEntryState.LOADED)


class CapabilityDescription(Protocol):
    """A description of something that not every charger has."""

    @property
    def capability(self) -> Capability | None:
        """Return what a charger must have; ``None``: every one has it."""


def supported[D: CapabilityDescription](
    unit: ChargerUnit, descriptions: Iterable[D]
) -> Iterable[D]:
    """Return what a charger has of a table.

    What is of a whole box (``whole``) is there once, however many ports it has.
    """
    capabilities = unit.charger.capabilities
    return (
        description
        for description in descriptions
        if (description.capability is None or description.capability in capabilities)
        and (unit.leads or not getattr(description, "whole", False))
    )


@callback
def add_charger_entities(
    domain: str,
    entry: EvseBusConfigEntry,
    async_add_entities: AddConfigEntryEntitiesCallback,
    make: Callable[[BusCoordinator, ChargerUnit], Iterable[Entity]],
    unwanted: Callable[[ChargerUnit], Iterable[str]] = lambda _unit: (),
) -> None:
    """Add a platform's entities for each charger, now and as more is learnt.

    ``unwanted`` returns keys of those that a charger's set-up leaves no use for;
    where they exist, they are removed.
    """
    coordinator = entry.runtime_data
    registry = er.async_get(coordinator.hass)

    @callback
    def add(unit: ChargerUnit) -> None:
        if entry.state not in _GROWING:
            # The bus still talks while the platforms are being unloaded.
            return
        for key in unwanted(unit):
            unique_id = f"{unit.key}_{key}"
            unit.added.discard((domain, unique_id))
            if known := registry.async_get_entity_id(domain, DOMAIN, unique_id):
                registry.async_remove(known)
        new = [
            entity
            for entity in make(coordinator, unit)
            if (domain, entity.unique_id) not in unit.added
        ]
        if not new:
            return
        unit.added.update((domain, entity.unique_id or "") for entity in new)
        async_add_entities(new, config_subentry_id=unit.subentry_id)

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
        """Listen in a context."""
        super().__init__(coordinator, context)
        self.entity_description = description
        self._seen: Hashable = None

    @override
    async def async_added_to_hass(self) -> None:
        """Listen, and show what is known already."""
        await super().async_added_to_hass()
        self._look()

    @callback
    @override
    def _handle_coordinator_update(self) -> None:
        """Show what has changed."""
        if self._look():
            self.async_write_ha_state()

    def _look(self) -> bool:
        """Take over what is known now; return whether it differs from before."""
        available = self.is_available()
        seen = (available, self.show() if available else None)
        if seen == self._seen:
            return False
        self._seen = seen
        self._attr_available = available
        return True

    @abstractmethod
    def is_available(self) -> bool:
        """Return whether there is anything to show."""

    @abstractmethod
    def show(self) -> Hashable:
        """Set the entity's attributes from what is known; return what they are."""

    @override
    async def async_update(self) -> None:
        """Do nothing: the bus decides when a charger is asked."""


class BusEntity(EvseBusEntity):
    """An entity of the bus itself."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        description: EntityDescription,
        context: Context = BUS,
    ) -> None:
        """Belong to the bus's device."""
        super().__init__(coordinator, context, description)
        entry_id = coordinator.entry.entry_id
        self._attr_unique_id = f"{entry_id}_{description.key}"
        self._attr_device_info = DeviceInfo(identifiers={(DOMAIN, entry_id)})

    @override
    def is_available(self) -> bool:
        """Return true: a bus that is down can still say so."""
        return True


class ChargerEntity(EvseBusEntity):
    """An entity of a whole charger."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        unit: ChargerUnit,
        description: EntityDescription,
        context: Context | None = None,
        *,
        whole: bool = False,
    ) -> None:
        """Belong to the charger's device; ``whole``: to that of its whole box."""
        super().__init__(coordinator, context or (unit.key, None), description)
        self.unit = unit
        owner = unit.subentry_id if whole else unit.key
        self._attr_unique_id = f"{owner}_{description.key}"
        self._attr_device_info = (
            connector_info(unit, unit.part)
            if unit.part is not None and unit.split and not whole
            else charger_info(unit)
        )

    @property
    def charger(self) -> Charger:
        """Return the library's charger; another one after a changed set-up."""
        return self.unit.charger

    @override
    def is_available(self) -> bool:
        """Return whether the charger answers."""
        return self.charger.available


class SettingEntity(ChargerEntity):
    """Something that a box keeps in its own memory."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        unit: ChargerUnit,
        description: EntityDescription,
        setting: Setting,
    ) -> None:
        """Belong to the charger's device."""
        super().__init__(coordinator, unit, description)
        self.setting = setting

    @property
    def told(self) -> int | None:
        """Return what the box told; ``None``: it was not read."""
        reading = self.charger.reading
        return None if reading is None else reading.settings.get(self.setting)

    @property
    def reach(self) -> Range:
        """Return from where to where it can be set."""
        return self.charger.settings[self.setting]

    @override
    def is_available(self) -> bool:
        """Return whether the charger answers and has this setting still."""
        return super().is_available() and self.setting in self.charger.settings


class ConnectorEntity(ChargerEntity):
    """An entity of one connector."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        unit: ChargerUnit,
        number: int,
        description: EntityDescription,
    ) -> None:
        """Belong to the connector's device, or to its charger's if it is the only."""
        super().__init__(coordinator, unit, description, context=(unit.key, number))
        self.number = number
        self._attr_unique_id = f"{connector_key(unit, number)}_{description.key}"
        if unit.split:
            self._attr_device_info = connector_info(unit, number)

    @property
    def reading(self) -> ConnectorReading | None:
        """Return what the charger said of this connector last."""
        return self.unit.connector(self.number)

    @override
    def is_available(self) -> bool:
        """Return whether the charger answers and still has this connector."""
        return self.reading is not None
