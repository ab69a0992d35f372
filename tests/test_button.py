"""Buttons through Home Assistant."""

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError
import pytest

from tests.common import call, entity_id, get_entity, running, wait_for_state
from tests.virtual import AblBox, Car, EvboxChargePoint


async def test_restart(hass: HomeAssistant) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        status = await get_entity(hass, "sensor", entry, "1_status")
        button = await get_entity(hass, "button", entry, "reset")
        await call(hass, "button.press", button)
        assert box.resets == 1
        await wait_for_state(hass, status, "available")
        assert box.resets == 1


async def test_wake_the_car(hass: HomeAssistant) -> None:
    car = Car()
    box = AblBox(1, car=car)
    async with running(hass, box) as (entry, _):
        car.plug_in(request=False)
        state = await get_entity(hass, "sensor", entry, "1_raw_state")
        await wait_for_state(hass, state, "B2")
        button = await get_entity(hass, "button", entry, "wake")
        await call(hass, "button.press", button)
        values = [write.value for write in box.writes if write.register == 0x05]
        assert values == [0xE0E0, 0xA1A1]
        assert box.state != "E0"


async def test_a_box_that_cannot(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    async with running(hass, box, poll_interval=0.5) as (entry, _):
        await get_entity(hass, "sensor", entry, "maximum_current")
        assert entity_id(hass, "button", entry, "reset") is None
        assert entity_id(hass, "button", entry, "wake") is None


async def test_a_box_that_is_gone(hass: HomeAssistant) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, bus):
        button = await get_entity(hass, "button", entry, "reset")
        bus.remove(box)
        with pytest.raises(HomeAssistantError):
            await call(hass, "button.press", button)
        assert box.resets == 0
