"""Home Assistant stops, crashes and starts while an EWS-Box charges or is paused."""

from typing import Any

from homeassistant.const import EVENT_HOMEASSISTANT_STOP
from homeassistant.core import HomeAssistant
from homeassistant.helpers import issue_registry as ir
import pytest

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.stores.orders import ORDERS_KEY
from tests.common import (
    call,
    crash,
    get_entity,
    running,
    shut_down,
    state_of,
    stored_order,
    wait_for_state,
)
from tests.ews import (
    PAUSE,
    START,
    charge,
    limits,
    orders,
    plug_in,
    polled,
    quick_car,
)
from tests.virtual import EwsBox


async def test_a_crash_in_the_middle_of_a_charge(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    """It goes on, at what was ordered, whatever somebody has said meanwhile."""
    box = EwsBox(cars=(quick_car(),))
    port = box.ports[0]
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        await call(hass, "number.set_value", limit, value=16)
        await call(hass, "number.set_value", limit, value=9)
        switch = await charge(hass, entry, bus, box)
        await crash(hass, entry, hass_storage)

        def raised() -> None:
            port.limit = 16

        bus.call(raised)
        told = len(limits(box))
        await hass.config_entries.async_setup(entry.entry_id)
        await bus.wait_for_async(lambda: port.limit == 9)
        await wait_for_state(hass, limit, "9.0")
        await wait_for_state(hass, switch, "on")
        await polled(bus, box, 10)
        assert set(limits(box)[told:]) == {9}
        # Nobody was started, stopped or unlocked.
        assert orders(box) == [START]
        assert port.contactor
        assert port.locked


@pytest.mark.parametrize("shows", [0x50, 0x42])
async def test_a_crash_in_the_middle_of_a_pause(
    hass: HomeAssistant, hass_storage: dict[str, Any], shows: int
) -> None:
    box = EwsBox(cars=(quick_car(),))
    port = box.ports[0]
    port.pause_status = shows  # type: ignore[assignment]
    async with running(hass, box) as (entry, bus):
        switch = await charge(hass, entry, bus, box)
        await call(hass, "switch.turn_off", switch)
        await crash(hass, entry, hass_storage)
        await hass.config_entries.async_setup(entry.entry_id)
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, switch, "off")
        await polled(bus, box, 20)
        assert state_of(hass, switch) == "off"
        # Whether it is our pause nobody knows: a 6 might unlock it.
        await call(hass, "switch.turn_off", switch)
        await polled(bus, box, 10)
        assert orders(box) == [START, PAUSE]
        assert port.locked
        assert not port.history.unlockings
        assert not port.contactor
        # The user's word lets it go on.
        await call(hass, "switch.turn_on", switch)
        await wait_for_state(hass, status, "charging")
        assert orders(box) == [START, PAUSE, START]
        assert port.session.cycles == 1


async def test_another_car_comes_while_we_are_away(hass: HomeAssistant) -> None:
    car = quick_car()
    box = EwsBox(cars=(car,))
    port = box.ports[0]
    async with running(hass, box) as (entry, bus):
        switch = await charge(hass, entry, bus, box)
        await call(hass, "switch.turn_off", switch)
        await hass.config_entries.async_unload(entry.entry_id)
        car.leave()
        await bus.wait_for_async(lambda: port.status == 0x00)
        await plug_in(bus, box)
        await hass.config_entries.async_setup(entry.entry_id)
        await wait_for_state(hass, switch, "off")
        await polled(bus, box, 20)
        assert orders(box) == [START, PAUSE]
        await call(hass, "switch.turn_on", switch)
        assert orders(box) == [START, PAUSE, START]
        assert port.session.cycles == 2


