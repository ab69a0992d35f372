"""Setting up, changing and taking down a bus in Home Assistant."""

from homeassistant.config_entries import ConfigEntryState
from homeassistant.core import HomeAssistant
import pytest

from tests.common import charger, get_entity, setup_bus, wait_for_state
from tests.virtual import AblBox, Car, VirtualBus


async def test_from_the_wire_to_a_state_and_back(hass: HomeAssistant) -> None:
    car = Car(max_current=16, reaction=0.0, ramp=0.1)
    box = AblBox(1, car=car)
    with VirtualBus.pty(box) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        assert entry.state is ConfigEntryState.LOADED
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "available")

        car.plug_in()
        await wait_for_state(hass, status, "charging")
        limit = await get_entity(hass, "number", entry, "charging_current")
        await hass.services.async_call(
            "number", "set_value", {"entity_id": limit, "value": 10}, blocking=True
        )
        assert box.ic_amps == pytest.approx(9.96)  # 16.6 %, rounded down
        assert hass.states.get(limit).state == "10.0"

        assert await hass.config_entries.async_unload(entry.entry_id)
        await hass.async_block_till_done()
        assert entry.state is ConfigEntryState.NOT_LOADED
