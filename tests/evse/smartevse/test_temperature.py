"""Until its first measurement a box reports 0 degrees Celsius: that is not shown."""

import asyncio

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.smartevse.dialects import Dialect

from .polled_scene import LATER, PolledScene, play

each = pytest.mark.parametrize("dialect", LATER)


@each
@given(
    after=st.floats(0.0, 9.0),
    plugged=st.booleans(),
    fixed=st.booleans(),
    deaf=st.booleans(),
)
@settings(max_examples=25)
def test_0_degrees_after_power_up_are_not_shown(
    dialect: Dialect, after: float, *, plugged: bool, fixed: bool, deaf: bool
) -> None:
    """As recorded (`power_cycle`), whenever it is read, also with its cable measured."""

    async def acts(scene: PolledScene) -> None:
        if plugged:
            scene.car.plug_in()
        await scene.polled(2)
        assert scene.reading.temperature == 20
        shown: list[float | None] = []
        scene.charger.subscribe(lambda: shown.append(scene.reading.temperature))
        await asyncio.sleep(after)
        scene.box.controller.power_cycle()
        scene.box.deaf = deaf
        await asyncio.sleep(0.4)
        scene.box.deaf = False
        await scene.polled(3)
        assert set(shown) <= {20.0, None}
        assert scene.reading.temperature == 20

    settings_of_box = {"config": 1} if fixed else {}
    play(PolledScene(dialect, settings=settings_of_box), acts)


@each
def test_0_degrees_are_shown_once_it_has_measured(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        for degrees in (9, 4, 0, -2):
            scene.outlet.temperature = degrees
            await scene.polled(2)
            assert scene.reading.temperature == degrees

    play(PolledScene(dialect), acts)
