"""Sensors: readings of the chargers, and statistics of the bus."""

from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from math import isfinite
from typing import Any, TypeGuard, override

from homeassistant.components.sensor import (
    RestoreSensor,
    SensorEntity,
    SensorEntityDescription,
    SensorExtraStoredData,
)
from homeassistant.const import Platform
from homeassistant.core import HomeAssistant
from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback
from homeassistant.util import dt as dt_util

from .connections import ListenerConnections
from .coordinator import (
    BUS,
    STATISTICS,
    BusCoordinator,
    Context,
    EvseBusConfigEntry,
)
from .energy import MeterTotal, SummedTotal
from .entity import (
    BusEntity,
    ChargerEntity,
    ConnectorEntity,
    EvseBusEntity,
    add_charger_entities,
    supported,
)
from .evse.model import Capability, Fault
from .managed_charger import ManagedCharger
from .sensor_tables import (
    BUS_SENSORS,
    CHARGER_SENSORS,
    CHARGER_STATISTICS,
    CONNECTED_BOXES,
    CONNECTOR_SENSORS,
    ENERGY,
    ESTIMATED_ENERGY,
    FAULT,
    LISTENER_SENSORS,
    NO_FAULT,
    WAITING,
    BusSensorDescription,
    ChargerSensorDescription,
    ConnectorSensorDescription,
    StatisticDescription,
)

PARALLEL_UPDATES = 0


async def async_setup_entry(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
    async_add_entities: AddConfigEntryEntitiesCallback,
) -> None:
    """Set up the sensors of a bus and of its chargers."""
    coordinator = entry.runtime_data
    if coordinator.bus is not None:
        async_add_entities(
            BusSensor(
                coordinator, description, partial(description.value, coordinator.bus)
            )
            for description in BUS_SENSORS
        )
    if isinstance(lines := coordinator.connections, ListenerConnections):
        connected = BusSensor(
            coordinator, CONNECTED_BOXES, lambda: lines.connected, BUS
        )
        async_add_entities([connected])
        async_add_entities(
            BusSensor(coordinator, counted, partial(counted.value, lines.listener))
            for counted in LISTENER_SENSORS
        )
    add_charger_entities(Platform.SENSOR, entry, async_add_entities, _sensors)


def _sensors(
    coordinator: BusCoordinator, managed: ManagedCharger
) -> Iterable[SensorEntity]:
    charger = managed.charger
    yield from _line_sensors(coordinator, managed)
    for description in supported(managed, CHARGER_SENSORS):
        yield ChargerSensor(coordinator, managed, description)
    for statistic in CHARGER_STATISTICS:
        # Looks the charger up at each use: a changed configuration may replace it.
        yield ChargerStatistic(
            coordinator,
            managed,
            statistic,
            partial(_charger_statistic, managed, statistic),
        )
    if Capability.FAULTS in charger.capabilities:
        yield FaultSensor(coordinator, managed, FAULT)
    for number in sorted(managed.connector_numbers):
        for connector_description in supported(managed, CONNECTOR_SENSORS):
            yield ConnectorSensor(coordinator, managed, number, connector_description)
        if Capability.ENERGY in charger.capabilities:
            yield EnergySensor(coordinator, managed, number, ENERGY)
        if Capability.ESTIMATED_ENERGY in charger.capabilities:
            yield EstimatedEnergySensor(coordinator, managed, number, ESTIMATED_ENERGY)


def _line_sensors(
    coordinator: BusCoordinator, managed: ManagedCharger
) -> Iterable[SensorEntity]:
    """Return the statistics of a line that a box has for itself."""
    if managed.is_primary_port and coordinator.bus is None:
        for description in BUS_SENSORS:
            yield ChargerStatistic(
                coordinator,
                managed,
                description,
                partial(_bus_statistic, managed, description),
                of_box=True,
            )


def _charger_statistic(
    managed: ManagedCharger, description: StatisticDescription
) -> float | None:
    return description.value(managed.charger)


def _bus_statistic(
    managed: ManagedCharger, description: BusSensorDescription
) -> float | None:
    return description.value(managed.bus)


class _ValueSensor(EvseBusEntity, SensorEntity):
    """A sensor that shows a single value."""

    @override
    def update_attributes(self) -> Hashable:
        """Show the value."""
        self._attr_native_value = value = self.value()
        return value

    def value(self) -> str | float | datetime | None:
        """Return the value to show."""
        raise NotImplementedError


class BusSensor(BusEntity, _ValueSensor):
    """A statistic of a bus or a listener."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        description: SensorEntityDescription,
        value: Callable[[], float | None],
        context: Context = STATISTICS,
    ) -> None:
        """Initialize the sensor; statistics are updated at intervals."""
        super().__init__(coordinator, description, context)
        self._value = value

    @override
    def value(self) -> float | None:
        """Return the value of the statistic."""
        return self._value()


class ChargerSensor(ChargerEntity, _ValueSensor):
    """A reading of a charger."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: ChargerSensorDescription,
    ) -> None:
        """Initialize the sensor."""
        super().__init__(coordinator, managed, description, of_box=description.of_box)
        self._value = description.value

    @override
    def value(self) -> str | float | None:
        """Return the value last read."""
        return self._value(self.charger)


