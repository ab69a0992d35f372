"""The tables of what is counted: of buses, of chargers, of a listener.

All of it is disabled at first: it is for whoever looks for a fault.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from homeassistant.components.sensor import (
    SensorDeviceClass,
    SensorEntityDescription,
    SensorStateClass,
)
from homeassistant.const import PERCENTAGE, EntityCategory, UnitOfTime

from .evse.bus import Bus
from .evse.charger import Charger
from .evse.ews import Listener


@dataclass(frozen=True, kw_only=True)
class BusSensorDescription(SensorEntityDescription):
    """A count of a bus."""

    value: Callable[[Bus], float | None]


@dataclass(frozen=True, kw_only=True)
class StatisticDescription(SensorEntityDescription):
    """A count about a charger."""

    value: Callable[[Charger], float | None]


@dataclass(frozen=True, kw_only=True)
class ListenerSensorDescription(SensorEntityDescription):
    """A count of a listener."""

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
    """Return the mean time from a request to its answer, of all chargers, s."""
    told = [charger.statistics for charger in bus.chargers.values()]
    replies = sum(statistics.replies for statistics in told)
    total = sum(statistics.round_trip_sum for statistics in told)
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
    _listener_count("strangers", lambda listener: listener.statistics.strangers),
    _listener_count("seconds", lambda listener: listener.statistics.seconds),
    _listener_count("replaced", lambda listener: listener.statistics.replaced),
)
