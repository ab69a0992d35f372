"""The minimum interval holds across searches, reloads, and chargers added again."""

import asyncio
from dataclasses import replace
from itertools import pairwise

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.evbox import PROTOCOL, EvboxCharger, EvboxConfig
from custom_components.evse_bus.evse.evbox.config import (
    INTERVAL_MARGIN,
    UNKNOWN_INTERVAL,
)
from custom_components.evse_bus.evse.evbox.frames import EvboxFramer
from custom_components.evse_bus.evse.memory import LineMemory
from custom_components.evse_bus.evse.model import (
    ChargerConfig,
    Fault,
    OrderChange,
    Orders,
)
from tests.evse.simulated_line import until
from tests.simulated_time import now, simulate
from tests.virtual import EvboxChargePoint, Module

from .scene import ORDERS, EvboxLine, Scene

SERIAL = 1923054
SHORT = replace(ORDERS, fail_safe_timeout=15)
"""The shortest time-out that a form accepts for the usual poll interval."""
ANY = EvboxConfig(key="scan", name="scan", address=0, installation_limit=32.0)


class Setups(Scene):
    """One line on which buses come and go, as with searches and reloads."""

    async def reload(self, *, forget: bool = False, orders: Orders = ORDERS) -> None:
        """Make a new bus; ``forget``: in a new process, which knows nothing."""
        await self.bus.stop()
        if forget:
            self.line.memory = LineMemory()
        configs = [one.config for one in self.bus.chargers.values()]
        await self._set_up(configs, orders)

    async def _set_up(
        self, chargers: list[ChargerConfig], orders: Orders = ORDERS
    ) -> None:
        await self.bus.stop()
        self.bus = Bus(self.line, EvboxFramer(), PROTOCOL.timing, "simulated")
        for config in chargers:
            self.bus.add(EvboxCharger(config, orders))  # type: ignore[arg-type]
        await self.bus.start()

    async def search(self, address: int = 0) -> list[int | str]:
        """Search on a bus of its own, as a flow does where none runs."""
        chargers = [one.config for one in self.bus.chargers.values()]
        await self.bus.stop()
        self.bus = Bus(self.line, EvboxFramer(), PROTOCOL.timing, "search")
        await self.bus.start()
        try:
            return await self._search(address)
        finally:
            await self._set_up(chargers)

    async def _search(self, address: int) -> list[int | str]:
        config = replace(ANY, address=address)
        report = await PROTOCOL.scan(self.bus, config, ORDERS, lambda _share: None)
        return [one.address for one in report.found]

    async def add_again(self, charger: EvboxCharger, **values: object) -> EvboxCharger:
        await self.bus.remove(charger)
        return self.add(SERIAL, **values)

    @property
    def charger(self) -> EvboxCharger:
        (charger,) = self.bus.chargers.values()
        assert isinstance(charger, EvboxCharger)
        return charger


def stage(interval: int, *, too_soon_restarts: bool = False) -> Setups:
    point = EvboxChargePoint(
        SERIAL, min_interval=interval, too_soon_restarts=too_soon_restarts
    )
    scene = Setups.of(point)
    assert isinstance(scene, Setups)
    return scene


def too_soon(scene: Scene) -> int:
    return scene.line.points[0].counters.too_soon


@pytest.mark.parametrize("address", [0, SERIAL])
def test_after_a_search(address: int) -> None:
    """The first message waits for the rest of the interval that was just reported."""

    async def scene() -> None:
        async with stage(20) as line:
            assert await line.search(address) == [SERIAL]
            await line.reload()
            await asyncio.sleep(1.3)
            charger = line.add(SERIAL)
            await charger.wait_available(30)
            assert 20.0 <= line.line.pauses()[0] < 20.5
            assert (too_soon(line), charger.statistics.timeouts) == (0, 0)

    simulate(scene())


def test_after_a_search_that_has_reported_a_short_interval() -> None:
    """No 20 s are waited for nothing."""

    async def scene() -> None:
        async with stage(1) as line:
            await line.search()
            charger = line.add(SERIAL)
            await charger.wait_available(3)
            assert 1.0 <= line.line.pauses()[0] < 1.5

    simulate(scene())


def test_a_search_after_a_search() -> None:
    async def scene() -> None:
        async with stage(20) as line:
            assert await line.search() == [SERIAL]
            began = now()
            assert await line.search(SERIAL) == [SERIAL]
            # The rest of one interval, and another until a second reply agrees.
            assert now() - began < 41.5
            assert too_soon(line) == 0

    simulate(scene())


