"""A real Home Assistant, started for a benchmark in a process of its own.

As a program: ``python -m benchmarks.house FOLDER`` starts Home Assistant with that
configuration folder, as `homeassistant.runner` does, and then does what it reads from
stdin (a line of JSON each, answered by one). As a module: `House` starts that.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
import gc
import json
import os
from pathlib import Path
import random
import resource
import socket
import sys
import tempfile
import time
from types import MappingProxyType
from typing import Any, Final, Self

from .blocks import watch
from .machine import OUTPUT, ROOT

CONFIGURATION: Final = """\
recorder:
history:
logbook:
logger:
  default: warning
"""
LOADED: Final = (
    "Home Assistant's own default integrations with frontend, and recorder (SQLite),"
    " history and logbook"
)
_STARTS_WITHIN: Final = 180.0
_ENDS_WITHIN: Final = 60.0
_LINE_LIMIT: Final = 2**26


class House:
    """A Home Assistant in another process."""

    def __init__(self) -> None:
        """Start nothing yet."""
        self._folder = tempfile.TemporaryDirectory(prefix="evse-bus-bench-")
        self._process: asyncio.subprocess.Process | None = None

    async def __aenter__(self) -> Self:
        """Start it with an empty configuration; return when it runs."""
        folder = Path(self._folder.name)
        (folder / "configuration.yaml").write_text(CONFIGURATION, encoding="utf-8")
        OUTPUT.mkdir(exist_ok=True)
        with (OUTPUT / "home-assistant.log").open("w", encoding="utf-8") as errors:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                "benchmarks.house",
                str(folder),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=errors,
                cwd=ROOT,
                env={**os.environ, "SETUP_PORT": str(_free_port())},
                limit=_LINE_LIMIT,
            )
        async with asyncio.timeout(_STARTS_WITHIN):
            await self._answer()
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Stop it and delete what it stored."""
        process = self._process
        if process is not None and process.stdin is not None:
            process.stdin.close()
            try:
                async with asyncio.timeout(_ENDS_WITHIN):
                    await process.wait()
            except TimeoutError:
                process.kill()
                await process.wait()
        self._folder.cleanup()

    async def do(self, command: str, **arguments: object) -> Any:  # noqa: ANN401 - JSON
        """Have one of `_COMMANDS` carried out there; return its answer."""
        if self._process is None or self._process.stdin is None:
            message = "Home Assistant is not running"
            raise RuntimeError(message)
        line = json.dumps({"command": command, "arguments": arguments})
        self._process.stdin.write(line.encode() + b"\n")
        await self._process.stdin.drain()
        return await self._answer()

    async def _answer(self) -> Any:  # noqa: ANN401 - JSON
        if self._process is None or self._process.stdout is None:
            message = "Home Assistant is not running"
            raise RuntimeError(message)
        line = await self._process.stdout.readline()
        if not line:
            message = f"Home Assistant has ended, see {OUTPUT}/home-assistant.log"
            raise RuntimeError(message)
        return json.loads(line)


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port: int = one.getsockname()[1]
        return port


# -- In the other process ----------------------------------------------------------


async def _serve(folder: str) -> None:
    # Home Assistant is loaded by the process that runs it only.
    from homeassistant.bootstrap import async_setup_hass  # noqa: PLC0415
    from homeassistant.runner import RuntimeConfig  # noqa: PLC0415

    hass = await async_setup_hass(RuntimeConfig(config_dir=folder, skip_pip=True))
    if hass is None:
        message = "Home Assistant did not start"
        raise SystemExit(message)
    await hass.async_start()
    print(json.dumps(None), flush=True)
    reader = asyncio.StreamReader()
    await hass.loop.connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), sys.stdin
    )
    while line := await reader.readline():
        asked = json.loads(line)
        answer = await _COMMANDS[asked["command"]](hass, **asked["arguments"])
        print(json.dumps(answer), flush=True)
    await hass.async_stop()


async def _add(
    hass: Any,  # noqa: ANN401 - not imported here
    *,
    protocol: str,
    url: str,
    chargers: Sequence[Mapping[str, Any]],
) -> None:
    """Add a bus and its chargers as the config flow stores them; wait until known."""
    from homeassistant.config_entries import (  # noqa: PLC0415
        ConfigEntry,
        ConfigSubentryData,
    )

    from .setup import settled  # noqa: PLC0415

    entry = ConfigEntry(
        data={"protocol": protocol, "device": url},
        discovery_keys=MappingProxyType({}),
        domain="evse_bus",
        minor_version=1,
        options={},
        source="user",
        subentries_data=[
            ConfigSubentryData(
                data={"voltage": 230.0, "order_lifetime": None, **charger},
                subentry_type="charger",
                title=f"{protocol} {charger['address']}",
                unique_id=f"{protocol}_{charger['serial']}",
            )
            for charger in chargers
        ],
        title=f"Bus {protocol}",
        unique_id=None,
        version=1,
    )
    await hass.config_entries.async_add(entry)
    await settled(entry.runtime_data.bus)
    await hass.async_block_till_done()


async def _count(hass: Any) -> dict[str, int]:  # noqa: ANN401
    """Return how many states there are, and how many of them are available."""
    states = hass.states.async_all()
    return {
        "states": len(states),
        "available": sum(state.state != "unavailable" for state in states),
    }


async def _cost(hass: Any, *, seconds: float) -> dict[str, float]:  # noqa: ANN401
    """Return the share of one core, the memory, and what happened meanwhile."""
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
    """Return how long single callbacks have held the event loop."""
    with watch() as blocks:
        await asyncio.sleep(seconds)
    return blocks.as_dict()


async def _watched_add(
    hass: object, *, buses: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Add buses; return how long single callbacks have held the loop meanwhile."""
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
    """Call number.set_value again and again: device-ID, value, before and after, s."""
    from homeassistant.helpers import entity_registry as er  # noqa: PLC0415

    registry = er.async_get(hass)
    (entry,) = hass.config_entries.async_entries("evse_bus")
    numbers = [
        (
            int(subentry.data["address"]),
            registry.async_get_entity_id(
                "number", "evse_bus", f"{subentry.subentry_id}_charging_current"
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
        # A call comes at any moment of the bus's round.
        await asyncio.sleep(0.05 + 0.2 * dice.random())
        before = time.monotonic()
        await hass.services.async_call(
            "number", "set_value", {"entity_id": entity, "value": value}, blocking=True
        )
        called.append((address, value, before, time.monotonic()))
    return called


_COMMANDS: Final[dict[str, Callable[..., Any]]] = {
    "add": _add,
    "blocks": _blocks,
    "cost": _cost,
    "count": _count,
    "set_values": _set_values,
    "watched_add": _watched_add,
}


def _main() -> None:
    from homeassistant.runner import create_event_loop  # noqa: PLC0415

    loop = create_event_loop()
    asyncio.set_event_loop(loop)
    loop.run_until_complete(_serve(sys.argv[1]))


if __name__ == "__main__":
    _main()
