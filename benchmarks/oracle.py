"""Virtual chargers in a process of their own, whose log is the oracle.

As a program: ``python -m benchmarks.oracle SPEC`` (JSON) puts virtual chargers on a pty
(or lets them dial an address), prints its path, and executes commands from stdin until
that ends. As a module: `Oracle` starts such a process. Both ends use CLOCK_MONOTONIC,
one clock for the whole machine, so that times of the log can be compared with ours.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
import json
import sys
from typing import Any, Final, Self

from tests.virtual import CLIENT, AblBox, Car, EvboxChargePoint, Module, VirtualBus
from tests.virtual.device import Device

from .ews_boxes import (
    Buses,
    buses_of,
    commands,
    dialling,
    ews_boxes,
    operate,
    plug_in,
)
from .machine import ROOT
from .offers import Offer, offers_of, smartevse_boxes

_READY_WITHIN = 15.0
_ENDS_WITHIN = 10.0
_LINE_LIMIT = 2**28
"""A log of some minutes is one long line of JSON."""


@dataclass(frozen=True, slots=True)
class LoggedFrame:
    """One frame on the wire; times in seconds of CLOCK_MONOTONIC."""

    start: float
    end: float
    from_client: bool
    data: bytes
    collided: bool = False


class Oracle:
    """Virtual chargers in another process."""

    def __init__(self, protocol: str, **options: object) -> None:
        """Prepare these chargers (see `_MAKERS`); ``dial``: HOST:PORT that they dial."""
        self._spec = json.dumps({"protocol": protocol, **options})
        self._process: asyncio.subprocess.Process | None = None
        self.url = ""

    async def __aenter__(self) -> Self:
        """Start the process; the port can be opened then."""
        self._process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "benchmarks.oracle",
            self._spec,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            cwd=ROOT,
            limit=_LINE_LIMIT,
        )
        async with asyncio.timeout(_READY_WITHIN):
            self.url = str(await self._result())
        return self

    async def __aexit__(self, *_error: object) -> None:
        """End the process."""
        process = self._process
        if process is None or process.stdin is None:
            return
        process.stdin.close()
        try:
            async with asyncio.timeout(_ENDS_WITHIN):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()

    async def log(self, since: float = 0.0) -> list[LoggedFrame]:
        """Return the frames on the wire from a time on."""
        entries: Any = await self._command({"log": since})
        return [
            LoggedFrame(start, end, from_client, bytes.fromhex(data), collided)
            for start, end, from_client, data, collided in entries
        ]

    async def offers(self) -> list[Offer]:
        """Return the changes of the offers of SmartEVSEs."""
        entries: Any = await self._command({"offers": True})
        return [Offer(*entry) for entry in entries]

    async def stats(self) -> dict[str, Any]:
        """Return the counters of the virtual chargers."""
        stats: dict[str, Any] = await self._command({"stats": True})
        return stats

    async def kill(self, names: Sequence[str]) -> None:
        """Make these devices dead."""
        await self._command({"kill": list(names)})

    async def operate(self, name: str, action: str, port: int, *values: int) -> float:
        """Operate an EWS-Box (see `ews_boxes.operate`); return the time, s."""
        return float(await self._command({"operate": [name, action, port, *values]}))

    async def commands(self, since: float) -> dict[str, list[tuple[float, str]]]:
        """Return times and names of the commands to each EWS-Box from a time on."""
        entries: dict[str, Any] = await self._command({"commands": since})
        return {box: [(at, name) for at, name in one] for box, one in entries.items()}

    async def plug_in(self) -> None:
        """Plug a car in at each port of all EWS-Boxes."""
        await self._command({"plug_in": True})

    async def unplug(self) -> None:
        """Pull the adapter, or all network cables."""
        await self._command({"unplug": True})

    async def replug(self) -> None:
        """Plug it, or all of them, in again."""
        await self._command({"replug": True})

    async def _command(self, command: dict[str, object]) -> Any:  # noqa: ANN401 - JSON
        process = self._process
        if process is None or process.stdin is None:
            message = "the virtual chargers are not running"
            raise RuntimeError(message)
        process.stdin.write(json.dumps(command).encode() + b"\n")
        await process.stdin.drain()
        return await self._result()

    async def _result(self) -> Any:  # noqa: ANN401 - JSON
        if self._process is None or self._process.stdout is None:
            message = "the virtual chargers are not running"
            raise RuntimeError(message)
        line = await self._process.stdout.readline()
        if not line:
            message = "the virtual chargers have ended by themselves"
            raise RuntimeError(message)
        return json.loads(line)


# -- In the other process ----------------------------------------------------------


def _abl(
    *, ids: Sequence[int], dead: Sequence[int] = (), plugged: bool = False
) -> list[Device]:
    """Make wallboxes that reply 2 ms after a request, without jitter."""
    boxes: list[Device] = []
    for number in ids:
        car = Car()
        box = AblBox(number, car=car, serial=f"2W22xy{number:08d}", jitter=0.0)
        box.faults.dead = number in dead
        if plugged:
            car.plug_in()
        boxes.append(box)
    return boxes


def _evbox(*, serials: Sequence[int], modules: int) -> list[Device]:
    """Make ChargePoints of so many modules, with a car charging at each."""
    points: list[Device] = []
    for serial in serials:
        cars = [Car(phases=1 + at % 3) for at in range(modules)]
        for car in cars:
            car.plug_in()
        boxes = [
            Module(car=car, energy_wh=1000.0 * at) for at, car in enumerate(cars, 1)
        ]
        points.append(EvboxChargePoint(serial, boxes, max_current=400.0))
    return points


_MAKERS: Final[dict[str, Callable[..., list[Device]]]] = {
    "abl": _abl,
    "evbox": _evbox,
    "ews": ews_boxes,
    "smartevse": smartevse_boxes,
}


def _kill(bus: Buses, names: Sequence[str]) -> None:
    for device in bus.devices:
        if device.name in names:
            device.faults.dead = True


def _offers(bus: Buses) -> object:
    offers = bus.call(lambda: offers_of(bus.devices))
    return [(one.at, one.name, one.amps, one.closed) for one in offers]


def logged(bus: Buses, since: float = 0.0) -> list[LoggedFrame]:
    """Return the frames on the wire from a time on."""
    entries = [
        entry
        for one in buses_of(bus)
        for entry in (
            *one.log.bursts(CLIENT),
            *(each for each in one.log if each.source != CLIENT),
        )
    ]
    entries.sort(key=lambda entry: entry.t)
    return [
        LoggedFrame(
            entry.t, entry.end, entry.source == CLIENT, entry.data, entry.collided
        )
        for entry in entries
        if entry.t >= since
    ]


def _log(bus: Buses, since: float) -> object:
    return [
        (one.start, one.end, one.from_client, one.data.hex(), one.collided)
        for one in logged(bus, since)
    ]


_COMMANDS: Final[dict[str, Callable[[Buses, Any], object]]] = {
    "commands": commands,
    "kill": _kill,
    "log": _log,
    "offers": lambda bus, _: _offers(bus),
    "plug_in": lambda bus, _: plug_in(bus),
    "replug": lambda bus, _: bus.replug(),
    "stats": lambda bus, _: bus.stats(),
    "operate": lambda bus, action: operate(bus, *action),
    "unplug": lambda bus, _: bus.unplug(),
}


def _main() -> None:
    spec = json.loads(sys.argv[1])
    protocol, dial = spec.pop("protocol"), spec.pop("dial", "")
    devices = _MAKERS[protocol](**spec)
    one = dialling(devices, dial) if dial else VirtualBus.pty(*devices, ring=None)
    with one as bus:
        print(json.dumps(bus.url), flush=True)
        for line in sys.stdin:
            ((command, argument),) = json.loads(line).items()
            print(json.dumps(_COMMANDS[command](bus, argument)), flush=True)


if __name__ == "__main__":
    _main()
