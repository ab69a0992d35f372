"""Orders of single slaves under our own master: set-points, stops, starts."""

import asyncio

import pytest

from custom_components.evse_bus.evse.errors import NotConfirmedError
from custom_components.evse_bus.evse.model import (
    Circuit,
    Fault,
    OrderChange,
    PauseReason,
    Setting,
    Status,
)
from custom_components.evse_bus.evse.smartevse.slave import WITHHELD_FOR
from tests.evse.smartevse.scene import MasterScene
from tests.simulated_time import now, simulate

OFF = "021000a7000102000"
STOP, START = "021000a70001020000abb7", "021000a700010200016a77"


def test_a_set_point_does_not_wait_for_the_next_broadcast() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(5)
            for current in (10.0, 7.3, 6.0, 14.0):
                await asyncio.sleep(0.77)
                begin = now()
                await scene.slave(2).change_orders(OrderChange(current=current))
                assert now() - begin < 0.5
                assert scene.offers == current
                assert scene.slave(2).orders.limit.current == current
            assert max(scene.gaps()) <= 2.02

    simulate(scene())


def test_a_raise_above_its_share_is_confirmed_all_the_same() -> None:
    async def scene() -> None:
        async with MasterScene(limit=16.0, current=6.0) as scene:
            await asyncio.sleep(5)
            await scene.charge(2, 3)
            await scene.slave(2).change_orders(OrderChange(current=16.0))
            assert scene.slave(2).orders.limit.current == 16
            await asyncio.sleep(3)
            assert scene.box(2).offers == 10
            assert scene.slave(2).limits.ceiling == 16
            # It gets the share of the other as soon as that one has left.
            scene.box(3).car.leave()
            await asyncio.sleep(3)
            assert scene.box(2).offers == 16

    simulate(scene())


@pytest.mark.parametrize("attempt", range(3))
def test_a_command_whose_broadcast_is_lost_is_repeated(attempt: int) -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            lost = 0

            def misses(data: bytes) -> bool:
                nonlocal lost
                lost += data.startswith(b"\x00\x10")
                return data.startswith(b"\x00\x10") and lost <= attempt

            scene.box(2).misses = misses
            await scene.slave(2).change_orders(OrderChange(current=8.0))
            assert scene.offers == 8

    simulate(scene())


def test_a_box_that_does_not_follow_is_a_fault() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            scene.box(2).misses = lambda data: data.startswith(b"\x00\x10")
            with pytest.raises(NotConfirmedError):
                await scene.slave(2).change_orders(OrderChange(current=8.0))
            assert Fault.LIMIT_NOT_TAKEN in scene.slave(2).faults
            # The lowering stands, and takes effect as soon as it is received.
            scene.box(2).misses = lambda _data: False
            await asyncio.sleep(5)
            assert scene.offers == 8
            assert Fault.LIMIT_NOT_TAKEN not in scene.slave(2).faults

    simulate(scene())


def test_a_box_that_stays_above_its_share_is_a_fault() -> None:
    """Without any command: its share fell, and it misses the broadcasts."""

    async def scene() -> None:
        async with MasterScene(limit=32.0, watch=False) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            scene.box(2).misses = lambda data: data.startswith(b"\x00\x10")
            begin = now()
            await scene.master.change_circuit(Circuit(limit=10.0))
            await asyncio.sleep(5)
            assert Fault.LIMIT_NOT_TAKEN in scene.slave(2).faults
            # Repeated after each reading above its share, beside the regular ones.
            assert len(scene.broadcasts(begin)) >= 5
            scene.box(2).misses = lambda _data: False
            # The next broadcast, and the reading after it.
            await asyncio.sleep(5)
            assert scene.offers == 10
            assert Fault.LIMIT_NOT_TAKEN not in scene.slave(2).faults

    simulate(scene())


