"""Selects: the mode of a box, now and after a power failure."""

from collections.abc import Hashable, Iterable
from typing import Final, override

from homeassistant.components.select import SelectEntity, SelectEntityDescription
from homeassistant.const import EntityCategory, Platform
from homeassistant.core import HomeAssistant
from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback

from .chargers.managed import ManagedCharger
from .coordinator import BusCoordinator, EvseBusConfigEntry
from .entity import ChargerEntity, SettingEntity, add_charger_entities
from .errors import translated_errors
from .evse.model import Capability, Command, Mode, Setting

PARALLEL_UPDATES = 0

MODES: Final = tuple(Mode)
"""In the order of the numbers that a box stores."""

MODE: Final = SelectEntityDescription(
    key="mode", translation_key="mode", options=[str(mode) for mode in MODES]
)
MODE_AT_START: Final = SelectEntityDescription(
    key=f"setting_{Setting.MODE_AT_START}",
    translation_key=f"setting_{Setting.MODE_AT_START}",
    entity_category=EntityCategory.CONFIG,
    # The memory of a box endures a limited number of writes.
    entity_registry_enabled_default=False,
    options=[str(mode) for mode in MODES],
)


async def async_setup_entry(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
    async_add_entities: AddConfigEntryEntitiesCallback,
) -> None:
    """Set up the selects of a bus's chargers."""
    add_charger_entities(Platform.SELECT, entry, async_add_entities, _selects)


def _selects(
    coordinator: BusCoordinator, managed: ManagedCharger
) -> Iterable[SelectEntity]:
    charger = managed.charger
    if Capability.MODE in charger.capabilities:
        yield ModeSelect(coordinator, managed, MODE)
    if Setting.MODE_AT_START in charger.settings:
        yield ModeAtStartSelect(coordinator, managed, MODE_AT_START)


class ModeSelect(ChargerEntity, SelectEntity):
    """The current mode of a box, which it loses with the power."""

    @override
    def update_attributes(self) -> Hashable:
        """Show the mode last read."""
        reading = self.charger.reading
        self._attr_current_option = reading.mode if reading is not None else None
        return self._attr_current_option

    @override
    async def async_select_option(self, option: str) -> None:
        """Set the mode; return when the box has confirmed it."""
        with translated_errors(self.managed.name, self.coordinator.port):
            await self.charger.command(Command.SET_MODE, Mode(option))


class ModeAtStartSelect(SettingEntity, SelectEntity):
    """The mode in which a box starts, stored in its own memory."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: SelectEntityDescription,
    ) -> None:
        """Initialize the select."""
        super().__init__(coordinator, managed, description, Setting.MODE_AT_START)

    @override
    def update_attributes(self) -> Hashable:
        """Show the stored mode."""
        number = self.stored_value
        self._attr_current_option = None if number is None else MODES[number]
        return number

    @override
    async def async_select_option(self, option: str) -> None:
        """Write the mode to the box; return when it is read back."""
        with translated_errors(self.managed.name, self.coordinator.port):
            await self.charger.configure(self.setting, MODES.index(Mode(option)))
