"""A ceiling on a slave of our master; the oracle is what the box offers."""

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
    Orders,
    PauseReason,
)
from custom_components.evse_bus.evse.smartevse.dialects import MAPS
from custom_components.evse_bus.evse.smartevse.slave import SlaveSmartEvse
from tests.evse.house import NOTE, House, Recent
from tests.simulated_time import now, simulate

from .scene import MasterScene, Sent

SAFE = 8.0
IN_FLIGHT = 0.3
"""Time from the decision to the end of its request, s."""
OBEYS = 25.0
"""Time in which a box follows, lost frames included, s."""
ALL = ("2.17", "2.20", "2.30", "3")
VOLATILE = ("2.17", "2.20", "2.30")
"""The dialects whose access bit is not in flash memory."""
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
                        *("plug_in", "leave", "finish", "request"),
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
    """The first of two slaves is governed."""

    scene: MasterScene
    house: House = field(default_factory=House)
    limit: Recent = field(default_factory=lambda: Recent(16.0))
    allowed: bool | None = True
    stopped_at: float = -1.0
    driver: bool = False
    above_since: float | None = None
    wrong: list[str] = field(default_factory=list)
    accesses: list[bool] = field(default_factory=list)
    tasks: list[asyncio.Task[None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.scene.watch = False
        on_sent, step = self.scene.line.on_sent, self.scene.step

        def sent(one: Sent) -> None:
            on_sent(one)
            self.on_sent(one)

        def stepped() -> None:
            step()
            self.watch()

        self.scene.line.on_sent = sent
        self.scene.step = stepped  # type: ignore[method-assign]

    @property
    def slave(self) -> SlaveSmartEvse:
        return self.scene.slave(2)

    @property
    def box(self):  # type: ignore[no-untyped-def] # noqa: ANN201 - the virtual one
        return self.scene.box(2)

    @property
    def outlet(self):  # type: ignore[no-untyped-def] # noqa: ANN201 - the virtual one
        return self.box.controller.outlet

    def on_sent(self, sent: Sent) -> None:
        data, dialect = sent.data, self.slave.dialect
        if data[0] != 2 or data[1] != 0x10 or dialect is None:
            return
        if int.from_bytes(data[2:4], "big") != MAPS[dialect].access_register:
            return
        opens = bool(data[8])
        self.accesses.append(opens)
        least = min(self.house.highest(IN_FLIGHT), self.limit.highest(IN_FLIGHT))
        if opens and self.allowed is False and now() > self.stopped_at + IN_FLIGHT:
            self.wrong.append("opened against the switch")
        if opens and least < MINIMUM_CURRENT and not self.driver:
            self.wrong.append(f"opened with {least} A")

    def watch(self) -> None:
        most = self.house.permits
        if self.driver:
            most = max(most, MINIMUM_CURRENT)
        most = min(most, self.limit.value)
        if self.allowed is False or most < MINIMUM_CURRENT:
            most = 0.0
        if self.box.offers <= most:
            self.above_since = None
            return
        self.above_since = self.above_since or now()
        if now() > self.above_since + OBEYS:
            self.wrong.append(f"it offers {self.box.offers} A, {most} A allowed")

    # -- What happens --------------------------------------------------------------

    def change(self, change: OrderChange) -> None:
        async def changing() -> None:
            with suppress(EvseError):
                await self.slave.change_orders(change)

        self.tasks.append(asyncio.create_task(changing()))

    async def act(self, name: str, value: float) -> None:
        match name:
            case "ceiling":
                self.house.says(value)
                self.slave.governance.set_ceiling(value)
            case "give up":
                self.house.falls_silent()
                self.slave.governance.give_up_ceiling()
            case "limit":
                self.limit.set(value)
                self.change(OrderChange(current=value))
            case "allow" | "stop":
                self.allowed, self.stopped_at = name == "allow", now()
                self.change(OrderChange(allowed=self.allowed))
            case "access on" | "access off":
                self.driver |= name == "access on"
                self.outlet.set_access(name == "access on")
            case "power failure":
                # A short one may be taken for the driver.
                self.driver = True
                self.box.controller.power_cycle()
            case _:
                getattr(self.box.car, name)()

    async def settle(self, value: float, seconds: float = 60.0) -> None:
        for _ in range(int(seconds / 10)):
            await self.act("ceiling", value)
            await asyncio.sleep(10.0)


async def charging(scene: MasterScene) -> Trial:
    trial = Trial(scene)
    await scene.until(lambda: trial.slave.configuration is not None)
    trial.house.governs(SAFE)
    await trial.slave.governance.begin(SAFE)
    await trial.act("ceiling", 12.0)
    await scene.charge(2)
    await trial.settle(12.0, 20)
    assert trial.box.offers == 12
    return trial


def scene_of(dialect: str) -> MasterScene:
    return MasterScene(limit=32.0, maximum=32, dialect=dialect)


@pytest.mark.slow
@pytest.mark.parametrize("dialect", ALL)
@settings(max_examples=6, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(acts=ACTS, last=CEILINGS, seed=st.integers(0, 99))
def test_permission_and_ceiling(
    dialect: str, acts: list[tuple[tuple[str, float], float]], last: float, seed: int
) -> None:
    async def happens() -> None:
        scene = scene_of(dialect)
        rng = Random(seed)  # noqa: S311 - repeatable on purpose
        losing = True
        async with scene:
            trial = await charging(scene)
            trial.box.loses = lambda _data: losing and rng.random() < 0.05
            for (name, value), wait in acts:
                await trial.act(name, value)
                await asyncio.sleep(wait)
            losing = False
            await asyncio.gather(*trial.tasks)
            await trial.settle(last, 90)
            assert not trial.wrong, trial.wrong
            names = {name for (name, _), _ in acts}
            if names <= {"ceiling", "limit", "give up"}:
                orders = trial.slave.orders
                expected = min(orders.limit.current, last)
                expected = 0 if expected < MINIMUM_CURRENT else expected
                assert trial.box.offers == expected

    simulate(happens())


@pytest.mark.parametrize("dialect", ALL)
def test_a_ceiling_pauses_and_resumes(dialect: str) -> None:
    async def happens() -> None:
        scene = scene_of(dialect)
        async with scene:
            trial = await charging(scene)
            trial.slave.governance.set_ceiling(0.0)
            assert trial.slave.pause_reason is PauseReason.CEILING_TOO_LOW
            await trial.settle(0.0, 20)
            assert trial.box.offers == 0
            assert NOTE in trial.slave.orders.remembered
            volatile = dialect in VOLATILE
            # Flash memory wears: its access is never written for a pause.
            assert trial.accesses == ([False] if volatile else [])
            await trial.settle(9.0, 90)
            assert trial.box.offers == 9
            assert trial.accesses == ([False, True] if volatile else [])
            assert NOTE not in trial.slave.orders.remembered
            assert trial.slave.pause_reason is None
            assert trial.slave.orders.limit.current == 16
            # Nobody renews it.
            await asyncio.sleep(66)
            assert trial.box.offers == SAFE
            assert not trial.wrong

    simulate(happens())


@pytest.mark.parametrize("dialect", ALL)
def test_access_that_was_closed_at_the_box_stays_closed(dialect: str) -> None:
    async def happens() -> None:
        scene = scene_of(dialect)
        async with scene:
            trial = await charging(scene)
            await trial.act("access off", 0.0)
            await trial.settle(12.0, 20)
            await trial.settle(0.0, 20)
            await trial.settle(12.0, 40)
            assert True not in trial.accesses
            assert not trial.outlet.access
            assert trial.slave.pause_reason is PauseReason.NOT_ALLOWED

    simulate(happens())


@pytest.mark.parametrize("dialect", VOLATILE)
def test_access_opened_at_the_box_is_the_drivers_word(dialect: str) -> None:
    async def happens() -> None:
        scene = scene_of(dialect)
        async with scene:
            trial = await charging(scene)
            await trial.settle(0.0, 20)
            await trial.act("access on", 0.0)
            await trial.settle(0.0, 90)
            assert trial.outlet.access
            assert trial.box.offers == MINIMUM_CURRENT
            assert trial.accesses == [False]
            # The fuse is stronger.
            for _ in range(3):
                trial.slave.governance.set_ceiling(0.0, guard=0.0)
                await asyncio.sleep(10)
            assert trial.box.offers == 0
            # It ends with the visit.
            await trial.settle(0.0, 20)
            trial.box.car.leave()
            await trial.settle(0.0, 60)
            assert not trial.slave.governance.driver_allows

    simulate(happens())


@pytest.mark.parametrize("dialect", ALL)
def test_a_pause_of_an_earlier_run(dialect: str) -> None:
    """It waits for the user, unless it was a pause by broadcast alone."""

    async def happens() -> None:
        scene = scene_of(dialect)
        async with scene:
            trial = await charging(scene)
            await trial.settle(0.0, 20)
            stored: Orders = trial.slave.orders
            await scene.bus.stop()
            scene.new_bus()
            for unit in scene.units:
                scene.add(unit, remembered=stored.remembered if unit == 2 else {})
            trial.house.restarts(stored.remembered)
            await scene.bus.start()
            await asyncio.sleep(30)
            assert trial.box.offers == 0
            await trial.settle(12.0, 90)
            if dialect in VOLATILE:
                assert trial.box.offers == 0
                assert trial.slave.pause_reason is PauseReason.WAITS_FOR_USER
                await trial.slave.change_orders(OrderChange(allowed=True))
                await trial.settle(12.0, 60)
            assert trial.box.offers == 12
            assert not trial.wrong

    simulate(happens())
