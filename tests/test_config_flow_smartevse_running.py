"""A SmartEVSE added in the frontend does at once what was chosen there."""

from typing import TYPE_CHECKING

from homeassistant.config_entries import ConfigEntryState
from homeassistant.const import EVENT_HOMEASSISTANT_STOP
import pytest

from tests.flow import Flow, charger, smartevse_step
from tests.virtual import Car, SmartEvse, VirtualBus

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

pytestmark = pytest.mark.usefixtures("quick_search")

FAST = {"poll_interval": 0.1}


async def added(hass: HomeAssistant, flow: Flow) -> None:
    """Submit the last step, which sets the bus up."""
    await flow.submit()
    await hass.async_block_till_done()
    assert flow.result["result"].state is ConfigEntryState.LOADED


@pytest.mark.parametrize("stops", [True, False])
async def test_polled_box_stops_with_home_assistant_if_that_was_chosen(
    hass: HomeAssistant, *, stops: bool
) -> None:
    car = Car(max_current=16, reaction=0.1)
    box = SmartEvse("2.20", unit=1, car=car, max_current=16)
    with VirtualBus.in_loop(box) as bus:
        car.plug_in()
        await bus.wait_for_async(lambda: box.contactor)
        flow = await smartevse_step(hass, "polled", bus.url)
        await flow.wait()
        await flow.submit({"chargers": "1"})
        typed = charger("Box", fail_safe_current=8, expert=FAST)
        await flow.submit(typed | {"stop_on_shutdown": stops})
        assert not box.writes
        await added(hass, flow)
        # It offered 16 A of its own: now it is what was confirmed.
        await bus.wait_for_async(lambda: 0 < box.pilot_current <= 8, timeout=10)

        hass.bus.async_fire(EVENT_HOMEASSISTANT_STOP)
        await hass.async_block_till_done()
        assert box.access is not stops
        assert await hass.config_entries.async_unload(flow.result["result"].entry_id)


async def test_slaves_hear_their_master_and_share_what_was_chosen(
    hass: HomeAssistant,
) -> None:
    cars = Car(max_current=16, reaction=0.1), Car(max_current=16, reaction=0.1)
    boxes = tuple(
        SmartEvse(load_balance=unit, car=car) for unit, car in enumerate(cars, 2)
    )
    with VirtualBus.in_loop(*boxes) as bus:
        flow = await smartevse_step(hass, "master", bus.url)
        await flow.submit({"supply_limit": 15, "supply_minimum": 6})
        await flow.wait()
        await flow.submit({"chargers": ["2", "3"], "installation_limit": 15})
        for name in ("Left", "Right"):
            assert flow.step == "charger"
            await flow.submit(charger(name, 15, fail_safe_current=13, expert=FAST))
        assert not any(box.broadcasts for box in boxes)
        await added(hass, flow)
        await bus.wait_for_async(lambda: all(box.broadcasts for box in boxes))
        for car in cars:
            car.plug_in()
        await bus.wait_for_async(
            lambda: (
                all(box.contactor for box in boxes)
                and sum(box.pilot_current for box in boxes) == 15
            ),
            timeout=20,
        )
        assert await hass.config_entries.async_unload(flow.result["result"].entry_id)