def test_off_is_the_access_bit_and_not_a_broadcast_of_0() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            slave = scene.slave(2)
            await slave.change_orders(OrderChange(allowed=False))
            assert scene.box(2).state == "A"
            assert scene.frames(OFF) == [STOP]
            assert slave.reading is not None
            assert slave.reading.allowed is False
            # A limit does not start it again.
            for current in (10.0, 0.0, 16.0):
                await slave.change_orders(OrderChange(current=current))
            await asyncio.sleep(200)
            assert scene.offers == 0
            assert START not in scene.frames("021000a7")
            await slave.change_orders(OrderChange(allowed=True))
            assert scene.frames("021000a7")[-1] == START
            await asyncio.sleep(5)
            assert scene.offers == 16

    simulate(scene())


def test_a_lost_stop_is_repeated_until_it_is_read_back() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            left = 1

            def misses(data: bytes) -> bool:
                nonlocal left
                hit = data[1:4] == b"\x10\x00\xa7" and left > 0
                left -= hit
                return hit

            scene.box(2).misses = misses
            await scene.slave(2).change_orders(OrderChange(allowed=False))
            assert left == 0
            assert scene.offers == 0

    simulate(scene())


def test_a_box_opened_at_the_box_is_closed_again() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,), allowed=False) as scene:
            await asyncio.sleep(5)
            outlet = scene.box(2).controller.outlet
            assert not outlet.access
            scene.box(2).car.plug_in()
            outlet.set_access(True)
            await asyncio.sleep(4)
            assert not outlet.access
            assert scene.most == 0

    simulate(scene())


def test_a_box_closed_at_the_box_stays_closed() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            scene.box(2).controller.outlet.set_access(False)
            await asyncio.sleep(100)
            await scene.slave(2).change_orders(OrderChange(current=10.0))
            assert scene.frames("021000a7") == []
            assert scene.offers == 0

    simulate(scene())


def test_a_limit_below_the_minimum_is_kept_and_pauses() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            slave = scene.slave(2)
            await slave.change_orders(OrderChange(current=5.9))
            assert slave.orders.limit.current == 5.9
            assert scene.offers == 0
            assert slave.pause_reason is PauseReason.LIMIT_TOO_LOW
            await asyncio.sleep(100)
            assert scene.offers == 0
            # The user's own pause, and permission again: only the limit is missing.
            await slave.change_orders(OrderChange(allowed=False))
            assert slave.pause_reason is PauseReason.NOT_ALLOWED
            await slave.change_orders(OrderChange(allowed=True))
            await asyncio.sleep(100)
            assert scene.offers == 0
            assert slave.pause_reason is PauseReason.LIMIT_TOO_LOW
            await slave.change_orders(OrderChange(current=9.0))
            await asyncio.sleep(5)
            assert scene.offers == 9
            assert slave.pause_reason is None

    simulate(scene())


def test_a_pause_by_a_limit_of_0_a_ends_with_that_limit() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            slave = scene.slave(2)
            await slave.change_orders(OrderChange(current=0.0))
            assert scene.box(2).state == "A"
            assert scene.frames("021000a7") == [STOP]
            await asyncio.sleep(30)
            await slave.change_orders(OrderChange(current=10.0))
            await asyncio.sleep(5)
            assert scene.frames("021000a7") == [STOP, START]
            assert scene.offers == 10
            # But not a pause by the user in between.
            await slave.change_orders(OrderChange(current=0.0))
            await slave.change_orders(OrderChange(allowed=False))
            await slave.change_orders(OrderChange(current=10.0))
            await asyncio.sleep(5)
            assert scene.offers == 0

    simulate(scene())


