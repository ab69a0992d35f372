"""A ceiling on an EVBox: each frame is checked as a ChargePoint decodes it."""

import asyncio
from dataclasses import replace
from math import inf
from typing import override

from hypothesis import HealthCheck, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.errors import RefusedOrderError
from custom_components.evse_bus.evse.evbox import PROTOCOL, EvboxCharger
from custom_components.evse_bus.evse.evbox.frames import EvboxFramer
from custom_components.evse_bus.evse.model import (
    CurrentLimit,
    OrderChange,
    Orders,
    PauseReason,
)
from tests.evse.house import NOTE, House
from tests.simulated_time import simulate
from tests.virtual import EvboxChargePoint, Order

from .scene import Scene, Sent
from .test_safety import INSTALLATION, Act, Trial, acts

SAFE = 8.0
CEILINGS = st.sampled_from([0.0, 3.0, 5.9, 6.0, 7.3, 8.0, 12.0, 16.0, 32.0])
house_acts = st.one_of(
    acts,
    st.tuples(st.just("ceiling"), CEILINGS),
    st.tuples(st.just("ceiling"), CEILINGS),
    st.tuples(st.sampled_from(["silence", "give up", "restart"]), st.just(0.0)),
)


class GovernedTrial(Trial):
    """The same, under a house."""

    @override
    def __post_init__(self) -> None:
        super().__post_init__()
        self.house = House(SAFE, value=SAFE)
        self.stored = self.charger.orders
        self.keep()

    def keep(self) -> None:
        async def commit(orders: Orders) -> None:
            self.stored = orders

        self.charger.standing_orders.commit = commit

    @override
    def check(self, order: Order) -> None:
        super().check(order)
        for sent in order.limits:
            assert sent <= self.house.permits
        for sent in order.fallback:
            assert sent <= SAFE
            assert sent == 0 or any(order.limits), "it would start when we die"

    async def do_ceiling(self, value: float) -> None:
        self.house.says(value)
        self.charger.governance.set_ceiling(value)

    async def do_silence(self, _value: float) -> None:
        await asyncio.sleep(61.0)

    async def do_give_up(self, _value: float) -> None:
        self.house.falls_silent()
        self.charger.governance.give_up_ceiling()

    async def do_restart(self, _value: float) -> None:
        await asyncio.gather(*self.tasks)
        await self.scene.bus.stop()
        self.answered = 0
        line = self.scene.line
        self.scene.bus = Bus(line, EvboxFramer(), PROTOCOL.timing, "again")
        self.house.restarts(self.stored.remembered)
        config = self.charger.config
        self.charger = self.scene.add(
            config.address,
            self.stored,
            installation_limit=INSTALLATION,
            poll_interval=2.0,
        )
        self.keep()
        await self.scene.bus.start()

    @override
    async def run(self, acts: list[Act]) -> None:
        await self.charger.governance.begin(SAFE)
        await super().run(acts)

    async def settle(self, value: float) -> None:
        async with self.scene:
            for _ in range(9):
                await self.do_ceiling(value)
                await asyncio.sleep(10.0)


@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(
    maximum=st.sampled_from([6.0, 13.0, 35.0]),
    interval=st.sampled_from([0, 1, 3, 20]),
    seed=st.integers(0, 100),
    steps=st.lists(house_acts, max_size=20),
    last=CEILINGS,
)
def test_nothing_goes_above_order_charger_and_ceiling(
    maximum: float, interval: int, seed: int, steps: list[Act], last: float
) -> None:
    trial = GovernedTrial(maximum, interval, seed)
    wrong: list[AssertionError] = []

    def check(sent: Sent) -> None:
        try:
            trial.check(sent.order)
        except AssertionError as error:
            wrong.append(error)

    trial.scene.line.on_sent = check

    async def scene() -> None:
        await trial.run(steps)
        trial.answered = 0
        await trial.settle(last)

    simulate(scene())
    assert not wrong, wrong[0]
    # In the end orders and ceiling stand: it goes up again as well. (A raise that the
    # line has lost failed, and does not stand.)
    orders = trial.charger.orders
    ordered = orders.limit.effective()[1]
    expected = min(ordered, INSTALLATION, maximum, last)
    expected = expected if orders.allowed is not False and expected >= 6.0 else 0.0
    order = trial.scene.line.orders[-1]
    assert order.limits[1] == pytest.approx(expected, abs=0.1)


def play(acts: object, *, orders: Orders | None = None, interval: int = 0) -> Scene:
    stage = Scene.of(EvboxChargePoint(1923054, min_interval=interval))

    async def scene() -> None:
        async with stage:
            charger = stage.add(
                orders=orders or Orders(limit=CurrentLimit(current=16.0)),
                poll_interval=17.0,
            )
            await charger.governance.begin(SAFE)
            await asyncio.sleep(5.0)
            await acts(stage, charger)  # type: ignore[operator]

    simulate(scene())
    return stage


