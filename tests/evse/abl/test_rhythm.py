"""A sleeping box loses the first request: in each mode it gets a second one in time."""

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from custom_components.evse_bus.evse.abl import PROTOCOL
from custom_components.evse_bus.evse.model import OrderChange
from tests.simulated_time import now
from tests.virtual import AblBox, Car

from .scene import Scene, config, orders, until

FOUND_WITHIN = 2.0
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


@pytest.mark.parametrize(("idle", "poll_interval"), [(1.0, 2.0), (10.0, 15.0)])
async def test_an_adapter_that_closes_idle_lines_costs_nothing(
    idle: float, poll_interval: float
) -> None:
    """Each time the box is identified anew; nothing is written, nothing flaps."""
    car = Car(max_current=32.0)
    box = AblBox(1, car=car, sleep_after=20.0)
    async with Scene(box) as scene:
        charger = scene.add(config(poll_interval=poll_interval), orders(10))
        await until(lambda: charger.available)
        car.plug_in()
        await asyncio.sleep(3 * poll_interval)
        closing = asyncio.create_task(close_when_idle(scene, idle))
        gone: list[bool] = []
        charger.subscribe(lambda: gone.append(charger.reading is None))
        before = len(scene.writes())
        await asyncio.sleep(20 * poll_interval)
        assert scene.bus.line.statistics.opened > 15
        assert len(scene.writes()) == before
        assert not any(gone)
        await charger.change_orders(OrderChange(current=8.0))
        assert 7.9 < box.ic_amps <= 8.0
        closing.cancel()


async def close_when_idle(scene: Scene, idle: float) -> None:
    """Close the line as some adapters do; it can be opened again at once."""
    while True:
        await asyncio.sleep(0.1)
        line = scene.bus.line
        if line.is_open and now() - line.last_activity > idle:
            assert line._transport is not None
            line._transport.close()
