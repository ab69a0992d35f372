"""Numbers: limits, fail-safe values, settings of a box, the shared supply.

Limits show orders, never readings: a slider that followed the current on offer would
go down with it and not come up again. Their range is what the user has set up and
nothing else: Home Assistant refuses a value outside it, so an automation must be able
to rely on it, whatever charger and cable can do at the moment.
"""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from functools import partial
from math import floor, isfinite
from typing import Any, Final, override

from homeassistant.components.number import (
    NumberDeviceClass,
    NumberEntity,
    NumberEntityDescription,
    NumberMode,
)
from homeassistant.const import (
    EntityCategory,
    Platform,
    UnitOfElectricCurrent,
    UnitOfTime,
)
from homeassistant.core import HomeAssistant
from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback

from .chargers.managed import ManagedCharger
from .coordinator import BusCoordinator, EvseBusConfigEntry
from .entity import BusEntity, ChargerEntity, SettingEntity, add_charger_entities
from .errors import ActionError, translated_errors, wrong_action
from .evse.charger import Charger
from .evse.model import (
    Capability,
    CurrentLimit,
    Limits,
    OrderChange,
    Orders,
    Phases,
    Setting,
)
from .supply import STEP, SharedSupply

PARALLEL_UPDATES = 0

LONGEST_TIMEOUT: Final = 3600
"""Longest fail-safe time-out on offer, s; a longer one would hardly be safe."""
SHORTEST_STEP: Final = 0.1
"""Finest step of a slider, A; the protocol rounds down to its own resolution."""

FAIL_SAFE_CURRENT: Final = "fail_safe_current"


@dataclass(frozen=True, kw_only=True)
class OrderNumberDescription(NumberEntityDescription):
    """Description of one number of a charger's orders."""

    exists: Callable[[Charger], bool] = lambda _charger: True
    value: Callable[[Orders, Limits], float]
    change: Callable[[float], OrderChange]
    lowest: float = 0.0
    highest: Callable[[Limits], float] = lambda limits: limits.installation
    finest: Callable[[Limits], float] = lambda limits: max(limits.step, SHORTEST_STEP)


_CURRENT: Final[dict[str, Any]] = {
    "device_class": NumberDeviceClass.CURRENT,
    "native_unit_of_measurement": UnitOfElectricCurrent.AMPERE,
    "mode": NumberMode.SLIDER,
}


def _one_phase(index: int, value: float) -> Phases[float | None]:
    one, two, three = (value if at == index else None for at in range(3))
    return one, two, three


def _limit_of(index: int, limit: CurrentLimit, limits: Limits) -> float:
    """Return the limit of a phase; without one of its own, the installation's."""
    own = limit.phases[index]
    return limits.installation if own is None else min(own, limits.installation)


def _has(capability: Capability) -> Callable[[Charger], bool]:
    return lambda charger: capability in charger.capabilities


def falls_back(charger: Charger) -> bool:
    """Return whether a fail-safe current applies: in the box, or to expired orders."""
    return (
        Capability.FAIL_SAFE_CURRENT in charger.capabilities
        or charger.config.order_lifetime is not None
    )


def _falls_back_per_phase(charger: Charger) -> bool:
    return {Capability.FAIL_SAFE_CURRENT, Capability.PHASE_LIMITS} <= (
        charger.capabilities
    )


def _phase_limit(index: int) -> OrderNumberDescription:
    return OrderNumberDescription(
        key=f"limit_l{index + 1}",
        translation_key="limit_phase",
        translation_placeholders={"phase": f"L{index + 1}"},
        exists=_has(Capability.PHASE_LIMITS),
        value=lambda orders, limits: _limit_of(index, orders.limit, limits),
        change=lambda value: OrderChange(phases=_one_phase(index, value)),
        **_CURRENT,
    )


