"""What a real Home Assistant is asked to do with EWS-Boxes; in its own process.

As in `house_commands`. Times are s of CLOCK_MONOTONIC.
"""

import asyncio
from collections.abc import Callable, Iterator, Sequence
import random
import time
from typing import Any, Final

from .blocks import watch
from .house_commands import add_entry

_LOOK: Final = 0.02
"""Pause between two looks at whether all boxes are there, s."""
_PAUSES: Final = (0.02, 0.1)
"""Shortest and longest time between two commands of a busy house, s."""
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
    """Return the id of one of a port's entities, if it is there."""
    from homeassistant.helpers import entity_registry as er  # noqa: PLC0415

    found: str | None = er.async_get(hass).async_get_entity_id(
        platform, "evse_bus", f"{managed.key}_{key}"
    )
    return found


def _entity_of(
    hass: Any,  # noqa: ANN401
    managed: Any,  # noqa: ANN401
    platform: str,
    key: str,
) -> str:
    """Return the id of one of a port's entities, which must be there."""
    if (found := _find(hass, managed, platform, key)) is None:
        message = f"{managed.name} has no {platform} {key}"
        raise LookupError(message)
    return found


def _is_there(hass: Any, managed: Any) -> bool:  # noqa: ANN401
    """Return whether a person sees in what state a port is."""
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
    """Wait until all ports are there, or none; return how long it took, s."""
    async with asyncio.timeout(patience):
        while True:
            # A look costs little; to be told of each of thousands of changes, much.
            if all(
                _is_there(hass, managed) is available for managed in _chargers(hass)
            ):
                return time.monotonic() - since
            await asyncio.sleep(_LOOK)


async def _add_boxes(
    hass: Any,  # noqa: ANN401
    **about: Any,  # noqa: ANN401
) -> dict[str, Any]:
    """Add a bus or a listener; return how long until all ports are there, and blocks."""
    with watch() as blocks:
        since = time.monotonic()
        await add_entry(hass, **about)
        took = await _until(hass, available=True, since=since)
    return {"took": took, **blocks.as_dict()}


async def _reload(hass: Any) -> dict[str, Any]:  # noqa: ANN401
    """Set everything up anew; return how long until all ports are there, and blocks."""
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
    """Let all ports charge by one call; return how long it took, s."""
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
    """Return what all buses have counted together, and the listener."""
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
    """Return which states the entities of this key have got meanwhile, and when.

    Of an event the state is its type. ``busy``: set currents all the time.
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
            what = new.attributes.get("event_type", new.state)
            seen.append((time.monotonic(), port, what))

    stop = hass.bus.async_listen("state_changed", note)
    until = time.monotonic() + seconds
    given = refused = 0
    if busy:
        given, refused = await _command(hass, until)
    await asyncio.sleep(until - time.monotonic())
    stop()
    return {"seen": seen, "commands": given, "refused": refused}


async def _command(hass: Any, until: float) -> tuple[int, int]:  # noqa: ANN401
    """Set the current of each port in turn; return how often, and how often in vain."""
    from homeassistant.exceptions import HomeAssistantError  # noqa: PLC0415

    numbers = [
        _entity_of(hass, managed, "number", "charging_current")
        for managed in _chargers(hass)
    ]
    dice = random.Random(1)  # noqa: S311 - repeatable on purpose
    given = refused = 0
    while time.monotonic() < until:
        await asyncio.sleep(dice.uniform(*_PAUSES))
        about = {
            "entity_id": numbers[given % len(numbers)],
            "value": _CURRENTS[given // len(numbers) % len(_CURRENTS)],
        }
        given += 1
        try:
            await hass.services.async_call("number", "set_value", about, blocking=True)
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
    serials: Sequence[str], *, interval: float, **where: str | int
) -> dict[str, Any]:
    """Return what `add_boxes` takes: boxes of two ports, on a port or a listener."""
    return {
        "protocol": "ews" if "device" in where else "ews_network",
        **where,
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
