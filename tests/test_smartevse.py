"""A polled SmartEVSE in Home Assistant: limits, access, mode, what it keeps."""

from dataclasses import replace

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError, ServiceValidationError
from homeassistant.helpers import device_registry as dr, entity_registry as er
import pytest

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.evse.model import Setting
from tests.common import (
    call,
    entity_id,
    get_entity,
    running,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.smartevse import car, shorten_quiet
from tests.test_coordinator import issue
from tests.virtual import SmartEvse


@pytest.mark.parametrize(
    ("dialect", "firmware", "settings"),
    [
        ("2.17", "2.17", 3),
        ("2.20", "2.20", len(Setting)),
        ("2.30", "2.30", len(Setting)),
        ("2.30+", "2.30, development version", len(Setting)),
    ],
)
@pytest.mark.usefixtures("all_entities_enabled")
async def test_what_a_dialect_has(
    hass: HomeAssistant, dialect: str, firmware: str, settings: int
) -> None:
    box = SmartEvse(dialect)
    async with running(hass, box) as (entry, _):
        await get_entity(hass, "number", entry, "setting_minimum_current")
        device = dr.async_get(hass).async_get_device_by_identifier(
            (DOMAIN, f"smartevse{box.unit}"), "bus"
        )
        assert device.model == "SmartEVSE v2"
        assert device.sw_version == firmware
        keys = {
            one.unique_id.removeprefix(f"smartevse{box.unit}_")
            for one in er.async_entries_for_config_entry(er.async_get(hass), "bus")
        }
        assert sum(key.startswith("setting_") for key in keys) == settings
        assert ("temperature" in keys) == dialect.startswith("2.30")
        assert not {"shared_supply", "second_master"} & {
            key.removeprefix("bus_") for key in keys
        }
        fail_safe = await get_entity(hass, "sensor", entry, "fail_safe")
        assert state_of(hass, fail_safe) == "forgets"


async def test_a_limit_is_what_the_car_is_offered(hass: HomeAssistant) -> None:
    box = SmartEvse(car=car(), max_current=13)
    async with running(hass, box, time_scale=4) as (entry, bus):
        box.car.plug_in()
        charging = await get_entity(hass, "binary_sensor", entry, "1_charging")
        offered = await get_entity(hass, "sensor", entry, "offered_current")
        limit = await get_entity(hass, "number", entry, "charging_current")
        await wait_for_state(hass, charging, "on")
        # It began with its own 13 A; the order is what was confirmed at first.
        await wait_for_state(hass, offered, "6.0")
        assert state_of(hass, limit) == "6.0"
        # What may be asked is the user's; what is offered is the box's own maximum.
        assert hass.states.get(limit).attributes["max"] == 16.0
        await call(hass, "number.set_value", limit, value=16)
        await bus.wait_for_async(lambda: box.pilot_current == 13)
        assert state_of(hass, limit) == "16.0"
        await wait_for_state(hass, offered, "13.0")
        await call(hass, "number.set_value", limit, value=10.5)
        await bus.wait_for_async(lambda: box.pilot_current == 10.5)
        assert state_of(hass, offered) == "10.5"


async def test_access_off_hides_whether_a_car_is_there(hass: HomeAssistant) -> None:
    box = SmartEvse(car=car())
    async with running(hass, box, time_scale=4) as (entry, _):
        box.car.plug_in()
        plugged = await get_entity(hass, "binary_sensor", entry, "1_plugged")
        status = await get_entity(hass, "sensor", entry, "1_status")
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        await wait_for_state(hass, status, "charging")
        assert state_of(hass, plugged) == "on"

        await call(hass, "switch.turn_off", allowed)
        assert not box.access
        assert not box.contactor
        assert state_of(hass, allowed) == "off"
        assert state_of(hass, plugged) == "unknown"
        assert state_of(hass, status) == "out_of_service"

        await call(hass, "switch.turn_on", allowed)
        assert box.access
        assert state_of(hass, allowed) == "on"
        await wait_for_state(hass, status, "charging")
        await wait_for_state(hass, plugged, "on")


async def test_somebody_turns_access_off_at_the_box(hass: HomeAssistant) -> None:
    """The switch says what the box says, and nothing turns it on again."""
    box = SmartEvse(settings={"switch": 1})
    async with running(hass, box) as (entry, bus):
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "switch.turn_on", allowed)
        box.press_access()
        await wait_for_state(hass, allowed, "off")
        await call(hass, "number.set_value", limit, value=9)
        polls = box.requests
        await bus.wait_for_async(lambda: box.requests > polls + 10)
        assert not box.access


