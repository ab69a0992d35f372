"""Property: whatever happens on the bus, the boxes together keep to the circuit limit.

Requests, lost broadcasts and answers, orders, boxes that fall silent but still receive,
a lost port, a restart: the oracle is the sum of offers with closed contactors.
"""

import asyncio
from contextlib import suppress
from random import Random

from hypothesis import HealthCheck, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import Circuit, OrderChange
from tests.evse.smartevse.scene import Box, MasterScene
from tests.simulated_time import simulate

UNITS = (2, 3, 4)

type Act = tuple[str, int, float]

acts = st.lists(
    st.tuples(
        st.sampled_from(
            (
                "come",
                "come",
                *("leave", "rest", "ask", "deaf", "mute", "lossy", "reset", "press"),
                *("unplug", "again", "reload", "remove", "well", "well"),
                *("off", "on", "none", "less", "more"),
            )
        ),
        st.sampled_from(UNITS),
        st.sampled_from((0.0, 0.05, 0.3, 1.0, 2.5, 7.0, 13.0)),
    ),
    max_size=14,
)


CHANGES = {
    "off": OrderChange(allowed=False),
    "on": OrderChange(allowed=True),
    "none": OrderChange(current=0.0),
    "less": OrderChange(current=9.3),
    "more": OrderChange(current=16.0),
}


async def act_on_box(box: Box, what: str, dice: Random) -> None:
    match what:
        case "come":
            box.car.plug_in()
        case "leave":
            box.car.leave()
        case "rest":
            box.car.finish()
        case "ask":
            box.car.request()
        case "deaf":
            box.deaf = True
        case "mute":
            box.mute = True
        case "lossy":
            box.misses = box.loses = lambda _data: dice.random() < 0.4
        case "reset":
            box.controller.power_cycle()
        case "press":
            box.controller.outlet.set_access(not box.controller.outlet.access)


async def act_on_bus(scene: MasterScene, what: str, unit: int) -> None:
    slave = scene.bus.chargers.get(str(unit))
    if what == "unplug":
        scene.line.unplug()
    elif what in ("again", "reload"):
        # Home Assistant is restarted without a shutdown, or only the config entry.
        await scene.bus.stop()
        scene.new_bus(reload=what == "reload")
        for one in UNITS:
            scene.add(one)
        await scene.bus.start()
    elif what == "remove" and slave is not None:
        await scene.bus.remove(slave)
    elif what == "well":
        box = scene.box(unit)
        box.deaf = box.mute = False
        box.misses = box.loses = lambda _data: False
        if slave is None:
            scene.add(unit)
    elif what in CHANGES and slave is not None:
        with suppress(EvseError, TimeoutError):
            async with asyncio.timeout(3):
                await slave.change_orders(CHANGES[what])


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    story=acts,
    limit=st.sampled_from((18.0, 20.0, 32.0)),
    minimum=st.sampled_from((6.0, 8.0)),
    seed=st.integers(0, 1000),
)
def test_never_more_than_the_circuit_limit(
    story: list[Act], limit: float, minimum: float, seed: int
) -> None:
    """18 A are 6 A for each of three, whether it can be stopped or not."""

    async def scene() -> None:
        dice = Random(seed)  # noqa: S311 - the same each time
        scene = MasterScene(units=UNITS, limit=limit, minimum=minimum, maximum=32)
        async with scene:
            for what, unit, pause in story:
                await act_on_box(scene.box(unit), what, dice)
                await act_on_bus(scene, what, unit)
                await asyncio.sleep(pause)
            # All is well again, and stays so.
            for unit in UNITS:
                await act_on_bus(scene, "well", unit)
            await asyncio.sleep(10)

    simulate(scene())


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(
    first=st.sampled_from((20.0, 32.0)),
    then=st.sampled_from((18.0, 12.0, 6.0, 0.0)),
    at=st.floats(0.0, 2.0),
)
def test_a_lower_circuit_limit_counts_at_once(
    first: float, then: float, at: float
) -> None:
    async def scene() -> None:
        scene = MasterScene(limit=first, maximum=32, watch=False)
        async with scene:
            await asyncio.sleep(4)
            await scene.charge(2, 3)
            await asyncio.sleep(6 + at)
            await scene.master.change_circuit(Circuit(limit=then))
            # One broadcast, and a stop for each box for which there is no current.
            await asyncio.sleep(1.0)
            assert scene.offers <= then
            scene.overshoot = 0.0
            await asyncio.sleep(90)
            assert scene.overshoot == 0.0

    simulate(scene())