def test_after_a_reload() -> None:
    async def scene() -> None:
        async with stage(20) as line:
            await line.add(SERIAL).wait_available()
            await asyncio.sleep(70)
            await line.reload()
            await line.charger.wait_available(30)
            assert line.charger.statistics.timeouts == 0
            assert min(line.line.pauses()[1:]) >= 20.0
            assert max(line.line.pauses()[1:]) < 20.5

    simulate(scene())


def test_after_it_was_added_again_or_changed() -> None:
    async def scene() -> None:
        async with stage(20) as line:
            charger = line.add(SERIAL)
            await charger.wait_available()
            await asyncio.sleep(22)
            charger = await line.add_again(charger)
            await charger.wait_available(30)
            charger = await line.add_again(charger, command=69)
            await charger.wait_available(30)
            charger = await line.add_again(charger)
            await charger.wait_available(30)
            assert too_soon(line) == 0

    simulate(scene())


def test_after_a_reconnect() -> None:
    async def scene() -> None:
        async with stage(20) as line:
            charger = line.add(SERIAL)
            await charger.wait_available()
            line.line.unplug()
            await asyncio.sleep(5)
            await charger.wait_available(30)
            await asyncio.sleep(60)
            assert (too_soon(line), charger.statistics.timeouts) == (0, 0)

    simulate(scene())


@pytest.mark.parametrize("away", [2.0, 8.0, 25.0])
def test_after_a_restart_it_is_asked_at_once(away: float) -> None:
    """Whether it may be asked is not known; that it may fall back soon, is.

    One that stays silent because it was asked too soon is asked again after its
    interval, once, and is not taken for one that is away.
    """

    async def scene() -> None:
        async with stage(20) as line:
            await line.add(SERIAL).wait_available()
            await asyncio.sleep(40.3)
            before = len(line.line.sent)
            await line.bus.stop()
            await asyncio.sleep(away)
            began = now()
            await line.reload(forget=True)
            charger = line.charger
            await charger.wait_available(30)
            assert now() - began < UNKNOWN_INTERVAL + INTERVAL_MARGIN + 1
            first, *others = (sent.at - began for sent in line.line.sent[before:])
            assert first < 0.5
            assert charger.misses == 0
            assert too_soon(line) == len(others) <= 1

    simulate(scene())


@pytest.mark.parametrize("too_soon_restarts", [False, True])
@pytest.mark.parametrize("reload", [False, True])
def test_a_box_with_a_longer_interval_in_its_place(
    reload: bool,  # noqa: FBT001
    too_soon_restarts: bool,  # noqa: FBT001
) -> None:
    """A remembered interval may be of another box: it is not asked too often for ever."""

    async def scene() -> None:
        async with stage(1, too_soon_restarts=too_soon_restarts) as line:
            await line.add(SERIAL).wait_available()
            await asyncio.sleep(10)
            line.line.points[0].min_interval = 20
            if reload:
                await line.reload()
            patience = 330 if too_soon_restarts else 60
            await until(lambda: line.charger.minimum_interval == 20, patience)
            assert line.charger.available
            before = too_soon(line)
            await asyncio.sleep(200)
            assert too_soon(line) == before

    simulate(scene())

    simulate(scene())


_EVENTS = st.lists(
    st.tuples(
        st.sampled_from(("reload", "again", "command", "search", "unplug", "wait")),
        st.floats(0.0, 30.0),
    ),
    min_size=1,
    max_size=6,
)


@settings(max_examples=30)
@given(events=_EVENTS, interval=st.integers(1, 30), searched=st.booleans())
def test_whatever_happens_it_is_never_asked_too_soon(
    events: list[tuple[str, float]], interval: int, *, searched: bool
) -> None:
    async def scene() -> None:
        async with stage(interval) as line:
            if searched:
                assert await line.search() == [SERIAL]
            charger = line.add(SERIAL)
            await charger.wait_available(60)
            # Two replies must agree on an interval longer than the one first assumed.
            await asyncio.sleep(2 * interval + 21)
            before = too_soon(line)
            for event, pause in events:
                if event == "reload":
                    await line.reload()
                elif event == "again":
                    charger = await line.add_again(line.charger)
                elif event == "command":
                    charger = await line.add_again(line.charger, command=69)
                elif event == "search":
                    await line.search(SERIAL)
                elif event == "unplug":
                    line.line.unplug()
                await asyncio.sleep(pause)
            await line.charger.wait_available(120)
            # The interval of the other command is not known: 20 s are assumed, and a
            # longer one counts when two replies to one bus agree.
            learnt = any(event == "command" for event, _ in events)
            exceptions = len(events) if learnt and interval > UNKNOWN_INTERVAL else 0
            assert too_soon(line) <= before + exceptions
            if interval <= UNKNOWN_INTERVAL:
                assert before == 0

    simulate(scene())