async def test_a_limit_of_nothing_leaves_it_allowed(hass: HomeAssistant) -> None:
    """A box has no other stop than its access: what a limit took, a limit gives."""
    box = SmartEvse(car=car())
    async with running(hass, box, fail_safe_current=0.0) as (entry, bus):
        box.car.plug_in()
        await bus.wait_for_async(lambda: box.writes and not box.access)
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        limit = await get_entity(hass, "number", entry, "charging_current")
        status = await get_entity(hass, "sensor", entry, "1_status")
        # It says that it may not charge.
        await wait_for_state(hass, status, "out_of_service")
        polls = box.requests
        await bus.wait_for_async(lambda: box.requests > polls + 2)
        await wait_for_state(hass, allowed, "on")
        assert state_of(hass, limit) == "0.0"
        await call(hass, "number.set_value", limit, value=8)
        assert box.access
        assert state_of(hass, allowed) == "on"

        # What the user has switched off no limit switches on.
        await call(hass, "switch.turn_off", allowed)
        await call(hass, "number.set_value", limit, value=10)
        assert not box.access
        assert state_of(hass, allowed) == "off"


async def test_to_wait_for_current_is_no_problem(hass: HomeAssistant) -> None:
    box = SmartEvse(car=car(), mode=1)
    box.outlet.meter_leaves = 0.0
    async with running(hass, box, time_scale=10) as (entry, _):
        fault = await get_entity(hass, "sensor", entry, "fault")
        problem = await get_entity(hass, "binary_sensor", entry, "problem")
        await wait_for_state(hass, fault, "none")
        box.car.plug_in()
        await wait_for_state(hass, fault, "less_6a")
        assert state_of(hass, problem) == "off"
        assert hass.states.get(fault).attributes["codes"] == ["0x01"]

        # What is a problem comes first.
        box.outlet.meter_works = False
        await wait_for_state(hass, fault, "no_comm")
        assert state_of(hass, problem) == "on"
        faults = hass.states.get(fault).attributes["faults"]
        assert faults == ["no_comm", "less_6a"]


# -- Mode ------------------------------------------------------------------------


@pytest.mark.parametrize("dialect", ["2.17", "2.20"])
async def test_the_mode_until_a_restart(hass: HomeAssistant, dialect: str) -> None:
    box = SmartEvse(dialect, load_balance=1, mode=1)
    async with running(hass, box) as (entry, _):
        mode = await get_entity(hass, "select", entry, "mode")
        await wait_for_state(hass, mode, "smart")
        await call(hass, "select.select_option", mode, option="solar")
        assert box.outlet.settings["mode"] == 2
        assert state_of(hass, mode) == "solar"
        assert not box.eeprom_writes
        with pytest.raises(ServiceValidationError):
            await call(hass, "select.select_option", mode, option="lunar")


async def test_a_mode_that_cannot_be_changed_says_why(hass: HomeAssistant) -> None:
    """Such a box does not even answer; the error says what to set in its menu."""
    async with running(hass, SmartEvse(mode=1)) as (entry, _):
        mode = await get_entity(hass, "select", entry, "mode")
        with pytest.raises(HomeAssistantError) as refused:
            await call(hass, "select.select_option", mode, option="solar")
        assert refused.value.translation_key == "smartevse_mode_load_balancing"
        assert "Master in its menu" in str(refused.value)
        assert state_of(hass, mode) == "smart"


# -- What it keeps in its memory -------------------------------------------------


async def test_settings_are_disabled_at_first(hass: HomeAssistant) -> None:
    async with running(hass, SmartEvse("2.30+")):

        def settings() -> list[er.RegistryEntry]:
            known = er.async_get(hass)
            return [
                one
                for one in er.async_entries_for_config_entry(known, "bus")
                if "_setting_" in one.unique_id
            ]

        await wait_until(hass, settings)
        assert len(settings()) == len(Setting)
        assert all(one.disabled_by for one in settings())


@pytest.mark.usefixtures("all_entities_enabled")
async def test_a_setting_is_written_once(hass: HomeAssistant) -> None:
    box = SmartEvse("2.20", max_current=13)
    async with running(hass, box) as (entry, bus):
        highest = await get_entity(hass, "number", entry, "setting_maximum_current")
        limit = await get_entity(hass, "number", entry, "charging_current")
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        assert state_of(hass, highest) == "13"
        # No more than the wiring carries.
        assert hass.states.get(highest).attributes["max"] == 16
        await call(hass, "switch.turn_off", allowed)
        await call(hass, "number.set_value", highest, value=15.9)
        assert box.outlet.settings["max_current"] == 15
        assert state_of(hass, highest) == "15"
        # Such a write opens access: it is closed again.
        assert not box.access
        assert hass.states.get(limit).attributes["max"] == 16
        for absurd in (float("nan"), 17):
            with pytest.raises(ServiceValidationError):
                await call(hass, "number.set_value", highest, value=absurd)
        polls = box.requests
        await bus.wait_for_async(lambda: box.requests > polls + 3)
        assert sum(box.eeprom_writes.values()) == 1


