"""A ceiling on a SmartEVSE that is polled; the oracle is the wire, and the box."""

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field
from random import Random

from hypothesis import HealthCheck, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import (
    MINIMUM_CURRENT,
    OrderChange,
    PauseReason,
)
from custom_components.evse_bus.evse.smartevse.dialects import Dialect
from tests.evse.house import NOTE, House, Recent
from tests.simulated_time import now, simulate

from .polled_scene import ALL, V2_17, PolledScene, as_write, play

SAFE = 8.0
IN_FLIGHT = 0.3
"""Time from the decision to the end of its request, s."""
OBEYS = 40.0
"""Time in which a box is stopped, lost replies and its quiet included, s."""
CEILINGS = st.sampled_from((0.0, 5.0, 6.0, 8.0, 12.0, 16.0, 32.0))
ACTS = st.lists(
    st.tuples(
        st.one_of(
            st.tuples(st.just("ceiling"), CEILINGS),
            st.tuples(st.just("ceiling"), CEILINGS),
            st.tuples(st.just("limit"), st.sampled_from((0.0, 6.0, 10.0, 16.0))),
            st.tuples(st.sampled_from(("allow", "stop")), st.just(0.0)),
            st.tuples(
                st.sampled_from(
                    (
                        *("plug_in", "leave", "finish", "request", "restart"),
                        *("access off", "access on", "power failure", "give up"),
                    )
                ),
                st.just(0.0),
            ),
        ),
        st.sampled_from((0.0, 0.7, 2.5, 9.0, 20.0, 61.0)),
    ),
    max_size=9,
)