class ChargerStatistic(ChargerEntity, _ValueSensor):
    """A statistic of a charger or its line, available even if it does not answer."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: SensorEntityDescription,
        value: Callable[[], float | None],
        *,
        of_box: bool = False,
    ) -> None:
        """Initialize the sensor, which is updated at intervals."""
        super().__init__(coordinator, managed, description, STATISTICS, of_box=of_box)
        self._value = value

    @override
    def is_available(self) -> bool:
        """Return true: the counters matter most while the charger does not answer."""
        return True

    @override
    def value(self) -> float | None:
        """Return the value of the statistic."""
        return self._value()


class FaultSensor(ChargerEntity, SensorEntity):
    """The most important fault; the attributes list all of them."""

    @override
    def is_available(self) -> bool:
        """Return whether it answers; a fault detected by us shows even if it does not."""
        return self.charger.available or bool(self.charger.noticed)

    @override
    def update_attributes(self) -> Hashable:
        """Show the first fault in the order of `Fault`, reasons for waiting last."""
        faults = [fault for fault in Fault if fault in self.charger.faults]
        faults.sort(key=lambda fault: fault in WAITING)
        reading = self.charger.reading
        codes = reading.fault_codes if reading else ()
        self._attr_native_value = faults[0] if faults else NO_FAULT
        self._attr_extra_state_attributes: dict[str, Any] = {
            "faults": [str(fault) for fault in faults],
            "codes": list(codes),
        }
        return (tuple(faults), codes)


class ConnectorSensor(ConnectorEntity, _ValueSensor):
    """A reading of one connector."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        number: int,
        description: ConnectorSensorDescription,
    ) -> None:
        """Initialize the sensor."""
        super().__init__(coordinator, managed, number, description)
        self._value = description.value

    @override
    def value(self) -> str | float | datetime | None:
        """Return the value last read."""
        reading = self.reading
        return None if reading is None else self._value(reading)


class EnergySensor(ConnectorEntity, RestoreSensor):
    """The total of the meter; a jump to the value of another meter is left out."""

    @override
    async def async_added_to_hass(self) -> None:
        """Restore the total of the last run."""
        self._total = MeterTotal()
        self._stored_at = dt_util.utcnow()
        data = await self.async_get_last_sensor_data()
        extra = await self.async_get_last_extra_data()
        state = await self.async_get_last_state()
        if data is not None and extra is not None and state is not None:
            offset = extra.as_dict().get("offset")
            if is_energy(data.native_value) and is_energy(offset):
                self._total = MeterTotal(offset=offset, total=data.native_value)
                self._stored_at = state.last_updated
        await super().async_added_to_hass()

    @override
    def update_attributes(self) -> Hashable:
        """Show the total; unknown while there is no meter reading."""
        reading = self.reading
        shown = None
        if reading is not None and reading.energy is not None:
            downtime = (dt_util.utcnow() - self._stored_at).total_seconds()
            shown = self._total.update(
                reading.energy, reading.meter_generation, downtime
            )
        self._attr_native_value = shown
        return shown

    @property
    @override
    def extra_restore_state_data(self) -> MeterData:
        """Return the data to store for the next run."""
        return MeterData(
            self._total.total, self.native_unit_of_measurement, self._total.offset
        )


@dataclass
class MeterData(SensorExtraStoredData):
    """Stored data of a meter's total."""

    offset: float

    @override
    def as_dict(self) -> dict[str, Any]:
        """Return the data as it is stored."""
        return {**super().as_dict(), "offset": self.offset}


class EstimatedEnergySensor(ConnectorEntity, RestoreSensor):
    """Estimated energy: the sum of the library, continued across restarts."""

    @override
    async def async_added_to_hass(self) -> None:
        """Restore the total of the last run."""
        self._total = SummedTotal()
        last = await self.async_get_last_sensor_data()
        if last is not None and is_energy(last.native_value):
            self._total = SummedTotal(total=last.native_value)
        await super().async_added_to_hass()

    @override
    def update_attributes(self) -> Hashable:
        """Add the energy since the last update."""
        reading = self.reading
        summed = reading.estimated_energy if reading is not None else None
        if summed is not None:
            self._total.update(summed, self.charger)
        self._attr_native_value = shown = round(self._total.total, 3)
        return shown


def is_energy(value: object) -> TypeGuard[float]:
    """Return whether a stored value is a usable energy."""
    return isinstance(value, (int, float)) and isfinite(value)
