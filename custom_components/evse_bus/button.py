"""Buttons: restart a charger, wake a car."""

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import Final, override

from homeassistant.components.button import ButtonEntity, ButtonEntityDescription
from homeassistant.components.button.const import ButtonDeviceClass
from homeassistant.const import EntityCategory, Platform
from homeassistant.core import HomeAssistant
from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback

from .coordinator import BusCoordinator, EvseBusConfigEntry
from .entity import ChargerEntity, add_charger_entities, supported
from .errors import translated_errors
from .evse.model import Capability, Command
from .managed_charger import ManagedCharger

PARALLEL_UPDATES = 0


@dataclass(frozen=True, kw_only=True)
class CommandButtonDescription(ButtonEntityDescription):
    """Something that a charger does when told."""

    capability: Capability
    command: Command
    whole: bool = False
    """Of the whole box, where that has several ports."""


BUTTONS: Final[tuple[CommandButtonDescription, ...]] = (
    CommandButtonDescription(
        key="reset",
        translation_key="reset",
        device_class=ButtonDeviceClass.RESTART,
        entity_category=EntityCategory.CONFIG,
        capability=Capability.RESET,
        command=Command.RESET,
        whole=True,
    ),
    CommandButtonDescription(
        key="wake",
        translation_key="wake",
        capability=Capability.WAKE,
        command=Command.WAKE,
    ),
    CommandButtonDescription(
        key="stop_and_unlock",
        translation_key="stop_and_unlock",
        capability=Capability.START_REQUEST,
        command=Command.STOP_AND_UNLOCK,
    ),
    CommandButtonDescription(
        key="request_start",
        translation_key="request_start",
        capability=Capability.START_REQUEST,
        command=Command.REQUEST_START,
    ),
)


async def async_setup_entry(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
    async_add_entities: AddConfigEntryEntitiesCallback,
) -> None:
    """Set up the buttons of a bus's chargers."""
    add_charger_entities(Platform.BUTTON, entry, async_add_entities, _buttons)


def _buttons(
    coordinator: BusCoordinator, managed: ManagedCharger
) -> Iterable[ButtonEntity]:
    for description in supported(managed, BUTTONS):
        yield CommandButton(coordinator, managed, description)


class CommandButton(ChargerEntity, ButtonEntity):
    """Something that a charger does when told."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: CommandButtonDescription,
    ) -> None:
        """Belong to the charger."""
        super().__init__(coordinator, managed, description, whole=description.whole)
        self._command = description.command

    @override
    def update_attributes(self) -> Hashable:
        """Show nothing but that it is there."""
        return None

    @override
    async def async_press(self) -> None:
        """Tell the charger; return when it is known to have worked."""
        with translated_errors(self.managed.name, self.coordinator.port):
            await self.charger.command(self._command)
