"""Commands for a real Home Assistant with EWS-Boxes, in its own process.

As in `house_commands`. Times are s of CLOCK_MONOTONIC.
"""

import asyncio
from collections.abc import Callable, Iterator, Sequence
import random
import time
from typing import Any, Final

from .blocks import watch
from .house_commands import add_entry

_CHECK_PAUSE: Final = 0.02
"""Pause between two checks whether all boxes are available, s."""
_PAUSES: Final = (0.02, 0.1)
"""Shortest and longest time between two commands on a busy bus, s."""
_CURRENTS: Final = (6, 16, 10, 13)
"""A"""


def _chargers(hass: Any) -> Iterator[Any]:  # noqa: ANN401 - not imported here
    for entry in hass.config_entries.async_entries("evse_bus"):
        yield from entry.runtime_data.chargers.values()


def _find(
    hass: Any,  # noqa: ANN401
    managed: Any,  # noqa: ANN401
    platform: str,
    key: str,
) -> str | None:
    """Return the id of an entity of a port, if it exists."""
    from homeassistant.helpers import entity_registry as er  # noqa: PLC0415

    found: str | None = er.async_get(hass).async_get_entity_id(
        platform, "evse_bus", f"{managed.unique_key}_{key}"
    )
    return found


def _entity_of(
    hass: Any,  # noqa: ANN401
    managed: Any,  # noqa: ANN401
    platform: str,
    key: str,
) -> str:
    """Return the id of an entity of a port; raises LookupError."""
    if (found := _find(hass, managed, platform, key)) is None:
        message = f"{managed.name} has no {platform} {key}"
        raise LookupError(message)
    return found


def _is_available(hass: Any, managed: Any) -> bool:  # noqa: ANN401
    """Return whether the status of a port is available."""
    entity = _find(hass, managed, "sensor", "status")
    state = hass.states.get(entity) if entity else None
    return state is not None and state.state not in ("unavailable", "unknown")


async def _until(
    hass: Any,  # noqa: ANN401
    *,
    available: bool,
    since: float,
    patience: float = 180.0,
) -> float:
    """Wait until all ports are available, or none; return the time it took, s."""
    async with asyncio.timeout(patience):
        while True:
            # A check costs little; a listener for thousands of changes, much.
            if all(
                _is_available(hass, managed) is available for managed in _chargers(hass)
            ):
                return time.monotonic() - since
            await asyncio.sleep(_CHECK_PAUSE)


async def _add_boxes(
    hass: Any,  # noqa: ANN401
    **options: Any,  # noqa: ANN401
) -> dict[str, Any]:
    """Add a bus or a listener; return the time until all ports are available, blocks."""
    with watch() as blocks:
        since = time.monotonic()
        await add_entry(hass, **options)
        took = await _until(hass, available=True, since=since)
    return {"took": took, **blocks.as_dict()}


async def _reload(hass: Any) -> dict[str, Any]:  # noqa: ANN401
    """Reload all entries; return the time until all ports are available, and blocks."""
    with watch() as blocks:
        since = time.monotonic()
        for entry in hass.config_entries.async_entries("evse_bus"):
            await hass.config_entries.async_reload(entry.entry_id)
        took = await _until(hass, available=True, since=since)
    return {"took": took, **blocks.as_dict()}


async def _remove(hass: Any) -> None:  # noqa: ANN401
    """Remove all buses."""
    for entry in hass.config_entries.async_entries("evse_bus"):
        await hass.config_entries.async_remove(entry.entry_id)


async def _charge(hass: Any) -> float:  # noqa: ANN401
    """Let all ports charge by one call; return the time it took, s."""
    switches = [
        _entity_of(hass, managed, "switch", "charging_allowed")
        for managed in _chargers(hass)
    ]
    since = time.monotonic()
    await hass.services.async_call(
        "switch", "turn_on", {"entity_id": switches}, blocking=True
    )
    return time.monotonic() - since


async def _statistics(hass: Any) -> dict[str, int]:  # noqa: ANN401
    """Return the sums of the counters of all buses, and those of the listener."""
    total = dict.fromkeys(
        ("requests", "timeouts", "missed_deadlines", "bad_frames", "reopened"), 0
    )
    for bus in {managed.bus for managed in _chargers(hass)}:
        for name in total:
            total[name] += getattr(bus.wire.statistics, name)
    for entry in hass.config_entries.async_entries("evse_bus"):
        listener = getattr(entry.runtime_data.connections, "listener", None)
        if listener is not None:
            for name in ("accepted", "crowded_out", "unidentified", "replaced"):
                total[name] = getattr(listener.statistics, name)
    return total


async def _watch_states(
    hass: Any,  # noqa: ANN401
    *,
    seconds: float,
    platform: str,
    key: str,
    busy: bool,
) -> dict[str, Any]:
    """Return the new states of the entities of this key, with their times.

    For an event entity the state is the event type. ``busy``: set currents all the time.
    """
    from homeassistant.core import callback  # noqa: PLC0415

    ports = {
        _entity_of(hass, managed, platform, key): managed.port_number
        for managed in _chargers(hass)
    }
    seen: list[tuple[float, int, str]] = []

    @callback
    def note(event: Any) -> None:  # noqa: ANN401
        port = ports.get(event.data["entity_id"])
        new = event.data["new_state"]
        if port is not None and new is not None:
            state = new.attributes.get("event_type", new.state)
            seen.append((time.monotonic(), port, state))

    stop = hass.bus.async_listen("state_changed", note)
    until = time.monotonic() + seconds
    given = refused = 0
    if busy:
        given, refused = await _command(hass, until)
    await asyncio.sleep(until - time.monotonic())
    stop()
    return {"seen": seen, "commands": given, "refused": refused}


async def _command(hass: Any, until: float) -> tuple[int, int]:  # noqa: ANN401
    """Set the current of each port in turn; return the numbers of calls and failures."""
    from homeassistant.exceptions import HomeAssistantError  # noqa: PLC0415

    numbers = [
        _entity_of(hass, managed, "number", "charging_current")
        for managed in _chargers(hass)
    ]
    dice = random.Random(1)  # noqa: S311 - repeatable on purpose
    given = refused = 0
    while time.monotonic() < until:
        await asyncio.sleep(dice.uniform(*_PAUSES))
        values = {
            "entity_id": numbers[given % len(numbers)],
            "value": _CURRENTS[given // len(numbers) % len(_CURRENTS)],
        }
        given += 1
        try:
            await hass.services.async_call("number", "set_value", values, blocking=True)
        except HomeAssistantError:
            refused += 1
    return given, refused


COMMANDS: Final[dict[str, Callable[..., Any]]] = {
    "add_boxes": _add_boxes,
    "charge": _charge,
    "reload": _reload,
    "remove": _remove,
    "statistics": _statistics,
    "until": _until,
    "watch_states": _watch_states,
}


def box_entry(
    serials: Sequence[str], *, interval: float, **address: str | int
) -> dict[str, Any]:
    """Return arguments of `add_boxes`: boxes of two ports, on a port or a listener."""
    return {
        "protocol": "ews" if "device" in address else "ews_network",
        **address,
        "chargers": [
            {
                "address": serial,
                "serial": serial,
                "ports": 2,
                "installation_limit": 16.0,
                "installation_limit_2": 16.0,
                "poll_interval": interval,
                "fail_safe_current": 6.0,
            }
            for serial in serials
        ],
    }