async def test_a_car_that_was_started_while_we_were_away_is_paused(
    hass: HomeAssistant,
) -> None:
    """Somebody has said no, and that stands; once, and the cable stays locked."""
    car = quick_car()
    box = EwsBox(cars=(car,))
    port = box.ports[0]
    async with running(hass, box) as (entry, bus):
        switch = await get_entity(hass, "switch", entry, "1_charging_allowed")
        await call(hass, "switch.turn_off", switch)
        await hass.config_entries.async_unload(entry.entry_id)
        await plug_in(bus, box)
        bus.call(lambda: port.release_start("somebody"))
        await bus.wait_for_async(lambda: port.contactor)
        await hass.config_entries.async_setup(entry.entry_id)
        await bus.wait_for_async(lambda: not port.contactor, timeout=10)
        await wait_for_state(hass, switch, "off")
        await polled(bus, box, 20)
        assert orders(box) == [PAUSE]
        assert port.locked


async def test_what_home_assistant_says_when_it_stops(hass: HomeAssistant) -> None:
    """Nothing: the box has a fail-safe of its own, and the user was told which."""
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        fail_safe = await get_entity(hass, "sensor", entry, "fail_safe")
        await wait_for_state(hass, fail_safe, "ends")
        await charge(hass, entry, bus, box)
        writes = len(box.writes)
        hass.bus.async_fire(EVENT_HOMEASSISTANT_STOP)
        await hass.async_block_till_done()
        await bus.wait_for_async(lambda: not bus.connected)
        assert len(box.writes) == writes
        assert box.ports[0].contactor
        bus.advance(601)
        await bus.wait_for_async(lambda: box.server_timeouts)
        assert not box.ports[0].contactor


async def test_a_box_on_its_own_goes_on_when_we_fall_silent(
    hass: HomeAssistant,
) -> None:
    async with running(hass, EwsBox(mode="standalone")) as (entry, _):
        fail_safe = await get_entity(hass, "sensor", entry, "fail_safe")
        await wait_for_state(hass, fail_safe, "nothing")


async def test_orders_are_stored_for_each_port(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    box = EwsBox()
    async with running(hass, box) as (entry, bus):
        one = await get_entity(hass, "number", entry, "1_charging_current")
        two = await get_entity(hass, "number", entry, "2_charging_current")
        off = await get_entity(hass, "switch", entry, "2_charging_allowed")
        await call(hass, "number.set_value", one, value=14)
        await call(hass, "number.set_value", two, value=8)
        await call(hass, "switch.turn_off", off)
        await shut_down(hass, entry)
        stored = [stored_order(hass_storage, "ews01", port) for port in (1, 2)]
        assert [one["limit"]["current"] for one in stored] == [14, 8]
        assert [one["allowed"] for one in stored] == [None, False]
        bus.call(lambda: [setattr(port, "limit", 0) for port in box.ports])
        await hass.config_entries.async_setup(entry.entry_id)
        await bus.wait_for_async(
            lambda: (box.ports[0].limit, box.ports[1].limit) == (14, 8)
        )
        await wait_for_state(hass, off, "off")


async def test_a_port_whose_orders_are_lost_is_stopped(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    box = EwsBox()
    async with running(hass, box, fail_safe_current=7.0) as (entry, bus):
        one = await get_entity(hass, "number", entry, "1_charging_current")
        two = await get_entity(hass, "number", entry, "2_charging_current")
        await call(hass, "number.set_value", one, value=14)
        await call(hass, "number.set_value", two, value=12)
        await shut_down(hass, entry)
        del hass_storage[ORDERS_KEY]["data"][f"serial:ews_{box.serial}_2"]
        await hass.config_entries.async_setup(entry.entry_id)
        await bus.wait_for_async(lambda: box.ports[1].limit == 7)
        assert box.ports[0].limit == 14
        issues = ir.async_get(hass)
        found = issues.async_get_issue(DOMAIN, "orders_lost_ews01_2")
        assert found is not None
        assert found.translation_placeholders == {"charger": "Yard 2", "current": "7"}
        assert issues.async_get_issue(DOMAIN, "orders_lost_ews01_1") is None
        allowed = await get_entity(hass, "switch", entry, "2_charging_allowed")
        await call(hass, "number.set_value", two, value=10)
        assert issues.async_get_issue(DOMAIN, "orders_lost_ews01_2") is not None
        await call(hass, "switch.turn_on", allowed)
        assert issues.async_get_issue(DOMAIN, "orders_lost_ews01_2") is None
        assert state_of(hass, one) == "14.0"
