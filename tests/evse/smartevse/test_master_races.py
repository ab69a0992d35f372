"""Commands at the box, or ours, that cross another frame on the line."""

import asyncio
from contextlib import suppress

import pytest

from custom_components.evse_bus.evse.errors import EvseError, NotConfirmedError
from custom_components.evse_bus.evse.model import (
    Circuit,
    Fault,
    OrderChange,
)
from tests.evse.smartevse.frames import REQUEST_C, answers
from tests.evse.smartevse.scene import MasterScene
from tests.simulated_time import now, simulate

ACCESS = b"\x10\x00\xa7"
START = "021000a70001020001"


def test_a_slave_that_misses_its_stop_is_granted_current_again_later() -> None:
    """Withheld for lack of current, its car left before the stop: nothing to restore."""

    async def scene() -> None:
        async with MasterScene(units=(2,), watch=False) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            box = scene.box(2)
            box.misses = lambda data: data[1:4] == ACCESS
            await scene.master.change_circuit(Circuit(limit=5.0))
            await asyncio.sleep(3)
            box.car.leave()
            await asyncio.sleep(5)
            await scene.master.change_circuit(Circuit(limit=16.0))
            await scene.until(lambda: not scene.slave(2).withheld)
            await asyncio.sleep(3)
            assert box.controller.outlet.access
            box.misses = lambda _data: False
            box.car.plug_in()
            await scene.until(lambda: box.state == "C", 5)

    simulate(scene())


@pytest.mark.parametrize("waits", ["F", "G"])
def test_access_turned_off_at_the_box_while_our_answer_is_sent(waits: str) -> None:
    """82 and 83 take a box to B and to C from any state, with access or without."""

    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            box = scene.box(2)
            box.car.plug_in(request=False)
            await scene.until(lambda: box.state == "F")
            if waits == "G":
                await scene.until(lambda: box.state == "B")
                box.car.request()
                await scene.until(lambda: box.state == "G")
            # While our answer is on its way.
            box.controller.outlet.set_access(False)
            box.car.request()
            await scene.until(lambda: box.state != "A")
            await scene.until(lambda: box.state == "A", 5)
            await asyncio.sleep(100)
            assert box.state == "A"
            assert scene.frames(START) == []

    simulate(scene())


def test_a_request_older_than_access_turned_off_at_the_box() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            scene.box(2).controller.outlet.set_access(False)
            await asyncio.sleep(3)
            asked = now()
            scene.line.send(REQUEST_C)
            await asyncio.sleep(3)
            assert answers(scene, asked) == []
            assert scene.most == 0

    simulate(scene())


@pytest.mark.parametrize("cause", ["circuit", "limit"])
def test_access_turned_off_at_the_box_right_before_our_own_stop(cause: str) -> None:
    """It was not read yet: access is not ours to restore."""

    async def scene() -> None:
        async with MasterScene(units=(2,), watch=False) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await scene.until(lambda: scene.slave(2).slot.ready - now() > 1.9)
            scene.box(2).controller.outlet.set_access(False)
            if cause == "circuit":
                await scene.master.change_circuit(Circuit(limit=5.0))
                await asyncio.sleep(3)
                await scene.master.change_circuit(Circuit(limit=16.0))
            else:
                await scene.slave(2).change_orders(OrderChange(current=0.0))
                await scene.slave(2).change_orders(OrderChange(current=16.0))
            await asyncio.sleep(100)
            assert scene.frames(START) == []
            assert scene.offers == 0

    simulate(scene())


def test_access_turned_on_at_the_box_counts_at_the_next_request() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            box = scene.box(2)
            box.controller.outlet.set_access(False)
            box.car.plug_in()
            await asyncio.sleep(5)
            box.controller.outlet.set_access(True)
            assert await scene.until(lambda: box.state == "C", 5) < 3

    simulate(scene())


