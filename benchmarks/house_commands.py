"""Commands for a real Home Assistant, in its own process.

Each command takes `hass`; its type is not imported here, because only the process that
runs Home Assistant imports it.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
import gc
from pathlib import Path
import random
import resource
import time
from types import MappingProxyType
from typing import Any, Final

from .blocks import watch


async def _add(
    hass: Any,  # noqa: ANN401 - not imported here
    **options: Any,  # noqa: ANN401 - of all kinds
) -> None:
    """Add a bus and its chargers (see `add_entry`); wait until they are known."""
    from .setup import settled  # noqa: PLC0415

    entry = await add_entry(hass, **options)
    await settled(entry.runtime_data.bus)
    await hass.async_block_till_done()


async def add_entry(
    hass: Any,  # noqa: ANN401 - not imported here
    *,
    protocol: str,
    chargers: Sequence[Mapping[str, Any]],
    **address: str | int,
) -> Any:  # noqa: ANN401 - not imported here
    """Add a bus and its chargers as the config flow stores them; return the entry.

    ``address``: its port, or the address of its listener.
    """
    from homeassistant.config_entries import (  # noqa: PLC0415
        ConfigEntry,
        ConfigSubentryData,
    )

    from custom_components.evse_bus.evse.protocols import PROTOCOLS  # noqa: PLC0415
    from custom_components.evse_bus.identity import identity_data  # noqa: PLC0415

    entry = ConfigEntry(
        data={"protocol": protocol, **address},
        discovery_keys=MappingProxyType({}),
        domain="evse_bus",
        minor_version=1,
        options={},
        source="user",
        subentries_data=[
            ConfigSubentryData(
                data={"voltage": 230.0, "order_lifetime": None, **charger}
                | identity_data(PROTOCOLS[protocol], charger["serial"]),
                subentry_type="charger",
                title=f"{protocol} {charger['address']}",
                unique_id=PROTOCOLS[protocol].identity(charger["serial"]),
            )
            for charger in chargers
        ],
        title=f"Bus {protocol}",
        unique_id=None,
        version=1,
    )
    await hass.config_entries.async_add(entry)
    return entry


async def _count(hass: Any) -> dict[str, int]:  # noqa: ANN401
    """Return the number of states, and of those that are available."""
    states = hass.states.async_all()
    return {
        "states": len(states),
        "available": sum(state.state != "unavailable" for state in states),
    }


async def _cost(hass: Any, *, seconds: float) -> dict[str, float]:  # noqa: ANN401
    """Return the share of one core, the memory, and the rate of state changes."""
    changes = 0

    def count(_event: object) -> None:
        nonlocal changes
        changes += 1

    from homeassistant.core import callback  # noqa: PLC0415

    stop = hass.bus.async_listen("state_changed", callback(count))
    wall, begun = time.monotonic(), time.process_time()
    await asyncio.sleep(seconds)
    used, elapsed = time.process_time() - begun, time.monotonic() - wall
    stop()
    gc.collect()
    return {
        "cpu": used / elapsed,
        "memory": _resident(),
        "changes_per_second": changes / elapsed,
    }


def _resident() -> float:
    """Return the resident memory, bytes."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return float(pages * resource.getpagesize())


async def _blocks(_hass: object, *, seconds: float) -> dict[str, Any]:
    """Return the times that single callbacks held the event loop."""
    with watch() as blocks:
        await asyncio.sleep(seconds)
    return blocks.as_dict()


async def _watched_add(
    hass: object, *, buses: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Add buses; return the times that single callbacks held the loop meanwhile."""
    with watch() as blocks:
        for bus in buses:
            await _add(hass, **bus)
    return blocks.as_dict()


async def _set_values(
    hass: Any,  # noqa: ANN401
    *,
    times: int,
    values: Sequence[float],
    seed: int = 1,
) -> list[tuple[int, float, float, float]]:
    """Call number.set_value; return device-ID, value, start and end (s) of each call."""
    from homeassistant.helpers import entity_registry as er  # noqa: PLC0415

    from custom_components.evse_bus.identity import identity_of  # noqa: PLC0415

    registry = er.async_get(hass)
    (entry,) = hass.config_entries.async_entries("evse_bus")
    numbers = [
        (
            int(subentry.data["address"]),
            registry.async_get_entity_id(
                "number", "evse_bus", f"{identity_of(subentry)}_charging_current"
            ),
        )
        for subentry in entry.subentries.values()
    ]
    dice = random.Random(seed)  # noqa: S311 - repeatable on purpose
    called: list[tuple[int, float, float, float]] = []
    for at in range(times):
        # Each box in turn, all of them to one value, then all to the next.
        address, entity = numbers[at % len(numbers)]
        value = values[at // len(numbers) % len(values)]
        # A call comes at any moment of a round of the bus.
        await asyncio.sleep(0.05 + 0.2 * dice.random())
        before = time.monotonic()
        await hass.services.async_call(
            "number", "set_value", {"entity_id": entity, "value": value}, blocking=True
        )
        called.append((address, value, before, time.monotonic()))
    return called


COMMANDS: Final[dict[str, Callable[..., Any]]] = {
    "add": _add,
    "blocks": _blocks,
    "cost": _cost,
    "count": _count,
    "set_values": _set_values,
    "watched_add": _watched_add,
}
