"""Events of an EWS-Box in Home Assistant: what they say, and of which port."""

from homeassistant.core import HomeAssistant
import pytest

from tests.common import get_entity, running, wait_for_state
from tests.virtual import Car, EwsBox, EwsCard


def _cars() -> tuple[Car, Car]:
    cars = (Car(), Car())
    for car in cars:
        car.plug_in()
    return cars


async def test_a_key(hass: HomeAssistant) -> None:
    box = EwsBox(manual_io=True)
    async with running(hass, box) as (entry, _):
        key = await get_entity(hass, "event", entry, "2_key_3")
        box.key_down(2, 3)
        state = await wait_for_state(hass, key, lambda _: True)
        assert state.attributes["event_type"] == "press_start"
        box.key_up(2, 3)
        state = await wait_for_state(
            hass, key, lambda new: new.attributes["event_type"] == "press_end"
        )
        assert state.attributes["duration"] == pytest.approx(0.1, abs=0.1)
        other = hass.states.get(await get_entity(hass, "event", entry, "1_key_3"))
        assert other is not None
        assert other.attributes["event_type"] is None


async def test_a_start_is_asked_for(hass: HomeAssistant) -> None:
    box = EwsBox(cars=_cars(), rfid=True)
    async with running(hass, box) as (entry, _):
        asked = await get_entity(hass, "event", entry, "1_start_request")
        waits = await get_entity(hass, "binary_sensor", entry, "1_start_requested")
        await wait_for_state(hass, waits, "off")
        box.press_key(1, 3)
        box.press_key(1, 1)
        box.present_card(EwsCard(3, 77))
        state = await wait_for_state(hass, asked, lambda _: True)
        assert state.attributes["event_type"] == "requested"
        assert state.attributes["optimised"] is True
        assert (state.attributes["group"], state.attributes["number"]) == (3, 77)


async def test_a_charge_begins_and_ends(hass: HomeAssistant) -> None:
    box = EwsBox(cars=_cars())
    async with running(hass, box, time_scale=4) as (entry, bus):
        charge = await get_entity(hass, "event", entry, "1_charge")
        allowed = await get_entity(hass, "switch", entry, "1_charging_allowed")
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "preparing")
        await hass.services.async_call(
            "switch", "turn_on", {"entity_id": allowed}, blocking=True
        )
        state = await wait_for_state(hass, charge, lambda _: True)
        assert state.attributes["event_type"] == "started"
        session = box.ports[0].session
        await bus.wait_for_async(lambda: session.wh > 3)
        box.press_key(1, 2)
        state = await wait_for_state(
            hass, charge, lambda new: new.attributes["event_type"] == "ended"
        )
        assert state.attributes["result"] == "stopped"
        assert state.attributes["energy"] == int(session.last_wh)
        assert state.attributes["duration"] == int(session.last_seconds)
