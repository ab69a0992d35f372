"""Switches: the permission to charge, and features of a box."""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from typing import Any, Final, override

from homeassistant.components.switch import SwitchEntity, SwitchEntityDescription
from homeassistant.const import EntityCategory, Platform
from homeassistant.core import HomeAssistant
from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback

from .chargers.managed import ManagedCharger
from .coordinator import BusCoordinator, EvseBusConfigEntry
from .entity import (
    ChargerEntity,
    ConnectorEntity,
    add_charger_entities,
    supported,
)
from .errors import translated_errors
from .evse.charger import Charger
from .evse.model import Capability, Command, OrderChange
from .evse.readings import ConnectorReading

PARALLEL_UPDATES = 0


@dataclass(frozen=True, kw_only=True)
class CommandSwitchDescription(SwitchEntityDescription):
    """Description of a feature that a command sets and a reading reports."""

    capability: Capability
    command: Command
    value: Callable[[Charger], bool | None]


@dataclass(frozen=True, kw_only=True)
class ConnectorSwitchDescription(SwitchEntityDescription):
    """Description of a feature of one connector, set by commands."""

    capability: Capability
    turn_on: tuple[Command, bool | None]
    turn_off: tuple[Command, bool | None]
    value: Callable[[ConnectorReading], bool | None]


def _option(name: str) -> Callable[[Charger], bool | None]:
    """Return a getter for a configuration bit of the charger."""

    def value(charger: Charger) -> bool | None:
        option = charger.info.options.get(name) if charger.info else None
        return option if isinstance(option, bool) else None

    return value


ALLOWED: Final = SwitchEntityDescription(
    key="charging_allowed", translation_key="charging_allowed"
)

COMMANDS: Final[tuple[CommandSwitchDescription, ...]] = (
    CommandSwitchDescription(
        key="outlet_enabled",
        translation_key="outlet_enabled",
        capability=Capability.OUTLET_ENABLED,
        command=Command.SET_OUTLET,
        value=lambda charger: (
            None if charger.reading is None else charger.reading.outlet_enabled
        ),
    ),
    CommandSwitchDescription(
        key="upstream_timeout",
        translation_key="upstream_timeout",
        entity_category=EntityCategory.CONFIG,
        capability=Capability.UPSTREAM_TIMEOUT,
        command=Command.SET_UPSTREAM_TIMEOUT,
        value=_option("upstream_timeout"),
    ),
    CommandSwitchDescription(
        key="enable_after_power_cycle",
        translation_key="enable_after_power_cycle",
        entity_category=EntityCategory.CONFIG,
        capability=Capability.ENABLE_AFTER_POWER_CYCLE,
        command=Command.SET_ENABLE_AFTER_POWER_CYCLE,
        value=_option("enable_after_power_cycle"),
    ),
    CommandSwitchDescription(
        key="stored_access",
        translation_key="stored_access",
        entity_category=EntityCategory.CONFIG,
        # Each change wears out the memory of the box: for people, not for automations.
        entity_registry_enabled_default=False,
        capability=Capability.STORED_ACCESS,
        command=Command.STORE_ACCESS,
        value=lambda charger: (
            None if charger.reading is None else charger.reading.allowed
        ),
    ),
)


CONNECTOR_COMMANDS: Final[tuple[ConnectorSwitchDescription, ...]] = (
    ConnectorSwitchDescription(
        key="cable_lock",
        translation_key="cable_lock",
        capability=Capability.LOCK,
        turn_on=(Command.LOCK, None),
        turn_off=(Command.UNLOCK, None),
        value=lambda reading: reading.locked,
    ),
    ConnectorSwitchDescription(
        key="optimised_charging",
        translation_key="optimised_charging",
        capability=Capability.OPTIMISED,
        turn_on=(Command.SET_OPTIMISED, True),
        turn_off=(Command.SET_OPTIMISED, False),
        value=lambda reading: reading.optimised,
    ),
)


async def async_setup_entry(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
    async_add_entities: AddConfigEntryEntitiesCallback,
) -> None:
    """Set up the switches of a bus's chargers."""
    add_charger_entities(Platform.SWITCH, entry, async_add_entities, _switches)


def _switches(
    coordinator: BusCoordinator, managed: ManagedCharger
) -> Iterable[SwitchEntity]:
    yield AllowedSwitch(coordinator, managed, ALLOWED)
    for description in supported(managed, COMMANDS):
        yield CommandSwitch(coordinator, managed, description)
    for number in sorted(managed.connector_numbers):
        for connector_description in supported(managed, CONNECTOR_COMMANDS):
            yield ConnectorSwitch(coordinator, managed, number, connector_description)


class _ChargerSwitch(ChargerEntity, SwitchEntity):
    """A switch of a charger or of one of its connectors."""

    @override
    async def async_turn_on(self, **kwargs: Any) -> None:
        """Switch on; return when the charger has confirmed it."""
        with translated_errors(self.managed.name, self.coordinator.port):
            await self.async_set(on=True)

    @override
    async def async_turn_off(self, **kwargs: Any) -> None:
        """Switch off; return when the charger has confirmed it."""
        with translated_errors(self.managed.name, self.coordinator.port):
            await self.async_set(on=False)

    async def async_set(self, *, on: bool) -> None:
        """Send the new state to the charger; raises EvseError."""
        raise NotImplementedError


class AllowedSwitch(_ChargerSwitch):
    """Permission to charge, independent of the limit."""

    @override
    def update_attributes(self) -> Hashable:
        """Show the permission that the charger reports, else the one ordered.

        A charger that we have paused for lack of current stays allowed: it resumes
        without being switched on again.
        """
        self._attr_is_on = self.charger.is_allowed
        return self._attr_is_on

    @override
    async def async_set(self, *, on: bool) -> None:
        """Change the order."""
        await self.charger.change_orders(OrderChange(allowed=on))
        await self.coordinator.async_permission_set(self.managed)


class CommandSwitch(_ChargerSwitch):
    """A feature of the box that a command sets and a reading reports."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: CommandSwitchDescription,
    ) -> None:
        """Initialize the switch."""
        super().__init__(coordinator, managed, description)
        self._value = description.value
        self._command = description.command

    @override
    def update_attributes(self) -> Hashable:
        """Show the state last read."""
        self._attr_is_on = self._value(self.charger)
        return self._attr_is_on

    @override
    async def async_set(self, *, on: bool) -> None:
        """Send the command."""
        await self.charger.command(self._command, on)


class ConnectorSwitch(ConnectorEntity, _ChargerSwitch):
    """A feature of one connector that commands set and a reading reports."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        number: int,
        description: ConnectorSwitchDescription,
    ) -> None:
        """Initialize the switch."""
        super().__init__(coordinator, managed, number, description)
        self._description = description

    @override
    def update_attributes(self) -> Hashable:
        """Show the state last read."""
        reading = self.reading
        value = None if reading is None else self._description.value(reading)
        self._attr_is_on = value
        return value

    @override
    async def async_set(self, *, on: bool) -> None:
        """Send the command."""
        description = self._description
        command, value = description.turn_on if on else description.turn_off
        await self.charger.command(command, value)
