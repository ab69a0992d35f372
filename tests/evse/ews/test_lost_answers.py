"""Pausing and starting with lost answers and restarts: nothing is unlocked."""

import asyncio
from contextlib import suppress

import pytest

from custom_components.evse_bus.evse.errors import (
    EvseError,
    NotAvailableError,
    NotConfirmedError,
)
from custom_components.evse_bus.evse.events import ChargeEnded
from custom_components.evse_bus.evse.ews.port import BoxPorts
from custom_components.evse_bus.evse.ews.wire.answers import EwsRefusedError, Refusal
from custom_components.evse_bus.evse.model import Fault, OrderChange, Status

from .scene import EwsScene, now, play

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)
STOP, START, PAUSE = 1, 3, 6


def amperes(current: float) -> OrderChange:
    return OrderChange(current=current)


@pytest.mark.parametrize("pause_status", [0x50, 0x42])
@pytest.mark.parametrize("received", [True, False])
@pytest.mark.parametrize("times", [1, 2])
def test_a_pause_with_a_lost_answer(
    *, received: bool, times: int, pause_status: int
) -> None:
    """Also two in a row: never is there a 6 where the first one has worked."""

    async def acts(scene: EwsScene) -> None:
        scene.box.ports[0].pause_status = pause_status  # type: ignore[assignment]
        await scene.charge()
        begin = now()
        left = times

        def lose(name: str) -> bool:
            nonlocal left
            if name != "sl" or not left:
                return False
            left -= 1
            return True

        if received:
            scene.line.mute = lose
        else:
            scene.line.deaf = lose
        with suppress(NotConfirmedError):
            await scene.charger().change_orders(OFF)
        await asyncio.sleep(40)
        sixes = scene.line.orders(PAUSE, since=begin)
        assert len(sixes) == (1 if received else times + 1)
        assert scene.status() == pause_status
        assert scene.box.ports[0].locked
        assert not scene.unlocked()
        await scene.charger().change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)

    play(EwsScene(), acts)


@pytest.mark.parametrize("lost", ["id", "rs", "rc", "rd", "st"])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_pause_while_other_answers_are_lost(lost: str, count: int) -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        left = count

        def lose(name: str) -> bool:
            nonlocal left
            if name == lost and left:
                left -= 1
                return True
            return False

        scene.line.mute = lose
        with suppress(EvseError):
            await scene.charger().change_orders(OFF)
        await scene.until(lambda: scene.status() == 0x50)
        await asyncio.sleep(30)
        assert len(scene.line.orders(PAUSE)) == 1
        assert not scene.unlocked()

    play(EwsScene(), acts)


