"""Late frames under our own master: echoes, answers, its broadcast."""

import asyncio
from contextlib import suppress
from random import Random

import pytest

from custom_components.evse_bus.evse.conversation import FollowUp, rest
from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.exchange import Turn
from custom_components.evse_bus.evse.model import (
    OrderChange,
    Persistence,
)
from custom_components.evse_bus.evse.smartevse.master import PERIOD
from custom_components.evse_bus.evse.smartevse.other_masters import ECHO
from tests.evse.smartevse.far_line import FarLine
from tests.evse.smartevse.frames import (
    OTHER_BROADCAST,
    REQUEST_C,
    answers,
    frame,
)
from tests.evse.smartevse.scene import MasterScene
from tests.simulated_time import SimulatedLoop, now, simulate


def test_late_echoes_of_several_broadcasts_are_not_taken_for_another_master() -> None:
    """A network port passes an echo on after the next broadcast has been sent."""

    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            line = scene.line
            write = line.write
            loop = asyncio.get_running_loop()

            def echoing(data: bytes, *, reply_may_equal: bool = False) -> float:
                end = write(data, reply_may_equal=reply_may_equal)
                loop.call_at(end + 0.3, line.noise, data)
                return end

            line.write = echoing  # type: ignore[method-assign]
            for current in (15.0, 14.0, 13.0, 12.0, 11.0, 10.0):
                await scene.slave(2).change_orders(OrderChange(current=current))
            await asyncio.sleep(2 * ECHO)
            assert scene.master.noticed == frozenset()
            assert scene.offers == 10

    simulate(scene())


async def endless(_turn: Turn) -> None:
    for _ in range(10):
        await asyncio.sleep(0.45)
        await rest()
    await asyncio.sleep(0.45)


def test_a_late_broadcast_goes_before_turns_that_waited_longer() -> None:
    """The event loop is blocked for a moment while long conversations are under way."""

    async def scene() -> None:
        async with MasterScene(units=(2, 3)) as scene:
            await asyncio.sleep(6)
            for unit in (2, 3):
                follow_up = FollowUp(endless, worst_case=0.45)
                scene.bus._follow_up(scene.slave(unit), follow_up, Persistence.ONCE)
            loop = asyncio.get_running_loop()
            assert isinstance(loop, SimulatedLoop)
            planned = scene.master.slot.ready
            loop.call_at(planned - 0.01, setattr, loop, "now", planned + 0.1)
            await asyncio.sleep(15)
            assert max(scene.gaps()) < PERIOD + 0.7

    simulate(scene())


@pytest.mark.parametrize("before", [0.1, 0.2, 0.3, 0.5])
def test_making_room_delays_no_broadcast(before: float) -> None:
    """The slaves that must go down do not answer: each costs a whole time-out."""

    async def scene() -> None:
        scene = MasterScene(units=(2, 3, 4), limit=32.0, current=32.0, maximum=32)
        async with scene:
            await asyncio.sleep(5)
            await scene.charge(2, 4)
            await asyncio.sleep(13)
            scene.box(3).car.plug_in(request=False)
            await scene.until(lambda: scene.box(3).state == "B")
            await scene.until(lambda: scene.offers == 32)
            await asyncio.sleep(scene.master.slot.ready + PERIOD - before - now())
            scene.box(2).deaf = scene.box(4).deaf = True
            statistics = scene.bus.wire.statistics
            missed, timeouts = statistics.missed_deadlines, statistics.timeouts
            scene.line.send(frame("030600030082"))
            await asyncio.sleep(1.9)
            assert statistics.missed_deadlines == missed
            assert statistics.timeouts > timeouts

    simulate(scene())


def test_requests_beside_another_master_leave_no_jobs() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(6)
            scene.line.send(OTHER_BROADCAST)
            for _ in range(40):
                await asyncio.sleep(1)
                scene.line.send(REQUEST_C)
            assert list(scene.bus._jobs) == []

    simulate(scene())


@pytest.mark.parametrize(
    ("delay", "jitter"), [(0.1, 0.0), (0.02, 1.0), (0.08, 0.5), (0.02, 3.0)]
)
def test_a_slow_network_port(delay: float, jitter: float) -> None:
    """Both directions are delayed, at times by more than a time-out."""

    async def scene() -> None:
        dice = Random(3)  # noqa: S311 - the same each time
        scene = MasterScene(units=(), limit=25.0, maximum=32)
        scene.line = FarLine(delay, jitter, dice)
        scene.new_bus()
        for unit in (2, 3, 4):
            scene.plug_box(unit)
            scene.add(unit)
        charged = 0
        orders: set[asyncio.Task[None]] = set()

        async def order() -> None:
            slave = scene.slave(dice.choice((2, 3, 4)))
            with suppress(EvseError):
                current = dice.choice((6.0, 10.0, 16.0, 32.0))
                await slave.change_orders(OrderChange(current=current))

        async with scene:
            await asyncio.sleep(8)
            for _ in range(100):
                car = scene.box(dice.choice((2, 3, 4))).car
                match dice.randrange(4):
                    case 0:
                        (car.leave if car.plugged else car.plug_in)()
                    case 1:
                        car.request()
                    case 2:
                        car.finish()
                    case _:
                        orders.add(asyncio.create_task(order()))
                await asyncio.sleep(dice.choice((0.02, 0.3, 1.3, 5.0)))
                charged += scene.offers > 0
            await asyncio.gather(*orders)
        assert max(scene.gaps()) < 5
        assert charged > 20

    simulate(scene())


@pytest.mark.parametrize("before", [0.2, 0.4, 0.6])
def test_an_older_request_is_not_answered_after_a_newer_one(before: float) -> None:
    """82 to a box that charges by then: it reports B with its contactor closed."""

    async def scene() -> None:
        scene = MasterScene(units=(2, 3, 4), limit=32.0, current=32.0, maximum=32)
        async with scene:
            await asyncio.sleep(5)
            await scene.charge(2, 4)
            await asyncio.sleep(13)
            await scene.until(lambda: scene.offers == 32)
            await asyncio.sleep(scene.master.slot.ready + PERIOD - before - now())
            scene.box(2).deaf = scene.box(4).deaf = True
            asked = now()
            scene.line.send(frame("030600020082"))
            scene.line.send(frame("030600030082"))
            await asyncio.sleep(1.9)
            kinds = [answer.data[3] for answer in answers(scene, asked)]
            assert kinds in ([], [0x83], [0x82], [0x82, 0x83])

    simulate(scene())
