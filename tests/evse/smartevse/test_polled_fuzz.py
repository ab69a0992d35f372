"""Property: any orders, cars, use of the box and losses; the wire is the oracle.

No set-point is above the orders and limits or below the minimum, 0 is never written,
access that was turned off at the box is never turned on, and in the end the order stands.
"""

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field
from random import Random

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import MINIMUM_CURRENT, OrderChange
from custom_components.evse_bus.evse.smartevse.dialects import MAPS, Dialect
from tests.simulated_time import now, simulate

from .polled_scene import ALL, LATER, PolledScene, as_write

INSTALLATION = 20.0

ACTS = st.one_of(
    st.booleans().map(lambda allowed: ("order", OrderChange(allowed=allowed))),
    st.sampled_from((0.0, 6.0, 7.7, 10.0, 13.0, 16.0, 20.0)).map(
        lambda amperes: ("order", OrderChange(current=amperes))
    ),
    st.sampled_from(
        (
            ("plug_in", None),
            ("leave", None),
            ("finish", None),
            ("request", None),
            ("access off", None),
            ("access on", None),
            ("power failure", None),
            ("override removed", None),
            ("another cable", 13),
            ("another cable", 32),
            ("error", 2),
            ("error", 1),
        )
    ),
)
STEPS = st.lists(
    st.tuples(st.sampled_from((0.0, 0.1, 0.7, 2.5, 9.0)), ACTS),
    min_size=1,
    max_size=10,
)


@dataclass
class Oracle:
    """The orders given, and frames on the wire that contradict them."""

    scene: PolledScene
    limit: float = 10.0
    allowed: bool | None = None
    ours: bool = False
    """A limit of 0 A may have turned access off."""
    broken: list[str] = field(default_factory=list)

    def order(self, change: OrderChange) -> None:
        if change.allowed is not None:
            self.allowed = change.allowed
        if change.current is not None:
            self.ours = self.ours or change.current == 0 or self.limit == 0
            self.limit = change.current

    def on_wire(self, data: bytes) -> None:
        write = as_write(now(), data)
        if write is None:
            return
        layout = MAPS[self.scene.dialect]
        if write.register == layout.access_register:
            if write.value and self.allowed is False:
                self.broken.append("access turned on against a pause by the user")
            if write.value and self.limit < MINIMUM_CURRENT:
                self.broken.append("access turned on against a limit of 0 A")
            if write.value and self.allowed is None and not self.ours:
                self.broken.append("access turned on that was turned off at the box")
        elif write.register == layout.current_register:
            self._on_current(write.value / 10)
        else:
            self.broken.append(f"{write.register:#x} written")

    def _on_current(self, amperes: float) -> None:
        charger = self.scene.charger
        if amperes < MINIMUM_CURRENT:
            self.broken.append(f"{amperes} A written")
        # 6 A is written ahead of a car whatever the limit.
        ceiling = max(MINIMUM_CURRENT, min(self.limit, charger.limits.ceiling))
        if amperes > INSTALLATION:
            self.broken.append(f"{amperes} A in an installation for {INSTALLATION} A")
        if amperes > ceiling:
            self.broken.append(f"{amperes} A above {ceiling} A")
        outlet = self.scene.outlet
        cable = outlet.cable_measured or MINIMUM_CURRENT
        if self.scene.box.state == "C" and amperes > max(cable, MINIMUM_CURRENT):
            self.broken.append(f"{amperes} A on a cable for {cable} A")


async def act(scene: PolledScene, oracle: Oracle, what: str, value: object) -> None:
    if isinstance(value, OrderChange):
        oracle.order(value)
        with suppress(EvseError):
            await scene.charger.change_orders(value)
    elif hasattr(scene.car, what):
        getattr(scene.car, what)()
    else:
        at_the_box(scene, what, value)


def at_the_box(scene: PolledScene, what: str, value: object) -> None:
    outlet = scene.outlet
    match what:
        case "access off":
            outlet.set_access(False)
        case "access on":
            outlet.set_access(True)
        case "power failure":
            scene.box.controller.power_cycle()
        case "override removed":
            outlet.override = 0
        case "another cable" if not scene.car.plugged:
            assert isinstance(value, int)
            outlet.cable = value
        case "error":
            assert isinstance(value, int)
            outlet.set_error(value)


async def play(
    dialect: Dialect, steps: list[tuple[float, tuple[str, object]]], seed: int
) -> Oracle:
    scene = PolledScene(
        dialect,
        current=10.0,
        installation=INSTALLATION,
        maximum=32,
        cable=32,
        measures=seed % 2 == 1,
    )
    oracle = Oracle(scene)
    rng = Random(seed)  # noqa: S311 - repeatable on purpose
    losing = True
    scene.box.loses = lambda _data: losing and rng.random() < 0.1
    scene.box.misses = lambda _data: losing and rng.random() < 0.1
    write = scene.line.write

    def watched(data: bytes, *, reply_may_equal: bool = False) -> float:
        oracle.on_wire(data)
        return write(data, reply_may_equal=reply_may_equal)

    scene.line.write = watched  # type: ignore[method-assign]
    orders: list[asyncio.Task[None]] = []
    async with scene:
        for pause, (what, value) in steps:
            await asyncio.sleep(pause)
            orders.append(asyncio.create_task(act(scene, oracle, what, value)))
            await asyncio.sleep(0)
        losing = False
        await asyncio.gather(*orders)
        # Long enough for an unavailable box to be found again.
        await asyncio.sleep(45 if dialect not in LATER else 60)
        assert scene.charger.available
        standing = scene.charger.setpoint
        if standing.paused:
            assert not scene.outlet.access, "access is open"
            assert scene.box.offers == 0
        else:
            highest = max(standing.current, MINIMUM_CURRENT)
            if scene.box.offers > highest:
                # A charge begins with the box's own maximum, until its next cycle.
                await asyncio.sleep(110 if scene.outlet.measures else 15)
            assert scene.box.offers <= highest
        assert scene.charger.orders.limit.current <= oracle.limit
        if oracle.allowed is False:
            assert scene.charger.orders.allowed is False
    return oracle


@pytest.mark.parametrize("dialect", ALL)
@given(steps=STEPS, seed=st.integers(0, 99))
@settings(max_examples=15, deadline=None)
def test_the_last_order_stands(
    dialect: Dialect, steps: list[tuple[float, tuple[str, object]]], seed: int
) -> None:
    oracle = simulate(play(dialect, steps, seed))
    assert oracle.broken == []
