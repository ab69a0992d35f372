"""Many orders at once to a polled SmartEVSE, cancelled ones, and use at the box."""

import asyncio
from collections.abc import Coroutine
from contextlib import suppress

import pytest

from custom_components.evse_bus.evse.errors import EvseError, SupersededError
from custom_components.evse_bus.evse.model import Fault, OrderChange, Setting
from custom_components.evse_bus.evse.smartevse.dialects import Dialect

from .polled_scene import ALL, PolledScene, play

each = pytest.mark.parametrize("dialect", ALL)


def let_go(order: Coroutine[None, None, None]) -> asyncio.Task[None]:
    """Start an order in the background; it may be superseded, but not fail."""

    async def wait() -> None:
        with suppress(SupersededError):
            await order

    return asyncio.create_task(wait())


@each
@pytest.mark.parametrize(
    ("currents", "pause"),
    [
        ([16, 8, 12, 6, 14, 7] * 10, 1.3),
        ([16 - tenth / 10 for tenth in range(80)], 0.9),
    ],
    ids=["up and down", "down"],
)
def test_limits_in_quick_succession_stop_no_charge(
    dialect: Dialect, currents: list[float], pause: float
) -> None:
    """A box that had no time to follow is not at fault."""

    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(3)
        orders = []
        for current in currents:
            change = OrderChange(current=current)
            orders.append(let_go(scene.charger.change_orders(change)))
            await asyncio.sleep(pause)
        await asyncio.sleep(30)
        await asyncio.gather(*orders)
        assert scene.accesses() == []
        assert scene.box.offers == currents[-1]
        assert scene.charger.faults == frozenset()

    play(PolledScene(dialect), acts)


@each
def test_callers_may_be_cancelled(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(3)
        for delay in (0, 0.01, 0.03, 0.1, 0.6, 2):
            pause = asyncio.create_task(
                scene.charger.change_orders(OrderChange(allowed=False))
            )
            await asyncio.sleep(delay)
            pause.cancel()
            await asyncio.sleep(8)
            assert not scene.outlet.access
            with suppress(EvseError):
                await scene.charger.change_orders(OrderChange(allowed=True))
            await asyncio.sleep(15)
            assert scene.outlet.access
        for delay in (0, 0.01, 0.03, 0.05, 0.1, 0.2, 0.6, 2):
            request = asyncio.create_task(
                scene.charger.configure(Setting.MAXIMUM_CURRENT, 14)
            )
            await asyncio.sleep(delay)
            request.cancel()
            await asyncio.sleep(10)
        assert sum(scene.box.controller.eeprom_writes.values()) <= 1
        assert not scene.charger.busy

    play(PolledScene(dialect), acts)


@each
def test_a_box_that_follows_no_limit_with_access_turned_on_at_it(
    dialect: Dialect,
) -> None:
    async def acts(scene: PolledScene) -> None:
        def is_stopped() -> bool:
            faulty = Fault.LIMIT_NOT_TAKEN in scene.charger.faults
            return faulty and not scene.outlet.access

        scene.car.plug_in()
        await scene.until(is_stopped)
        scene.outlet.access = True
        await scene.until(lambda: not scene.outlet.access, 60)
        await scene.polled(2)
        assert is_stopped()
        scene.line.unplug()
        await asyncio.sleep(40)
        assert scene.charger.available
        assert is_stopped()
        await scene.charger.change_orders(OrderChange(current=16))
        await scene.until(lambda: scene.box.offers == 16, 30)
        await scene.polled(2)
        assert Fault.LIMIT_NOT_TAKEN not in scene.charger.faults

    play(PolledScene(dialect, override_works=False), acts)
