"""The safety rules, checked on the wire.

Requests of the user, replies, losses, damage and unplugging in any order: each frame
is checked at the moment it is sent, as a ChargePoint decodes it.
"""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf, nan
from random import Random

from hypothesis import HealthCheck, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import EvseError, RefusedOrderError
from custom_components.evse_bus.evse.evbox import EvboxCharger
from custom_components.evse_bus.evse.model import CurrentLimit, OrderChange, Orders
from tests.simulated_time import simulate
from tests.virtual import Car, EvboxChargePoint, Module, Order
from tests.virtual.evbox_frames import frame

from .scene import Scene, Sent

INSTALLATION = 25.0
type Act = tuple[str, float]

amperes = st.one_of(
    st.floats(0, INSTALLATION),
    st.sampled_from([0.0, 3.0, 6.0, INSTALLATION, 5.9, -1.0, nan, inf, 10_000.0, 25.1]),
)
acts = st.one_of(
    st.tuples(
        st.sampled_from(["current", "phase", "fail-safe", "fail-safe phase"]), amperes
    ),
    st.tuples(st.sampled_from(["pause", "allow"]), st.just(0.0)),
    st.tuples(st.just("time-out"), st.sampled_from([-1, 0, 1, 9, 60, 600, 10**9])),
    st.tuples(st.just("wait"), st.sampled_from([0.05, 0.3, 1.2, 5.0, 30.0])),
    st.tuples(
        st.sampled_from(["lose", "die", "live", "unplug", "power cycle", "damage"]),
        st.just(0.0),
    ),
    st.tuples(st.just("modules"), st.sampled_from([0.0, 1.0, 3.0])),
)


