"""Binary sensors: plugged, charging, problem, and whether the port is open."""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from typing import Final, override

from homeassistant.components.binary_sensor import (
    BinarySensorEntity,
    BinarySensorEntityDescription,
)
from homeassistant.components.binary_sensor.const import BinarySensorDeviceClass
from homeassistant.const import EntityCategory, Platform
from homeassistant.core import HomeAssistant
from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback

from .coordinator import BusCoordinator, EvseBusConfigEntry
from .entity import (
    BusEntity,
    ChargerEntity,
    ConnectorEntity,
    add_charger_entities,
    supported,
)
from .evse.bus import Bus
from .evse.master import BusMaster
from .evse.model import Capability, Fault
from .evse.readings import ChargerReading, ConnectorReading
from .managed_charger import ManagedCharger
from .sensor_tables import WAITING

PARALLEL_UPDATES = 0


@dataclass(frozen=True, kw_only=True)
class ConnectorBinarySensorDescription(BinarySensorEntityDescription):
    """Something a charger says of one connector."""

    capability: Capability
    value: Callable[[ConnectorReading], bool | None]


@dataclass(frozen=True, kw_only=True)
class BoxBinarySensorDescription(BinarySensorEntityDescription):
    """Something a box says of itself as a whole."""

    capability: Capability
    value: Callable[[ChargerReading], bool | None]
    whole: bool = True


def _not(value: bool | None) -> bool | None:  # noqa: FBT001 - told, or not
    return None if value is None else not value


CONNECTOR_SENSORS: Final[tuple[ConnectorBinarySensorDescription, ...]] = (
    ConnectorBinarySensorDescription(
        key="plugged",
        translation_key="plugged",
        device_class=BinarySensorDeviceClass.PLUG,
        capability=Capability.PLUGGED,
        value=lambda reading: reading.plugged,
    ),
    ConnectorBinarySensorDescription(
        key="charging",
        device_class=BinarySensorDeviceClass.BATTERY_CHARGING,
        capability=Capability.CHARGING,
        value=lambda reading: reading.charging,
    ),
    ConnectorBinarySensorDescription(
        key="start_requested",
        translation_key="start_requested",
        capability=Capability.START_REQUEST,
        value=lambda reading: reading.start_requested,
    ),
    ConnectorBinarySensorDescription(
        key="locked",
        translation_key="locked",
        # Home Assistant's class is on when something is unlocked.
        device_class=BinarySensorDeviceClass.LOCK,
        entity_category=EntityCategory.DIAGNOSTIC,
        capability=Capability.LOCK,
        value=lambda reading: _not(reading.locked),
    ),
    ConnectorBinarySensorDescription(
        key="contactor",
        translation_key="contactor",
        entity_category=EntityCategory.DIAGNOSTIC,
        capability=Capability.CONTACTOR,
        value=lambda reading: reading.contactor,
    ),
    ConnectorBinarySensorDescription(
        key="rcd_tripped",
        translation_key="rcd_tripped",
        device_class=BinarySensorDeviceClass.PROBLEM,
        entity_category=EntityCategory.DIAGNOSTIC,
        capability=Capability.RCD,
        value=lambda reading: reading.rcd_tripped,
    ),
    ConnectorBinarySensorDescription(
        key="ventilation_requested",
        translation_key="ventilation_requested",
        entity_category=EntityCategory.DIAGNOSTIC,
        capability=Capability.VENTILATION,
        value=lambda reading: reading.ventilation_requested,
    ),
)

BOX_SENSORS: Final[tuple[BoxBinarySensorDescription, ...]] = (
    BoxBinarySensorDescription(
        key="server_connected",
        translation_key="server_connected",
        device_class=BinarySensorDeviceClass.CONNECTIVITY,
        entity_category=EntityCategory.DIAGNOSTIC,
        capability=Capability.SERVER,
        value=lambda reading: reading.server_connected,
    ),
    BoxBinarySensorDescription(
        key="ventilating",
        translation_key="ventilating",
        device_class=BinarySensorDeviceClass.RUNNING,
        entity_category=EntityCategory.DIAGNOSTIC,
        capability=Capability.VENTILATION,
        value=lambda reading: reading.ventilating,
    ),
)

PROBLEM: Final = BinarySensorEntityDescription(
    key="problem", device_class=BinarySensorDeviceClass.PROBLEM
)
ORDERS_EXPIRED: Final = BinarySensorEntityDescription(
    key="orders_expired",
    translation_key="orders_expired",
    entity_category=EntityCategory.DIAGNOSTIC,
)
SECOND_MASTER: Final = BinarySensorEntityDescription(
    key="second_master",
    translation_key="second_master",
    device_class=BinarySensorDeviceClass.PROBLEM,
    entity_category=EntityCategory.DIAGNOSTIC,
)
CONNECTED: Final = BinarySensorEntityDescription(
    key="connected",
    device_class=BinarySensorDeviceClass.CONNECTIVITY,
    entity_category=EntityCategory.DIAGNOSTIC,
)


