"""Binary sensors: connector states, problems, and connections."""

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

from .chargers.managed import ManagedCharger
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
from .sensor_tables import WAITING

PARALLEL_UPDATES = 0


@dataclass(frozen=True, kw_only=True)
class ConnectorBinarySensorDescription(BinarySensorEntityDescription):
    """Description of a binary state of one connector."""

    capability: Capability
    value: Callable[[ConnectorReading], bool | None]


@dataclass(frozen=True, kw_only=True)
class BoxBinarySensorDescription(BinarySensorEntityDescription):
    """Description of a binary state of a whole box."""

    capability: Capability
    value: Callable[[ChargerReading], bool | None]
    of_box: bool = True


def _not(value: bool | None) -> bool | None:  # noqa: FBT001 - the value itself
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
        # This device class is on when unlocked.
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
    if (master := coordinator.connections.master) is not None:
        async_add_entities([SecondMasterSensor(coordinator, master)])
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
    orders_expire = managed.charger.config.order_lifetime is not None
    return () if orders_expire else (ORDERS_EXPIRED.key,)


class ConnectedSensor(BusEntity, BinarySensorEntity):
    """Connectivity of the port."""

    def __init__(self, coordinator: BusCoordinator, bus: Bus) -> None:
        """Initialize the binary sensor."""
        super().__init__(coordinator, CONNECTED)
        self._bus = bus

    @override
    def update_attributes(self) -> Hashable:
        """Show whether the port is open."""
        self._attr_is_on = self._bus.connected
        return self._attr_is_on


class BoxConnectedSensor(ChargerEntity, BinarySensorEntity):
    """Connectivity of a box that dials."""

    def __init__(self, coordinator: BusCoordinator, managed: ManagedCharger) -> None:
        """Initialize the binary sensor."""
        super().__init__(coordinator, managed, CONNECTED, of_box=True)

    @override
    def is_available(self) -> bool:
        """Return true: this entity reports a missing box."""
        return True

    @override
    def update_attributes(self) -> Hashable:
        """Show whether the box is connected."""
        self._attr_is_on = self.managed.bus.connected
        return self._attr_is_on


class BoxBinarySensor(ChargerEntity, BinarySensorEntity):
    """A binary state of a whole box."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: BoxBinarySensorDescription,
    ) -> None:
        """Initialize the binary sensor."""
        super().__init__(coordinator, managed, description, of_box=description.of_box)
        self._value = description.value

    @override
    def update_attributes(self) -> Hashable:
        """Show the state last read."""
        reading = self.charger.reading
        self._attr_is_on = None if reading is None else self._value(reading)
        return self._attr_is_on


class SecondMasterSensor(BusEntity, BinarySensorEntity):
    """Problem: another master is on the bus, so ours is silent."""

    def __init__(self, coordinator: BusCoordinator, master: BusMaster) -> None:
        """Initialize the binary sensor."""
        super().__init__(coordinator, SECOND_MASTER)
        self._master = master

    @override
    def update_attributes(self) -> Hashable:
        """Show whether another master was detected."""
        self._attr_is_on = Fault.SECOND_MASTER in self._master.noticed
        return self._attr_is_on


class ProblemSensor(ChargerEntity, BinarySensorEntity):
    """Problem: any fault, reported by the charger or detected by us.

    Waiting for current or for the sun is not a fault.
    """

    @override
    def is_available(self) -> bool:
        """Return whether it answers; a fault detected by us shows even if it does not."""
        return self.charger.available or bool(self.charger.noticed)

    @override
    def update_attributes(self) -> Hashable:
        """Show whether there is a fault."""
        self._attr_is_on = bool(self.charger.faults - WAITING)
        return self._attr_is_on


class OrdersExpiredSensor(ChargerEntity, BinarySensorEntity):
    """State of the orders: expired ones are replaced by the fail-safe."""

    @override
    def update_attributes(self) -> Hashable:
        """Show whether the orders have expired."""
        self._attr_is_on = self.charger.orders_expired
        return self._attr_is_on


class ConnectorBinarySensor(ConnectorEntity, BinarySensorEntity):
    """A binary state of one connector."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        number: int,
        description: ConnectorBinarySensorDescription,
    ) -> None:
        """Initialize the binary sensor."""
        super().__init__(coordinator, managed, number, description)
        self._value = description.value

    @override
    def update_attributes(self) -> Hashable:
        """Show the state last read."""
        reading = self.reading
        value = None if reading is None else self._value(reading)
        self._attr_is_on = value
        return value
