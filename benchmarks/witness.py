"""The virtual bus in a process of its own, and its log as the witness.

As a program: ``python -m benchmarks.witness SPEC`` (JSON) puts virtual chargers on a
pty (or lets them dial an address), prints its path, and then does what it reads from
stdin until that ends. As a module: `Witness` starts such a process. Both ends use
CLOCK_MONOTONIC, which is one clock for the whole machine, so times of the log can be
compared with ours.
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
    asked,
    buses_of,
    dialling,
    ews_boxes,
    plug_in,
    touch,
)
from .machine import ROOT
from .offers import Offer, offers_of, smartevse_boxes

_READY_WITHIN = 15.0
_ENDS_WITHIN = 10.0
_LINE_LIMIT = 2**28
"""A log of some minutes is one long line of JSON."""


@dataclass(frozen=True, slots=True)
class Heard:
    """One frame on the wire; times in seconds of CLOCK_MONOTONIC."""

    start: float
    end: float
    from_client: bool
    data: bytes
    collided: bool = False


class Witness:
    """A virtual bus in another process."""

    def __init__(self, protocol: str, **options: object) -> None:
        """Say who is on the bus (see `_MAKERS`); ``dial``: HOST:PORT that they dial."""
        self._spec = json.dumps({"protocol": protocol, **options})
        self._process: asyncio.subprocess.Process | None = None
        self.url = ""

    async def __aenter__(self) -> Self:
        """Start the process; the port can be opened then."""
        self._process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "benchmarks.witness",
            self._spec,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            cwd=ROOT,
            limit=_LINE_LIMIT,
        )
        async with asyncio.timeout(_READY_WITHIN):
            self.url = str(await self._answer())
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

    async def log(self, since: float = 0.0) -> list[Heard]:
        """Return what was on the wire from then on, frame by frame."""
        entries: Any = await self._ask({"log": since})
        return [
            Heard(start, end, from_client, bytes.fromhex(data), collided)
            for start, end, from_client, data, collided in entries
        ]

    async def offers(self) -> list[Offer]:
        """Return what SmartEVSEs have offered, change by change."""
        entries: Any = await self._ask({"offers": True})
        return [Offer(*entry) for entry in entries]

    async def stats(self) -> dict[str, Any]:
        """Return the virtual chargers' own counters."""
        answer: dict[str, Any] = await self._ask({"stats": True})
        return answer

    async def kill(self, names: Sequence[str]) -> None:
        """Let these devices fall silent."""
        await self._ask({"kill": list(names)})

    async def touch(self, name: str, what: str, port: int, *values: int) -> float:
        """Do something to an EWS-Box (see `ews_boxes.touch`); return when."""
        return float(await self._ask({"touch": [name, what, port, *values]}))

    async def asked(self, since: float) -> dict[str, list[tuple[float, str]]]:
        """Return what each EWS-Box has been asked from then on, and when."""
        entries: dict[str, Any] = await self._ask({"asked": since})
        return {name: [(at, what) for at, what in one] for name, one in entries.items()}

    async def plug_in(self) -> None:
        """Let a car come to each port of all EWS-Boxes."""
        await self._ask({"plug_in": True})

    async def unplug(self) -> None:
        """Pull the adapter, or all network cables."""
        await self._ask({"unplug": True})

    async def replug(self) -> None:
        """Put it, or all of them, back."""
        await self._ask({"replug": True})

    async def _ask(self, command: dict[str, object]) -> Any:  # noqa: ANN401 - JSON
        process = self._process
        if process is None or process.stdin is None:
            message = "the virtual bus is not running"
            raise RuntimeError(message)
        process.stdin.write(json.dumps(command).encode() + b"\n")
        await process.stdin.drain()
        return await self._answer()

    async def _answer(self) -> Any:  # noqa: ANN401 - JSON
        if self._process is None or self._process.stdout is None:
            message = "the virtual bus is not running"
            raise RuntimeError(message)
        line = await self._process.stdout.readline()
        if not line:
            message = "the virtual bus has ended by itself"
            raise RuntimeError(message)
        return json.loads(line)


# -- In the other process ----------------------------------------------------------


def _abl(
    *, ids: Sequence[int], dead: Sequence[int] = (), plugged: bool = False
) -> list[Device]:
    """Make wallboxes that answer 2 ms after a request, without jitter."""
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
    """Make ChargePoints of so many modules, a car charging at each."""
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


def _log(bus: Buses, since: float) -> object:
    heard = [
        entry
        for one in buses_of(bus)
        for entry in (
            *one.log.bursts(CLIENT),
            *(each for each in one.log if each.source != CLIENT),
        )
    ]
    heard.sort(key=lambda entry: entry.t)
    return [
        (
            entry.t,
            entry.end,
            entry.source == CLIENT,
            entry.data.hex(),
            entry.collided,
        )
        for entry in heard
        if entry.t >= since
    ]


_COMMANDS: Final[dict[str, Callable[[Buses, Any], object]]] = {
    "asked": asked,
    "kill": _kill,
    "log": _log,
    "offers": lambda bus, _: _offers(bus),
    "plug_in": lambda bus, _: plug_in(bus),
    "replug": lambda bus, _: bus.replug(),
    "stats": lambda bus, _: bus.stats(),
    "touch": lambda bus, how: touch(bus, *how),
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
            ((command, about),) = json.loads(line).items()
            print(json.dumps(_COMMANDS[command](bus, about)), flush=True)


if __name__ == "__main__":
    _main()