@dataclass
class Trial:
    """One charger, and the orders that a user requested last."""

    maximum: float
    interval: int = 1
    seed: int = 0
    allowed: bool = True
    current: float = 16.0
    phase: float = inf
    fail_safe: float = 10.0
    fail_safe_phase: float = inf
    answered: int = 0
    tasks: list[asyncio.Task[None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        car = Car(max_current=32.0)
        car.plug_in()
        self.rng = Random(self.seed)  # noqa: S311 - repeatable on purpose
        self.point = EvboxChargePoint(
            1923054,
            [Module(car), Module()],
            max_current=self.maximum,
            min_interval=self.interval,
        )
        self.scene = Scene.of(self.point)
        self.scene.line.on_sent = lambda sent: self.check(sent.order)
        orders = Orders(
            limit=CurrentLimit(current=self.current),
            fail_safe=CurrentLimit(current=self.fail_safe),
        )
        self.charger: EvboxCharger = self.scene.add(
            orders=orders, installation_limit=INSTALLATION, poll_interval=2.0
        )

    def check(self, order: Order) -> None:
        ceiling = min(INSTALLATION, self.maximum)
        if self.answered < 2:
            ceiling = min(ceiling, 6.0)
        for index, sent in enumerate(order.limits):
            assert sent <= ceiling
            assert sent <= self.current
            assert sent <= self.phase or index != 1
            assert sent == 0 or sent >= 6.0
            assert self.allowed or sent == 0, "a pause is 0 A on all phases"
        assert all(order.limits) or not any(order.limits), "no phase pauses alone"
        for index, sent in enumerate(order.fallback):
            assert sent <= ceiling
            assert sent <= self.fail_safe
            assert sent <= self.fail_safe_phase or index != 1
        assert order.timeout >= 3

    async def request(self, change: OrderChange, **orders: float | bool) -> None:
        """Request a change without waiting for its result."""

        async def requesting() -> None:
            # From this moment on the frames are checked against it.
            for name, value in orders.items():
                setattr(self, name, value)
            with suppress(EvseError):
                await self.charger.change_orders(change)

        self.tasks.append(asyncio.create_task(requesting()))
        await asyncio.sleep(0)

    def usable(self, value: float) -> bool:
        """Return whether a value must be accepted; another one is refused."""
        return 0 <= value <= INSTALLATION

    async def act(self, name: str, value: float) -> None:
        await getattr(self, "do_" + name.replace(" ", "_").replace("-", "_"))(value)

    async def do_current(self, value: float) -> None:
        usable = self.usable(value)
        await self.request(
            OrderChange(current=value), **({"current": value} if usable else {})
        )

    async def do_phase(self, value: float) -> None:
        usable = self.usable(value)
        change = OrderChange(phases=(None, value, None))
        await self.request(change, **({"phase": value} if usable else {}))

    async def do_fail_safe(self, value: float) -> None:
        usable = self.usable(value)
        change = OrderChange(fail_safe_current=value)
        await self.request(change, **({"fail_safe": value} if usable else {}))

    async def do_fail_safe_phase(self, value: float) -> None:
        usable = self.usable(value)
        change = OrderChange(fail_safe_phases=(None, value, None))
        await self.request(change, **({"fail_safe_phase": value} if usable else {}))

    async def do_time_out(self, value: float) -> None:
        await self.request(OrderChange(fail_safe_timeout=int(value)))

    async def do_pause(self, _value: float) -> None:
        await self.request(OrderChange(allowed=False), allowed=False)

    async def do_allow(self, _value: float) -> None:
        await self.request(OrderChange(allowed=True), allowed=True)

    async def do_wait(self, value: float) -> None:
        await asyncio.sleep(value)

    async def do_lose(self, _value: float) -> None:
        self.point.faults.once("lose")

    async def do_die(self, _value: float) -> None:
        self.point.faults.dead = True

    async def do_live(self, _value: float) -> None:
        self.point.faults.dead = False

    async def do_unplug(self, _value: float) -> None:
        if self.scene.line.is_open:
            # Opened again at once, a box that was answering is still the same.
            if self.charger.misses or not self.charger.available:
                self.answered = 0
            self.scene.line.unplug()

    async def do_power_cycle(self, _value: float) -> None:
        self.point.power_cycle()

    async def do_damage(self, _value: float) -> None:
        # The shortest reply, of no modules, has 30 bytes.
        self.point.faults.once("corrupt", self.rng.randrange(1, 29))

    async def do_modules(self, value: float) -> None:
        self.point.modules[:] = [Module() for _ in range(int(value))]

    def count_answers(self, data: bytes) -> bytes:
        self.answered += 1
        return data

    async def run(self, acts: list[Act]) -> None:
        async with self.scene:
            # An upper bound: a reply that is lost on the way is counted too.
            self.scene.line.damage = self.count_answers
            for name, value in acts:
                await self.act(name, value)
            self.point.faults.dead = False
            # Commands that cannot be merged wait for one minimum interval each.
            for _ in range(60):
                await asyncio.sleep(20.0)
                if all(task.done() for task in self.tasks):
                    break
            await asyncio.sleep(45.0)
            for task in self.tasks:
                task.result()


@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(
    maximum=st.sampled_from([6.0, 13.0, 20.0, 35.0, 63.0]),
    interval=st.sampled_from([0, 1, 3, 20]),
    seed=st.integers(0, 100),
    steps=st.lists(acts, max_size=25),
)
def test_no_sequence_of_events_puts_too_much_current_on_the_wire(
    maximum: float, interval: int, seed: int, steps: list[Act]
) -> None:
    trial = Trial(maximum, interval, seed)
    wrong: list[AssertionError] = []

    def check(sent: Sent) -> None:
        try:
            trial.check(sent.order)
        except AssertionError as error:
            wrong.append(error)

    trial.scene.line.on_sent = check
    simulate(trial.run(steps))
    assert not wrong, wrong[0]
    # Also after a power failure, and after a reply that was lost, although the library
    # cannot know whether the box received its request.
    assert trial.point.counters.too_soon == 0
    # In the end the orders stand, within the limits.
    ceiling = min(INSTALLATION, maximum)
    ordered = min(trial.current, ceiling)
    expected = ordered if trial.allowed and ordered >= 6.0 else 0.0
    last = trial.scene.line.orders[-1]
    assert last.limits[0] <= expected


@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([7.0, 13.0, 20.0, 35.0]), st.floats(0.1, 12.0)),
        min_size=1,
        max_size=12,
    )
)
def test_no_request_is_above_the_maximum_of_the_last_two_replies(
    steps: list[tuple[float, float]],
) -> None:
    async def scene() -> None:
        point = EvboxChargePoint(1923054)
        reported: list[float] = []
        wrong: list[tuple[float, list[float]]] = []

        def record(data: bytes) -> bytes:
            # The word after serial number and interval (manual, "Response").
            reported.append(int(data[19:23], 16) / 10)
            return data

        def check(sent: Sent) -> None:
            highest = max(sent.order.limits + sent.order.fallback)
            allowed = min(reported[-2:]) if len(reported) > 1 else 6.0
            if highest > allowed:
                wrong.append((highest, reported[-2:]))

        stage = Scene.of(point)
        stage.line.damage, stage.line.on_sent = record, check
        async with stage:
            stage.add(
                orders=Orders(
                    limit=CurrentLimit(current=32.0),
                    fail_safe=CurrentLimit(current=32.0),
                )
            )
            for maximum, wait in steps:
                point.max_current = maximum
                await asyncio.sleep(wait)
            await asyncio.sleep(12.0)
        assert wrong == []
        assert stage.line.orders[-1].limits[0] == min(point.max_current, 32.0)

    simulate(scene())


