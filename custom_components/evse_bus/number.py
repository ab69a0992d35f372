"""Numbers: limits, fail-safe values, the settings of a box, what a bus shares.

Limits show orders, never a reading: a slider that followed what the charger just
offers would go down with it and not come up again.
"""

from collections.abc import Hashable, Iterable
from functools import partial
from typing import override

from homeassistant.components.number import NumberEntity
from homeassistant.const import Platform
from homeassistant.core import HomeAssistant
from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback

from .coordinator import BusCoordinator, EvseBusConfigEntry
from .entity import BusEntity, ChargerEntity, SettingEntity, add_charger_entities
from .errors import translated_errors
from .number_tables import (
    FAIL_SAFE_CURRENT,
    NUMBERS,
    SETTINGS,
    SUPPLY,
    OrderNumberDescription,
    SettingNumberDescription,
    falls_back,
    whole,
)
from .supply import STEP, SharedSupply
from .unit import ChargerUnit

PARALLEL_UPDATES = 0


async def async_setup_entry(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
    async_add_entities: AddConfigEntryEntitiesCallback,
) -> None:
    """Set up the numbers of a bus and of its chargers."""
    if (supply := entry.runtime_data.supply) is not None:
        async_add_entities([SupplyNumber(entry.runtime_data, supply)])
    add_charger_entities(
        Platform.NUMBER, entry, async_add_entities, _numbers, _unwanted
    )


def _numbers(coordinator: BusCoordinator, unit: ChargerUnit) -> Iterable[NumberEntity]:
    order = partial(OrderNumber, coordinator, unit)
    yield from (order(entry) for entry in NUMBERS if entry.exists(unit.charger))
    setting = partial(SettingNumber, coordinator, unit)
    there = unit.charger.settings
    yield from (setting(entry) for entry in SETTINGS if entry.setting in there)


def _unwanted(unit: ChargerUnit) -> Iterable[str]:
    return () if falls_back(unit.charger) else (FAIL_SAFE_CURRENT,)


class OrderNumber(ChargerEntity, NumberEntity):
    """One number of a charger's orders."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        unit: ChargerUnit,
        description: OrderNumberDescription,
    ) -> None:
        """Belong to the charger."""
        super().__init__(coordinator, unit, description)
        self._order = description

    @override
    def show(self) -> Hashable:
        """Show the order that counts, and what may be asked for."""
        order = self._order
        limits = self.charger.limits
        self._attr_native_value = order.value(self.charger.effective_orders, limits)
        self._attr_native_min_value = order.lowest(limits)
        self._attr_native_max_value = order.highest(limits)
        self._attr_native_step = order.finest(limits)
        return (self._attr_native_value, limits)

    @override
    async def async_set_native_value(self, value: float) -> None:
        """Order a value; return when the charger follows it."""
        with translated_errors(self.unit.name, self.coordinator.port):
            await self.charger.change_orders(self._order.change(value))


class SettingNumber(SettingEntity, NumberEntity):
    """A number that a box keeps in its own memory."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        unit: ChargerUnit,
        description: SettingNumberDescription,
    ) -> None:
        """Belong to the charger."""
        super().__init__(coordinator, unit, description, description.setting)

    @override
    def show(self) -> Hashable:
        """Show what the box told, and what can be set."""
        reach = self.reach
        self._attr_native_value = self.told
        self._attr_native_min_value = reach.minimum
        self._attr_native_max_value = reach.maximum
        return (self.told, reach)

    @override
    async def async_set_native_value(self, value: float) -> None:
        """Write it into the box; return when it is read back."""
        with translated_errors(self.unit.name, self.coordinator.port):
            await self.charger.configure(self.setting, whole(value))


class SupplyNumber(BusEntity, NumberEntity):
    """What all chargers of a bus may draw together, A a phase."""

    _attr_native_step = STEP

    def __init__(self, coordinator: BusCoordinator, supply: SharedSupply) -> None:
        """Belong to the bus."""
        super().__init__(coordinator, SUPPLY)
        self._supply = supply

    @override
    def show(self) -> Hashable:
        """Show the order that counts, and what may be asked for."""
        self._attr_native_value = self._supply.limit
        self._attr_native_max_value = self._supply.installed.limit
        return (self._attr_native_value, self._attr_native_max_value)

    @override
    async def async_set_native_value(self, value: float) -> None:
        """Order it; return when it counts."""
        with translated_errors(self.coordinator.entry.title, self.coordinator.port):
            await self.coordinator.async_order_supply(value)
