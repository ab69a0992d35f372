"""A confirmation comes from the register that means it; the wire is the oracle.

The virtual box shows what real ones do: a pause stands in word 3 of 0x000F, and Ic
stays at Idefault. What no source settles is drawn at random.
"""

import asyncio
from contextlib import suppress
from dataclasses import replace
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.abl import AblCharger
from custom_components.evse_bus.evse.errors import EvseError, NotAvailableError
from custom_components.evse_bus.evse.model import (
    Command,
    Fault,
    OrderChange,
    Orders,
    OrderState,
    Status,
)
from tests.simulated_time import now, simulate
from tests.virtual import AblBox, Car

from .scene import LIMIT, Scene, config, orders, until

PAUSE = 0x3E8
DEFAULT = 0x10B
ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)


def limit(current: float) -> OrderChange:
    return OrderChange(current=current)


def plugged() -> Car:
    car = Car()
    car.plug_in()
    return car


def box_of_16_a(car: Car | None = None, **options: Any) -> AblBox:  # noqa: ANN401
    box = AblBox(1, car=car, **options)
    box.outlet.default_duty = DEFAULT
    box.outlet.icmax = box.outlet.icmax_shown = DEFAULT
    return box


def paused_elsewhere(**options: Any) -> AblBox:  # noqa: ANN401
    box = box_of_16_a(plugged(), **options)
    box.set_by_other_master(0)
    return box


async def begun(scene: Scene, wanted: Orders, **options: Any) -> AblCharger:  # noqa: ANN401
    charger = scene.add(config(poll_interval=2.0, **options), wanted)
    await until(lambda: charger.available and charger.info is not None)
    await asyncio.sleep(5)
    return charger


# -- Seen on real boxes ----------------------------------------------------------------


async def test_a_box_paused_by_another_is_not_started_by_a_lower_limit() -> None:
    box = paused_elsewhere()
    async with Scene(box) as scene:
        charger = await begun(scene, orders(6))
        await asyncio.sleep(60)
        assert scene.writes() == []
        assert box.ic_amps == 0
        assert charger.order_state is OrderState.PAUSED_ELSEWHERE
        assert charger.reading is not None
        assert charger.reading.allowed is False
        assert charger.reading.offered_current == 0
        assert charger.reading.connectors[1].status is Status.SUSPENDED_EVSE


async def test_10_a_do_not_start_a_car_that_was_stopped_elsewhere() -> None:
    box = paused_elsewhere()
    async with Scene(box) as scene:
        charger = await begun(scene, orders(16, allowed=True))
        await charger.change_orders(limit(10))
        await charger.change_orders(limit(0))
        await charger.change_orders(limit(10))
        await asyncio.sleep(60)
        assert scene.writes() == []
        await charger.change_orders(ON)
        assert scene.writes() == [166]
        assert charger.order_state is OrderState.CONFIRMED


async def test_a_pause_of_ours_is_confirmed_by_word_3() -> None:
    box = box_of_16_a(plugged())
    async with Scene(box) as scene:
        charger = await begun(scene, orders(16, allowed=True))
        await until(lambda: box.state == "C2")
        before = len(scene.writes())
        await charger.change_orders(OFF)
        await asyncio.sleep(300)
        # Not once more, though Ic stays at Idefault.
        assert scene.writes()[before:] == [PAUSE]
        assert box.outlet.ic == DEFAULT
        assert charger.order_state is OrderState.CONFIRMED
        assert charger.reading is not None
        assert charger.reading.allowed is False
        assert charger.reading.offered_current == 0
        assert not charger.faults


async def test_a_pause_lost_to_a_power_cut_is_written_again() -> None:
    box = box_of_16_a(plugged())
    async with Scene(box) as scene:
        charger = await begun(scene, orders(16, allowed=False))
        await asyncio.sleep(30)
        box.power_cycle()
        await until(lambda: box.outlet.icmax == PAUSE)
        await asyncio.sleep(60)
        assert scene.writes() == [PAUSE, PAUSE]
        assert charger.order_state is OrderState.CONFIRMED


