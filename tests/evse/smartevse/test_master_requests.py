"""Requests of slaves, and their answers: in time, or not at all."""

import asyncio

import pytest

from custom_components.evse_bus.evse.model import OrderChange
from custom_components.evse_bus.evse.smartevse.master import PERIOD
from tests.evse.smartevse.frames import REQUEST_A, REQUEST_C, answers, frame
from tests.evse.smartevse.scene import BYTE, MasterScene, Sent
from tests.simulated_time import now, simulate

TO_STATE_B = "02060084"


@pytest.mark.parametrize("before", [1.0, 0.3, 0.1, 0.05, 0.03, 0.015])
def test_answered_in_time_also_right_before_a_broadcast(before: float) -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(6)
            await asyncio.sleep(scene.master.slot.ready + PERIOD - before - now())
            asked = now()
            scene.line.send(REQUEST_A)
            await asyncio.sleep(0.5)
            (answer,) = answers(scene, asked)
            assert answer.data == frame("020600810000")
            assert answer.when - asked < 0.2
            assert max(scene.gaps()) <= PERIOD + 0.02

    simulate(scene())


def test_answered_in_time_during_a_time_out() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2, 3)) as scene:
            await asyncio.sleep(6)
            scene.box(3).deaf = True
            start = len(scene.line.sent)
            await scene.until(
                lambda: any(s.data[0] == 3 for s in scene.line.sent[start:])
            )
            asked = now()
            scene.line.send(REQUEST_A)
            await asyncio.sleep(0.9)
            (answer,) = answers(scene, asked)
            # The time-out is 0.25 s, and counted from the end of the request.
            assert answer.when - asked < 0.45

    simulate(scene())


@pytest.mark.parametrize("silence", [0.0062, 0.008, 0.009, 0.0095, 0.0105])
def test_a_request_after_a_broadcast_does_not_collide(silence: float) -> None:
    """Boxes detect a silence of 6 ms some milliseconds later, each in its own time."""

    async def scene() -> None:
        async with MasterScene(units=(2, 3)) as scene:
            await asyncio.sleep(6)
            line = scene.line
            asked: list[float] = []

            def ask(sent: Sent) -> None:
                if sent.is_broadcast and not asked:
                    asked.append(sent.when + len(sent.data) * BYTE + silence)
                    line.loop.call_at(asked[0], line.send, REQUEST_A)

            line.on_sent = ask
            # A reading is due, too: it comes right after the broadcast.
            scene.slave(3).read_soon(scene.master.slot.ready)
            await asyncio.sleep(PERIOD + 0.5)
            (answer,) = answers(scene, asked[0])
            assert answer.when - asked[0] < 0.1

    simulate(scene())


def test_a_repeated_request_has_one_answer_each() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(6)
            asked = now()
            scene.line.send(REQUEST_A)
            await asyncio.sleep(0.3)
            scene.line.send(REQUEST_A)
            await asyncio.sleep(0.3)
            assert len(answers(scene, asked)) == 2

    simulate(scene())


def test_state_b_is_acknowledged_only_when_requested() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(5)
            assert scene.frames(TO_STATE_B) == []
            ended = now()
            scene.box(2).car.finish()
            await asyncio.sleep(3)
            assert scene.frames(TO_STATE_B, ended) == [frame("020600840000").hex()]
            assert scene.box(2).state == "B"

    simulate(scene())


@pytest.mark.parametrize(
    "stops",
    [OrderChange(allowed=False), OrderChange(current=0.0)],
    ids=["off", "0 A"],
)
def test_nothing_is_granted_to_a_box_that_may_not_charge(stops: OrderChange) -> None:
    """Access was turned on at the box: its request is granted 0 A."""

    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(5)
            await scene.slave(2).change_orders(stops)
            asked = now()
            scene.box(2).controller.outlet.set_access(True)
            scene.box(2).car.plug_in()
            scene.line.send(REQUEST_C)
            await asyncio.sleep(20)
            assert answers(scene, asked)
            for answer in answers(scene, asked):
                assert answer.data[4:6] == b"\x00\x00", answer
            assert scene.most == 0
            assert not scene.box(2).controller.outlet.access

    simulate(scene())


