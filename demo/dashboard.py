"""The dashboard "Chargers", built from the entities that exist. Pure."""

from collections.abc import Iterable, Sequence
from typing import Any, Final

from .listing import ListedBus, ListedCharger, Part

TITLE: Final = "Chargers"
URL_PATH: Final = "evse-chargers"
ICON: Final = "mdi:ev-station"
BUS_ICON: Final = "mdi:source-branch"
PLUG_ICON: Final = "mdi:ev-plug-type2"
POWER: Final = ("power", "estimated_power")
"""Keys of the power of a connector, measured or estimated."""

FULL: Final = 12
HALF: Final = 6
"""Columns of a section's twelve."""
HISTORY_HOURS: Final = 0.25

type Card = dict[str, Any]


def dashboard(buses: Iterable[ListedBus]) -> dict[str, Any]:
    """Return a dashboard: a section for each charger, and one with the history.

    Chargers with a shared supply have one section together.
    """
    buses = list(buses)
    chargers = [charger for bus in buses for charger in bus.chargers]
    view = {
        "type": "sections",
        "title": TITLE,
        "path": "chargers",
        "icon": ICON,
        "max_columns": 4,
        "dense_section_placement": True,
        "badges": [
            {
                "type": "entity",
                "entity": connected,
                "name": bus.name,
                "show_name": True,
                "show_state": True,
            }
            for bus in buses
            if (connected := bus.find("connected"))
        ],
        "sections": [
            *(section for bus in buses for section in _bus_sections(bus)),
            _history_section(chargers),
        ],
    }
    return {"views": [view]}


def _bus_sections(bus: ListedBus) -> list[Card]:
    supply = _tile(
        bus.find("shared_supply"),
        FULL,
        name="Shared supply",
        icon="mdi:call-split",
        features=[{"type": "numeric-input", "style": "slider"}],
    )
    if supply is None:
        return [_section(_charger_cards(charger)) for charger in bus.chargers]
    cards = [
        # Without the port, for which a heading has no room.
        _heading(
            bus.name.partition(" (")[0], BUS_ICON, "title", bus.find("second_master")
        ),
        supply,
        *(card for charger in bus.chargers for card in _charger_cards(charger)),
    ]
    return [_section(cards)]


def _charger_cards(charger: ListedCharger) -> list[Card | None]:
    cards = [
        _heading(charger.name, ICON, "title", charger.find("problem", "connected")),
        *_control_cards(charger),
    ]
    several = len(charger.connectors) > 1
    for connector in charger.connectors.values():
        if several:
            problem = connector.find("problem")
            cards.append(_heading(connector.name, PLUG_ICON, "subtitle", problem))
        cards += [
            # The ports of an EWS-Box are chargers of their own.
            *_control_cards(connector),
            *_connector_cards(connector),
        ]
    if not _measured(charger):
        cards.append(
            _tile(
                charger.find("offered_current"),
                FULL,
                name="Offered",
                icon="mdi:current-ac",
                color="amber",
            )
        )
    return cards


def _control_cards(part: Part) -> list[Card | None]:
    return [
        _tile(
            part.find("charging_current"),
            FULL,
            name="Charging current",
            icon="mdi:speedometer",
            features=[{"type": "numeric-input", "style": "slider"}],
        ),
        _tile(
            part.find("charging_allowed"),
            FULL,
            name="Charging allowed",
            features=[{"type": "toggle"}],
            features_position="inline",
        ),
    ]


def _measured(charger: ListedCharger) -> bool:
    """Return whether it reports power; a SmartEVSE reports its offer only."""
    return any(
        connector.find(*POWER) is not None for connector in charger.connectors.values()
    )


def _connector_cards(connector: Part) -> list[Card | None]:
    return [
        # An EVBox module reports no status, but whether current flows.
        _tile(
            connector.find("status", "charging"),
            FULL,
            name="Status",
            icon="mdi:car-electric",
            color="green",
        ),
        *_used(connector),
        _tile(
            connector.find("session_energy"),
            HALF,
            name="This charge",
            icon="mdi:battery-charging",
            color="amber",
        ),
        _tile(
            connector.find("start_requested"),
            HALF,
            name="Start requested",
            icon="mdi:gesture-tap-button",
            color="amber",
        ),
        _tile(connector.find("locked"), HALF, name="Cable lock"),
        _tile(
            connector.find("last_result"),
            FULL,
            name="Last result",
            icon="mdi:flag-checkered",
        ),
    ]


def _used(connector: Part) -> list[Card | None]:
    """Return the power of a connector, in a row with its currents if it has some."""
    power = connector.find(*POWER)
    name = "Power" if "power" in connector.entities else "Est. power"
    phases = [
        {"entity": entity, "name": phase.upper()}
        for phase in ("l1", "l2", "l3")
        if (entity := connector.find(f"current_{phase}"))
    ]
    if not phases:
        return [_tile(power, HALF, name=name, icon="mdi:flash", color="amber")]
    values = [{"entity": power, "name": name}] if power else []
    return [
        {
            "type": "glance",
            "columns": len(values + phases),
            "show_icon": False,
            "entities": values + phases,
            "grid_options": {"columns": FULL},
        }
    ]


def _history_section(chargers: Sequence[ListedCharger]) -> Card:
    parts = [
        (
            f"{charger.name} {number}" if len(charger.connectors) > 1 else charger.name,
            connector,
        )
        for charger in chargers
        for number, connector in charger.connectors.items()
    ]
    power = _graph(parts, POWER)
    unmeasured = [(one.name, one) for one in chargers if not _measured(one)]
    offered = _graph(unmeasured, ("offered_current",))
    status = _graph(parts, ("status", "charging"))
    cards = [
        _heading("The last quarter of an hour", "mdi:chart-line", "title"),
        power and {**power, "title": "Power"},
        offered and {**offered, "title": "Offered current"},
        status and {**status, "title": "Status"},
    ]
    return _section(cards)


def _graph(parts: Iterable[tuple[str, Part]], keys: tuple[str, ...]) -> Card | None:
    lines = [
        {"entity": entity, "name": name}
        for name, part in parts
        if (entity := part.find(*keys))
    ]
    if not lines:
        return None
    return {
        "type": "history-graph",
        "entities": lines,
        "hours_to_show": HISTORY_HOURS,
        "grid_options": {"columns": FULL},
    }


def _section(cards: Iterable[Card | None]) -> Card:
    return {"type": "grid", "cards": [card for card in cards if card]}


def _heading(name: str, icon: str, style: str, badge: str | None = None) -> Card:
    card: Card = {
        "type": "heading",
        "heading": name,
        "icon": icon,
        "heading_style": style,
    }
    if badge is not None:
        card["badges"] = [{"type": "entity", "entity": badge, "show_icon": True}]
    return card


def _tile(entity: str | None, columns: int, **options: Any) -> Card | None:  # noqa: ANN401
    if entity is None:
        return None
    return {
        "type": "tile",
        "entity": entity,
        "grid_options": {"columns": columns},
        **options,
    }