def test_nothing_is_granted_to_a_box_withheld_for_lack_of_current() -> None:
    """There is room, but its minute is not over: access is turned on at the box."""

    async def scene() -> None:
        async with MasterScene(units=(2,), watch=False) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            await scene.master.change_circuit(Circuit(limit=5.0))
            await asyncio.sleep(3)
            await scene.master.change_circuit(Circuit(limit=16.0))
            asked = now()
            scene.box(2).controller.outlet.set_access(True)
            scene.line.send(REQUEST_C)
            await asyncio.sleep(10)
            assert answers(scene, asked)
            for answer in answers(scene, asked):
                assert answer.data[4:6] == b"\x00\x00", answer
            assert scene.offers == 0

    simulate(scene())


def test_after_a_restart_nothing_is_restored() -> None:
    """It is not known who stopped it: access may have been turned off at the box."""

    async def scene() -> None:
        async with MasterScene(units=(2,), watch=False) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            await scene.master.change_circuit(Circuit(limit=5.0))
            await asyncio.sleep(3)
            await scene.bus.stop()
            scene.new_bus()
            slave = scene.add(2)
            await scene.bus.start()
            await asyncio.sleep(100)
            assert scene.offers == 0
            await slave.change_orders(OrderChange(allowed=True))
            await scene.until(lambda: scene.offers == 16)

    simulate(scene())


def test_a_box_that_does_not_stop_is_a_fault() -> None:
    """No order stops it: the circuit limit does not suffice."""

    async def scene() -> None:
        async with MasterScene(units=(2,), watch=False) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            assert Fault.LIMIT_NOT_TAKEN not in scene.slave(2).faults
            scene.box(2).controller.ignore_access = True
            await scene.master.change_circuit(Circuit(limit=5.0))
            await asyncio.sleep(6)
            assert scene.offers == 6
            assert Fault.LIMIT_NOT_TAKEN in scene.slave(2).faults
            scene.box(2).controller.ignore_access = False
            await asyncio.sleep(6)
            assert scene.offers == 0
            assert Fault.LIMIT_NOT_TAKEN not in scene.slave(2).faults

    simulate(scene())


def test_a_slave_that_charges_without_access_is_a_fault() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,), watch=False) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            slave = scene.slave(2)
            outlet = scene.box(2).controller.outlet
            outlet.keeps_charging = True
            with pytest.raises(NotConfirmedError):
                await slave.change_orders(OrderChange(allowed=False))
            await asyncio.sleep(12)
            assert Fault.CHARGES_ALTHOUGH_PAUSED in slave.faults
            outlet.keeps_charging = False
            outlet.set_access(allowed=False)
            await asyncio.sleep(6)
            assert Fault.CHARGES_ALTHOUGH_PAUSED not in slave.faults

    simulate(scene())


def test_an_off_is_not_overtaken_by_the_start_before_it() -> None:
    """The start is not received, and would be repeated after the off."""

    async def scene() -> None:
        async with MasterScene(units=(2,), allowed=False) as scene:
            await asyncio.sleep(5)
            box, slave = scene.box(2), scene.slave(2)
            box.car.plug_in()
            box.misses = lambda data: data.hex().startswith(START)
            starting = asyncio.create_task(
                slave.change_orders(OrderChange(allowed=True))
            )
            await scene.until(lambda: scene.frames(START))
            await slave.change_orders(OrderChange(allowed=False))
            off = now()
            box.misses = lambda _data: False
            with suppress(EvseError):
                await starting
            await asyncio.sleep(10)
            assert scene.frames(START, off) == []
            assert slave.orders.allowed is False

    simulate(scene())


def test_a_limit_is_not_overtaken_by_the_stop_before_it() -> None:
    """0 A is not received, and would be repeated after the limit that follows."""

    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            box, slave = scene.box(2), scene.slave(2)
            box.misses = lambda data: data[1:4] == ACCESS
            stopping = asyncio.create_task(
                slave.change_orders(OrderChange(current=0.0))
            )
            await scene.until(lambda: scene.frames("021000a7"))
            box.misses = lambda _data: False
            await slave.change_orders(OrderChange(current=10.0))
            with suppress(EvseError):
                await stopping
            await scene.until(lambda: scene.offers == 10)
            await asyncio.sleep(30)
            assert scene.offers == 10

    simulate(scene())