@pytest.mark.usefixtures("all_entities_enabled")
async def test_minimum_and_maximum_do_not_cross(hass: HomeAssistant) -> None:
    box = SmartEvse(max_current=10, settings={"min_current": 8})
    async with running(hass, box) as (entry, _):
        lowest = await get_entity(hass, "number", entry, "setting_minimum_current")
        highest = await get_entity(hass, "number", entry, "setting_maximum_current")
        for entity, wrong in ((lowest, 11), (highest, 7)):
            with pytest.raises(ServiceValidationError):
                await call(hass, "number.set_value", entity, value=wrong)
        assert not box.eeprom_writes
        await call(hass, "number.set_value", lowest, value=10)
        assert state_of(hass, lowest) == "10"


@pytest.mark.usefixtures("all_entities_enabled")
async def test_minimum_above_the_maximum_can_be_put_right(hass: HomeAssistant) -> None:
    """Somebody has set that at the box: no car can charge, and the reason is shown."""
    box = SmartEvse(max_current=10, settings={"min_current": 14})
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        lowest = await get_entity(hass, "number", entry, "setting_minimum_current")
        reason = await get_entity(hass, "sensor", entry, "pause_reason")
        await call(hass, "number.set_value", limit, value=10)
        assert not box.access
        await wait_for_state(hass, reason, "maximum_too_low")
        await call(hass, "number.set_value", lowest, value=6)
        await wait_for_state(hass, reason, "none")
        await bus.wait_for_async(lambda: box.access)
        assert state_of(hass, limit) == "10.0"


@pytest.mark.usefixtures("all_entities_enabled")
async def test_signed_settings(
    hass: HomeAssistant, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_quiet(monkeypatch)
    box = SmartEvse("2.30+")
    async with running(hass, box, time_scale=10) as (entry, _):
        start = await get_entity(hass, "number", entry, "setting_solar_start_current")
        attributes = hass.states.get(start).attributes
        assert (attributes["min"], attributes["max"]) == (-16, 16)
        await call(hass, "number.set_value", start, value=-2.5)
        # Down means: it starts with more import, as asked for or later.
        assert state_of(hass, start) == "-3"


@pytest.mark.usefixtures("all_entities_enabled")
async def test_the_mode_it_starts_with(hass: HomeAssistant) -> None:
    box = SmartEvse("2.20")
    async with running(hass, box) as (entry, _):
        start = await get_entity(hass, "select", entry, "setting_mode_at_start")
        assert state_of(hass, start) == "normal"
        await call(hass, "select.select_option", start, option="solar")
        assert box.outlet.stored["mode"] == 2
        assert state_of(hass, start) == "solar"
        assert sum(box.eeprom_writes.values()) == 1


# -- What is not as it should be -------------------------------------------------


async def test_another_device_answers(hass: HomeAssistant) -> None:
    box = SmartEvse()
    dialect = box.controller.dialect
    box.controller.dialect = replace(dialect, states=dict.fromkeys(dialect.states, 90))
    async with running(hass, box) as (entry, _):
        problem = await get_entity(hass, "binary_sensor", entry, "problem")
        await wait_for_state(hass, problem, "on")
        assert issue(hass, "unknown_firmware_smartevse0")
        assert state_of(hass, entity_id(hass, "sensor", entry, "fault")) == (
            "unsupported_firmware"
        )
        assert entity_id(hass, "sensor", entry, "1_status") is None
        assert not box.writes
        box.controller.dialect = dialect
        await wait_for_state(hass, problem, "off")
        assert not issue(hass, "unknown_firmware_smartevse0")


async def test_at_address_0_others_would_hear_what_it_is_told(
    hass: HomeAssistant,
) -> None:
    box, other = SmartEvse(), SmartEvse("2.20", unit=1)
    async with running(hass, box, other) as (entry, _):
        problem = await get_entity(hass, "binary_sensor", entry, "problem")
        await wait_for_state(hass, problem, "on")
        assert issue(hass, "shared_address_smartevse0")
        assert not issue(hass, "duplicate_address_smartevse0")
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        with pytest.raises(HomeAssistantError) as refused:
            await call(hass, "switch.turn_off", allowed)
        assert refused.value.translation_key == "shared_address"
        assert not box.writes
        # Alone again, it can be told.
        hass.config_entries.async_remove_subentry(entry, f"smartevse{other.unit}")
        await wait_for_state(hass, problem, "off")
        assert not issue(hass, "shared_address_smartevse0")
        assert not issue(hass, "duplicate_address_smartevse0")
        await call(hass, "switch.turn_off", allowed)
        assert not box.access
