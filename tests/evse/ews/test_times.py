"""When a box is polled, and the effect of silence."""

import asyncio
from dataclasses import replace
from itertools import pairwise

import pytest

from custom_components.evse_bus.evse.ews.timing import TCP_TIMING
from custom_components.evse_bus.evse.model import (
    Fault,
    OrderChange,
    Status,
)

from .scene import EwsScene, now, play

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)


def amperes(current: float) -> OrderChange:
    return OrderChange(current=current)


def longest_silence(scene: EwsScene, since: float) -> float:
    times = [since, *(one.when for one in scene.line.sent if one.when >= since), now()]
    return max(later - sooner for sooner, later in pairwise(times))


@pytest.mark.parametrize("interval", [0.5, 2.0, 20.0, 300.0])
def test_the_box_never_waits_for_30_seconds(interval: float) -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        await asyncio.sleep(400)
        assert longest_silence(scene, begin) < 25
        assert scene.bus.wire.statistics.missed_deadlines == 0
        assert scene.box.server_connected

    play(EwsScene(timing=TCP_TIMING, config={"poll_interval": interval}), acts)


def test_a_slow_first_port_does_not_delay_the_other() -> None:
    """The first port has the deadline, which moves with commands to the other."""

    async def acts(scene: EwsScene) -> None:
        port = scene.charger()
        port.reconfigure(replace(port.config, poll_interval=300.0))
        await asyncio.sleep(3)
        begin = now()
        await asyncio.sleep(120)
        looks = [begin, *(one.when for one in scene.line.named("rc", since=begin))]
        assert max(later - sooner for sooner, later in pairwise(looks)) < 4
        assert scene.bus.wire.statistics.missed_deadlines == 0

    play(EwsScene(timing=TCP_TIMING), acts)


def test_commands_that_never_end_keep_no_poll_from_its_deadline() -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        end = begin + 60
        stop = scene.charger(2)

        async def ask() -> None:
            while now() < end:
                await stop.services.read_cards()

        await asyncio.gather(*(ask() for _ in range(4)))
        looks = [begin, *(one.when for one in scene.line.named("rc", since=begin))]
        assert max(later - sooner for sooner, later in pairwise(looks)) < 30
        assert scene.bus.wire.statistics.missed_deadlines == 0

    play(EwsScene(timing=TCP_TIMING), acts)


def test_a_lost_answer_over_the_network_costs_no_connection() -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        for _ in range(20):
            scene.box.faults.once("lose")
            await asyncio.sleep(15)
        assert longest_silence(scene, begin) < 25
        assert scene.charger().available

    play(EwsScene(timing=TCP_TIMING), acts)


def test_a_silent_box_is_unavailable_and_comes_back() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.line.cut = True
        took = await scene.until(lambda: not scene.charger().available)
        assert took < 10
        assert scene.charger().reading is None
        await asyncio.sleep(100)
        scene.line.cut = False
        await scene.until(lambda: scene.charger().reading is not None, 40)
        assert scene.status() == 0x40
        assert scene.connector().status is Status.CHARGING

    play(EwsScene(), acts)


def test_ten_minutes_of_silence_are_the_boxes_own_business() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.line.cut = True
        await asyncio.sleep(640)
        assert scene.status() == 0x60
        scene.line.cut = False
        await scene.until(lambda: scene.charger().reading is not None, 40)
        assert scene.reading().faults == {Fault.UPSTREAM_TIMEOUT}
        await asyncio.sleep(30)
        assert scene.status() == 0x60

    play(EwsScene(), acts)


def test_answers_that_cannot_be_change_nothing_and_end_in_a_fault() -> None:
    async def acts(scene: EwsScene) -> None:
        before = scene.reading()
        port = scene.box.ports[0]
        port.cable = 200
        port.plug_cable()
        await asyncio.sleep(2.5)
        assert scene.reading() == before
        await scene.until(lambda: scene.charger().reading is None)
        assert Fault.IMPLAUSIBLE in scene.charger().faults
        port.cable = 32
        await scene.until(lambda: scene.charger().reading is not None)
        assert not scene.charger().faults

    play(EwsScene(), acts)
