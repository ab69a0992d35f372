"""Quiet and broadcasts across searches and reloads of the bus."""

import asyncio

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.model import Fault, OrderChange
from custom_components.evse_bus.evse.smartevse import POLLED
from custom_components.evse_bus.evse.smartevse.dialects import STOPS_ALONE, Dialect
from custom_components.evse_bus.evse.smartevse.master import (
    LISTENING,
    STAY_SILENT,
    STILL_CHARGING,
)
from custom_components.evse_bus.evse.smartevse.polled import QUIET
from tests.simulated_time import now, simulate

from .frames import frame
from .polled_scene import ALL, HEAD, LATER, PolledScene
from .scene import MasterScene
from .test_polled_quiet import quiets

NO_COMM = 2


async def search(scene: PolledScene) -> int:
    """Search the bus of the scene; return how many boxes were found."""
    config, orders = scene.charger.config, scene.charger.orders
    report = await POLLED.scan(scene.bus, config, orders, lambda _share: None)
    return len(report.found)


async def search_alone(scene: PolledScene) -> int:
    """Search on a bus of its own, as a flow does where none runs."""
    await scene.bus.stop()
    scene.bus = Bus(scene.line, POLLED.framer(), POLLED.timing, "search")
    await scene.bus.start()
    return await search(scene)


@pytest.mark.parametrize("dialect", ALL)
@pytest.mark.parametrize("after", [0.0, 1.3, 20.0])
def test_after_a_search(dialect: Dialect, after: float) -> None:
    """A later box has its quiet before it is polled; others are polled at once."""

    async def run() -> None:
        scene = PolledScene(dialect)
        async with scene:
            await scene.settled()
            assert await search_alone(scene) == 1
            searched = scene.line.sent[-1].when
            await asyncio.sleep(after)
            opened = now()
            await scene.restart(reload=True)
            await scene.until(lambda: scene.charger.available, QUIET + 1)
            first = next(one for one in scene.line.sent if one.when >= opened)
            if dialect in LATER:
                assert first.when - max(searched + QUIET, opened) < 0.1
                assert first.when - searched >= QUIET
            else:
                assert first.when - opened < 0.1

    simulate(run())


@pytest.mark.parametrize("after", [0.3, 3.0, 6.4])
def test_a_reload_keeps_the_quiet(after: float) -> None:
    async def run() -> None:
        scene = PolledScene(HEAD)
        async with scene:
            await scene.settled()
            await scene.charge()
            await scene.polled(3)
            last = len(scene.line.sent)
            await scene.until(lambda: len(scene.line.sent) > last)
            await asyncio.sleep(after)
            await scene.restart(reload=True)
            await asyncio.sleep(30)
            assert min(quiets(scene)) >= QUIET - 0.1

    simulate(run())


def test_a_search_beside_a_running_box_is_one_burst_with_its_poll() -> None:
    async def run() -> None:
        scene = PolledScene(HEAD)
        async with scene:
            await scene.settled()
            await scene.polled(2)
            for pause in (1.0, 5.0, 9.0):
                await asyncio.sleep(pause)
                assert await search(scene) == 1
            await asyncio.sleep(10)
            assert min(quiets(scene)) >= QUIET - 0.1
            # The search itself takes 2 s, most of them at an address without a box.
            assert max(quiets(scene)) < QUIET + 1.0

    simulate(run())


def test_a_box_added_again_gets_its_quiet() -> None:
    async def run() -> None:
        scene = PolledScene(HEAD)
        async with scene:
            await scene.settled()
            await scene.charge()
            for pause in (0.5, 3.0, 6.0):
                await asyncio.sleep(pause)
                await scene.bus.remove(scene.charger)
                scene.charger = scene.make_charger()
                scene.bus.add(scene.charger)
                await scene.until(lambda: scene.charger.available, QUIET + 1)
            await asyncio.sleep(30)
            assert min(quiets(scene)) >= QUIET - 0.1

    simulate(run())


