"""A sleeping box loses the first request: in each mode it gets a second one in time."""

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from custom_components.evse_bus.evse.abl import PROTOCOL
from tests.simulated_time import now
from tests.virtual import AblBox

from .scene import Scene, config, orders, until

FOUND_WITHIN = 1.5
"""From the first request to a sleeping box to its first reading, s."""
PAIR_WITHIN = 1.0
"""From the first to the second request, s."""
ASLEEP = 30.0

type Mode = Callable[[Scene], Awaitable[None]]
"""What happens before a sleeping box is asked again."""


async def start(scene: Scene) -> None:
    """Put it on a bus that runs."""
    scene.add(config(poll_interval=2.0), orders(10))


async def reconnect(scene: Scene) -> None:
    await start(scene)
    await asyncio.sleep(5)
    scene.virtual.unplug()
    await asyncio.sleep(ASLEEP)
    scene.virtual.replug()
    await until(lambda: scene.bus.connected)


async def reload(scene: Scene) -> None:
    """Stop the bus for longer than the box stays awake."""
    await start(scene)
    await asyncio.sleep(5)
    await scene.bus.stop()
    await asyncio.sleep(ASLEEP)
    scene.bus = PROTOCOL.bus(scene.virtual.url)
    await scene.bus.start()
    await start(scene)


async def add_again(scene: Scene) -> None:
    await start(scene)
    await asyncio.sleep(5)
    (charger,) = scene.bus.chargers.values()
    await scene.bus.remove(charger)
    await asyncio.sleep(ASLEEP)
    await start(scene)


async def search(scene: Scene) -> None:
    report = await PROTOCOL.scan(scene.bus, config(), orders(10), lambda _share: None)
    assert [one.address for one in report.found] == [1]
    await asyncio.sleep(ASLEEP)
    await start(scene)


@pytest.mark.parametrize("mode", [start, reconnect, reload, add_again, search])
async def test_a_sleeping_box_is_found_by_a_pair_of_requests(mode: Mode) -> None:
    async with Scene(AblBox(1, sleep_after=20.0)) as scene:
        await asyncio.sleep(ASLEEP)
        await mode(scene)
        (charger,) = scene.bus.chargers.values()
        # A port that was away is opened again in the meantime.
        asked = len(scene.requests())
        began = now()
        await until(lambda: charger.reading is not None and charger.available)
        assert now() - began < FOUND_WITHIN
        first, second = (one.t for one in scene.requests()[asked:][:2])
        assert second - first < PAIR_WITHIN
        assert charger.statistics.timeouts >= 1


async def test_a_box_that_is_polled_seldom_is_asked_twice_each_time() -> None:
    """A poll interval longer than the box stays awake costs no availability."""
    async with Scene(AblBox(1, sleep_after=20.0)) as scene:
        charger = scene.add(config(poll_interval=60.0), orders(10))
        await until(lambda: charger.available)
        gone: list[bool] = []
        charger.subscribe(lambda: gone.append(not charger.available))
        await asyncio.sleep(600)
        assert charger.available
        assert not any(gone)
        assert charger.statistics.timeouts >= 9
