"""Sensors: what chargers say, and what the bus counts."""

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
from .sensor_counts import (
    BUS_SENSORS,
    CHARGER_STATISTICS,
    CONNECTED_BOXES,
    LISTENER_SENSORS,
    BusSensorDescription,
    StatisticDescription,
)
from .sensor_tables import (
    CHARGER_SENSORS,
    CONNECTOR_SENSORS,
    ENERGY,
    ESTIMATED_ENERGY,
    FAULT,
    NO_FAULT,
    WAITING,
    ChargerSensorDescription,
    ConnectorSensorDescription,
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
        boxes = BusSensor(coordinator, CONNECTED_BOXES, lambda: lines.connected, BUS)
        async_add_entities([boxes])
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
        # Another charger may be behind it after a changed set-up.
        yield ChargerStatistic(
            coordinator, managed, statistic, partial(_counted, managed, statistic)
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
    """Return what is counted of the line that a box has for itself."""
    if managed.is_primary_port and coordinator.bus is None:
        for description in BUS_SENSORS:
            yield ChargerStatistic(
                coordinator,
                managed,
                description,
                partial(_counted_of_line, managed, description),
                whole=True,
            )


def _counted(
    managed: ManagedCharger, description: StatisticDescription
) -> float | None:
    return description.value(managed.charger)


def _counted_of_line(
    managed: ManagedCharger, description: BusSensorDescription
) -> float | None:
    return description.value(managed.bus)


class _ValueSensor(EvseBusEntity, SensorEntity):
    """A sensor whose state is one value."""

    @override
    def update_attributes(self) -> Hashable:
        """Show the value."""
        self._attr_native_value = value = self.value()
        return value

    def value(self) -> str | float | datetime | None:
        """Return what to show."""
        raise NotImplementedError


class BusSensor(BusEntity, _ValueSensor):
    """Something of a port's bus, or of a listener."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        description: SensorEntityDescription,
        value: Callable[[], float | None],
        context: Context = STATISTICS,
    ) -> None:
        """Be told from time to time, or in another context."""
        super().__init__(coordinator, description, context)
        self._value = value

    @override
    def value(self) -> float | None:
        """Return what was counted."""
        return self._value()


class ChargerSensor(ChargerEntity, _ValueSensor):
    """Something a charger says of itself."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: ChargerSensorDescription,
    ) -> None:
        """Be told with the charger."""
        super().__init__(coordinator, managed, description, whole=description.whole)
        self._value = description.value

    @override
    def value(self) -> str | float | None:
        """Return what the charger said."""
        return self._value(self.charger)


class ChargerStatistic(ChargerEntity, _ValueSensor):
    """A count about a charger or its line; there also when nobody answers."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: SensorEntityDescription,
        value: Callable[[], float | None],
        *,
        whole: bool = False,
    ) -> None:
        """Be told from time to time."""
        super().__init__(coordinator, managed, description, STATISTICS, whole=whole)
        self._value = value

    @override
    def is_available(self) -> bool:
        """Return true: how often it did not answer is best known then."""
        return True

    @override
    def value(self) -> float | None:
        """Return what was counted."""
        return self._value()


class FaultSensor(ChargerEntity, SensorEntity):
    """The most important fault; all of them are in the attributes."""

    @override
    def is_available(self) -> bool:
        """Return whether there is anything to say; we notice some things ourselves."""
        return self.charger.available or bool(self.charger.noticed)

    @override
    def update_attributes(self) -> Hashable:
        """Show the first fault in the order of their list; waiting comes last."""
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
    """Something a charger says of one connector."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        number: int,
        description: ConnectorSensorDescription,
    ) -> None:
        """Be told with the connector."""
        super().__init__(coordinator, managed, number, description)
        self._value = description.value

    @override
    def value(self) -> str | float | datetime | None:
        """Return what the charger said."""
        reading = self.reading
        return None if reading is None else self._value(reading)


class EnergySensor(ConnectorEntity, RestoreSensor):
    """The meter's total; what another meter has counted before is left out."""

    @override
    async def async_added_to_hass(self) -> None:
        """Go on from where the last run ended."""
        self._total = MeterTotal()
        self._kept_at = dt_util.utcnow()
        data = await self.async_get_last_sensor_data()
        extra = await self.async_get_last_extra_data()
        state = await self.async_get_last_state()
        if data is not None and extra is not None and state is not None:
            offset = extra.as_dict().get("offset")
            if is_energy(data.native_value) and is_energy(offset):
                self._total = MeterTotal(offset=offset, total=data.native_value)
                self._kept_at = state.last_updated
        await super().async_added_to_hass()

    @override
    def update_attributes(self) -> Hashable:
        """Show the total; unknown while the meter is not told."""
        reading = self.reading
        shown = None
        if reading is not None and reading.energy is not None:
            away = (dt_util.utcnow() - self._kept_at).total_seconds()
            shown = self._total.take(reading.energy, reading.meter_generation, away)
        self._attr_native_value = shown
        return shown

    @property
    @override
    def extra_restore_state_data(self) -> MeterData:
        """Return what is kept for the next run."""
        return MeterData(
            self._total.total, self.native_unit_of_measurement, self._total.offset
        )


@dataclass
class MeterData(SensorExtraStoredData):
    """What is kept of a meter's total."""

    offset: float

    @override
    def as_dict(self) -> dict[str, Any]:
        """Return it as it is stored."""
        return {**super().as_dict(), "offset": self.offset}


class EstimatedEnergySensor(ConnectorEntity, RestoreSensor):
    """Estimated energy: summed by the library since its start, and by us before."""

    @override
    async def async_added_to_hass(self) -> None:
        """Go on from where the last run ended."""
        self._total = SummedTotal()
        last = await self.async_get_last_sensor_data()
        if last is not None and is_energy(last.native_value):
            self._total = SummedTotal(total=last.native_value)
        await super().async_added_to_hass()

    @override
    def update_attributes(self) -> Hashable:
        """Add what came since the last look."""
        reading = self.reading
        summed = reading.estimated_energy if reading is not None else None
        if summed is not None:
            self._total.take(summed, self.charger)
        self._attr_native_value = shown = round(self._total.total, 3)
        return shown


def is_energy(value: object) -> TypeGuard[float]:
    """Return whether a stored value can be used as an energy."""
    return isinstance(value, (int, float)) and isfinite(value)
