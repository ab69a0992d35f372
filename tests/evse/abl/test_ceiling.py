"""A ceiling on an ABL wallbox; the oracle is what the box receives."""

import asyncio
from contextlib import suppress

from hypothesis import HealthCheck, example, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.abl import PROTOCOL, AblCharger
from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import OrderChange, Orders, PauseReason
from tests.evse.house import NOTE, House, Recent
from tests.simulated_time import now, simulate
from tests.virtual import AblBox, Car

from .scene import LIMIT, STATE, Scene, config, orders, until

PAUSE = 1000
SAFE = 8.0
IN_FLIGHT = 0.3
"""Time from the decision to the end of its request, or a repetition of it, s."""
CEILINGS = st.sampled_from((0.0, 5.9, 6.0, 8.0, 12.0, 16.0, 32.0))
WAITS = st.sampled_from((0.0, 0.02, 0.3, 2.0, 15.0, 61.0))
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
                        *("pause elsewhere", "power cycle", "lose", "restart"),
                        *("plug", "leave", "outlet off", "outlet on", "give up"),
                    )
                ),
                st.just(0.0),
            ),
        ),
        WAITS,
    ),
    max_size=12,
)


def amperes_of(code: int) -> float:
    return 0.0 if code == PAUSE else code * 0.06


class Trial:
    """One box, its user, its house, and what it receives."""

    def __init__(self, *, tells_icmax: bool, allowed: bool | None) -> None:
        self.car = Car(ramp=0.1, reaction=0.0)
        self.car.plug_in()
        self.box = AblBox(1, car=self.car, boot_time=0.05, tells_icmax=tells_icmax)
        self.house = House(SAFE, value=SAFE)
        self.limit = Recent(16.0)
        self.allowed = allowed
        self.stopped_at = -1.0
        self.foreign_since: float | None = None
        """Loop time since when another's pause stands at the box."""
        self.stored = orders(16, allowed=allowed)
        self.wrong: list[str] = []
        self.tasks: list[asyncio.Task[None]] = []
        self._take = self.box.outlet.write_icmax
        self.box.outlet.write_icmax = self.on_limit  # type: ignore[method-assign]
        execute = self.box.outlet.execute

        def on_state(value: int) -> bool:
            self.wrong.append(f"state {value:#x} was written")
            return execute(value)

        self.box.outlet.execute = on_state  # type: ignore[method-assign]

    def on_limit(self, code: int, at: float) -> bool:
        amperes = amperes_of(code)
        if amperes > self.house.highest(IN_FLIGHT):
            self.wrong.append(f"{amperes} A above the ceiling {self.house}")
        if amperes > self.limit.highest(IN_FLIGHT):
            self.wrong.append(f"{amperes} A above the order")
        if code != PAUSE and self.allowed is False and at > self.stopped_at + 1:
            self.wrong.append("started against the switch")
        if code != PAUSE and self.foreign_since is not None:
            if now() > self.foreign_since + 1:
                self.wrong.append("the pause of another was undone")
            self.foreign_since = None
        return self._take(code, at)

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
            case _:
                self.user(name, value)
                self.at_the_box(name)

    def user(self, name: str, value: float) -> None:
        match name:
            case "limit":
                self.limit.set(value)
                self.change(OrderChange(current=value))
            case "allow":
                self.allowed, self.foreign_since = True, None
                self.change(OrderChange(allowed=True))
            case "stop":
                self.allowed, self.stopped_at = False, now()
                self.change(OrderChange(allowed=False))

    def at_the_box(self, name: str) -> None:
        outlet = self.box.outlet
        match name:
            case "pause elsewhere":
                if outlet.icmax != PAUSE:
                    self.foreign_since = now()
                self.box.set_by_other_master(0)
            case "power cycle":
                self.foreign_since = None
                self.box.power_cycle()
            case "lose":
                self.box.faults.once("lose")
            case "plug" if not self.car.plugged:
                self.car.plug_in()
            case "leave" if self.car.plugged:
                self.car.leave()
            case "outlet off":
                self.box.stop_locally()
            case "outlet on":
                self.box.start_locally()

    async def restart(self) -> None:
        await asyncio.gather(*self.tasks)
        await self.scene.bus.stop()
        self.house.restarts(self.stored.remembered)
        self.scene.bus = PROTOCOL.bus(self.scene.virtual.url)
        await self.scene.bus.start()
        self.put()

    def put(self) -> None:
        async def commit(stored: Orders) -> None:
            self.stored = stored

        self.charger: AblCharger = self.scene.add(
            config(poll_interval=2.0), self.stored
        )
        self.charger.standing_orders.commit = commit

    async def run(
        self, acts: list[tuple[tuple[str, float], float]], last: float
    ) -> None:
        async with Scene(self.box) as scene:
            self.scene = scene
            self.put()
            await self.charger.governance.begin(SAFE)
            for (name, value), wait in acts:
                await self.act(name, value)
                await asyncio.sleep(wait)
            await asyncio.gather(*self.tasks)
            self.box.start_locally()
            for _ in range(9):
                await self.act("ceiling", last)
                await asyncio.sleep(10.0)
            self.reason = self.charger.pause_reason