def test_nothing_is_granted_when_the_circuit_limit_is_used_up() -> None:
    async def scene() -> None:
        async with MasterScene(limit=10.0) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            asked = now()
            scene.box(3).car.plug_in()
            await asyncio.sleep(3)
            (answer,) = answers(scene, asked)
            assert answer.data == frame("030600820000")
            assert scene.box(3).controller.outlet.error & 1
            assert scene.box(2).offers == 10

    simulate(scene())


def test_room_is_made_first_and_well_within_the_second() -> None:
    async def scene() -> None:
        async with MasterScene() as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(13)
            assert scene.box(2).offers == 16
            scene.box(3).car.plug_in(request=False)
            await scene.until(lambda: scene.box(3).state == "B")
            # Its reservation has ended meanwhile.
            await scene.until(lambda: scene.box(2).offers == 16)
            asked = now()
            scene.box(3).car.request()
            await scene.until(lambda: scene.box(3).state == "G")
            took = await scene.until(lambda: scene.box(3).state == "C")
            assert took < 0.6
            sent = [s for s in scene.line.sent if s.when >= asked]
            order = [s.data.hex()[:8] for s in sent]
            lowered = next(
                i for i, s in enumerate(sent) if s.is_broadcast and s.values[1] == 80
            )
            assert order[lowered : lowered + 3] == [
                "00100001",
                "020400a0",
                "03060083",
            ]
            # The lowest at first: its value was 0 as long as it drew nothing.
            assert sent[lowered + 2].data[4:6] == (60).to_bytes(2, "big")
            await scene.until(lambda: scene.box(3).offers == 8, 5)

    simulate(scene())


def test_current_that_is_not_confirmed_to_be_free_is_not_granted() -> None:
    """The other misses each broadcast from now on: it does not go down."""

    async def scene() -> None:
        async with MasterScene() as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(13)
            scene.box(2).misses = lambda data: data.startswith(b"\x00\x10")
            asked = now()
            scene.box(3).car.plug_in()
            await asyncio.sleep(5)
            assert {a.data[4:6] for a in answers(scene, asked)} == {b"\x00\x00"}
            assert scene.box(3).offers == 0

    simulate(scene())


def test_the_maximum_in_a_request_limits_its_share() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,), maximum=13) as scene:
            await asyncio.sleep(5)
            await scene.charge(2)
            await asyncio.sleep(3)
            assert scene.slave(2).limits.reported == 13
            assert scene.offers == 13
            # Another car, with a cable that carries less.
            scene.line.send(frame("02060003005a"))
            await asyncio.sleep(3)
            assert scene.broadcasts()[-1].values == (0, 90, 0, 0)

    simulate(scene())


def test_a_box_that_was_not_read_is_not_answered() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            scene.box(2).deaf = True
            await asyncio.sleep(6)
            scene.line.send(REQUEST_C)
            await asyncio.sleep(2)
            assert answers(scene) == []
            # Nor is one that is not configured.
            scene.line.send(frame("040600030082"))
            await asyncio.sleep(2)
            assert answers(scene) == []

    simulate(scene())


def test_no_answer_is_sent_too_late() -> None:
    """The line is busy: after 1 s the box repeats, and a late answer would count."""

    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(6)
            asked = now()
            scene.line.send(REQUEST_A)
            await asyncio.sleep(0.012)
            while now() < asked + 1.2:
                scene.line.noise(b"\x55")
                await asyncio.sleep(0.004)
            await asyncio.sleep(0.5)
            assert answers(scene, asked) == []
            scene.line.send(REQUEST_A)
            await asyncio.sleep(0.3)
            assert len(answers(scene, asked)) == 1

    simulate(scene())


@pytest.mark.parametrize("before", [0.46, 0.47, 0.48, 0.49, 0.5, 1.0])
def test_a_request_after_access_was_allowed_is_answered_at_once(before: float) -> None:
    """A box asks 0.1 s after the write; its read-back may wait for a broadcast."""

    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(6)
            slave, box = scene.slave(2), scene.box(2)
            await slave.change_orders(OrderChange(allowed=False))
            box.car.plug_in()
            await asyncio.sleep(6)
            await asyncio.sleep(scene.master.slot.ready + PERIOD - before - now())
            await slave.change_orders(OrderChange(allowed=True))
            await scene.until(lambda: box.state == "C")
            asked = box.controller.requests_sent
            assert [one.register for one in asked] == [2, 3]
            for one, answer in zip(asked, box.controller.answers, strict=True):
                assert answer.t - one.t < 0.8

    simulate(scene())
