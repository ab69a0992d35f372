"""Tables of the sensors: readings of chargers and connectors, and statistics."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
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
from homeassistant.util import dt as dt_util

from .evse.bus import Bus
from .evse.charger import Charger
from .evse.dialling import Listener
from .evse.model import (
    Capability,
    FailSafe,
    Fault,
    OrderState,
    PauseReason,
    Phases,
    SessionResult,
    Status,
)
from .evse.readings import ChargerReading, ConnectorReading

NO_FAULT: Final = "none"
NO_PAUSE: Final = "none"

WAITING: Final = frozenset({Fault.LESS_6A, Fault.NO_CURRENT, Fault.NO_SUN})
"""Reported among the faults of a box, but none: it waits for current or the sun."""


@dataclass(frozen=True, kw_only=True)
class ChargerSensorDescription(SensorEntityDescription):
    """Description of a reading of a charger."""

    capability: Capability | None = None
    value: Callable[[Charger], str | float | None]
    of_box: bool = False
    """One sensor for a box, however many ports it has."""


@dataclass(frozen=True, kw_only=True)
class ConnectorSensorDescription(SensorEntityDescription):
    """Description of a reading of one connector."""

    capability: Capability
    value: Callable[[ConnectorReading], str | float | datetime | None]


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
_SESSION_ENERGY: Final[dict[str, Any]] = {
    "device_class": SensorDeviceClass.ENERGY,
    "native_unit_of_measurement": UnitOfEnergy.WATT_HOUR,
    "suggested_unit_of_measurement": UnitOfEnergy.KILO_WATT_HOUR,
    "suggested_display_precision": 2,
}
_SESSION_TIME: Final[dict[str, Any]] = {
    "device_class": SensorDeviceClass.DURATION,
    "native_unit_of_measurement": UnitOfTime.SECONDS,
    "suggested_unit_of_measurement": UnitOfTime.MINUTES,
    "suggested_display_precision": 0,
}
_ENERGY: Final[dict[str, Any]] = {
    "device_class": SensorDeviceClass.ENERGY,
    "native_unit_of_measurement": UnitOfEnergy.WATT_HOUR,
    "suggested_unit_of_measurement": UnitOfEnergy.KILO_WATT_HOUR,
    "state_class": SensorStateClass.TOTAL_INCREASING,
    "suggested_display_precision": 2,
}


def _one_phase(
    phases: Callable[[ConnectorReading], Phases[float | None]], index: int
) -> Callable[[ConnectorReading], float | None]:
    return lambda reading: phases(reading)[index]


def _reading_value(
    value: Callable[[ChargerReading], float | None],
) -> Callable[[Charger], float | None]:
    """Return a getter for a value of the charger's reading, if there is one."""
    return lambda charger: None if charger.reading is None else value(charger.reading)


def _per_phase(
    key: str,
    capability: Capability,
    phases: Callable[[ConnectorReading], Phases[float | None]],
    traits: dict[str, Any],
) -> tuple[ConnectorSensorDescription, ...]:
    """Return three descriptions: L1, L2 and L3."""
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


def _pilot(
    key: str, value: Callable[[ConnectorReading], float | None]
) -> ConnectorSensorDescription:
    """Return the description of a voltage that serves to find faults."""
    return ConnectorSensorDescription(
        key=key,
        translation_key=key,
        entity_category=EntityCategory.DIAGNOSTIC,
        entity_registry_enabled_default=False,
        capability=Capability.PILOT_VOLTAGE,
        value=value,
        **_VOLTAGE,
    )