def test_a_silent_box_gets_its_quiet() -> None:
    """It may receive, though it is not received."""

    async def run() -> None:
        scene = PolledScene(HEAD)
        errors: list[int] = []
        async with scene:
            await scene.settled()
            await scene.charge()
            await scene.polled(3)
            scene.box.mute = True
            scene.on_step.append(lambda: errors.append(scene.outlet.error))
            await scene.until(lambda: not scene.charger.available)
            await asyncio.sleep(300)
            assert not any(error & NO_COMM for error in errors)
            assert min(quiets(scene)[-20:]) >= QUIET - 0.1
            assert max(quiets(scene)[-20:]) < QUIET + 1.0

    simulate(run())


def test_a_later_box_is_quiet_across_a_lost_port() -> None:
    async def run() -> None:
        scene = PolledScene(HEAD)
        async with scene:
            await scene.settled()
            await scene.charge()
            for pause in (0.5, 3.0, 6.0):
                await asyncio.sleep(pause)
                scene.line.unplug()
                await scene.until(lambda: scene.charger.available, 20)
            await asyncio.sleep(30)
            assert min(quiets(scene)) >= QUIET - 0.1

    simulate(run())


@pytest.mark.parametrize("dialect", ALL)
@pytest.mark.parametrize("how", ["restart", "reload", "unplug", "again"])
def test_a_pause_that_was_undone_meanwhile_stands_again(
    dialect: Dialect, how: str
) -> None:
    """Access was opened while we were away; with a car in, in the first burst."""

    async def run() -> None:
        scene = PolledScene(dialect, allowed=False)
        async with scene:
            await scene.settled()
            scene.car.plug_in()
            await scene.polled(2)
            assert not scene.outlet.access
            if how in ("restart", "reload"):
                await scene.bus.stop()
                scene.outlet.set_access(True)
                await scene.restart(away=3.0, reload=how == "reload")
            elif how == "unplug":
                scene.outlet.set_access(True)
                scene.line.unplug()
            else:
                await scene.bus.remove(scene.charger)
                scene.outlet.set_access(True)
                scene.charger = scene.make_charger()
                scene.bus.add(scene.charger)
            took = await scene.until(lambda: not scene.outlet.access)
            assert took < (QUIET + 1.0 if dialect in LATER else 2.5)

    simulate(run())