async def test_a_box_that_never_follows_gets_few_writes() -> None:
    box = box_of_16_a(plugged())
    box.outlet.ignore_limit = True
    async with Scene(box) as scene:
        charger = await begun(scene, orders(10, allowed=True))
        await asyncio.sleep(60)
        assert len(scene.writes()) <= 6
        assert Fault.LIMIT_NOT_TAKEN in charger.faults
        assert charger.order_state is OrderState.NOT_TAKEN
        before = len(scene.writes())
        await asyncio.sleep(600)
        assert len(scene.writes()) - before <= 11
        assert charger.reading is not None
        assert charger.reading.offered_current == pytest.approx(16.02)


async def test_no_code_above_the_default_of_the_box() -> None:
    box = box_of_16_a(plugged())
    async with Scene(box) as scene:
        charger = await begun(scene, orders(32, allowed=True), installation_limit=32)
        await charger.change_orders(limit(20))
        await charger.change_orders(limit(32))
        await charger.change_orders(OFF)
        await charger.change_orders(ON)
        assert all(code == PAUSE or code <= DEFAULT for code in scene.writes(LIMIT))
        assert charger.orders.limit.current == 32


async def test_a_slow_box_is_given_time() -> None:
    box = box_of_16_a(plugged())
    box.outlet.icmax_delay = box.outlet.ic_delay = 7.0
    async with Scene(box) as scene:
        charger = await begun(scene, orders(16, allowed=True))
        await asyncio.sleep(30)
        before = len(scene.writes())
        await charger.change_orders(limit(10))
        assert box.outlet.icmax_shown == 166
        assert scene.writes()[before:] == [166] * 2
        await charger.change_orders(OFF)
        assert box.outlet.icmax_shown == PAUSE
        assert not charger.faults


# -- Boxes that do not report Icmax ----------------------------------------------------


async def test_a_pause_that_cannot_be_read_back_is_shown_as_such() -> None:
    box = box_of_16_a(plugged(), tells_icmax=False)
    async with Scene(box) as scene:
        charger = await begun(scene, orders(16, allowed=True))
        await charger.change_orders(OFF)
        assert box.ic_amps == 0
        await asyncio.sleep(300)
        assert charger.order_state is OrderState.NOT_READ_BACK
        assert charger.reading is not None
        assert charger.reading.allowed is False
        # Every minute, and after each change of state.
        assert 4 <= scene.writes().count(PAUSE) <= 9
        await charger.change_orders(ON)
        await until(lambda: box.state == "C2")


async def test_a_limit_waits_for_c_where_a_pause_cannot_be_seen() -> None:
    box = paused_elsewhere(tells_icmax=False)
    async with Scene(box) as scene:
        charger = await begun(scene, orders(16))
        for current in (10, 8, 16, 6):
            await charger.change_orders(limit(current))
        await asyncio.sleep(120)
        assert scene.writes() == []
        assert charger.order_state is OrderState.NOT_READ_BACK
        assert charger.reading is not None
        assert charger.reading.allowed is None
        # The other ends its pause: the limit is written as soon as a car charges.
        box.set_by_other_master(16)
        await until(lambda: box.state == "C2")
        await until(lambda: box.ic_amps == 6)


async def test_a_later_silence_of_0x0f_is_a_miss_and_no_absence() -> None:
    box = box_of_16_a(plugged())
    async with Scene(box) as scene:
        charger = await begun(scene, orders(10, allowed=True))
        await until(lambda: box.state == "C2")
        box.tells_icmax = False
        await until(lambda: charger.box.icmax_misses == 1)
        assert charger.box.missed
        # Read again soon, with the identity first.
        begin, serials = now(), len(scene.reads(1, 0x50))
        await until(lambda: charger.box.icmax_misses == 2)
        assert now() - begin < 2
        assert len(scene.reads(1, 0x50)) > serials
        # For however long: what the box does answer is shown, and in C Ic counts.
        await asyncio.sleep(60)
        reads = len(scene.reads(1))
        await asyncio.sleep(60)
        assert len(scene.reads(1)) - reads <= 61
        assert charger.available
        assert charger.reading is not None
        assert charger.order_state is OrderState.NOT_READ_BACK
        assert charger.box.reports_icmax
        box.set_by_other_master(16)
        await until(lambda: box.ic_amps < 11, 20)
        box.tells_icmax = True
        await until(lambda: charger.order_state is OrderState.CONFIRMED)


# -- Who has paused it -----------------------------------------------------------------


