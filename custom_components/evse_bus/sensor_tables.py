"""The tables of all sensors."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

from homeassistant.components.sensor import (
    SensorDeviceClass,
    SensorEntityDescription,
    SensorStateClass,
)
from homeassistant.const import (
    PERCENTAGE,
    EntityCategory,
    UnitOfElectricCurrent,
    UnitOfElectricPotential,
    UnitOfEnergy,
    UnitOfPower,
    UnitOfTemperature,
    UnitOfTime,
)

from .coordinator import BusCoordinator
from .evse.charger import Charger
from .evse.model import Capability, Fault, Phases, Status
from .evse.readings import ChargerReading, ConnectorReading

NO_FAULT: Final = "none"

WAITING: Final = frozenset({Fault.LESS_6A, Fault.NO_CURRENT, Fault.NO_SUN})
"""What a box tells among its faults, and is none: it waits for current or the sun."""


class FailSafe(StrEnum):
    """What a charger does when it no longer hears from Home Assistant."""

    NOTHING = "nothing"
    """The last limit stands."""
    FALLS_BACK = "falls_back"
    """It charges with its fail-safe current after its time-out."""
    STOPS = "stops"


@dataclass(frozen=True, kw_only=True)
class BusSensorDescription(SensorEntityDescription):
    """A count of the bus."""

    value: Callable[[BusCoordinator], float | None]


@dataclass(frozen=True, kw_only=True)
class ChargerSensorDescription(SensorEntityDescription):
    """Something a charger says of itself, or that is counted about it."""

    capability: Capability | None = None
    value: Callable[[Charger], str | float | None]


@dataclass(frozen=True, kw_only=True)
class ConnectorSensorDescription(SensorEntityDescription):
    """Something a charger says of one connector."""

    capability: Capability
    value: Callable[[ConnectorReading], str | float | None]


_CURRENT: Final[dict[str, Any]] = {
    "device_class": SensorDeviceClass.CURRENT,
    "native_unit_of_measurement": UnitOfElectricCurrent.AMPERE,
    "state_class": SensorStateClass.MEASUREMENT,
    "suggested_display_precision": 1,
}
_VOLTAGE: Final[dict[str, Any]] = {
    "device_class": SensorDeviceClass.VOLTAGE,
    "native_unit_of_measurement": UnitOfElectricPotential.VOLT,
    "state_class": SensorStateClass.MEASUREMENT,
    "suggested_display_precision": 1,
}
_COS_PHI: Final[dict[str, Any]] = {
    "device_class": SensorDeviceClass.POWER_FACTOR,
    "state_class": SensorStateClass.MEASUREMENT,
    "suggested_display_precision": 2,
}
_POWER: Final[dict[str, Any]] = {
    "device_class": SensorDeviceClass.POWER,
    "native_unit_of_measurement": UnitOfPower.WATT,
    "state_class": SensorStateClass.MEASUREMENT,
    "suggested_display_precision": 0,
}
_ENERGY: Final[dict[str, Any]] = {
    "device_class": SensorDeviceClass.ENERGY,
    "native_unit_of_measurement": UnitOfEnergy.WATT_HOUR,
    "suggested_unit_of_measurement": UnitOfEnergy.KILO_WATT_HOUR,
    "state_class": SensorStateClass.TOTAL_INCREASING,
    "suggested_display_precision": 2,
}
_COUNT: Final[dict[str, Any]] = {
    "entity_category": EntityCategory.DIAGNOSTIC,
    "entity_registry_enabled_default": False,
    "state_class": SensorStateClass.TOTAL_INCREASING,
}
_ROUND_TRIP: Final[dict[str, Any]] = {
    "entity_category": EntityCategory.DIAGNOSTIC,
    "entity_registry_enabled_default": False,
    "device_class": SensorDeviceClass.DURATION,
    "native_unit_of_measurement": UnitOfTime.SECONDS,
    "suggested_unit_of_measurement": UnitOfTime.MILLISECONDS,
    "state_class": SensorStateClass.MEASUREMENT,
    "suggested_display_precision": 1,
}


def _one_phase(
    phases: Callable[[ConnectorReading], Phases[float | None]], index: int
) -> Callable[[ConnectorReading], float | None]:
    return lambda reading: phases(reading)[index]


def _told(
    value: Callable[[ChargerReading], float | None],
) -> Callable[[Charger], float | None]:
    """Return how to get at a reading that may not be there."""
    return lambda charger: None if charger.reading is None else value(charger.reading)


def _per_phase(
    key: str,
    capability: Capability,
    phases: Callable[[ConnectorReading], Phases[float | None]],
    traits: dict[str, Any],
) -> tuple[ConnectorSensorDescription, ...]:
    """Return one description for each of L1, L2, L3."""
    return tuple(
        ConnectorSensorDescription(
            key=f"{key}_{phase}",
            translation_key=f"{key}_phase",
            translation_placeholders={"phase": phase.upper()},
            capability=capability,
            value=_one_phase(phases, index),
            **traits,
        )
        for index, phase in enumerate(("l1", "l2", "l3"))
    )


def _fail_safe(charger: Charger) -> FailSafe | None:
    """Return what a charger does in silence; ``None``: that is not known yet."""
    # A fail-safe current alone may be just for orders that nobody renews.
    if Capability.FAIL_SAFE_TIMEOUT in charger.capabilities:
        return FailSafe.FALLS_BACK
    if charger.bus is not None and charger.bus.duty is not None:
        # A slave without its master.
        return FailSafe.STOPS
    if Capability.UPSTREAM_TIMEOUT not in charger.capabilities:
        return FailSafe.NOTHING
    own = charger.info.options.get("upstream_timeout") if charger.info else None
    if own is None:
        return None
    return FailSafe.STOPS if own else FailSafe.NOTHING


CONNECTOR_SENSORS: Final[tuple[ConnectorSensorDescription, ...]] = (
    ConnectorSensorDescription(
        key="status",
        translation_key="status",
        device_class=SensorDeviceClass.ENUM,
        options=[str(status) for status in Status],
        capability=Capability.STATUS,
        value=lambda reading: reading.status,
    ),
    ConnectorSensorDescription(
        key="raw_state",
        translation_key="raw_state",
        entity_category=EntityCategory.DIAGNOSTIC,
        capability=Capability.RAW_STATE,
        value=lambda reading: reading.raw_state,
    ),
    *_per_phase(
        "current", Capability.CURRENT, lambda reading: reading.current, _CURRENT
    ),
    *_per_phase(
        "voltage", Capability.VOLTAGE, lambda reading: reading.voltage, _VOLTAGE
    ),
    *_per_phase(
        "cos_phi", Capability.COS_PHI, lambda reading: reading.cos_phi, _COS_PHI
    ),
    ConnectorSensorDescription(
        key="power",
        capability=Capability.POWER,
        value=lambda reading: reading.power,
        **_POWER,
    ),
    ConnectorSensorDescription(
        key="estimated_power",
        translation_key="estimated_power",
        capability=Capability.ESTIMATED_POWER,
        value=lambda reading: reading.estimated_power,
        **_POWER,
    ),
    ConnectorSensorDescription(
        key="minimum_current",
        translation_key="minimum_current",
        entity_category=EntityCategory.DIAGNOSTIC,
        capability=Capability.MINIMUM_CURRENT,
        value=lambda reading: reading.minimum_current,
        **_CURRENT,
    ),
)


ENERGY: Final = SensorEntityDescription(key="energy", **_ENERGY)
ESTIMATED_ENERGY: Final = SensorEntityDescription(
    key="estimated_energy", translation_key="estimated_energy", **_ENERGY
)

CHARGER_SENSORS: Final[tuple[ChargerSensorDescription, ...]] = (
    ChargerSensorDescription(
        key="offered_current",
        translation_key="offered_current",
        capability=Capability.OFFERED_CURRENT,
        value=_told(lambda reading: reading.offered_current),
        **_CURRENT,
    ),
    ChargerSensorDescription(
        key="maximum_current",
        translation_key="maximum_current",
        entity_category=EntityCategory.DIAGNOSTIC,
        capability=Capability.MAXIMUM_CURRENT,
        value=_told(lambda reading: reading.maximum_current),
        **_CURRENT,
    ),
    ChargerSensorDescription(
        key="temperature",
        entity_category=EntityCategory.DIAGNOSTIC,
        device_class=SensorDeviceClass.TEMPERATURE,
        native_unit_of_measurement=UnitOfTemperature.CELSIUS,
        state_class=SensorStateClass.MEASUREMENT,
        capability=Capability.TEMPERATURE,
        value=_told(lambda reading: reading.temperature),
    ),
    ChargerSensorDescription(
        key="fail_safe",
        translation_key="fail_safe",
        entity_category=EntityCategory.DIAGNOSTIC,
        device_class=SensorDeviceClass.ENUM,
        options=[str(one) for one in FailSafe],
        value=_fail_safe,
    ),
)

FAULT: Final = SensorEntityDescription(
    key="fault",
    translation_key="fault",
    entity_category=EntityCategory.DIAGNOSTIC,
    device_class=SensorDeviceClass.ENUM,
    options=[NO_FAULT, *(str(fault) for fault in Fault)],
)

CHARGER_STATISTICS: Final[tuple[ChargerSensorDescription, ...]] = (
    ChargerSensorDescription(
        key="requests",
        translation_key="requests",
        value=lambda charger: charger.statistics.requests,
        **_COUNT,
    ),
    ChargerSensorDescription(
        key="timeouts",
        translation_key="timeouts",
        value=lambda charger: charger.statistics.timeouts,
        **_COUNT,
    ),
    ChargerSensorDescription(
        key="bad_frames",
        translation_key="bad_frames",
        value=lambda charger: charger.statistics.bad_frames,
        **_COUNT,
    ),
    ChargerSensorDescription(
        key="reasserted",
        translation_key="reasserted",
        value=lambda charger: charger.statistics.reasserted,
        **_COUNT,
    ),
    ChargerSensorDescription(
        key="missed_deadlines",
        translation_key="missed_deadlines",
        value=lambda charger: charger.statistics.missed_deadlines,
        **_COUNT,
    ),
    ChargerSensorDescription(
        key="round_trip",
        translation_key="round_trip",
        value=lambda charger: charger.statistics.round_trip_mean,
        **_ROUND_TRIP,
    ),
)


def _mean_round_trip(coordinator: BusCoordinator) -> float | None:
    """Return the mean time from a request to its answer, of all chargers, s."""
    told = [charger.statistics for charger in coordinator.bus.chargers.values()]
    replies = sum(statistics.replies for statistics in told)
    total = sum(statistics.round_trip_sum for statistics in told)
    return total / replies if replies else None


def _utilisation(coordinator: BusCoordinator) -> float | None:
    share = coordinator.bus.wire.statistics.utilisation(coordinator.hass.loop.time())
    return None if share is None else share * 100


BUS_SENSORS: Final[tuple[BusSensorDescription, ...]] = (
    BusSensorDescription(
        key="requests",
        translation_key="requests",
        value=lambda coordinator: coordinator.bus.wire.statistics.requests,
        **_COUNT,
    ),
    BusSensorDescription(
        key="timeouts",
        translation_key="timeouts",
        value=lambda coordinator: coordinator.bus.wire.statistics.timeouts,
        **_COUNT,
    ),
    BusSensorDescription(
        key="bad_frames",
        translation_key="bad_frames",
        value=lambda coordinator: coordinator.bus.wire.statistics.bad_frames,
        **_COUNT,
    ),
    BusSensorDescription(
        key="foreign_frames",
        translation_key="foreign_frames",
        value=lambda coordinator: coordinator.bus.wire.statistics.foreign_frames,
        **_COUNT,
    ),
    BusSensorDescription(
        key="missed_deadlines",
        translation_key="missed_deadlines",
        value=lambda coordinator: coordinator.bus.wire.statistics.missed_deadlines,
        **_COUNT,
    ),
    BusSensorDescription(
        key="reconnects",
        translation_key="reconnects",
        value=lambda coordinator: coordinator.bus.wire.statistics.reopened,
        **_COUNT,
    ),
    BusSensorDescription(
        key="round_trip",
        translation_key="round_trip",
        value=_mean_round_trip,
        **_ROUND_TRIP,
    ),
    BusSensorDescription(
        key="utilisation",
        translation_key="utilisation",
        entity_category=EntityCategory.DIAGNOSTIC,
        entity_registry_enabled_default=False,
        native_unit_of_measurement=PERCENTAGE,
        state_class=SensorStateClass.MEASUREMENT,
        suggested_display_precision=1,
        value=_utilisation,
    ),
)
