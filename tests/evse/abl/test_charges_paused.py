"""A car that charges although the box is paused (rows 2 and 13 of docs/abl.md)."""

import asyncio
from typing import Any

import pytest

from custom_components.evse_bus.evse.abl import AblCharger
from custom_components.evse_bus.evse.errors import NotConfirmedError
from custom_components.evse_bus.evse.model import Fault, OrderChange, OrderState
from tests.simulated_time import now
from tests.virtual import AblBox, Car

from .scene import Scene, config, orders, until

CHARGES = Fault.CHARGES_ALTHOUGH_PAUSED
OFF = OrderChange(allowed=False)
ON = OrderChange(allowed=True)


def box_of(car: Car, **options: Any) -> AblBox:  # noqa: ANN401
    car.plug_in()
    return AblBox(1, car=car, **options)


async def charging(scene: Scene, box: AblBox, *, allowed: bool) -> AblCharger:
    charger = scene.add(config(poll_interval=2.0), orders(allowed=allowed))
    await until(lambda: charger.available and charger.info is not None)
    await until(lambda: box.state == "C2" or not allowed)
    await asyncio.sleep(5)
    return charger


async def seconds_until_fault(charger: AblCharger) -> float:
    begin = now()
    await until(lambda: CHARGES in charger.faults, 60)
    return now() - begin


@pytest.mark.parametrize(
    ("meter", "soonest", "latest"), [(True, 9.9, 14.0), (False, 29.9, 34.0)]
)
async def test_a_car_that_goes_on_is_a_fault(
    meter: bool,  # noqa: FBT001
    soonest: float,
    latest: float,
) -> None:
    car = Car(drawn_anyway=9.0)
    box = box_of(car, meter=meter)
    async with Scene(box) as scene:
        charger = await charging(scene, box, allowed=True)
        assert not charger.faults
        await charger.change_orders(OFF)
        assert soonest <= await seconds_until_fault(charger) <= latest
        # The box has taken the pause, and shows it.
        assert charger.faults == {CHARGES}
        assert charger.order_state is OrderState.NOT_TAKEN
        assert charger.reading is not None
        assert charger.reading.allowed is False
        car.drawn_anyway = 0.0
        await until(lambda: not charger.faults)
        assert charger.order_state is OrderState.CONFIRMED


async def test_a_pause_by_another_that_is_not_followed_is_one_too() -> None:
    car = Car(drawn_anyway=9.0)
    box = box_of(car)
    async with Scene(box) as scene:
        charger = await charging(scene, box, allowed=True)
        before = len(scene.writes())
        box.set_by_other_master(0)
        await seconds_until_fault(charger)
        assert charger.order_state is OrderState.PAUSED_ELSEWHERE
        assert len(scene.writes()) == before
        await charger.change_orders(ON)
        await until(lambda: not charger.faults)


async def test_a_welded_contactor_shows_in_the_current_alone() -> None:
    """The box is in B2 and opens its contactor; the current flows on."""
    car = Car()
    box = box_of(car)
    async with Scene(box) as scene:
        charger = await charging(scene, box, allowed=False)
        assert box.state == "B2"
        car.requesting = False
        car.drawn_anyway = 9.0
        await until(lambda: max(box.outlet.phase_currents) > 8, 20)
        assert box.state == "B2"
        await seconds_until_fault(charger)


async def test_a_box_that_does_not_report_its_pause() -> None:
    car = Car(drawn_anyway=9.0)
    box = box_of(car, tells_icmax=False)
    async with Scene(box) as scene:
        charger = await charging(scene, box, allowed=True)
        with pytest.raises(NotConfirmedError):
            await charger.change_orders(OFF)
        # The write was acknowledged: the car does not follow, the box does.
        await until(lambda: CHARGES in charger.faults, 60)
        assert charger.faults == {CHARGES}
        car.drawn_anyway = 0.0
        await until(lambda: not charger.faults)


async def test_a_pause_that_the_box_does_not_take() -> None:
    car = Car()
    box = box_of(car)
    async with Scene(box) as scene:
        charger = await charging(scene, box, allowed=True)
        box.outlet.ignore_limit = True
        with pytest.raises(NotConfirmedError):
            await charger.change_orders(OFF)
        assert charger.faults == {Fault.LIMIT_NOT_TAKEN}
        await until(lambda: CHARGES in charger.faults, 40)
        box.outlet.ignore_limit = False
        await until(lambda: not charger.faults, 90)


@pytest.mark.parametrize("delay", [0.0, 2.0, 7.0])
@pytest.mark.parametrize("tells", [True, False])
async def test_a_slow_box_and_a_slow_car_are_no_fault(
    delay: float,
    tells: bool,  # noqa: FBT001
) -> None:
    car = Car(reaction=6.0, ramp=2.0)
    box = box_of(car, tells_icmax=tells)
    box.outlet.icmax_delay = box.outlet.ic_delay = delay
    async with Scene(box) as scene:
        charger = await charging(scene, box, allowed=True)
        await asyncio.sleep(20)
        seen: set[Fault] = set()
        charger.subscribe(lambda: seen.update(charger.faults))
        await charger.change_orders(OFF)
        await asyncio.sleep(60)
        assert box.state == "B2"
        assert CHARGES not in seen