@pytest.mark.parametrize("remembers", [True, False])
async def test_after_a_restart_a_limit_ends_only_a_pause_proved_ours(
    remembers: bool,  # noqa: FBT001
) -> None:
    box = box_of_16_a(plugged())
    async with Scene(box) as scene:
        charger = await begun(scene, orders(16, allowed=True))
        await charger.change_orders(limit(0))
        stored = charger.orders
        await scene.bus.remove(charger)
        if not remembers:
            stored = replace(stored, remembered={})
        again = await begun(scene, stored)
        before = len(scene.writes())
        await again.change_orders(limit(10))
        assert scene.writes()[before:] == ([166] if remembers else [])
        assert (box.ic_amps > 0) is remembers


async def test_a_pause_by_another_after_ours_is_not_ours() -> None:
    box = box_of_16_a(plugged())
    async with Scene(box) as scene:
        charger = await begun(scene, orders(16, allowed=True))
        await charger.change_orders(limit(0))
        await charger.change_orders(limit(10))
        box.set_by_other_master(0)
        await asyncio.sleep(5)
        before = len(scene.writes())
        await charger.change_orders(limit(8))
        assert scene.writes()[before:] == []


# -- E0 by itself ----------------------------------------------------------------------

A1 = 0xA1A1


async def long_pause(box: AblBox, scene: Scene, **options: Any) -> AblCharger:  # noqa: ANN401
    box.outlet.e0_after_pause = 40.0
    charger = await begun(scene, orders(10, allowed=True))
    charger._config = replace(charger.config, **options)
    await charger.change_orders(OFF)
    await asyncio.sleep(90)
    assert box.state == "E0"
    return charger


async def test_allow_enables_an_outlet_disabled_by_a_long_pause() -> None:
    box = box_of_16_a(plugged())
    async with Scene(box) as scene:
        charger = await long_pause(box, scene, enable_again=True)
        await asyncio.sleep(60)
        await charger.change_orders(limit(8))
        assert box.state == "E0"
        before = len(scene.writes())
        await charger.change_orders(ON)
        # The limit first.
        assert scene.writes()[before:] == [133, A1]
        await until(lambda: box.state == "C2")


async def test_an_e0_after_a_missed_icmax_is_not_ours() -> None:
    """It may have lost its power, and its pause, in between."""
    box = box_of_16_a(plugged())
    async with Scene(box) as scene:
        charger = await begun(scene, orders(10, allowed=True))
        charger._config = replace(charger.config, enable_again=True)
        await charger.change_orders(OFF)
        await asyncio.sleep(10)
        box.tells_icmax = False
        await until(lambda: charger.box.icmax_misses)
        box.outlet.go("E0")
        await asyncio.sleep(0.5)
        box.tells_icmax = True
        await asyncio.sleep(10)
        assert charger.order_state is OrderState.CONFIRMED
        with pytest.raises(NotAvailableError):
            await charger.change_orders(ON)
        assert box.state == "E0"


async def test_without_the_option_the_outlet_stays_disabled() -> None:
    box = box_of_16_a(plugged())
    async with Scene(box) as scene:
        charger = await long_pause(box, scene)
        with pytest.raises(NotAvailableError, match="enable it first"):
            await charger.change_orders(ON)
        assert A1 not in scene.writes()


@pytest.mark.parametrize("how", ["input", "flag", "missed", "locked"])
async def test_an_e0_that_may_have_come_otherwise_stays(how: str) -> None:
    box = box_of_16_a(plugged())
    if how == "input":
        box.outlet.enable_input = 1
    if how == "flag":
        box.outlet.e0_a1_enabled = False
    async with Scene(box) as scene:
        charger = await long_pause(box, scene, enable_again=True)
        if how == "missed":
            box.faults.once("lose")
            await asyncio.sleep(10)
        if how == "locked":
            box.outlet.e0_after_pause = None
            await charger.command(Command.SET_OUTLET, value=True)
            await charger.command(Command.SET_OUTLET, value=False)
        with pytest.raises(NotAvailableError, match="enable it first"):
            await charger.change_orders(ON)
        assert box.state == "E0"


# -- Sleep -----------------------------------------------------------------------------


