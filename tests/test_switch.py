"""Permission and the box's own switches, through Home Assistant."""

import asyncio

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError
import pytest

from tests.common import call, get_entity, running, state_of, wait_for_state
from tests.virtual import AblBox, Car, EvboxChargePoint, orders_in


async def test_stop_and_start_an_abl_box(hass: HomeAssistant) -> None:
    car = Car(reaction=0.0, ramp=0.1)
    box = AblBox(1, car=car)
    async with running(hass, box) as (entry, _):
        car.plug_in()
        charging = await get_entity(hass, "binary_sensor", entry, "1_charging")
        await wait_for_state(hass, charging, "on")
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        await call(hass, "switch.turn_off", switch)
        assert box.ic_amps == 0
        assert box.limits_written[-1] == 0x3E8
        assert state_of(hass, switch) == "off"
        await wait_for_state(hass, charging, "off")
        # The cable is still seen: 100 % is a pause, not a disabled outlet.
        plugged = await get_entity(hass, "binary_sensor", entry, "1_plugged")
        assert state_of(hass, plugged) == "on"
        await call(hass, "switch.turn_on", switch)
        assert state_of(hass, switch) == "on"
        await wait_for_state(hass, charging, "on")


async def test_stop_and_start_an_evbox(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    async with running(hass, box, poll_interval=0.5, fail_safe_current=8.0) as (
        entry,
        bus,
    ):
        maximum = await get_entity(hass, "sensor", entry, "maximum_current")
        await wait_for_state(hass, maximum, "35.0")
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        assert state_of(hass, switch) == "on"
        await call(hass, "switch.turn_off", switch)
        assert box.limits_in_force == (0, 0, 0)
        assert state_of(hass, switch) == "off"
        await call(hass, "switch.turn_on", switch)
        assert box.limits_in_force == (8, 8, 8)
        # Whatever happens to the line, the fail-safe is always said with it.
        assert {order.fallback for order in orders_in(bus.log.bursts())} <= {
            (6, 6, 6),  # before the maximum of the connection was known
            (8, 8, 8),
        }


async def test_a_stop_outruns_a_start(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054, 1, min_interval=1)
    async with running(hass, box, poll_interval=1.0) as (entry, _):
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        await call(hass, "switch.turn_off", switch)
        results = await asyncio.gather(
            call(hass, "switch.turn_on", switch),
            call(hass, "switch.turn_off", switch),
            return_exceptions=True,
        )
        assert isinstance(results[0], HomeAssistantError)
        assert results[0].translation_key == "superseded"
        assert results[1] is None
        assert box.limits_in_force == (0, 0, 0)


async def test_the_outlet_of_an_abl_box(hass: HomeAssistant) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        outlet = await get_entity(hass, "switch", entry, "outlet_enabled")
        status = await get_entity(hass, "sensor", entry, "1_status")
        await call(hass, "switch.turn_off", outlet)
        assert box.state == "E0"
        await wait_for_state(hass, outlet, "off")
        await wait_for_state(hass, status, "out_of_service")
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        with pytest.raises(HomeAssistantError) as refused:
            await call(hass, "switch.turn_on", allowed)
        assert refused.value.translation_key == "abl_outlet_disabled"
        reason = await get_entity(hass, "sensor", entry, "pause_reason")
        assert state_of(hass, reason) == "outlet_disabled"
        assert "outlet" in str(refused.value)
        await call(hass, "switch.turn_on", outlet)
        assert box.state == "A1"
        await wait_for_state(hass, outlet, "on")


async def test_somebody_disables_the_outlet_at_the_box(hass: HomeAssistant) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, bus):
        outlet = await get_entity(hass, "switch", entry, "outlet_enabled")
        box.stop_locally()
        await wait_for_state(hass, outlet, "off")
        polls = len(bus.log.bursts())
        await bus.wait_for_async(lambda: len(bus.log.bursts()) > polls + 10)
        assert box.state == "E0"


@pytest.mark.parametrize("key", ["upstream_timeout", "enable_after_power_cycle"])
async def test_settings_of_an_abl_box(hass: HomeAssistant, key: str) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        switch = await get_entity(hass, "switch", entry, key)
        before = state_of(hass, switch)
        other, service = ("off", "turn_off") if before == "on" else ("on", "turn_on")
        await call(hass, f"switch.{service}", switch)
        await wait_for_state(hass, switch, other)