_EVENTS = st.lists(
    st.tuples(
        st.sampled_from(("reload", "search", "alone", "unplug")),
        st.floats(0.0, 12.0),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=25)
@given(events=_EVENTS)
def test_whatever_happens_a_later_box_does_not_stop_with_no_comm(
    events: list[tuple[str, float]],
) -> None:
    async def run() -> None:
        scene = PolledScene(HEAD)
        errors: list[int] = []
        async with scene:
            await scene.settled()
            await scene.charge()
            await scene.polled(3)
            scene.on_step.append(lambda: errors.append(scene.outlet.error))
            for event, pause in events:
                if event == "reload":
                    await scene.restart(reload=True)
                elif event == "search":
                    await search(scene)
                elif event == "alone":
                    await search_alone(scene)
                    await scene.restart(reload=True)
                else:
                    scene.line.unplug()
                await asyncio.sleep(pause)
            await asyncio.sleep(30)
            assert not any(error & NO_COMM for error in errors)
            assert scene.charger.available

    simulate(run())


@pytest.mark.parametrize("dialect", ALL)
@pytest.mark.parametrize(("idle", "poll_interval"), [(1.5, 2.0), (15.0, 20.0)])
def test_an_adapter_that_closes_idle_lines_takes_no_current(
    dialect: Dialect, idle: float, poll_interval: float
) -> None:
    """A later box cannot confirm a current if its quiet takes longer than that."""
    if dialect in LATER:
        idle = max(idle, QUIET + 0.5)

    async def close_when_idle(scene: PolledScene) -> None:
        while True:
            await asyncio.sleep(0.1)
            if scene.line.is_open and now() - scene.line.last_activity > idle:
                scene.line.unplug()

    async def run() -> None:
        scene = PolledScene(dialect, poll_interval=poll_interval)
        async with scene:
            await scene.settled()
            await scene.charge()
            await scene.polled(3)
            closing = asyncio.create_task(close_when_idle(scene))
            offers: list[float] = []
            gone: list[bool] = []
            scene.on_step.append(lambda: offers.append(scene.box.offers))
            scene.on_step.append(lambda: gone.append(scene.charger.reading is None))
            await asyncio.sleep(20 * poll_interval)
            assert set(offers) == {10.0}
            assert not any(gone)
            for current in (8.0, 12.0):
                await scene.charger.change_orders(OrderChange(current=current))
                assert scene.box.offers == current
            closing.cancel()

    simulate(run())


@pytest.mark.parametrize("away", [0.0, 2.0, 4.0, 6.0])
def test_slaves_go_on_across_a_reload(away: float) -> None:
    """The next broadcast does not wait until it is sure that there is no master."""

    async def run() -> None:
        async with MasterScene() as scene:
            await asyncio.sleep(5)
            await scene.charge(2, 3)
            await asyncio.sleep(4)
            last = scene.broadcasts()[-1].when
            await scene.bus.stop()
            await asyncio.sleep(away)
            if now() - last > STILL_CHARGING - 0.5:
                return
            scene.new_bus(reload=True)
            scene.add(2)
            scene.add(3)
            await scene.bus.start()
            begin = now()
            while now() - begin < 20:
                await asyncio.sleep(0.02)
                offers = [box.offers for box in scene.line.boxes.values()]
                assert offers == [8.0, 8.0]
            first = next(one.when for one in scene.broadcasts(begin))
            assert first - begin < 1.0

    simulate(run())


OTHER_MASTER = frame("001000010004080064003c00000000")
"""A broadcast to slaves of 2.17."""


@pytest.mark.parametrize("after", [0.5, 5.0])
def test_after_a_reload_it_listens_where_another_master_was(after: float) -> None:
    """It broadcast itself a moment ago, and is not the only one any more."""

    async def run() -> None:
        async with MasterScene(watch=False) as scene:
            await asyncio.sleep(6)
            await scene.until(lambda: now() > scene.line.busy_until + 0.01)
            scene.line.send(OTHER_MASTER)
            await asyncio.sleep(after)
            assert scene.master.noticed == {Fault.SECOND_MASTER}
            sent = len(scene.line.sent)
            await scene.bus.stop()
            scene.new_bus(reload=True)
            scene.add(2)
            scene.add(3)
            await scene.bus.start()
            await asyncio.sleep(LISTENING - 0.1)
            assert len(scene.line.sent) == sent

    simulate(run())


def test_silence_beside_another_master_outlasts_a_lost_port() -> None:
    async def run() -> None:
        async with MasterScene(watch=False) as scene:
            await asyncio.sleep(6)
            await scene.until(lambda: now() > scene.line.busy_until + 0.01)
            scene.line.send(OTHER_MASTER)
            await asyncio.sleep(5)
            sent = len(scene.line.sent)
            scene.line.unplug()
            await asyncio.sleep(STAY_SILENT - 10)
            assert scene.line.is_open
            assert len(scene.line.sent) == sent
            await asyncio.sleep(15)
            assert len(scene.line.sent) > sent

    simulate(run())


def test_after_a_reload_nothing_goes_up_before_all_are_known() -> None:
    """What an earlier bus has left a slave is not remembered: it may draw anything."""

    async def run() -> None:
        async with MasterScene(limit=20.0) as scene:
            await asyncio.sleep(5)
            await scene.charge(2, 3)
            await asyncio.sleep(3)
            await scene.bus.stop()
            scene.box(3).deaf = scene.box(3).mute = True
            scene.new_bus(reload=True)
            scene.add(2)
            scene.add(3)
            await scene.bus.start()
            begin = now()
            await scene.until(lambda: scene.box(2).offers > 10)
            assert now() - begin >= STOPS_ALONE

    simulate(run())