@pytest.mark.parametrize("lost", [1, 2])
async def test_a_sleeping_box_is_found_again_after_a_long_absence(lost: int) -> None:
    box = box_of_16_a(plugged(), sleep_after=15.0, wake_time=0.1)
    async with Scene(box) as scene:
        charger = await begun(scene, orders(6, allowed=True))
        box.faults.dead = True
        await asyncio.sleep(900)
        assert not charger.available
        box.power_cycle()
        box.lost_asleep_each = lost
        box.stray = b"\x00\xff"
        box.faults.dead = False
        await until(lambda: charger.available, 90)
        await until(lambda: box.ic_amps == 6, 10)


# -- Any box, any sequence -------------------------------------------------------------

_boxes = st.fixed_dictionaries(
    {
        "tells_icmax": st.booleans(),
        "meter": st.booleans(),
        "sleep_after": st.sampled_from([None, 5.0, 20.0]),
        "default_duty": st.sampled_from([0x85, DEFAULT, 0x14D, 0x215]),
        "icmax_delay": st.sampled_from([0.0, 0.2, 2.0, 6.0]),
        "ic_delay": st.sampled_from([0.0, 0.2, 2.0, 6.0]),
        "above_default": st.sampled_from(["clipped", "unchanged", "stored", "refused"]),
        "low_codes_taken": st.booleans(),
        "e0_keeps_icmax": st.booleans(),
        "e0_after_pause": st.sampled_from([None, 40.0]),
        "offered_reads_zero": st.booleans(),
        "idle_floor": st.sampled_from([0, 1]),
        "icmax_byte": st.integers(0, 0xFF),
        "lost_asleep_each": st.sampled_from([1, 2]),
        "stray": st.sampled_from([b"", b"\x00", b">0\xff"]),
    }
)
_ON_BOX = ("icmax_byte", "lost_asleep_each", "stray")
_IN_INIT = ("tells_icmax", "meter", "sleep_after")
_steps = st.lists(
    st.tuples(
        st.sampled_from(
            [
                *("on", "off", "6", "10", "16", "32", "0"),
                *["foreign pause"] * 8,
                *("foreign limit", "power", "dead", "car"),
                *("e0", "enable", "nothing"),
            ]
        ),
        st.sampled_from([0.5, 5.0, 30.0]),
    ),
    min_size=1,
    max_size=8,
)


class Oracle:
    """Watches the writes of the limit as the box receives them."""

    def __init__(self, box: AblBox) -> None:
        self.box = box
        self.foreign = False
        """Another master has paused the box, and nothing else was written since."""
        self.blind = False
        """A box that does not report Icmax may have lost its power."""
        self.allow_until = -1.0
        self.changes = 0
        self.times: list[float] = []
        self.violations: list[str] = []
        """Collected: an error in the virtual box would not end the test."""
        outlet = box.outlet
        write = outlet.write_icmax

        def watched(code: int, at: float) -> bool:
            self.check(code)
            return write(code, at)

        outlet.write_icmax = watched  # type: ignore[method-assign]

    def check(self, code: int) -> None:
        box = self.box
        self.times.append(now())
        if code != PAUSE and not 100 <= code <= 970:
            self.violations.append(f"code {code}")
        if box.tells_icmax and PAUSE != code > box.outlet.default:
            self.violations.append(f"code {code} above the default")
        # By going to E0 some boxes may forget it.
        stands = self.foreign and box.outlet.icmax_shown == PAUSE
        if stands and code != PAUSE:
            seen = box.tells_icmax or (box.state[0] in "ABE" and not self.blind)
            if seen and now() >= self.allow_until:
                self.violations.append("a foreign pause ended")
        self.foreign = False

    def bounded(self) -> None:
        for begin in self.times:
            window = [one for one in self.times if begin <= one < begin + 60]
            assert len(window) <= 10 + 3 * self.changes


