"""Buttons: commands without a state."""

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import Final, override

from homeassistant.components.button import ButtonEntity, ButtonEntityDescription
from homeassistant.components.button.const import ButtonDeviceClass
from homeassistant.const import EntityCategory, Platform
from homeassistant.core import HomeAssistant
from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback

from .chargers.managed import ManagedCharger
from .coordinator import BusCoordinator, EvseBusConfigEntry
from .entity import ChargerEntity, add_charger_entities, supported
from .errors import translated_errors
from .evse.model import Capability, Command

PARALLEL_UPDATES = 0


@dataclass(frozen=True, kw_only=True)
class CommandButtonDescription(ButtonEntityDescription):
    """Description of a command without a state."""

    capability: Capability
    command: Command
    of_box: bool = False
    """One button for a box, however many ports it has."""


BUTTONS: Final[tuple[CommandButtonDescription, ...]] = (
    CommandButtonDescription(
        key="reset",
        translation_key="reset",
        device_class=ButtonDeviceClass.RESTART,
        entity_category=EntityCategory.CONFIG,
        capability=Capability.RESET,
        command=Command.RESET,
        of_box=True,
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
    """A command to a charger."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: CommandButtonDescription,
    ) -> None:
        """Initialize the button."""
        super().__init__(coordinator, managed, description, of_box=description.of_box)
        self._command = description.command

    @override
    def update_attributes(self) -> Hashable:
        """Return nothing: a button has no state but its availability."""
        return None

    @override
    async def async_press(self) -> None:
        """Send the command; return when the charger has confirmed it."""
        with translated_errors(self.managed.name, self.coordinator.port):
            await self.charger.command(self._command)