@dataclass
class Trial:
    """One box, its user, its house, and what is written to it."""

    scene: PolledScene
    house: House = field(default_factory=House)
    limit: Recent = field(default_factory=lambda: Recent(16.0))
    allowed: bool | None = None
    stopped_at: float = -1.0
    closed_by_us: bool = False
    """We have turned access off that was on."""
    driver: bool = False
    """Access was opened at the box, or by a power failure."""
    excess_since: float | None = None
    wrong: list[str] = field(default_factory=list)
    tasks: list[asyncio.Task[None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        write = self.scene.line.write

        def watched(data: bytes, *, reply_may_equal: bool = False) -> float:
            self.on_wire(data)
            return write(data, reply_may_equal=reply_may_equal)

        self.scene.line.write = watched  # type: ignore[method-assign]
        self.scene.on_step.append(self.watch)
        self.keep()

    def keep(self) -> None:
        async def commit(stored: object) -> None:
            self.stored = stored

        self.stored: object = self.scene.charger.orders
        self.scene.charger.standing_orders.commit = commit  # type: ignore[assignment]

    @property
    def permitted(self) -> float:
        most = self.house.highest(IN_FLIGHT)
        if self.driver:
            most = max(most, MINIMUM_CURRENT)
        return min(most, self.limit.highest(IN_FLIGHT))

    def on_wire(self, data: bytes) -> None:
        write = as_write(now(), data)
        if write is None:
            return
        layout = self.scene.layout
        if write.register == layout.current_register:
            if write.value / 10 > max(MINIMUM_CURRENT, self.permitted):
                self.wrong.append(f"{write.value / 10} A, {self.permitted} A allowed")
            return
        assert write.register == layout.access_register
        if not write.value:
            self.closed_by_us |= self.scene.outlet.access
            return
        if self.allowed is False and now() > self.stopped_at + IN_FLIGHT:
            self.wrong.append("opened against the switch")
        if self.permitted < MINIMUM_CURRENT:
            self.wrong.append(f"opened with {self.permitted} A")
        if self.allowed is None and not self.closed_by_us:
            self.wrong.append("opened what was closed at the box")

    def watch(self) -> None:
        most = self.house.permits if not self.driver else MINIMUM_CURRENT
        least = min(most, self.limit.value)
        stopped = self.allowed is False or least < MINIMUM_CURRENT
        if not (stopped and self.scene.box.offers):
            self.excess_since = None
            return
        self.excess_since = self.excess_since or now()
        if now() > self.excess_since + OBEYS:
            self.wrong.append("it offers current although it is paused")

    # -- What happens --------------------------------------------------------------

    def change(self, change: OrderChange) -> None:
        async def changing() -> None:
            with suppress(EvseError):
                await self.scene.charger.change_orders(change)

        self.tasks.append(asyncio.create_task(changing()))

    async def act(self, name: str, value: float) -> None:
        scene = self.scene
        match name:
            case "ceiling":
                self.house.says(value)
                scene.charger.governance.set_ceiling(value)
            case "give up":
                self.house.falls_silent()
                scene.charger.governance.give_up_ceiling()
            case "restart":
                await self.restart()
            case "limit":
                self.limit.set(value)
                self.change(OrderChange(current=value))
            case "allow":
                self.allowed = True
                self.change(OrderChange(allowed=True))
            case "stop":
                self.allowed, self.stopped_at = False, now()
                self.change(OrderChange(allowed=False))
            case "access off":
                self.closed_by_us &= not scene.outlet.access
                scene.outlet.set_access(False)
            case "access on":
                self.driver = True
                scene.outlet.set_access(True)
            case "power failure":
                scene.box.controller.power_cycle()
                # A short one may be taken for the driver.
                self.driver = True
            case _:
                getattr(scene.car, name)()

    async def restart(self) -> None:
        await asyncio.gather(*self.tasks)
        scene, stored = self.scene, self.stored
        make = scene.make_charger

        def again(key: str = "box") -> object:
            charger = make(key)
            return type(charger)(charger.config, stored)  # type: ignore[arg-type]

        scene.make_charger = again  # type: ignore[method-assign, assignment]
        self.house.restarts(stored.remembered)  # type: ignore[attr-defined]
        await scene.restart()
        scene.make_charger = make  # type: ignore[method-assign]
        self.keep()

    async def settle(self, value: float, seconds: float = 60.0) -> None:
        for _ in range(int(seconds / 10)):
            await self.act("ceiling", value)
            await asyncio.sleep(10.0)


@pytest.mark.slow
@pytest.mark.parametrize("dialect", ALL)
@settings(max_examples=8, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(acts=ACTS, last=CEILINGS, seed=st.integers(0, 99))
def test_permission_and_ceiling(
    dialect: Dialect,
    acts: list[tuple[tuple[str, float], float]],
    last: float,
    seed: int,
) -> None:
    async def scene() -> None:
        scene = PolledScene(dialect, current=16.0, maximum=32, cable=32)
        trial = Trial(scene)
        rng = Random(seed)  # noqa: S311 - repeatable on purpose
        losing = True
        scene.box.loses = lambda _data: losing and rng.random() < 0.05
        async with scene:
            scene.car.plug_in()
            await scene.settled()
            trial.house.governs(SAFE)
            await scene.charger.governance.begin(SAFE)
            for (name, value), wait in acts:
                await trial.act(name, value)
                await asyncio.sleep(wait)
            losing = False
            await asyncio.gather(*trial.tasks)
            await trial.settle(last)
            assert not trial.wrong, trial.wrong
            orders, word = scene.charger.orders, scene.charger.governance
            most = max(last, MINIMUM_CURRENT) if word.driver_allows else last
            expected = min(orders.limit.current, most)
            if orders.allowed is False or expected < MINIMUM_CURRENT:
                assert scene.box.offers == 0
                return
            assert scene.box.offers <= expected
            names = {name for (name, _), _ in acts}
            if names <= {"ceiling", "limit", "give up", "finish", "request"}:
                assert scene.outlet.access, "it was not resumed"

    simulate(scene())


@pytest.mark.parametrize("dialect", ALL)
def test_a_ceiling_pauses_and_resumes(dialect: Dialect) -> None:
    async def happens(scene: PolledScene) -> None:
        trial = Trial(scene)
        await scene.charge()
        trial.house.governs(SAFE)
        await scene.charger.governance.begin(SAFE)
        await trial.settle(12.0, 20)
        assert scene.box.offers == 12
        await trial.settle(0.0, 20)
        assert scene.box.offers == 0
        assert not scene.outlet.access
        assert scene.charger.pause_reason is PauseReason.CEILING_TOO_LOW
        assert NOTE in scene.charger.orders.remembered
        accesses = len(scene.accesses())
        await trial.settle(5.9, 20)
        assert len(scene.accesses()) == accesses
        await trial.settle(8.0, 60)
        assert 0 < scene.box.offers <= 8
        assert scene.charger.pause_reason is None
        assert NOTE not in scene.charger.orders.remembered
        assert scene.charger.orders.limit.current == 16
        assert not trial.wrong

    play(PolledScene(dialect, current=16.0), happens)


@pytest.mark.parametrize("dialect", ALL)
def test_access_that_was_closed_at_the_box_stays_closed(dialect: Dialect) -> None:
    async def happens(scene: PolledScene) -> None:
        trial = Trial(scene)
        await scene.charge()
        trial.house.governs(SAFE)
        await scene.charger.governance.begin(SAFE)
        await trial.settle(16.0, 20)
        scene.outlet.set_access(False)
        await scene.polled()
        await trial.settle(0.0, 20)
        await trial.settle(16.0, 40)
        assert not scene.outlet.access
        assert scene.accesses() == []
        assert scene.charger.pause_reason is PauseReason.NOT_ALLOWED

    play(PolledScene(dialect, current=16.0), happens)


@pytest.mark.parametrize("dialect", ALL)
def test_access_opened_at_the_box_is_the_drivers_word(dialect: Dialect) -> None:
    async def happens(scene: PolledScene) -> None:
        trial = Trial(scene)
        await scene.charge()
        trial.house.governs(SAFE)
        await scene.charger.governance.begin(SAFE)
        await trial.settle(0.0, 20)
        closed = len(scene.accesses())
        await trial.act("access on", 0.0)
        await trial.settle(0.0, 60)
        assert scene.outlet.access
        assert scene.box.offers == MINIMUM_CURRENT
        assert len(scene.accesses()) == closed, "it was not closed again"
        assert scene.charger.setpoint.current == MINIMUM_CURRENT
        # The fuse is stronger.
        for _ in range(3):
            scene.charger.governance.set_ceiling(0.0, guard=0.0)
            await asyncio.sleep(10)
        assert scene.box.offers == 0
        assert not scene.outlet.access
        await trial.settle(0.0, 60)
        assert scene.box.offers == MINIMUM_CURRENT
        # It ends with the visit.
        scene.car.leave()
        await trial.settle(0.0, 40)
        assert not scene.charger.governance.driver_allows
        scene.car.plug_in()
        await trial.settle(0.0, 40)
        assert scene.box.offers == 0

    play(PolledScene(dialect, current=16.0), happens)


def test_the_switch_is_stronger_than_the_drivers_word() -> None:
    async def happens(scene: PolledScene) -> None:
        trial = Trial(scene)
        await scene.charge()
        trial.house.governs(SAFE)
        await scene.charger.governance.begin(SAFE)
        await trial.settle(0.0, 20)
        await trial.act("access on", 0.0)
        await trial.settle(0.0, 20)
        await scene.charger.change_orders(OrderChange(allowed=False))
        await trial.settle(16.0, 20)
        assert not scene.outlet.access

    play(PolledScene(V2_17, current=16.0), happens)


@pytest.mark.parametrize("dialect", ALL)
def test_a_pause_of_an_earlier_run_waits_for_the_user(dialect: Dialect) -> None:
    """With access off the box shows no car: nothing proves that it is the same."""

    async def happens(scene: PolledScene) -> None:
        trial = Trial(scene)
        await scene.charge()
        trial.house.governs(SAFE)
        await scene.charger.governance.begin(SAFE)
        await trial.settle(0.0, 20)
        await trial.restart()
        await trial.settle(16.0, 40)
        assert not scene.outlet.access
        assert scene.charger.pause_reason is PauseReason.WAITS_FOR_USER
        await scene.charger.change_orders(OrderChange(allowed=True))
        await scene.until(lambda: scene.box.offers == 16, 90)
        assert scene.charger.pause_reason is None

    play(PolledScene(dialect, current=16.0), happens)