async def run_with_damage(
    seed: int, damage_frame: Callable[[bytearray, Random], None]
) -> EvboxCharger:
    """Damage 40 % of the replies, and check each reading."""
    module = Module(
        energy_wh=5000, currents=(11.0, 12.0, 13.0), cos_phis=(0.9, 0.8, 0.7)
    )
    stage = Scene.of(EvboxChargePoint(1923054, [module, Module()]))
    rng = Random(seed)  # noqa: S311 - repeatable on purpose

    def damage(data: bytes) -> bytes:
        out = bytearray(data)
        if rng.random() < 0.4:
            damage_frame(out, rng)
        return bytes(out)

    stage.line.damage = damage
    async with stage:
        charger = stage.add(poll_interval=1.0)
        shown = 0
        for _ in range(100):
            await asyncio.sleep(1.0)
            if charger.reading is None:
                continue
            shown += 1
            one, two = charger.reading.connectors.values()
            assert one.current == (11.0, 12.0, 13.0)
            assert one.cos_phi == (0.9, 0.8, 0.7)
            assert one.voltage == (230, 230, 230)
            assert one.energy in {None, 5000}
            assert two.energy in {None, 0}
            assert charger.reading.maximum_current in {None, 35.0}
    assert shown
    assert charger.statistics.bad_frames
    return charger


def flip(out: bytearray, rng: Random) -> None:
    out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)


def swallow(out: bytearray, rng: Random) -> None:
    del out[rng.randrange(len(out))]


def truncate(out: bytearray, rng: Random) -> None:
    del out[rng.randrange(1, len(out)) :]


def burst(out: bytearray, rng: Random) -> None:
    start = rng.randrange(len(out) - 8)
    out[start : start + 8] = rng.randbytes(8)


@pytest.mark.parametrize("damage_frame", [flip, swallow, truncate, burst])
@pytest.mark.parametrize("seed", range(3))
def test_no_damaged_frame_makes_a_wrong_value(
    damage_frame: Callable[[bytearray, Random], None], seed: int
) -> None:
    simulate(run_with_damage(seed, damage_frame))


def fake(out: bytearray, rng: Random) -> None:
    """Change a digit and correct the checksums: only the value can be checked."""
    at = rng.randrange(25, len(out) - 5)
    out[at : at + 1] = b"F"
    out[:] = frame(out[1:-5].decode())


@pytest.mark.parametrize("seed", range(5))
def test_an_impossible_value_with_good_checksums_is_not_shown(seed: int) -> None:
    async def scene() -> None:
        rng = Random(seed)  # noqa: S311 - repeatable on purpose
        module = Module(energy_wh=5000, currents=(11.0, 12.0, 13.0))
        stage = Scene.of(EvboxChargePoint(1923054, [module, Module()]))

        def damage(data: bytes) -> bytes:
            out = bytearray(data)
            if rng.random() < 0.2:
                fake(out, rng)
            return bytes(out)

        stage.line.damage = damage
        async with stage:
            charger = stage.add(poll_interval=1.0)
            for _ in range(300):
                await asyncio.sleep(1.0)
                for one in (
                    charger.reading.connectors.values() if charger.reading else ()
                ):
                    assert all(amperes <= 39.5 for amperes in one.current if amperes)
                    assert all(abs(value) <= 1 for value in one.cos_phi if value)
                    assert all(volts <= 300 for volts in one.voltage if volts)
                    assert one.energy is None or one.energy <= 5500
        assert charger.statistics.implausible

    simulate(scene())


@given(
    st.sampled_from([nan, inf, -inf, -0.1, -6.0, 10_000.0, 32.1, True, "16", None]),
    st.sampled_from(["current", "fail_safe_current", "phases", "fail_safe_timeout"]),
)
def test_unusable_values_are_refused_before_anything_is_sent(
    value: object, field: str
) -> None:
    if value is None or (field == "fail_safe_timeout" and value in (10_000.0, 32.1)):
        return
    change = {field: (None, value, None) if field == "phases" else value}

    async def scene() -> None:
        async with Scene.of(EvboxChargePoint(1923054)) as stage:
            charger = stage.add()
            await asyncio.sleep(3.0)
            before = (charger.orders, len(stage.line.sent))
            try:
                await charger.change_orders(OrderChange(**change))  # type: ignore[arg-type]
            except RefusedOrderError:
                pass
            else:
                raise AssertionError("it was accepted")
            assert (charger.orders, len(stage.line.sent)) == before

    simulate(scene())
