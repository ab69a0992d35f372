"""The answer to a polled state, decided at the moment it is sent."""

import asyncio
from dataclasses import replace

import pytest

from custom_components.evse_bus.evse.errors import SupersededError
from custom_components.evse_bus.evse.smartevse.dialects import Status
from custom_components.evse_bus.evse.smartevse.handshake_polled import (
    ANSWER_WITHIN,
    PolledHandshake,
)
from custom_components.evse_bus.evse.smartevse.sharing import Contactor
from tests.evse.smartevse.scene import MasterScene
from tests.simulated_time import now, simulate

ASKS = Status(raw_state="G", error=0, current=6.0, access=True, maximum=32)
GRANTED, REFUSED = bytes((0, 7, 0, 0)), bytes((0, 6, 0, 1))


def answer(handshake: PolledHandshake, scene: MasterScene) -> bytes:
    """Return the state and the error that would be written now."""
    return handshake._answer_frame(scene.master)[7:11]


def test_a_status_is_answered_once() -> None:
    """Written again, it would close the contactor of a box whose car has left."""

    async def scene() -> None:
        async with MasterScene(units=(2,), dialect="2.30") as scene:
            await asyncio.sleep(8)
            handshake = PolledHandshake(scene.slave(2))
            handshake.on_status(ASKS, now())
            assert answer(handshake, scene) == GRANTED
            with pytest.raises(SupersededError):
                answer(handshake, scene)
            handshake.on_status(ASKS, now())
            assert answer(handshake, scene) == GRANTED

    simulate(scene())


def test_an_old_status_is_not_answered_but_read_again_at_once() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,), dialect="2.30") as scene:
            await asyncio.sleep(8)
            slave = scene.slave(2)
            handshake = PolledHandshake(slave)
            handshake.on_status(ASKS, now())
            await asyncio.sleep(ANSWER_WITHIN + 0.01)
            assert handshake.after_poll(scene.master) is None
            slave.slot.ready = now() + 1.0
            with pytest.raises(SupersededError):
                answer(handshake, scene)
            assert slave.slot.ready == now()

    simulate(scene())


def test_an_answer_that_is_not_sent_is_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("DEBUG")
    why = "Slave 2: a status that is no longer new is not answered"

    async def scene() -> None:
        async with MasterScene(units=(2,), dialect="2.30") as scene:
            await asyncio.sleep(8)
            slave = scene.slave(2)
            handshake = PolledHandshake(slave)
            for state, error in (("G", 0), ("A", 1)):
                handshake.on_status(replace(ASKS, raw_state=state, error=error), now())
                follow_up = handshake.after_poll(scene.master)
                assert follow_up is not None
                # Another one was answered before its turn.
                handshake._take(now())
                caplog.clear()
                await slave.run(follow_up.conversation)
                logged = [text for _, _, text in caplog.record_tuples]
                assert why in logged

    simulate(scene())


@pytest.mark.parametrize(("before", "then"), [(60, GRANTED), (160, REFUSED)])
def test_what_its_pilot_may_show_must_fit(before: int, then: bytes) -> None:
    """It was charging with 16 A a moment ago; meanwhile the other goes up to 10 A."""

    async def scene() -> None:
        async with MasterScene(units=(2, 3), dialect="2.30", current=10.0) as scene:
            await asyncio.sleep(8)
            await scene.charge(3)
            await asyncio.sleep(3)
            assert scene.offers == 10
            draw = scene.master.draw(2)
            draw.read(before, now(), Contactor.OPEN)
            draw.read(60, now(), Contactor.ASKED)
            handshake = PolledHandshake(scene.slave(2))
            handshake.on_status(ASKS, now())
            assert answer(handshake, scene) == then

    simulate(scene())


def test_one_without_access_is_refused_where_it_goes_on_asking() -> None:
    """Its access was turned off at the box while it asked."""

    async def scene() -> None:
        async with MasterScene(units=(2,), dialect="2.30+") as scene:
            await asyncio.sleep(8)
            slave = scene.slave(2)
            slave.status = replace(ASKS, access=False)
            handshake = PolledHandshake(slave)
            handshake.on_status(slave.status, now())
            assert answer(handshake, scene) == REFUSED

    simulate(scene())


@pytest.mark.parametrize(
    ("state", "error", "clears"),
    [
        ("A", 1, True),
        ("A", 0, False),
        # Another error would keep it from asking, and begin its 60 s anew.
        ("A", 1 | 2, False),
        ("A", 1 | 4, False),
        # In these the write would grant, or stop a charge.
        ("G", 1, False),
        ("C", 1, False),
    ],
)
def test_only_a_refusal_alone_is_cleared(
    state: str, error: int, *, clears: bool
) -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,), dialect="2.30") as scene:
            await asyncio.sleep(8)
            handshake = PolledHandshake(scene.slave(2))
            status = replace(ASKS, raw_state=state, error=error)
            assert handshake._may_clear(status, scene.master) is clears
            if clears:
                handshake.on_status(status, now())
                assert handshake.after_poll(scene.master) is not None
                assert handshake._clear_frame(scene.master)[7:11] == bytes(4)

    simulate(scene())