@pytest.mark.parametrize("late", [0.49, 0.501, 0.503, 0.506, 0.52, 0.8, 1.02, 1.6])
def test_a_late_answer_to_an_older_rc_is_not_used(late: float) -> None:
    """By it the car charges, but no longer when the pause is ordered."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        begin = now()
        scene.line.held_until = now() + late
        scene.charger().poll_now()
        await asyncio.sleep(0.3)
        # The cable stays locked, as after a stop at the box.
        scene.box.ports[0].pause()
        with suppress(EvseError):
            await scene.charger().change_orders(OFF)
        await asyncio.sleep(20)
        assert not scene.unlocked()
        assert not scene.line.orders(PAUSE, since=begin)

    play(EwsScene(), acts)


@pytest.mark.parametrize("received", [True, False])
def test_a_start_with_a_lost_answer(*, received: bool) -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.plug()
        left = 1

        def lose(name: str) -> bool:
            nonlocal left
            if name != "sl" or not left:
                return False
            left -= 1
            return True

        if received:
            scene.line.mute = lose
        else:
            scene.line.deaf = lose
        await scene.charger().change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)
        assert len(scene.line.orders(START)) == (1 if received else 2)

    play(EwsScene(), acts)


def test_a_box_that_does_not_pause_is_a_fault() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.box.ports[0].pause = lambda: None  # type: ignore[method-assign]
        with pytest.raises(NotConfirmedError):
            await scene.charger().change_orders(OFF)
        assert Fault.LIMIT_NOT_TAKEN in scene.charger().faults
        assert scene.charger().orders.allowed is False
        sixes = scene.line.orders(PAUSE)
        assert len(sixes) == 2
        assert sixes[1].when - sixes[0].when >= 5

    play(EwsScene(), acts)


def test_a_start_waits_for_a_box_that_is_starting() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.plug()
        scene.box.power_cycle(0.5)
        await scene.until(lambda: scene.status() == 0xF0)
        await scene.until(lambda: scene.connector().raw_state == "0xF0")
        began = now()
        await scene.charger().change_orders(ON)
        assert now() - began > 5
        await scene.until(lambda: scene.status() == 0x40)

    play(EwsScene(options={"init_time": 20.0}), acts)


def test_it_does_not_wait_for_ever() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.plug()
        scene.box.power_cycle(0.5)
        await scene.until(lambda: scene.connector().raw_state == "0xF0")
        with pytest.raises(NotAvailableError, match="starting up"):
            await scene.charger().change_orders(ON)

    play(EwsScene(options={"power_backup": True}), acts)


def test_a_refusal_has_its_reason() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.plug()
        # The lock jams after the status was read.
        scene.box.ports[0].release_start = lambda _why: None  # type: ignore[method-assign]
        scene.line.deaf = lambda name: (
            scene.box.trip_rcd(1) or True if name == "none" else False
        )
        original = scene.line.write

        def write(data: bytes, *, reply_may_equal: bool = False) -> float:
            if data[4:6] == b"sl":
                scene.box.trip_rcd(1)
            return original(data, reply_may_equal=reply_may_equal)

        scene.line.write = write  # type: ignore[method-assign]
        with pytest.raises(EwsRefusedError) as raised:
            await scene.charger().change_orders(ON)
        assert raised.value.reason is Refusal.RCD

    play(EwsScene(), acts)


@pytest.mark.parametrize("pause_status", [0x50, 0x42])
def test_a_restart_of_ours_does_not_unlock_a_paused_charge(
    pause_status: int,
) -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.ports[0].pause_status = pause_status  # type: ignore[assignment]
        await scene.charge()
        await scene.charger().change_orders(OFF)
        old = scene.charger()
        await scene.bus.remove(old)
        scene.allowed = False
        scene.bus.group = BoxPorts()
        scene.bus.add(scene.make_charger(1))
        await scene.until(lambda: scene.charger().reading is not None)
        await scene.charger().change_orders(OFF)
        await scene.charger().change_orders(amperes(0.0))
        await asyncio.sleep(30)
        assert scene.box.ports[0].locked
        assert not scene.unlocked()
        await scene.charger().change_orders(amperes(10.0))
        await scene.charger().change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)

    play(EwsScene(), acts)


def test_a_pause_lives_through_a_lost_line() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.charger().change_orders(OFF)
        scene.unplug()
        await asyncio.sleep(5)
        await scene.until(lambda: scene.charger().reading is not None)
        await asyncio.sleep(20)
        assert scene.connector().status is Status.SUSPENDED_EVSE
        assert len(scene.line.orders(PAUSE)) == 1
        await scene.charger().change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)

    play(EwsScene(), acts)


def test_a_line_lost_with_the_pause_on_its_way() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.line.mute = lambda name: name == "sl"
        task = asyncio.ensure_future(scene.charger().change_orders(OFF))
        await scene.until(lambda: scene.status() == 0x50)
        scene.unplug()
        with pytest.raises(EvseError):
            await task
        await scene.until(lambda: scene.charger().reading is not None)
        await asyncio.sleep(20)
        assert len(scene.line.orders(PAUSE)) == 1
        assert not scene.unlocked()
        scene.line.mute = lambda _name: False
        await scene.charger().change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)

    play(EwsScene(), acts)


def test_a_paused_charge_that_is_unlocked_at_the_box() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.charger().change_orders(OFF)
        scene.box.press_key(1, 2)
        await scene.until(lambda: not scene.box.ports[0].locked)
        await asyncio.sleep(5)
        assert scene.connector().status is Status.FINISHING
        assert any(isinstance(event, ChargeEnded) for event in scene.events)
        begin = now()
        await scene.charger().change_orders(ON)
        assert not scene.line.orders(since=begin)

    play(EwsScene(), acts)


def test_a_power_failure_with_a_start_of_its_own() -> None:
    """The jumper's current counts until our limit is there again: soon."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.charger().change_orders(amperes(10.0))
        scene.box.power_cycle(3.0)
        await scene.until(lambda: "power failure" in scene.starts())
        took = await scene.until(lambda: scene.box.ports[0].limit == 10)
        assert took < 5
        await asyncio.sleep(5)
        assert scene.reading().offered_current == 10

    play(EwsScene(options={"restart_after_power": True}), acts)


def test_a_power_failure_with_a_start_of_its_own_against_a_pause() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.charger().standing_orders.orders = OFF.apply(scene.charger().orders)
        scene.box.power_cycle(0.1)
        await scene.until(lambda: "power failure" in scene.starts())
        await scene.until(lambda: scene.status() in (0x50, 0x42))
        await asyncio.sleep(20)
        assert scene.status() == 0x50
        assert scene.unlocked() == ["power failure"]

    play(EwsScene(options={"restart_after_power": True}), acts)