@pytest.mark.parametrize("tells_icmax", [True, False])
@settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@example(
    # The ceiling falls while a limit is being applied.
    acts=[(("limit", 6.0), 0.3), (("ceiling", 0.0), 0.02), (("ceiling", 0.0), 0.02)],
    last=6.0,
    allowed=None,
)
@given(acts=ACTS, last=CEILINGS, allowed=st.sampled_from((None, True)))
def test_permission_and_ceiling(
    acts: list[tuple[tuple[str, float], float]],
    last: float,
    *,
    tells_icmax: bool,
    allowed: bool | None,
) -> None:
    trial = Trial(tells_icmax=tells_icmax, allowed=allowed)
    simulate(trial.run(acts, last))
    assert not trial.wrong, trial.wrong
    box, standing = trial.box, trial.charger.orders
    expected = min(standing.limit.current, last)
    if standing.allowed is False or expected < 6:
        assert box.ic_amps == 0
        return
    if not tells_icmax and not box.state.startswith("C"):
        # A limit may end a pause of another that cannot be read: not before C.
        return
    assert box.ic_amps <= expected
    if not tells_icmax or trial.foreign_since is not None:
        return
    if trial.reason is PauseReason.WAITS_FOR_USER:
        assert any(act == ("restart", 0.0) for act, _ in acts)
        assert box.ic_amps == 0
    else:
        assert box.ic_amps == pytest.approx(expected, abs=0.1)


async def governed(
    scene: Scene, box: AblBox, *, allowed: bool | None = True
) -> AblCharger:
    charger = await scene.settled(config(), orders(16, allowed=allowed))
    await scene.stop_polls(charger)
    await charger.governance.begin(SAFE)
    charger.governance.set_ceiling(16.0)
    await until(lambda: box.ic_amps == pytest.approx(16.0, abs=0.1))
    return charger


def plugged() -> Car:
    car = Car(ramp=0.1, reaction=0.0)
    car.plug_in()
    return car


async def test_a_ceiling_goes_down_and_up_without_a_poll() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await governed(scene, box)
        charger.governance.set_ceiling(0.0)
        await until(lambda: box.ic_amps == 0)
        assert charger.pause_reason is PauseReason.CEILING_TOO_LOW
        await until(lambda: NOTE in charger.orders.remembered)
        charger.governance.set_ceiling(10.0)
        await until(lambda: box.ic_amps == pytest.approx(10.0, abs=0.1))
        assert charger.pause_reason is None
        await until(lambda: NOTE not in charger.orders.remembered)
        assert charger.orders.limit.current == 16
        begun = now()
        # Nobody renews it, and no poll is due.
        await until(lambda: box.ic_amps == pytest.approx(SAFE, abs=0.1), 70)
        assert now() - begun < 61


async def test_the_pause_of_another_stays() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await governed(scene, box)
        box.set_by_other_master(0)
        charger.governance.set_ceiling(0.0)
        await asyncio.sleep(5)
        charger.governance.set_ceiling(16.0)
        await asyncio.sleep(15)
        assert box.ic_amps == 0
        assert charger.pause_reason is PauseReason.NOT_ALLOWED
        await charger.change_orders(OrderChange(allowed=True))
        assert box.ic_amps == pytest.approx(16.0, abs=0.1)


async def test_an_outlet_that_is_disabled_meanwhile_is_not_enabled() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await governed(scene, box)
        charger.governance.set_ceiling(0.0)
        await until(lambda: box.ic_amps == 0)
        box.stop_locally()
        charger.governance.set_ceiling(16.0)
        await asyncio.sleep(15)
        assert box.state == "E0"
        assert scene.writes(STATE) == []
        assert charger.pause_reason is PauseReason.OUTLET_DISABLED


async def test_a_pause_of_an_earlier_run_waits_for_the_user() -> None:
    trial = Trial(tells_icmax=True, allowed=True)
    async with Scene(trial.box) as scene:
        trial.scene = scene
        trial.put()
        await trial.charger.governance.begin(SAFE)
        trial.charger.governance.set_ceiling(0.0)
        await until(lambda: NOTE in trial.stored.remembered)
        await trial.restart()
        await until(lambda: trial.charger.available)
        trial.charger.governance.set_ceiling(16.0)
        await asyncio.sleep(15)
        assert trial.box.ic_amps == 0
        assert trial.charger.pause_reason is PauseReason.WAITS_FOR_USER
        # A limit is no word of the user: automations change it all day.
        with suppress(EvseError):
            await trial.charger.change_orders(OrderChange(current=10.0))
        assert trial.box.ic_amps == 0
        await trial.charger.change_orders(OrderChange(allowed=True))
        assert trial.box.ic_amps == pytest.approx(10.0, abs=0.1)
        assert scene.writes(LIMIT)[-1] == 166


async def test_a_ceiling_does_not_end_the_pause_of_an_order() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(
            config(order_lifetime=20.0), orders(16, allowed=True, fail_safe=8)
        )
        await charger.governance.begin(SAFE)
        charger.governance.set_ceiling(16.0)
        await charger.change_orders(OrderChange(current=0.0))
        assert box.ic_amps == 0
        await until(lambda: charger.orders_expired, 30)
        charger.governance.set_ceiling(0.0)
        await asyncio.sleep(2)
        charger.governance.set_ceiling(16.0)
        await asyncio.sleep(15)
        assert box.ic_amps == 0
        await charger.change_orders(OrderChange(current=10.0))
        assert box.ic_amps == pytest.approx(10.0, abs=0.1)
