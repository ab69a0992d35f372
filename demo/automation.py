"""The automation that lets cars charge at the EWS-Boxes. Pure.

In server mode such a box starts no charge by itself: a driver presses start, and waits
until Home Assistant allows it.
"""

from collections.abc import Iterable
from typing import Any, Final

from .listing import ListedBus

AUTOMATION_ID: Final = "evse_bus_demo_start_requests"
"""Where Home Assistant stores it."""


def answer_start_requests(buses: Iterable[ListedBus]) -> dict[str, Any] | None:
    """Return an automation that allows each request; ``None``: there are no ports."""
    ports = [
        (requested, allow)
        for bus in buses
        for charger in bus.chargers
        for port in charger.connectors.values()
        if (requested := port.find("start_requested"))
        and (allow := port.find("charging_allowed"))
    ]
    if not ports:
        return None
    return {
        "alias": "Answer start requests",
        "description": (
            "Allow charging when start is pressed at an EWS-Box. The trigger's ID is the"
            " switch of the same port."
        ),
        "triggers": [
            {"trigger": "state", "entity_id": requested, "to": "on", "id": allow}
            for requested, allow in ports
        ],
        "conditions": [],
        "actions": [
            {
                "action": "switch.turn_on",
                "target": {"entity_id": "{{ trigger.id }}"},
            }
        ],
        # Several drivers may press at once.
        "mode": "parallel",
    }
