"""A load-balancing master and its boxes, with cars and commands.

The same scene at real pace, on a pty with the boxes in a process of their own, and in
simulated time.
"""

import asyncio
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from random import Random
from time import process_time
from typing import Any, Final

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.smartevse.master import SLACK
from tests.virtual import VirtualBus

from .balancing import Shared
from .offers import Offer, offers_of, smartevse_boxes
from .oracle import LoggedFrame, Oracle, logged
from .random_commands import RandomCommands
from .setup import master_bus, settled

LIFE: Final = {
    "away": [1.0, 8.0],
    "hesitates": [0.0, 4.0],
    "wants_wh": [5.0, 60.0],
    "stays": [1.0, 6.0],
}
"""The lives of the cars: a charge takes less than a minute."""


@dataclass(frozen=True, slots=True)
class MasterScene:
    """Boxes with a master, by the dialects of units 2, 3 and so on."""

    name: str
    dialects: tuple[str, ...]
    supplies: tuple[float, ...]
    """Supplies to share, A; the first one to begin with."""
    dead: bool = False
    """The last box falls silent."""
    seed: int = 3

    @property
    def units(self) -> range:
        """Return the addresses of the boxes."""
        return range(2, 2 + len(self.dialects))

    @property
    def living(self) -> range:
        """Return the addresses of those that answer."""
        return self.units[:-1] if self.dead else self.units

    def boxes(self, *, plugged: bool = False) -> list[dict[str, Any]]:
        """Return the options of the boxes; ``plugged``: cars that charge for ever."""
        return [
            {
                "dialect": dialect,
                "load_balance": unit,
                "cable": 32,
                "max_current": 32,
                "car": "plugged" if plugged else LIFE | {"seed": self.seed + unit},
            }
            for unit, dialect in zip(self.units, self.dialects, strict=True)
        ]


@dataclass(frozen=True, slots=True)
class Given:
    """The commands of a scene, from `begin` to `end` (s of the loop)."""

    begin: float
    """A time at which a broadcast was due."""
    end: float
    processor: float
    """Processor time of this process, s."""
    commands: RandomCommands


@dataclass(frozen=True, slots=True)
class Seen:
    """What has come of a scene."""

    given: Given
    log: Sequence[LoggedFrame]
    offers: Sequence[Offer]

    @property
    def shared(self) -> Sequence[Shared]:
        """Return the supplies that were shared, by time."""
        return self.given.commands.shared


async def at_real_pace(scene: MasterScene, seconds: float) -> Seen:
    """Run a scene on a pty."""
    async with Oracle("smartevse", boxes=scene.boxes()) as oracle:
        bus = master_bus(oracle.url, scene.units, scene.supplies[0])
        await bus.start()
        try:
            await settled(bus)
            if scene.dead:
                await oracle.kill([list(bus.chargers)[-1]])
            given = await _command(bus, scene, seconds)
        finally:
            await bus.stop()
        log = await oracle.log(given.begin - 1.0)
        return _seen(given, log, await oracle.offers())


async def in_simulated_time(scene: MasterScene, seconds: float) -> Seen:
    """Run a scene on the loop, which is a simulated one."""
    devices = smartevse_boxes(scene.boxes())
    virtual = VirtualBus.in_loop(*devices, seed=scene.seed, ring=None)
    virtual.start()
    bus = master_bus(virtual.url, scene.units, scene.supplies[0])
    await bus.start()
    try:
        await settled(bus)
        devices[-1].faults.dead = scene.dead
        given = await _command(bus, scene, seconds)
    finally:
        await bus.stop()
    log = logged(virtual, given.begin - 1.0)
    virtual.stop()
    return _seen(given, log, offers_of(devices))


async def _command(bus: Bus, scene: MasterScene, seconds: float) -> Given:
    """Give commands to those that answer, for a time."""
    chargers = list(bus.chargers.values())[: len(scene.living)]
    begin = await _plan(bus)
    shared = [Shared(0.0, scene.supplies[0])]
    dice = Random(scene.seed)  # noqa: S311 - repeatable on purpose
    commands = RandomCommands(bus, chargers, shared, scene.supplies, dice)
    used = process_time()
    await commands.run(seconds)
    used = process_time() - used
    return Given(begin, asyncio.get_running_loop().time(), used, commands)


async def _plan(bus: Bus) -> float:
    """Return the time of a due broadcast, once there are any."""
    async with asyncio.timeout(10.0):
        while True:
            if bus.master is not None and bus.master.slot.start_by < inf:
                return bus.master.slot.start_by - SLACK
            await asyncio.sleep(0.1)


def _seen(given: Given, log: Iterable[LoggedFrame], offers: Iterable[Offer]) -> Seen:
    return Seen(
        given,
        [frame for frame in log if frame.start <= given.end],
        [offer for offer in offers if offer.at <= given.end],
    )
