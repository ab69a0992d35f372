"""A ceiling on a port of an EWS-Box; the oracle is the wire, and the port itself."""

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field

from hypothesis import HealthCheck, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.ews.charger import EwsPort
from custom_components.evse_bus.evse.ews.port import BoxPorts
from custom_components.evse_bus.evse.model import OrderChange, Orders, PauseReason
from tests.evse.house import NOTE, House, Recent

from .scene import EwsScene, Sent, now, play

START, PAUSE = 3, 6
CHARGES = (0x40, 0x41)
SAFE = 8.0
IN_FLIGHT = 0.3
"""Time from the decision to the end of its command, s."""
OBEYS = 20.0
"""Time in which a charge is paused, lost answers included, s."""
LOWEST = 6.0
"""A box that is paused, or that waits, is sent this limit: 0 switches its limit off."""
WAITS = st.sampled_from((0.0, 0.3, 2.0, 8.0, 30.0, 61.0))
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
                    ("ask", "finish", "rc", "sl", "st", "restart", "give up")
                ),
                st.just(0.0),
            ),
        ),
        WAITS,
    ),
    max_size=10,
)


@dataclass
class Trial:
    """One port, its user, its house, and what is sent to it."""

    scene: EwsScene
    house: House = field(default_factory=House)
    limit: Recent = field(default_factory=lambda: Recent(16.0))
    allowed: bool | None = None
    may_start: bool = False
    """The user has allowed a start, or we have paused a charge."""
    stopped_at: float = -1.0
    excess_since: float | None = None
    wrong: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    tasks: list[asyncio.Task[None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stored = self.charger.orders
        self.keep()
        self.scene.line.on_sent = self.on_sent
        self.scene.line.mute = self.loses
        self.scene.watchers.append(self.watch)

    @property
    def charger(self) -> EwsPort:
        return self.scene.charger()

    def keep(self) -> None:
        async def commit(stored: Orders) -> None:
            self.stored = stored

        self.charger.standing_orders.commit = commit

    def loses(self, name: str) -> bool:
        if name not in self.lost:
            return False
        self.lost.remove(name)
        return True

    @property
    def permitted(self) -> float:
        return min(self.house.highest(IN_FLIGHT), self.limit.highest(IN_FLIGHT))

    def on_sent(self, sent: Sent) -> None:
        if sent.name not in {"st", "sl"} or sent.parameters[0] != 1:
            return
        if sent.name == "st" and sent.parameters[1] > max(LOWEST, self.permitted):
            self.wrong.append(
                f"{sent.parameters[1]} A sent, {self.permitted} A allowed"
            )
        if sent.name == "st":
            return
        if sent.parameters[1] == PAUSE:
            self.may_start = True
        elif sent.parameters[1] == START:
            if self.allowed is False and now() > self.stopped_at + IN_FLIGHT:
                self.wrong.append("started against the switch")
            if self.permitted < LOWEST:
                self.wrong.append(f"started with {self.permitted} A")
            if not self.may_start:
                self.wrong.append("started what nobody allowed")

    def watch(self) -> None:
        """Check the port: it charges no longer than it takes to pause it."""
        least = min(self.house.permits, self.limit.value)
        stopped = self.allowed is False or least < LOWEST
        if not (stopped and self.scene.status() in CHARGES):
            self.excess_since = None
            return
        self.excess_since = self.excess_since or now()
        if now() > self.excess_since + OBEYS:
            self.wrong.append("it charges although it is paused")

    # -- What happens --------------------------------------------------------------

    def change(self, change: OrderChange) -> None:
        async def changing() -> None:
            with suppress(EvseError):
                await self.charger.change_orders(change)

        self.tasks.append(asyncio.create_task(changing()))

    async def act(self, name: str, value: float) -> None:
        match name:
            case "ceiling":
                self.house.says(value)
                self.charger.governance.set_ceiling(value)
            case "give up":
                self.house.falls_silent()
                self.charger.governance.give_up_ceiling()
            case "restart":
                await self.restart()
            case "limit":
                self.limit.set(value)
                self.change(OrderChange(current=value))
            case "allow":
                self.allowed = self.may_start = True
                self.change(OrderChange(allowed=True))
            case "stop":
                self.allowed, self.stopped_at = False, now()
                self.change(OrderChange(allowed=False))
            case "ask" | "finish":
                car = self.scene.cars[0]
                (car.request if name == "ask" else car.finish)()
            case _:
                self.lost.append(name)

    async def restart(self) -> None:
        await asyncio.gather(*self.tasks)
        await self.scene.bus.remove(self.charger)
        self.scene.bus.group = BoxPorts()
        self.house.restarts(self.stored.remembered)
        charger = self.scene.make_charger(1)
        self.scene.bus.add(type(charger)(charger.config, self.stored))
        self.keep()

    async def settle(self, value: float, seconds: float = 90.0) -> None:
        for _ in range(int(seconds / 10)):
            await self.act("ceiling", value)
            await asyncio.sleep(10.0)


@pytest.mark.slow
@settings(max_examples=20, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(
    acts=ACTS,
    last=CEILINGS,
    pause_status=st.sampled_from((0x50, 0x42)),
    charging=st.booleans(),
)
def test_permission_and_ceiling(
    acts: list[tuple[tuple[str, float], float]],
    last: float,
    pause_status: int,
    *,
    charging: bool,
) -> None:
    async def happens(scene: EwsScene) -> None:
        scene.box.ports[0].pause_status = pause_status  # type: ignore[assignment]
        trial = Trial(scene)
        if charging:
            trial.allowed = trial.may_start = True
            await scene.charge()
            trial.may_start = False
        else:
            await scene.plug()
        trial.limit.set(16.0)
        trial.house.governs(SAFE)
        await trial.charger.governance.begin(SAFE)
        for (name, value), wait in acts:
            await trial.act(name, value)
            await asyncio.sleep(wait)
        await asyncio.gather(*trial.tasks)
        trial.lost.clear()
        await trial.settle(last, 50.0)
        assert not trial.wrong, trial.wrong
        assert not scene.unlocked()
        orders = trial.charger.orders
        expected = min(orders.limit.current, last)
        if orders.allowed is False or expected < LOWEST:
            assert scene.status() not in CHARGES
        elif scene.status() in CHARGES:
            assert scene.box.ports[0].limit == expected
        else:
            undisturbed = charging and {name for (name, _), _ in acts} <= {
                *("ceiling", "limit", "give up", "rc", "st")
            }
            assert not undisturbed, "it was not resumed"

    play(EwsScene(installation=25.0, ports=(1,)), happens)


def test_a_ceiling_pauses_and_resumes() -> None:
    async def happens(scene: EwsScene) -> None:
        trial = Trial(scene, allowed=True, may_start=True)
        await scene.charge()
        trial.house.governs(SAFE)
        await trial.charger.governance.begin(SAFE)
        await trial.act("ceiling", 5.0)
        await scene.until(lambda: scene.status() not in CHARGES, 5)
        await scene.until(lambda: NOTE in trial.stored.remembered, 5)
        assert trial.charger.pause_reason is PauseReason.CEILING_TOO_LOW
        await trial.act("ceiling", 10.0)
        await scene.until(lambda: scene.status() == 0x40, 5)
        await scene.until(lambda: scene.box.ports[0].limit == 10, 5)
        await scene.until(lambda: NOTE not in trial.stored.remembered, 5)
        assert trial.charger.pause_reason is None
        assert [one.parameters[1] for one in scene.line.orders()][-2:] == [PAUSE, START]
        assert not trial.wrong
        # Nobody renews it.
        await asyncio.sleep(61)
        await scene.until(lambda: scene.box.ports[0].limit == SAFE, 5)

    play(EwsScene(), happens)


def test_a_car_that_waits_for_its_start_is_not_started_by_a_ceiling() -> None:
    async def happens(scene: EwsScene) -> None:
        trial = Trial(scene)
        await scene.plug()
        trial.house.governs(SAFE)
        await trial.charger.governance.begin(SAFE)
        await trial.settle(0.0, 20)
        await trial.settle(16.0, 30)
        assert not scene.line.orders()
        # Allowed under a ceiling that is too low, it starts with the next one.
        await trial.settle(0.0, 20)
        await trial.act("allow", 0.0)
        await trial.settle(0.0, 20)
        assert not scene.line.orders()
        await trial.settle(16.0, 20)
        assert scene.status() == 0x40
        assert not trial.wrong

    play(EwsScene(), happens)


@pytest.mark.parametrize("same", [True, False])
def test_a_pause_of_an_earlier_run(*, same: bool) -> None:
    """Resumed if the counters prove that no other charge was there meanwhile."""

    async def happens(scene: EwsScene) -> None:
        trial = Trial(scene, allowed=True, may_start=True)
        scene.box.ports[0].pause_status = 0x42  # type: ignore[assignment]
        await scene.charge()
        await asyncio.sleep(60)
        trial.house.governs(SAFE)
        await trial.charger.governance.begin(SAFE)
        await trial.settle(0.0, 20)
        assert NOTE in trial.stored.remembered
        if not same:
            trial.stored.remembered[NOTE] = trial.stored.remembered[NOTE] + "1"  # type: ignore[index]
        await trial.restart()
        await trial.settle(0.0, 20)
        assert len(scene.line.orders(PAUSE)) == 1
        await trial.settle(16.0, 30)
        if same:
            assert scene.status() == 0x40
            assert trial.charger.pause_reason is None
            return
        assert scene.status() == 0x42
        assert trial.charger.pause_reason is PauseReason.WAITS_FOR_USER
        await trial.charger.change_orders(OrderChange(allowed=True))
        await scene.until(lambda: scene.status() == 0x40)
        assert trial.charger.pause_reason is None

    play(EwsScene(ports=(1,)), happens)
