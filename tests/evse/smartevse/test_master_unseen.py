"""Our master beside boxes that it has not read yet, or whose frames it mistakes."""

import asyncio

import pytest

from custom_components.evse_bus.evse.modbus import rtu_frame, write_register
from custom_components.evse_bus.evse.smartevse.dialects import Dialect
from tests.evse.smartevse.scene import MasterScene
from tests.evse.smartevse.test_nodes import accesses, charging, scene_of
from tests.simulated_time import simulate

later = pytest.mark.parametrize("dialect", ["2.30", "2.30+", "3"])
polled = pytest.mark.parametrize("dialect", ["2.20", "2.30", "2.30+", "3"])


def test_an_address_beyond_a_broadcast_of_2_17_keeps_nobody_from_it() -> None:
    """The box there was added by hand, and was never seen."""

    async def scene() -> None:
        async with MasterScene(units=(2,), dialect="2.17") as scene:
            scene.add(5)
            await asyncio.sleep(12)
            await scene.charge(2)
            assert len(scene.broadcasts()) > 3

    simulate(scene())


def test_a_box_beyond_a_broadcast_of_2_17_charges_once_it_is_seen() -> None:
    async def scene() -> None:
        async with MasterScene(units=(), dialect="2.30") as scene:
            scene.add(5)
            await asyncio.sleep(20)
            scene.plug_box(5)
            await asyncio.sleep(30)
            await scene.charge(5)

    simulate(scene())


@later
@pytest.mark.parametrize("lost", [1, 2])
def test_no_broadcast_for_2_20_after_a_lost_reply(dialect: str, lost: int) -> None:
    """A box that was 2.20 when it was kept has other firmware now."""

    async def scene() -> None:
        async with MasterScene(units=(2,), dialect="2.20", kept=Dialect.V2_20) as scene:
            box = scene.plug_box(3, dialect)
            left = iter(range(lost))
            box.loses = lambda _data: next(left, None) is not None
            scene.add(3)
            await asyncio.sleep(20)
            assert scene.broadcasts() == []
            assert box.controller.writes == []

    simulate(scene())


def test_a_box_of_2_20_that_is_gone_delays_the_first_broadcast_a_little() -> None:
    async def scene() -> None:
        async with MasterScene(
            units=(2, 3, 4), dialect="2.20", kept=Dialect.V2_20
        ) as scene:
            for unit in (3, 4):
                del scene.line.boxes[unit]
            await asyncio.sleep(2.5 + 4)
            assert scene.broadcasts()

    simulate(scene())


@polled
@pytest.mark.parametrize("register", [1, 2, 3, 4])
def test_a_write_to_a_polled_box_is_no_request_of_it(
    dialect: str, register: int
) -> None:
    """Only 2.17 requests like this; it may have its contactor closed."""

    async def scene() -> None:
        async with scene_of(dialect, units=(2, 3)) as scene:
            await charging(scene, 2, 3)
            for _ in range(5):
                await asyncio.sleep(0.73)
                scene.line.noise(rtu_frame(2, write_register(register, 80)))
                await asyncio.sleep(0.01)
                assert scene.master.draw(2).may_draw

    simulate(scene())


@pytest.mark.parametrize("state", ["F", "G"])
def test_access_is_stored_by_one_write_while_it_asks(state: str) -> None:
    """It goes on asking without access, with its contactor open."""

    async def scene() -> None:
        async with scene_of("3") as scene:
            await asyncio.sleep(8)
            scene.box(2).car.plug_in()
            await scene.until(lambda: scene.box(2).state == state)
            await scene.slave(2).store_access(allowed=False)
            await asyncio.sleep(30)
            assert accesses(scene, 2) == [0]
            assert scene.offers == 0

    simulate(scene())