def test_the_last_to_begin_is_stopped_when_the_circuit_limit_falls() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2, 3, 4), limit=18.0) as scene:
            await asyncio.sleep(5)
            await scene.charge(3, 2)
            await asyncio.sleep(3)
            await scene.charge(4)
            await asyncio.sleep(3)
            assert scene.offers == 18
            await scene.master.change_circuit(Circuit(limit=13.0))
            lowered = now()
            await asyncio.sleep(0.6)
            assert scene.box(4).state == "A"
            # The others had no more than the lowest until the third one had stopped.
            assert 12 <= scene.offers <= 13
            scene.overshoot = 0.0
            await asyncio.sleep(3)
            assert scene.offers == 13
            # It is not out of service: it waits for current.
            waiting = scene.slave(4)
            assert waiting.waits_for_current
            assert waiting.pause_reason is PauseReason.SUPPLY_TOO_LOW
            assert waiting.reading is not None
            assert waiting.reading.connectors[1].status is Status.SUSPENDED_EVSE
            # There is room at once, but it does not start and stop all the time.
            await scene.master.change_circuit(Circuit(limit=18.0))
            back = await scene.until(lambda: scene.box(4).state == "C", 100)
            assert now() - lowered >= WITHHELD_FOR
            assert back < WITHHELD_FOR + 10
            assert scene.offers == 18
            # A pause by the user is not restored.
            await scene.master.change_circuit(Circuit(limit=13.0))
            await asyncio.sleep(2)
            scene.overshoot = 0.0
            await scene.slave(4).change_orders(OrderChange(allowed=False))
            await scene.master.change_circuit(Circuit(limit=32.0))
            await asyncio.sleep(100)
            assert scene.box(4).offers == 0
            assert scene.offers == 32

    simulate(scene())


def test_no_slave_goes_up_before_all_are_known() -> None:
    """One of two does not answer: for 12 s it may still charge as before."""

    async def scene() -> None:
        async with MasterScene(limit=20.0) as scene:
            await asyncio.sleep(5)
            await scene.charge(2, 3)
            await asyncio.sleep(3)
            await scene.bus.stop()
            scene.box(3).deaf = scene.box(3).mute = True
            scene.new_bus()
            scene.add(2)
            scene.add(3)
            await scene.bus.start()
            begin = now()
            await scene.until(lambda: scene.box(2).offers > 10)
            assert now() - begin >= 12
            assert scene.box(2).offers == 14

    simulate(scene())


def test_a_slave_that_falls_silent_may_still_receive() -> None:
    async def scene() -> None:
        async with MasterScene(limit=20.0) as scene:
            await asyncio.sleep(5)
            await scene.charge(2, 3)
            await asyncio.sleep(3)
            scene.box(3).mute = True
            await asyncio.sleep(60)
            assert not scene.slave(3).available
            assert scene.box(3).offers == 6
            assert scene.box(2).offers == 14
            scene.box(3).mute = False
            await scene.until(lambda: scene.box(3).offers == 10)
            assert scene.box(2).offers == 10

    simulate(scene())


def test_only_settings_that_a_slave_follows_can_be_set() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            assert set(scene.slave(2).settings) == {Setting.MAXIMUM_CURRENT}
            await scene.charge(2)
            await scene.slave(2).configure(Setting.MAXIMUM_CURRENT, 10)
            await asyncio.sleep(3)
            assert scene.offers == 10

    simulate(scene())


def test_one_goes_up_as_soon_as_the_other_has_confirmed_to_be_down() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2, 3), limit=20.0) as scene:
            await asyncio.sleep(5)
            await scene.slave(2).change_orders(OrderChange(current=16.0))
            await scene.slave(3).change_orders(OrderChange(current=6.0))
            await scene.charge(2, 3)
            await scene.until(lambda: scene.box(2).offers == 14)
            for wait in (0.3, 0.9, 1.5):
                await asyncio.sleep(wait)
                await scene.slave(3).change_orders(OrderChange(current=10.0))
                took = await scene.until(lambda: scene.box(3).offers == 10)
                # It waits for no poll, at most for the broadcast that is due.
                assert took < 0.8
                await scene.slave(3).change_orders(OrderChange(current=6.0))
                await scene.until(lambda: scene.box(2).offers == 14)

    simulate(scene())