def _phase_fail_safe(index: int) -> OrderNumberDescription:
    return OrderNumberDescription(
        key=f"fail_safe_current_l{index + 1}",
        translation_key="fail_safe_current_phase",
        translation_placeholders={"phase": f"L{index + 1}"},
        entity_category=EntityCategory.CONFIG,
        entity_registry_enabled_default=False,
        exists=_falls_back_per_phase,
        value=lambda orders, limits: _limit_of(index, orders.fail_safe, limits),
        change=lambda value: OrderChange(fail_safe_phases=_one_phase(index, value)),
        **_CURRENT,
    )


NUMBERS: Final[tuple[OrderNumberDescription, ...]] = (
    OrderNumberDescription(
        key="charging_current",
        translation_key="charging_current",
        # The installation limit may have been lowered below the order.
        value=lambda orders, limits: min(orders.limit.current, limits.installation),
        change=lambda value: OrderChange(current=value),
        **_CURRENT,
    ),
    *(_phase_limit(index) for index in range(3)),
    OrderNumberDescription(
        key=FAIL_SAFE_CURRENT,
        translation_key="fail_safe_current",
        entity_category=EntityCategory.CONFIG,
        exists=falls_back,
        value=lambda orders, limits: min(orders.fail_safe.current, limits.installation),
        change=lambda value: OrderChange(fail_safe_current=value),
        **_CURRENT,
    ),
    *(_phase_fail_safe(index) for index in range(3)),
    OrderNumberDescription(
        key="fail_safe_timeout",
        translation_key="fail_safe_timeout",
        entity_category=EntityCategory.CONFIG,
        device_class=NumberDeviceClass.DURATION,
        native_unit_of_measurement=UnitOfTime.SECONDS,
        mode=NumberMode.BOX,
        exists=_has(Capability.FAIL_SAFE_TIMEOUT),
        value=lambda orders, _limits: orders.fail_safe_timeout,
        change=lambda value: OrderChange(fail_safe_timeout=floor(value)),
        lowest=1,
        highest=lambda _limits: LONGEST_TIMEOUT,
        finest=lambda _limits: 1,
    ),
)


# -- Settings of a box -----------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class SettingNumberDescription(NumberEntityDescription):
    """Description of a number that a box stores in its own memory."""

    setting: Setting


def _setting(setting: Setting, **traits: Any) -> SettingNumberDescription:  # noqa: ANN401 - of many types
    """Return the description of a setting.

    Disabled by default: the memory of a box endures a limited number of writes, so
    automations should not use it.
    """
    key = f"setting_{setting}"
    return SettingNumberDescription(
        key=key,
        translation_key=key,
        entity_category=EntityCategory.CONFIG,
        entity_registry_enabled_default=False,
        mode=NumberMode.BOX,
        native_step=1,
        setting=setting,
        **traits,
    )


_AMPERES: Final[dict[str, Any]] = {
    "device_class": NumberDeviceClass.CURRENT,
    "native_unit_of_measurement": UnitOfElectricCurrent.AMPERE,
}

SETTINGS: Final[tuple[SettingNumberDescription, ...]] = (
    _setting(Setting.MINIMUM_CURRENT, **_AMPERES),
    _setting(Setting.MAXIMUM_CURRENT, **_AMPERES),
    _setting(Setting.CIRCUIT_CURRENT, **_AMPERES),
    _setting(Setting.MAINS_CURRENT, **_AMPERES),
    _setting(Setting.SOLAR_START_CURRENT, **_AMPERES),
    _setting(Setting.SOLAR_IMPORT_CURRENT, **_AMPERES),
    _setting(
        Setting.SOLAR_STOP_TIME,
        device_class=NumberDeviceClass.DURATION,
        native_unit_of_measurement=UnitOfTime.MINUTES,
    ),
)


# -- Shared supply ---------------------------------------------------------------

SUPPLY: Final = NumberEntityDescription(
    key="shared_supply", translation_key="shared_supply", native_min_value=0, **_CURRENT
)


# -- Entities --------------------------------------------------------------------