def test_a_lower_ceiling_is_sent_at_once_and_changes_no_order() -> None:
    async def acts(stage: Scene, charger: EvboxCharger) -> None:
        charger.governance.set_ceiling(13.0)
        await asyncio.sleep(0.5)
        assert stage.line.orders[-1].limits[0] == 13.0
        sent = len(stage.line.sent)
        charger.governance.set_ceiling(10.0)
        charger.governance.set_ceiling(9.0)
        await asyncio.sleep(0.5)
        assert [one.limits[0] for one in stage.line.orders[sent:]] == [9.0], "merged"
        charger.governance.set_ceiling(9.0)
        await asyncio.sleep(0.5)
        assert len(stage.line.sent) == sent + 1, "a renewal sends nothing"
        assert charger.orders.limit.current == 16.0

    play(acts)


def test_a_ceiling_below_the_minimum_is_a_pause_with_its_own_reason() -> None:
    async def acts(stage: Scene, charger: EvboxCharger) -> None:
        charger.governance.set_ceiling(5.9)
        assert charger.pause_reason is PauseReason.CEILING_TOO_LOW
        assert charger.setpoint.paused
        await asyncio.sleep(0.5)
        assert stage.line.orders[-1].limits == (0, 0, 0)
        assert stage.line.orders[-1].fallback == (0, 0, 0)
        assert NOTE in charger.orders.remembered
        charger.governance.set_ceiling(6.0)
        await asyncio.sleep(0.5)
        assert stage.line.orders[-1].limits == (6, 6, 6)
        assert stage.line.orders[-1].fallback == (6, 6, 6)
        assert NOTE not in charger.orders.remembered
        assert charger.pause_reason is None

    play(acts)


@pytest.mark.parametrize("safe_at_start", [0.0, SAFE])
def test_an_expired_ceiling_goes_down_by_itself(safe_at_start: float) -> None:
    async def acts(stage: Scene, charger: EvboxCharger) -> None:
        await charger.governance.begin(safe_at_start)
        # Between two polls.
        await asyncio.sleep(7.0)
        charger.governance.set_ceiling(16.0)
        await asyncio.sleep(59.9)
        assert stage.line.orders[-1].limits[0] == 16.0
        await asyncio.sleep(0.3)
        assert stage.line.orders[-1].limits[0] == safe_at_start
        # A higher safe value raises nothing while the house is silent.
        await charger.governance.begin(32.0)
        await asyncio.sleep(30.0)
        assert stage.line.orders[-1].limits[0] == safe_at_start

    play(acts)


def test_a_pause_by_the_switch_has_no_fail_safe_either() -> None:
    async def acts(stage: Scene, charger: EvboxCharger) -> None:
        charger.governance.set_ceiling(16.0)
        await charger.change_orders(OrderChange(allowed=False))
        assert stage.line.orders[-1].fallback == (0, 0, 0)

    play(acts)


def test_a_house_that_is_removed_leaves_no_more_than_the_safe_value() -> None:
    async def acts(stage: Scene, charger: EvboxCharger) -> None:
        charger.governance.set_ceiling(12.0)
        await asyncio.sleep(1.0)
        await charger.governance.release()
        await asyncio.sleep(25.0)
        assert stage.line.orders[-1].limits[0] == SAFE
        assert charger.orders == replace(
            charger.orders, limit=CurrentLimit(current=SAFE), allowed=None
        )
        assert charger.orders.remembered == {}
        await charger.change_orders(OrderChange(current=16.0))
        assert stage.line.orders[-1].limits[0] == 16.0

    play(acts)


def test_one_that_is_paused_stays_stopped_when_the_house_is_removed() -> None:
    async def acts(stage: Scene, charger: EvboxCharger) -> None:
        charger.governance.set_ceiling(0.0)
        await asyncio.sleep(1.0)
        await charger.governance.release()
        assert charger.orders.allowed is False
        await charger.change_orders(OrderChange(current=16.0))
        assert stage.line.orders[-1].limits[0] == 0.0

    play(acts)


@pytest.mark.parametrize("value", [-1.0, float("nan"), inf, True])
def test_an_unusable_ceiling_is_refused(value: float) -> None:
    async def acts(stage: Scene, charger: EvboxCharger) -> None:
        charger.governance.set_ceiling(9.0)
        with pytest.raises(RefusedOrderError):
            charger.governance.set_ceiling(value)
        assert charger.setpoint.current == 9.0
        free = stage.add(7)
        with pytest.raises(RefusedOrderError):
            free.governance.set_ceiling(16.0)

    play(acts)


@pytest.mark.parametrize("paused", [True, False])
def test_the_first_request_after_a_restart_knows_of_the_house(*, paused: bool) -> None:
    async def scene() -> None:
        trial = GovernedTrial(35.0)
        async with trial.scene:
            await trial.charger.governance.begin(SAFE)
            trial.charger.governance.set_ceiling(0.0 if paused else 16.0)
            await asyncio.sleep(5.0)
            sent = len(trial.scene.line.sent)
            await trial.do_restart(0.0)
            await asyncio.sleep(90.0)
            highest = max(one.limits[0] for one in trial.scene.line.orders[sent:])
            assert highest == (0.0 if paused else SAFE)
            assert trial.charger.orders.limit.current == 16.0
            trial.charger.governance.set_ceiling(12.0)
            await asyncio.sleep(5.0)
            assert trial.scene.line.orders[-1].limits[0] == 12.0
            await trial.scene.bus.stop()

    simulate(scene())