async def _step(  # noqa: C901
    name: str, box: AblBox, charger: AblCharger, oracle: Oracle
) -> None:
    changes = {"on": ON, "off": OFF}
    if name.isdigit() or name in changes:
        oracle.changes += 1
        if name == "on":
            oracle.allow_until = now() + 60
        if name == "off":
            oracle.allow_until = -1.0
        with suppress(EvseError):
            await charger.change_orders(changes.get(name) or limit(float(name)))
        if name == "on":
            oracle.allow_until = now() + 1
    elif name == "foreign pause":
        box.set_by_other_master(0)
        box.outlet._effects = []
        # While ours is ordered as well, no register tells the two apart.
        oracle.foreign = not charger.setpoint.paused
    elif name == "foreign limit":
        box.set_by_other_master(8)
        oracle.foreign = False
    elif name == "power":
        oracle.foreign, oracle.blind = False, True
        box.power_cycle()
    elif name == "dead":
        oracle.blind = True
        box.faults.dead = True
        await asyncio.sleep(40)
        box.faults.dead = False
    elif name == "car" and box.outlet.car is not None:
        (box.outlet.car.leave if box.outlet.car.plugged else box.outlet.car.plug_in)()
    elif name == "e0":
        box.stop_locally()
    elif name == "enable":
        with suppress(EvseError):
            await charger.command(Command.SET_OUTLET, value=True)


def _made(draw: dict[str, Any]) -> AblBox:
    box = AblBox(1, car=plugged(), **{name: draw[name] for name in _IN_INIT})
    for name, value in draw.items():
        if name in _ON_BOX:
            setattr(box, name, value)
        elif name not in _IN_INIT:
            setattr(box.outlet, name, value)
    box.outlet.icmax = box.outlet.icmax_shown = box.outlet.default
    return box


@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    phases=(Phase.explicit, Phase.reuse, Phase.generate),
    derandomize=True,
)
@given(_boxes, _steps, st.sampled_from([None, True, False]))
def test_any_box_and_any_sequence(
    draw: dict[str, Any],
    steps: list[tuple[str, float]],
    allowed: bool | None,  # noqa: FBT001
) -> None:
    async def scene_of() -> None:
        box = _made(draw)
        oracle = Oracle(box)
        async with Scene(box) as scene:
            charger = scene.add(
                config(poll_interval=2.0, installation_limit=32),
                orders(16, allowed=allowed),
            )
            await asyncio.sleep(10)
            for name, pause in steps:
                await _step(name, box, charger, oracle)
                await asyncio.sleep(pause)
                paused = charger.setpoint.paused and charger.available
                if paused and charger.order_state is OrderState.CONFIRMED:
                    assert box.tells_icmax, "confirmed without a register"
            # Left alone for long enough, a stop of the user stands.
            await asyncio.sleep(180)
            if charger.orders.allowed is False and box.state[0] in "ABCE":
                assert box.outlet.icmax == PAUSE
            oracle.bounded()
            assert oracle.violations == []

    simulate(scene_of())


@settings(
    max_examples=12,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    phases=(Phase.explicit, Phase.reuse, Phase.generate),
    derandomize=True,
)
@given(
    _boxes,
    st.sampled_from([None, 6.0, 10.0]),
    st.lists(
        st.tuples(st.sampled_from([6, 8, 10, 16, 32]), st.sampled_from([0.5, 12.0])),
        min_size=1,
        max_size=5,
    ),
    st.sampled_from([None, True]),
)
def test_no_limit_ends_a_pause_of_another(
    draw: dict[str, Any],
    before: float | None,
    limits: list[tuple[int, float]],
    allowed: bool | None,  # noqa: FBT001
) -> None:
    """Whatever limit stood before, and whichever come after."""

    async def scene_of() -> None:
        box = _made({**draw, "e0_after_pause": None})
        car = box.outlet.car
        assert car is not None
        # In C, a box that reports no Icmax would be taken for one without a pause.
        car.requesting = False
        oracle = Oracle(box)
        async with Scene(box) as scene:
            charger = scene.add(
                config(poll_interval=2.0, installation_limit=32),
                orders(16, allowed=allowed),
            )
            await asyncio.sleep(10)
            if before is not None:
                with suppress(EvseError):
                    await charger.change_orders(limit(before))
            await _step("foreign pause", box, charger, oracle)
            car.request()
            await asyncio.sleep(3)
            for current, pause in limits:
                with suppress(EvseError):
                    await charger.change_orders(limit(current))
                await asyncio.sleep(pause)
            await asyncio.sleep(30)
            assert oracle.violations == []
            assert box.outlet.icmax == PAUSE
            assert box.ic_amps == 0

    simulate(scene_of())
