"""Chargers and their entities, found in Home Assistant's registries. Pure."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
import re
from typing import Any, Final

DOMAIN: Final = "evse_bus"

_CONNECTOR: Final = re.compile(r"(\d+)_(.+)")


@dataclass(slots=True)
class Part:
    """A bus, a charger or a connector: its name, and its entities by their keys."""

    name: str
    entities: dict[str, str] = field(default_factory=dict)

    def find(self, *keys: str) -> str | None:
        """Return the first of these entities that exists."""
        return next((self.entities[key] for key in keys if key in self.entities), None)


@dataclass(slots=True)
class ListedCharger(Part):
    """A charger; entities of its connectors belong to these."""

    connectors: dict[int, Part] = field(default_factory=dict)


@dataclass(slots=True)
class ListedBus(Part):
    """A bus and its chargers, in the order of their names."""

    chargers: list[ListedCharger] = field(default_factory=list)


def list_buses(
    entities: Iterable[Mapping[str, Any]], devices: Iterable[Mapping[str, Any]]
) -> list[ListedBus]:
    """Return the buses in the registries, as the websocket API lists these.

    Disabled entities are left out: a dashboard cannot show them.
    """
    names = {
        device["id"]: device["name_by_user"] or device["name"] for device in devices
    }
    owners = {
        identifier: names[device["id"]]
        for device in devices
        for domain, identifier in device["identifiers"]
        if domain == DOMAIN
    }
    buses: dict[str, ListedBus] = {}
    chargers: dict[str, ListedCharger] = {}
    for entity in entities:
        if entity["platform"] != DOMAIN or entity["disabled_by"] is not None:
            continue
        entry, subentry = entity["config_entry_id"], entity["config_subentry_id"]
        bus = buses.setdefault(entry, ListedBus(owners.get(entry, entry)))
        owner = _owner(entity["unique_id"], owners)
        key = entity["unique_id"].removeprefix(f"{owner}_")
        if subentry is None:
            bus.entities[key] = entity["entity_id"]
            continue
        if subentry not in chargers:
            chargers[subentry] = ListedCharger(owners.get(owner, owner))
            bus.chargers.append(chargers[subentry])
        charger = chargers[subentry]
        if (match := _CONNECTOR.fullmatch(key)) is None:
            charger.entities[key] = entity["entity_id"]
            continue
        number = int(match[1])
        name = names.get(entity["device_id"], charger.name)
        connector = charger.connectors.setdefault(number, Part(name))
        connector.entities[match[2]] = entity["entity_id"]
    for bus in buses.values():
        bus.chargers.sort(key=lambda charger: charger.name)
    for charger in chargers.values():
        charger.connectors = dict(sorted(charger.connectors.items()))
    return sorted(buses.values(), key=lambda bus: bus.name)


def _owner(unique_id: str, identifiers: Iterable[str]) -> str:
    """Return the identifier with which a unique id begins: of a bus, or of a box.

    Connectors and ports have longer ones.
    """
    return min(
        (one for one in identifiers if unique_id.startswith(f"{one}_")),
        key=len,
        default=unique_id,
    )