def test_a_silent_box_is_not_asked_within_its_interval() -> None:
    """The shorter pauses of the back-off count for boxes with a shorter interval."""

    async def scene() -> None:
        async with stage(20) as line:
            await line.add(SERIAL).wait_available()
            await asyncio.sleep(45)
            line.line.points[0].faults.dead = True
            sent = len(line.line.sent)
            await asyncio.sleep(300)
            assert not line.charger.available
            silent = line.line.pauses()[sent:]
            assert min(silent) >= 20.0
            assert max(silent) < 21.0

    simulate(scene())


@pytest.mark.parametrize("dead", [1, 15])
@pytest.mark.parametrize("reload", [False, True])
def test_dead_boxes_do_not_make_a_living_one_fall_back(
    dead: int,
    reload: bool,  # noqa: FBT001
) -> None:
    """With the shortest time-out that is offered, also right after a reload."""

    async def scene() -> None:
        point = EvboxChargePoint(SERIAL, min_interval=1)
        async with Setups.of(point) as line:
            assert isinstance(line, Setups)
            # The dead ones are asked first after a reload.
            for number in range(dead):
                line.add(number + 1, orders=SHORT)
            living = line.add(SERIAL, orders=SHORT)
            await living.wait_available()
            await asyncio.sleep(60)
            assert living.effective_timeout == SHORT.fail_safe_timeout
            before = len(point.orders)
            if reload:
                await line.reload(orders=SHORT)
            await asyncio.sleep(120)
            assert point.counters.fail_backs == 0
            gaps = [b.t - a.t for a, b in pairwise(point.orders[before - 1 :])]
            assert max(gaps) < SHORT.fail_safe_timeout

    simulate(scene())


async def close_when_idle(line: EvboxLine, idle: float) -> None:
    """Close the line as some adapters do; it can be opened again at once."""
    while True:
        await asyncio.sleep(0.1)
        if line.is_open and now() - line.last_activity > idle:
            line.unplug()


@pytest.mark.parametrize(
    ("interval", "idle"), [(20, 10.0), (20, 3.0), (5, 3.0), (1, 3.0)]
)
def test_an_adapter_that_closes_idle_lines_takes_no_current(
    interval: int, idle: float
) -> None:
    """The line is opened anew before each message: its maximum stays known."""

    async def scene() -> None:
        async with stage(interval) as line:
            charger = line.add(SERIAL)
            closing = asyncio.create_task(close_when_idle(line.line, idle))
            await asyncio.sleep(3 * interval + 10)
            before = len(line.line.sent)
            await asyncio.sleep(20 * max(interval, 5))
            assert {sent.order.limits[0] for sent in line.line.sent[before:]} == {16.0}
            assert line.line.statistics.opened > 15
            assert charger.available
            assert too_soon(line) == 0
            # A box that has been away may be another one.
            line.line.points[0].faults.dead = True
            await until(lambda: not charger.available, 120)
            line.line.points[0].faults.dead = False
            before = len(line.line.sent)
            await until(lambda: charger.available, 60)
            assert line.line.sent[before].order.limits[0] == 6.0
            closing.cancel()

    simulate(scene())


def test_an_adapter_that_closes_idle_lines_hides_no_fault() -> None:
    async def scene() -> None:
        point = EvboxChargePoint(SERIAL, [Module(currents=(16.0, 16.0, 16.0))])
        async with Setups.of(point) as line:
            charger = line.add(SERIAL)
            closing = asyncio.create_task(close_when_idle(line.line, 3.0))
            await asyncio.sleep(30)
            assert Fault.LIMIT_EXCEEDED not in charger.faults
            await charger.change_orders(OrderChange(current=8.0))
            began = now()
            await until(lambda: Fault.LIMIT_EXCEEDED in charger.faults, 60)
            assert 15 <= now() - began < 25
            closing.cancel()

    simulate(scene())


@pytest.mark.parametrize("how", ["reload", "again", "unplug", "restart"])
def test_the_first_message_carries_the_orders_that_stand(how: str) -> None:
    """Below 6 A, which is sent until the maximum is known: a pause."""

    async def scene() -> None:
        paused = replace(ORDERS, allowed=False)
        async with stage(1) as line:
            charger = line.add(SERIAL, orders=paused)
            await charger.wait_available()
            await asyncio.sleep(10)
            before = len(line.line.sent)
            if how in ("reload", "restart"):
                await line.reload(forget=how == "restart", orders=paused)
            elif how == "again":
                await line.add_again(charger, orders=paused)
            else:
                line.line.unplug()
            await asyncio.sleep(10)
            later = line.line.sent[before:]
            assert later
            assert all(sent.order.limits == (0.0, 0.0, 0.0) for sent in later)

    simulate(scene())
