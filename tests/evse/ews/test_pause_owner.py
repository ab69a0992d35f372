"""A pause that may be ours is not ordered again, and its end starts no other car."""

import asyncio
from contextlib import suppress
from dataclasses import replace

import pytest

from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.ews.port import BoxPorts
from custom_components.evse_bus.evse.model import CurrentLimit, OrderChange, Orders

from .scene import EwsScene, now, play

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)
START, PAUSE = 3, 6


def amperes(current: float) -> OrderChange:
    return OrderChange(current=current)


async def begin_anew(scene: EwsScene, orders: Orders, **config: float | None) -> None:
    """Restart the library: the stored orders are all it knows."""
    await scene.bus.remove(scene.charger())
    scene.bus.group = BoxPorts()
    charger = scene.make_charger(1)
    charger._config = replace(charger.config, **config)  # type: ignore[arg-type]
    scene.bus.add(type(charger)(charger.config, orders))
    await scene.until(lambda: scene.charger().reading is not None)


def paused_as_0x42(scene: EwsScene) -> None:
    scene.box.ports[0].pause_status = 0x42


@pytest.mark.parametrize("flag", ["read", "clock", "never"])
def test_a_restart_flag_that_stays_does_not_end_our_pause(flag: str) -> None:
    async def acts(scene: EwsScene) -> None:
        paused_as_0x42(scene)
        await scene.charge()
        await scene.charger().change_orders(OFF)
        for _ in range(2):
            scene.unplug()
            await asyncio.sleep(20)
        await begin_anew(scene, scene.charger().orders)
        await asyncio.sleep(20)
        assert len(scene.line.orders(PAUSE)) == 1
        assert not scene.unlocked()
        await scene.charger().change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)

    play(EwsScene(options={"restart_flag_until": flag}), acts)


@pytest.mark.parametrize("how", ["lifetime removed", "fail-safe raised", "no orders"])
def test_a_pause_that_the_stored_orders_do_not_explain(how: str) -> None:
    """The order that has paused it was replaced, and the pause still stands."""

    async def acts(scene: EwsScene) -> None:
        paused_as_0x42(scene)
        await scene.charge()
        await scene.until(lambda: scene.status() == 0x42, 80)
        await asyncio.sleep(5)
        orders, lifetime = scene.charger().orders, scene.lifetime
        if how == "lifetime removed":
            lifetime = None
        elif how == "fail-safe raised":
            await scene.charger().change_orders(OrderChange(fail_safe_current=8.0))
            orders = scene.charger().orders
        else:
            orders = Orders(limit=CurrentLimit(current=6.0))
        await begin_anew(scene, orders, order_lifetime=lifetime)
        await scene.charger().change_orders(OFF)
        await asyncio.sleep(20)
        assert len(scene.line.orders(PAUSE)) == 1
        assert not scene.unlocked()
        await scene.charger().change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)

    play(EwsScene(lifetime=60.0, fail_safe=0.0), acts)


def test_a_box_that_resets_its_counters_with_our_pause() -> None:
    async def acts(scene: EwsScene) -> None:
        port = scene.box.ports[0]
        paused_as_0x42(scene)
        await scene.charge()
        await asyncio.sleep(30)

        def begin_counters() -> None:
            if port.status == 0x42:
                port.session.seconds = port.session.wh = 0.0

        scene.watchers.append(begin_counters)
        await scene.charger().change_orders(OFF)
        await asyncio.sleep(30)
        assert len(scene.line.orders(PAUSE)) == 1
        assert not scene.unlocked()

    play(EwsScene(), acts)


@pytest.mark.parametrize("received", [True, False])
def test_a_start_for_current_with_an_unknown_result(*, received: bool) -> None:
    """The line is lost right after the start: the next car is not started."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.until(lambda: scene.charger().waits_for_current, 80)
        scene.line.mute = lambda name: name == "sl" and not received
        task = asyncio.ensure_future(scene.charger().change_orders(amperes(16.0)))
        await scene.until(lambda: scene.status() == 0x40)
        await asyncio.sleep(0.05)
        scene.unplug()
        with suppress(EvseError):
            await task
        await asyncio.sleep(10)
        scene.line.mute = lambda _name: False
        scene.cars[0].leave()
        await scene.until(lambda: scene.status() == 0x00)
        await scene.plug()
        begin = now()
        await scene.charger().change_orders(amperes(10.0))
        await asyncio.sleep(20)
        assert not scene.line.orders(since=begin)
        assert scene.status() == 0x30

    play(EwsScene(lifetime=60.0, fail_safe=0.0), acts)


def test_another_car_came_while_the_line_was_lost() -> None:
    """The end of a pause for current is for the car that was paused."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.charger().change_orders(amperes(0.0))
        scene.unplug(20.0)
        scene.cars[0].leave()
        await scene.until(lambda: scene.status() == 0x00)
        scene.cars[0].plug_in()
        await scene.until(lambda: scene.status() == 0x30)
        assert not scene.bus.connected
        await scene.until(lambda: scene.bus.connected)
        begin = now()
        with suppress(EvseError):
            await scene.charger().change_orders(amperes(16.0))
        await asyncio.sleep(20)
        assert not scene.line.orders(since=begin)
        assert scene.status() == 0x30

    play(EwsScene(), acts)


def test_a_limit_of_zero_does_not_claim_a_charge_stopped_at_the_box() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.box.press_key(1, 2)
        await scene.until(lambda: scene.status() == 0x50)
        await asyncio.sleep(5)
        await begin_anew(scene, scene.charger().orders)
        await scene.charger().change_orders(amperes(0.0))
        assert not scene.charger().waits_for_current
        begin = now()
        await scene.charger().change_orders(amperes(16.0))
        await asyncio.sleep(5)
        assert not scene.line.orders(since=begin)

    play(EwsScene(lifetime=60.0, fail_safe=0.0), acts)


def test_a_charge_that_has_ended_is_not_started_again() -> None:
    """After a restart of ours it might be a pause, but its plug is free."""

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.box.press_key(1, 2)
        await scene.until(lambda: scene.status() == 0x50)
        await asyncio.sleep(5)
        await begin_anew(scene, scene.charger().orders)
        begin = now()
        await scene.charger().change_orders(ON)
        assert not scene.line.orders(since=begin)

    play(EwsScene(), acts)