def _local(clock: datetime | None) -> datetime | None:
    """Return the time on a box's clock, which is set to our time zone."""
    if clock is None:
        return None
    return clock.replace(tzinfo=dt_util.get_default_time_zone())


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
    ConnectorSensorDescription(
        key="cable_current",
        translation_key="cable_current",
        entity_category=EntityCategory.DIAGNOSTIC,
        capability=Capability.CABLE_CURRENT,
        value=lambda reading: reading.cable_current,
        **_CURRENT,
    ),
    ConnectorSensorDescription(
        key="session_energy",
        translation_key="session_energy",
        capability=Capability.SESSION,
        value=lambda reading: reading.session_energy,
        # Starts again at 0 with each charge, as this state class allows.
        state_class=SensorStateClass.TOTAL_INCREASING,
        **_SESSION_ENERGY,
    ),
    ConnectorSensorDescription(
        key="session_time",
        translation_key="session_time",
        capability=Capability.SESSION,
        value=lambda reading: reading.session_time,
        **_SESSION_TIME,
    ),
    ConnectorSensorDescription(
        key="last_session_energy",
        translation_key="last_session_energy",
        capability=Capability.SESSION,
        value=lambda reading: reading.last_session_energy,
        **_SESSION_ENERGY,
    ),
    ConnectorSensorDescription(
        key="last_session_time",
        translation_key="last_session_time",
        capability=Capability.SESSION,
        value=lambda reading: reading.last_session_time,
        **_SESSION_TIME,
    ),
    ConnectorSensorDescription(
        key="last_result",
        translation_key="last_result",
        device_class=SensorDeviceClass.ENUM,
        options=[str(result) for result in SessionResult],
        capability=Capability.SESSION,
        value=lambda reading: reading.last_result,
    ),
    ConnectorSensorDescription(
        key="last_end",
        translation_key="last_end",
        device_class=SensorDeviceClass.TIMESTAMP,
        capability=Capability.SESSION,
        value=lambda reading: _local(reading.last_end),
    ),
    ConnectorSensorDescription(
        key="user",
        translation_key="user",
        # Private: the recorder would store who charged when.
        entity_registry_enabled_default=False,
        capability=Capability.CARDS,
        value=lambda reading: reading.user,
    ),
    _pilot("pilot_low", lambda reading: reading.pilot_low),
    _pilot("pilot_high", lambda reading: reading.pilot_high),
    _pilot("proximity_voltage", lambda reading: reading.proximity_voltage),
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
        value=_reading_value(lambda reading: reading.offered_current),
        **_CURRENT,
    ),
    ChargerSensorDescription(
        key="maximum_current",
        translation_key="maximum_current",
        entity_category=EntityCategory.DIAGNOSTIC,
        capability=Capability.MAXIMUM_CURRENT,
        value=_reading_value(lambda reading: reading.maximum_current),
        **_CURRENT,
    ),
    ChargerSensorDescription(
        key="temperature",
        entity_category=EntityCategory.DIAGNOSTIC,
        device_class=SensorDeviceClass.TEMPERATURE,
        native_unit_of_measurement=UnitOfTemperature.CELSIUS,
        state_class=SensorStateClass.MEASUREMENT,
        capability=Capability.TEMPERATURE,
        value=_reading_value(lambda reading: reading.temperature),
    ),
    ChargerSensorDescription(
        key="fail_safe",
        translation_key="fail_safe",
        entity_category=EntityCategory.DIAGNOSTIC,
        device_class=SensorDeviceClass.ENUM,
        options=[str(one) for one in FailSafe],
        value=lambda charger: charger.fail_safe,
        of_box=True,
    ),
    ChargerSensorDescription(
        key="pause_reason",
        translation_key="pause_reason",
        device_class=SensorDeviceClass.ENUM,
        options=[NO_PAUSE, *(str(reason) for reason in PauseReason)],
        value=lambda charger: charger.pause_reason or NO_PAUSE,
    ),
    ChargerSensorDescription(
        key="order_state",
        translation_key="order_state",
        entity_category=EntityCategory.DIAGNOSTIC,
        device_class=SensorDeviceClass.ENUM,
        options=[str(one) for one in OrderState],
        capability=Capability.ORDER_STATE,
        value=lambda charger: charger.order_state,
    ),
)

FAULT: Final = SensorEntityDescription(
    key="fault",
    translation_key="fault",
    entity_category=EntityCategory.DIAGNOSTIC,
    device_class=SensorDeviceClass.ENUM,
    options=[NO_FAULT, *(str(fault) for fault in Fault)],
)


# -- Statistics: all but the connected boxes are disabled by default ------------


@dataclass(frozen=True, kw_only=True)
class BusSensorDescription(SensorEntityDescription):
    """Description of a statistic of a bus."""

    value: Callable[[Bus], float | None]