async def async_setup_entry(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
    async_add_entities: AddConfigEntryEntitiesCallback,
) -> None:
    """Set up the binary sensors of a bus and of its chargers."""
    coordinator = entry.runtime_data
    if coordinator.bus is not None:
        async_add_entities([ConnectedSensor(coordinator, coordinator.bus)])
    if (duty := coordinator.connections.master) is not None:
        async_add_entities([SecondMasterSensor(coordinator, duty)])
    add_charger_entities(
        Platform.BINARY_SENSOR, entry, async_add_entities, _sensors, _obsolete
    )


def _sensors(
    coordinator: BusCoordinator, managed: ManagedCharger
) -> Iterable[BinarySensorEntity]:
    charger = managed.charger
    yield ProblemSensor(coordinator, managed, PROBLEM)
    if managed.is_primary_port and coordinator.bus is None:
        yield BoxConnectedSensor(coordinator, managed)
    for box_description in supported(managed, BOX_SENSORS):
        yield BoxBinarySensor(coordinator, managed, box_description)
    if charger.config.order_lifetime is not None:
        yield OrdersExpiredSensor(coordinator, managed, ORDERS_EXPIRED)
    for number in sorted(managed.connector_numbers):
        for description in supported(managed, CONNECTOR_SENSORS):
            yield ConnectorBinarySensor(coordinator, managed, number, description)


def _obsolete(managed: ManagedCharger) -> Iterable[str]:
    expire = managed.charger.config.order_lifetime is not None
    return () if expire else (ORDERS_EXPIRED.key,)


class ConnectedSensor(BusEntity, BinarySensorEntity):
    """Whether the port is open."""

    def __init__(self, coordinator: BusCoordinator, bus: Bus) -> None:
        """Belong to the bus."""
        super().__init__(coordinator, CONNECTED)
        self._bus = bus

    @override
    def update_attributes(self) -> Hashable:
        """Show whether bytes can go out."""
        self._attr_is_on = self._bus.connected
        return self._attr_is_on


class BoxConnectedSensor(ChargerEntity, BinarySensorEntity):
    """Whether a box that dials us is connected."""

    def __init__(self, coordinator: BusCoordinator, managed: ManagedCharger) -> None:
        """Belong to the box."""
        super().__init__(coordinator, managed, CONNECTED, whole=True)

    @override
    def is_available(self) -> bool:
        """Return true: a box that is gone is just what this tells."""
        return True

    @override
    def update_attributes(self) -> Hashable:
        """Show whether it is connected."""
        self._attr_is_on = self.managed.bus.connected
        return self._attr_is_on


class BoxBinarySensor(ChargerEntity, BinarySensorEntity):
    """Something a box says of itself as a whole."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: BoxBinarySensorDescription,
    ) -> None:
        """Belong to the box."""
        super().__init__(coordinator, managed, description, whole=description.whole)
        self._value = description.value

    @override
    def update_attributes(self) -> Hashable:
        """Show what the box said."""
        reading = self.charger.reading
        self._attr_is_on = None if reading is None else self._value(reading)
        return self._attr_is_on


class SecondMasterSensor(BusEntity, BinarySensorEntity):
    """Whether somebody else also plays the master, so that we keep silent."""

    def __init__(self, coordinator: BusCoordinator, duty: BusMaster) -> None:
        """Belong to the bus."""
        super().__init__(coordinator, SECOND_MASTER)
        self._duty = duty

    @override
    def update_attributes(self) -> Hashable:
        """Show what was noticed."""
        self._attr_is_on = Fault.SECOND_MASTER in self._duty.noticed
        return self._attr_is_on


class ProblemSensor(ChargerEntity, BinarySensorEntity):
    """Whether there is any fault, told by the charger or noticed by us.

    A box that waits for current or for the sun is not at fault.
    """

    @override
    def is_available(self) -> bool:
        """Return whether there is anything to say; we notice some things ourselves."""
        return self.charger.available or bool(self.charger.noticed)

    @override
    def update_attributes(self) -> Hashable:
        """Show whether there is a fault."""
        self._attr_is_on = bool(self.charger.faults - WAITING)
        return self._attr_is_on


class OrdersExpiredSensor(ChargerEntity, BinarySensorEntity):
    """Whether the fail-safe counts because nobody has renewed the orders."""

    @override
    def update_attributes(self) -> Hashable:
        """Show whether the orders' lifetime is over."""
        self._attr_is_on = self.charger.orders_expired
        return self._attr_is_on


class ConnectorBinarySensor(ConnectorEntity, BinarySensorEntity):
    """Something a charger says of one connector."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        number: int,
        description: ConnectorBinarySensorDescription,
    ) -> None:
        """Be told with the connector."""
        super().__init__(coordinator, managed, number, description)
        self._value = description.value

    @override
    def update_attributes(self) -> Hashable:
        """Show what the charger said."""
        reading = self.reading
        value = None if reading is None else self._value(reading)
        self._attr_is_on = value
        return value
