"""How soon an order is in force and confirmed, whenever and after whatever it comes."""

import asyncio
from collections.abc import Awaitable, Callable
from itertools import pairwise

import pytest

from custom_components.evse_bus.evse.model import OrderChange
from custom_components.evse_bus.evse.smartevse.dialects import Dialect
from tests.evse.simulated_line import STEP
from tests.simulated_time import now, simulate

from .polled_scene import ALL, HEAD, LATER, PolledScene

type Past = Callable[[PolledScene], Awaitable[None]]
"""What happened before the order; returns when the library knows the box."""

CONFIRMED_WITHIN = {True: 13.0, False: 2.5}
"""By whether the dialect needs quiet, s (docs/smartevse.md)."""
NOT_FOLLOWED_FOR = {True: 16.0, False: 11.0}
"""By the same, s."""
OFFSETS = {True: (0.0, 0.6, 1.0, 4.0, 5.25, 6.5, 9.5), False: (0.0, 1.0, 4.0)}
"""From the moment the box is known to the order, s: over a whole quiet time."""


async def known(scene: PolledScene) -> None:
    await scene.until(lambda: scene.charger.available)


async def charging(scene: PolledScene) -> None:
    await scene.settled()
    await scene.charge()
    await scene.polled(4)


async def found(scene: PolledScene) -> None:
    """Find it while a car already charges with what the box itself allows."""
    await known(scene)


async def steady(scene: PolledScene) -> None:
    await charging(scene)


async def reconnected(scene: PolledScene) -> None:
    await charging(scene)
    scene.line.unplug()
    await asyncio.sleep(10)
    await known(scene)


async def restarted(scene: PolledScene) -> None:
    """Restart the library, as with Home Assistant."""
    await charging(scene)
    await scene.restart(away=10)
    await known(scene)


async def reloaded(scene: PolledScene) -> None:
    """Restart in the same process, while the box has its quiet."""
    await charging(scene)
    await scene.restart(reload=True)
    await known(scene)


async def box_restarted(scene: PolledScene) -> None:
    await charging(scene)
    scene.box.controller.power_cycle()
    await scene.until(lambda: scene.box.state == "C")


async def confirmation(dialect: Dialect, past: Past, offset: float, new: float) -> None:
    """Order a current; check when it is in force, and what was written for it."""
    scene = PolledScene(dialect)
    if past is found:
        scene.car.plug_in()
        life = asyncio.create_task(scene.live())
        await asyncio.sleep(30)
        life.cancel()
    async with scene:
        await past(scene)
        await asyncio.sleep(offset)
        began = now()
        await scene.charger.change_orders(OrderChange(current=new))
        took = now() - began
        assert scene.box.offers == new, "confirmed, and not in force"
        assert took < CONFIRMED_WITHIN[dialect in LATER], f"{took:.1f} s at {offset} s"
        values = scene.currents(since=began)
        assert values[-1] == new * 10
        assert all(a != b for a, b in pairwise(values)), f"written twice: {values}"
        if past is steady:
            assert values == [new * 10]


@pytest.mark.parametrize(
    "past", [steady, found, reconnected, restarted, reloaded, box_restarted]
)
@pytest.mark.parametrize("dialect", ALL)
@pytest.mark.parametrize("new", [8.0, 14.0])
def test_an_order_is_confirmed_in_time_and_not_written_again(
    dialect: Dialect, past: Past, new: float
) -> None:
    for offset in OFFSETS[dialect in LATER]:
        simulate(confirmation(dialect, past, offset, new))


@pytest.mark.parametrize("second", [7.0, 12.0, 14.0])
@pytest.mark.parametrize("pause", [0.5, 3.0, 8.0])
def test_a_second_order_within_the_quiet_of_the_first(
    second: float, pause: float
) -> None:
    """Both wait for one read-back; the newer one is in force in the end."""

    async def run() -> None:
        scene = PolledScene(HEAD)
        async with scene:
            await charging(scene)
            first = asyncio.create_task(
                scene.charger.change_orders(OrderChange(current=8.0))
            )
            await asyncio.sleep(pause)
            began = now()
            await scene.charger.change_orders(OrderChange(current=second))
            assert now() - began < CONFIRMED_WITHIN[True]
            assert scene.box.offers == second
            await asyncio.wait({first})
            values = scene.currents(since=began)
            assert all(a != b for a, b in pairwise(values))

    simulate(run())


@pytest.mark.parametrize("dialect", ALL)
def test_a_box_that_does_not_follow_is_stopped_in_time(dialect: Dialect) -> None:
    """From the moment a car is offered more than the limit until it is stopped."""

    async def run() -> None:
        for offset in (0.0, 1.0, 3.0, 5.0):
            scene = PolledScene(dialect, override_works=False)
            async with scene:
                await scene.settled()
                await asyncio.sleep(offset)
                scene.car.plug_in()
                await scene.until(lambda scene=scene: scene.box.offers > 0)
                took = await scene.until(lambda scene=scene: scene.box.offers == 0)
                assert took < NOT_FOLLOWED_FOR[dialect in LATER] + STEP

    simulate(run())
