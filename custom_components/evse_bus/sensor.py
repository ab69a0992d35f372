"""Sensors: readings of the chargers, and statistics of the bus."""

from collections.abc import Callable, Hashable, Iterable
from datetime import datetime
from functools import partial
from typing import Any, override

from homeassistant.components.sensor import (
    SensorEntity,
    SensorEntityDescription,
)
from homeassistant.const import Platform
from homeassistant.core import HomeAssistant
from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback
from homeassistant.util import dt as dt_util

from .chargers.managed import ManagedCharger
from .connections import ListenerConnections
from .coordinator import (
    BUS,
    STATISTICS,
    BusCoordinator,
    Context,
    EvseBusConfigEntry,
)
from .energy import TOTALS, Clocks, MeterRecord, MeterTotal, SummedTotal
from .entity import (
    BusEntity,
    ChargerEntity,
    ConnectorEntity,
    EvseBusEntity,
    add_charger_entities,
    supported,
)
from .evse.meter import HIGHEST_CURRENT
from .evse.model import Capability, Fault
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


class EnergySensor(ConnectorEntity, SensorEntity):
    """The total of the meter; a jump to the value of another meter is left out."""

    @override
    async def async_added_to_hass(self) -> None:
        """Continue the stored total."""
        self._store = self.hass.data[TOTALS]
        await self._store.async_load()
        self._source = self.charger
        self._total = MeterTotal(self._store.get(self._key))
        await super().async_added_to_hass()

    @override
    async def async_will_remove_from_hass(self) -> None:
        """Store the total."""
        await super().async_will_remove_from_hass()
        await self._store.async_flush()

    @property
    def _key(self) -> str:
        return self.unique_id or ""

    @override
    def update_attributes(self) -> Hashable:
        """Show the total; unknown while there is no meter reading."""
        reading = self.reading
        shown = None
        if reading is not None and reading.energy is not None:
            shown = self._update_total(reading.energy, reading.meter_generation)
        self._attr_native_value = shown
        return shown

    def _update_total(self, energy: float, generation: int) -> float:
        clocks = _clocks(self.hass)
        if self._source is not self.charger:
            # Its meters, and their generations, begin anew.
            self._source = self.charger
            self._total = MeterTotal(self._total.record(clocks))
        charger = self.charger.reading
        maximum = charger.maximum_current if charger is not None else None
        current = min(maximum or HIGHEST_CURRENT, HIGHEST_CURRENT)
        total = self._total.update(energy, generation, clocks, current)
        if (record := self._total.record(clocks)) is not None:
            self._store.put(self._key, record)
        if self._total.not_counted is not None:
            self.coordinator.issues.energy_not_counted(
                self.managed, self.number, self._total.not_counted
            )
            self._total.not_counted = None
        return total


class EstimatedEnergySensor(ConnectorEntity, SensorEntity):
    """Estimated energy: the sum of the library, continued across restarts.

    No meter keeps it, so only what is stored is shown: a total that falls after a
    crash would be taken for a new one.
    """

    @override
    async def async_added_to_hass(self) -> None:
        """Continue the stored total."""
        self._store = self.hass.data[TOTALS]
        await self._store.async_load()
        stored = self._store.get(self._key)
        self._total = SummedTotal(total=stored.total if stored is not None else 0.0)
        self.async_on_remove(self._store.subscribe(self._handle_coordinator_update))
        await super().async_added_to_hass()

    @override
    async def async_will_remove_from_hass(self) -> None:
        """Store the total."""
        await super().async_will_remove_from_hass()
        await self._store.async_flush()

    @property
    def _key(self) -> str:
        return self.unique_id or ""

    @override
    def update_attributes(self) -> Hashable:
        """Add the energy since the last update; show what is stored."""
        reading = self.reading
        summed = reading.estimated_energy if reading is not None else None
        if summed is not None:
            total = self._total.update(summed, self.charger)
            clocks = _clocks(self.hass)
            record = MeterRecord(total, total, clocks.wall, clocks.monotonic)
            known = self._store.get(self._key)
            if known is None or known.total != total:
                self._store.put(self._key, record)
        stored = self._store.stored(self._key)
        self._attr_native_value = shown = (
            None if stored is None else round(stored.total, 3)
        )
        return shown


def _clocks(hass: HomeAssistant) -> Clocks:
    return Clocks(hass.loop.time(), dt_util.utcnow().timestamp())