@dataclass(frozen=True, kw_only=True)
class StatisticDescription(SensorEntityDescription):
    """Description of a statistic of a charger."""

    value: Callable[[Charger], float | None]


@dataclass(frozen=True, kw_only=True)
class ListenerSensorDescription(SensorEntityDescription):
    """Description of a statistic of a listener."""

    value: Callable[[Listener], float | None]


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


CHARGER_STATISTICS: Final[tuple[StatisticDescription, ...]] = (
    StatisticDescription(
        key="requests",
        translation_key="requests",
        value=lambda charger: charger.statistics.requests,
        **_COUNT,
    ),
    StatisticDescription(
        key="timeouts",
        translation_key="timeouts",
        value=lambda charger: charger.statistics.timeouts,
        **_COUNT,
    ),
    StatisticDescription(
        key="bad_frames",
        translation_key="bad_frames",
        value=lambda charger: charger.statistics.bad_frames,
        **_COUNT,
    ),
    StatisticDescription(
        key="reasserted",
        translation_key="reasserted",
        value=lambda charger: charger.statistics.reasserted,
        **_COUNT,
    ),
    StatisticDescription(
        key="missed_deadlines",
        translation_key="missed_deadlines",
        value=lambda charger: charger.statistics.missed_deadlines,
        **_COUNT,
    ),
    StatisticDescription(
        key="round_trip",
        translation_key="round_trip",
        value=lambda charger: charger.statistics.round_trip_mean,
        **_ROUND_TRIP,
    ),
)


def _mean_round_trip(bus: Bus) -> float | None:
    """Return the mean time from request to reply over all chargers, s."""
    all_statistics = [charger.statistics for charger in bus.chargers.values()]
    replies = sum(statistics.replies for statistics in all_statistics)
    total = sum(statistics.round_trip_sum for statistics in all_statistics)
    return total / replies if replies else None


def _utilisation(bus: Bus) -> float | None:
    share = bus.wire.statistics.utilisation(bus.now)
    return None if share is None else share * 100


BUS_SENSORS: Final[tuple[BusSensorDescription, ...]] = (
    BusSensorDescription(
        key="requests",
        translation_key="requests",
        value=lambda bus: bus.wire.statistics.requests,
        **_COUNT,
    ),
    BusSensorDescription(
        key="timeouts",
        translation_key="timeouts",
        value=lambda bus: bus.wire.statistics.timeouts,
        **_COUNT,
    ),
    BusSensorDescription(
        key="bad_frames",
        translation_key="bad_frames",
        value=lambda bus: bus.wire.statistics.bad_frames,
        **_COUNT,
    ),
    BusSensorDescription(
        key="foreign_frames",
        translation_key="foreign_frames",
        value=lambda bus: bus.wire.statistics.foreign_frames,
        **_COUNT,
    ),
    BusSensorDescription(
        key="missed_deadlines",
        translation_key="missed_deadlines",
        value=lambda bus: bus.wire.statistics.missed_deadlines,
        **_COUNT,
    ),
    BusSensorDescription(
        key="reconnects",
        translation_key="reconnects",
        value=lambda bus: bus.wire.statistics.reopened,
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


CONNECTED_BOXES: Final = SensorEntityDescription(
    key="connected_boxes",
    translation_key="connected_boxes",
    entity_category=EntityCategory.DIAGNOSTIC,
    state_class=SensorStateClass.MEASUREMENT,
)


def _listener_count(
    key: str, value: Callable[[Listener], float]
) -> ListenerSensorDescription:
    return ListenerSensorDescription(
        key=key, translation_key=key, value=value, **_COUNT
    )


LISTENER_SENSORS: Final[tuple[ListenerSensorDescription, ...]] = (
    _listener_count("accepted", lambda listener: listener.statistics.accepted),
    _listener_count("not_allowed", lambda listener: listener.statistics.not_allowed),
    _listener_count("crowded_out", lambda listener: listener.statistics.crowded_out),
    _listener_count("unidentified", lambda listener: listener.statistics.unidentified),
    _listener_count("strangers", lambda listener: listener.statistics.unknown),
    _listener_count("seconds", lambda listener: listener.statistics.duplicates),
    _listener_count("replaced", lambda listener: listener.statistics.replaced),
)