def check_finite(entity: NumberEntity, value: float) -> None:
    """Raise ServiceValidationError, which names the range, unless a value is finite.

    Home Assistant's own range check lets NaN through.
    """
    if not isfinite(value):
        raise wrong_action(
            ActionError.FIELD_NUMBER,
            field=entity.name,
            minimum=f"{entity.min_value:g}",
            maximum=f"{entity.max_value:g}",
        )


async def async_setup_entry(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
    async_add_entities: AddConfigEntryEntitiesCallback,
) -> None:
    """Set up the numbers of a bus and of its chargers."""
    if (supply := entry.runtime_data.supply) is not None:
        async_add_entities([SupplyNumber(entry.runtime_data, supply)])
    add_charger_entities(
        Platform.NUMBER, entry, async_add_entities, _numbers, _obsolete
    )


def _numbers(
    coordinator: BusCoordinator, managed: ManagedCharger
) -> Iterable[NumberEntity]:
    order = partial(OrderNumber, coordinator, managed)
    yield from (order(entry) for entry in NUMBERS if entry.exists(managed.charger))
    setting = partial(SettingNumber, coordinator, managed)
    settings = managed.charger.settings
    yield from (setting(entry) for entry in SETTINGS if entry.setting in settings)


def _obsolete(managed: ManagedCharger) -> Iterable[str]:
    return () if falls_back(managed.charger) else (FAIL_SAFE_CURRENT,)


class OrderNumber(ChargerEntity, NumberEntity):
    """One number of a charger's orders."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: OrderNumberDescription,
    ) -> None:
        """Initialize the number."""
        super().__init__(coordinator, managed, description)
        self._order = description

    @override
    def update_attributes(self) -> Hashable:
        """Show the order in effect, and its range."""
        order = self._order
        limits = self.charger.limits
        self._attr_native_value = order.value(self.charger.valid_orders, limits)
        self._attr_native_min_value = order.lowest
        self._attr_native_max_value = order.highest(limits)
        self._attr_native_step = order.finest(limits)
        return (self._attr_native_value, limits.installation)

    @override
    async def async_set_native_value(self, value: float) -> None:
        """Change the order; return when the charger has confirmed it."""
        check_finite(self, value)
        with translated_errors(self.managed.name, self.coordinator.port):
            await self.charger.change_orders(self._order.change(value))


class SettingNumber(SettingEntity, NumberEntity):
    """A number that a box stores in its own memory."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: SettingNumberDescription,
    ) -> None:
        """Initialize the number."""
        super().__init__(coordinator, managed, description, description.setting)

    @override
    def update_attributes(self) -> Hashable:
        """Show the stored value, and its range."""
        value_range = self.value_range
        self._attr_native_value = self.stored_value
        self._attr_native_min_value = value_range.minimum
        self._attr_native_max_value = value_range.maximum
        return (self.stored_value, value_range)

    @override
    async def async_set_native_value(self, value: float) -> None:
        """Write the value to the box; return when it is read back."""
        check_finite(self, value)
        with translated_errors(self.managed.name, self.coordinator.port):
            await self.charger.configure(self.setting, floor(value))


class SupplyNumber(BusEntity, NumberEntity):
    """Limit of all chargers of a bus together, A per phase."""

    _attr_native_step = STEP

    def __init__(self, coordinator: BusCoordinator, supply: SharedSupply) -> None:
        """Initialize the number."""
        super().__init__(coordinator, SUPPLY)
        self._supply = supply

    @override
    def update_attributes(self) -> Hashable:
        """Show the limit in effect, and its range."""
        self._attr_native_value = self._supply.limit
        self._attr_native_max_value = self._supply.installed.limit
        return (self._attr_native_value, self._attr_native_max_value)

    @override
    async def async_set_native_value(self, value: float) -> None:
        """Change the limit; return when it is in effect."""
        check_finite(self, value)
        with translated_errors(
            self.coordinator.config_entry.title, self.coordinator.port
        ):
            await self.coordinator.async_order_supply(value)
