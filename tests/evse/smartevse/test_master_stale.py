"""A status counts once, as of the moment at which it was read.

Settings are read after a status, in turns of their own: broadcasts and grants go out
between them.
"""

import asyncio

import pytest

from custom_components.evse_bus.evse.model import Circuit
from tests.evse.smartevse.scene import BROADCASTS, MasterScene
from tests.evse.smartevse.test_nodes import charging, scene_of
from tests.simulated_time import now, simulate

each = pytest.mark.parametrize("dialect", ["2.17", "2.20", "2.30", "2.30+", "3"])


async def raised_while_settings_are_read(scene: MasterScene, pause: float) -> None:
    """Raise the supply after a status, before the settings were read."""
    slave = scene.slave(2)
    slave.configuration_due = 0.0
    await scene.until(lambda: slave.busy)
    await asyncio.sleep(pause)
    await scene.master.change_circuit(Circuit(limit=24.0))


@each
def test_a_raise_after_the_status_counts(dialect: str) -> None:
    async def scene() -> None:
        async with scene_of(
            dialect, units=(2, 3), current=32.0, maximum=32, watch=False
        ) as scene:
            await charging(scene, 2, 3)
            for step in range(30):
                await scene.master.change_circuit(Circuit(limit=16.0))
                await asyncio.sleep(6.37)
                raising = asyncio.create_task(
                    raised_while_settings_are_read(scene, 0.01 * step)
                )
                for _ in range(300):
                    await asyncio.sleep(0.01)
                    offers = round(scene.box(2).offers * 10)
                    assert scene.master.draw(2).most(now()) >= offers
                await raising

    simulate(scene())


@each
def test_the_supply_is_kept_where_the_next_broadcast_is_lost(dialect: str) -> None:
    async def most_after(asks: float) -> float:
        async with scene_of(
            dialect, units=(2, 3, 4), current=32.0, maximum=32, watch=False
        ) as scene:
            await charging(scene, 4)
            scene.box(4).car.finish()
            await charging(scene, 2, 3)
            await asyncio.sleep(17)
            assert scene.offers == 16
            raising = asyncio.create_task(raised_while_settings_are_read(scene, 0))
            box, slave = scene.box(2), scene.slave(2)
            await scene.until(lambda: box.offers == 12 and not slave.busy)
            lost = 0

            def misses(data: bytes) -> bool:
                nonlocal lost
                lost += data.startswith(BROADCASTS)
                return data.startswith(BROADCASTS) and lost == 1

            box.misses = misses
            await asyncio.sleep(asks)
            scene.box(4).car.request()
            most = 0.0
            for _ in range(300):
                await asyncio.sleep(0.01)
                most = max(most, scene.offers)
            await raising
            return most

    assert max(simulate(most_after(0.3 * n)) for n in range(6)) <= 24
