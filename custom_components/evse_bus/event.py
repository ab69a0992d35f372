"""Events: keys, cards, requested starts, begin and end of a charge."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, override

from homeassistant.components.event import (
    ButtonEventType,
    EventDeviceClass,
    EventEntity,
    EventEntityDescription,
)
from homeassistant.const import Platform
from homeassistant.core import HomeAssistant, callback
from homeassistant.helpers.entity_platform import AddConfigEntryEntitiesCallback

from .chargers.managed import ManagedCharger
from .coordinator import BusCoordinator, EvseBusConfigEntry
from .entity import ChargerEntity, add_charger_entities, supported
from .evse.events import (
    KEYS,
    CardPresented,
    ChargeEnded,
    ChargeStarted,
    Event,
    KeyEvent,
    StartRequested,
)
from .evse.model import Capability

PARALLEL_UPDATES = 0

type EventData = tuple[str, Mapping[str, Any]]
"""Type and attributes of an event."""


@dataclass(frozen=True, kw_only=True)
class ChargerEventDescription(EventEntityDescription):
    """Description of the events of one kind."""

    capability: Capability
    convert: Callable[[Event], EventData | None]
    """Return type and attributes of an event; ``None``: it is of another kind."""
    of_box: bool = False


def _key(number: int) -> ChargerEventDescription:
    def convert(event: Event) -> EventData | None:
        if not isinstance(event, KeyEvent) or event.key != number:
            return None
        if event.held is None:
            return ButtonEventType.PRESS_START, {}
        return ButtonEventType.PRESS_END, {"duration": event.held}

    return ChargerEventDescription(
        key=f"key_{number}",
        translation_key="key",
        translation_placeholders={"number": str(number)},
        device_class=EventDeviceClass.BUTTON,
        event_types=[ButtonEventType.PRESS_START, ButtonEventType.PRESS_END],
        capability=Capability.KEYS,
        convert=convert,
    )


def _charge(event: Event) -> EventData | None:
    if isinstance(event, ChargeStarted):
        return "started", {}
    if isinstance(event, ChargeEnded):
        result = event.result
        return "ended", {
            "result": None if result is None else str(result),
            "energy": event.energy,
            "duration": event.duration,
        }
    return None


def _start_request(event: Event) -> EventData | None:
    if not isinstance(event, StartRequested):
        return None
    attributes: dict[str, Any] = {"optimised": event.optimised}
    if event.group is not None:
        attributes |= {"group": event.group, "number": event.number}
    return "requested", attributes


def _card(event: Event) -> EventData | None:
    if not isinstance(event, CardPresented):
        return None
    # Without the valid flag: over Ethernet the box always sets it.
    attributes: dict[str, Any] = {"tag": event.tag.hex(), "readable": event.readable}
    if event.readable:
        attributes |= {"group": event.group, "number": event.number}
    return "presented", attributes


EVENTS: Final[tuple[ChargerEventDescription, ...]] = (
    *(_key(number) for number in range(1, KEYS + 1)),
    ChargerEventDescription(
        key="charge",
        translation_key="charge",
        event_types=["started", "ended"],
        capability=Capability.START_REQUEST,
        convert=_charge,
    ),
    ChargerEventDescription(
        key="start_request",
        translation_key="start_request",
        event_types=["requested"],
        capability=Capability.START_REQUEST,
        convert=_start_request,
    ),
    ChargerEventDescription(
        key="card",
        translation_key="card",
        event_types=["presented"],
        capability=Capability.CARDS,
        convert=_card,
        of_box=True,
    ),
)


async def async_setup_entry(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
    async_add_entities: AddConfigEntryEntitiesCallback,
) -> None:
    """Set up the events of a bus's chargers."""
    add_charger_entities(Platform.EVENT, entry, async_add_entities, _events)


def _events(
    coordinator: BusCoordinator, managed: ManagedCharger
) -> Iterable[EventEntity]:
    for description in supported(managed, EVENTS):
        yield ChargerEvent(coordinator, managed, description)


class ChargerEvent(ChargerEntity, EventEntity):
    """Events of one kind at a charger."""

    def __init__(
        self,
        coordinator: BusCoordinator,
        managed: ManagedCharger,
        description: ChargerEventDescription,
    ) -> None:
        """Initialize the event entity."""
        super().__init__(coordinator, managed, description, of_box=description.of_box)
        self._convert = description.convert

    @override
    async def async_added_to_hass(self) -> None:
        """Subscribe to the events of the charger."""
        await super().async_added_to_hass()
        self.async_on_remove(self.managed.events.subscribe(self._on_event))

    @callback
    def _on_event(self, event: Event) -> None:
        """Trigger the entity if the event is of its kind."""
        if (data := self._convert(event)) is None:
            return
        event_type, attributes = data
        self._trigger_event(event_type, dict(attributes))
        self.async_write_ha_state()

    @override
    def update_attributes(self) -> None:
        """Return nothing: an event is triggered when it happens."""
