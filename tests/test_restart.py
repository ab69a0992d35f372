"""Stops, crashes and starts: the orders on disk are what the wire hears first."""

import asyncio
from datetime import timedelta
import logging
from pathlib import Path
from typing import Any
from unittest.mock import patch

from homeassistant.config_entries import ConfigEntryDisabler, ConfigEntryState
from homeassistant.const import EVENT_HOMEASSISTANT_STOP, STATE_UNAVAILABLE
from homeassistant.core import HomeAssistant
from homeassistant.helpers import device_registry as dr, entity_registry as er
from homeassistant.helpers.storage import Store
from homeassistant.util import dt as dt_util
import pytest
from pytest_homeassistant_custom_component.common import async_fire_time_changed

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.stores.orders import ORDERS_KEY
from tests.common import (
    bus_entry,
    call,
    charger,
    charger_of,
    crash,
    get_entity,
    running,
    setup_bus,
    state_of,
    stored_order,
    wait_for_state,
)
from tests.ews import listening
from tests.virtual import (
    AblBox,
    Car,
    EvboxChargePoint,
    EwsBox,
    Module,
    SmartEvse,
    VirtualBus,
    orders_in,
)


async def test_orders_are_read_before_the_port_is_opened(hass: HomeAssistant) -> None:
    read = asyncio.Event()
    asked = asyncio.Event()
    original = Store.async_load

    async def slow(self: Store) -> Any:  # noqa: ANN401 - as Store's
        if self.key == ORDERS_KEY:
            asked.set()
            await read.wait()
        return await original(self)

    with VirtualBus.in_loop(AblBox(1)) as bus, patch.object(Store, "async_load", slow):
        entry = bus_entry("abl", bus.url, charger("abl", 1))
        entry.add_to_hass(hass)
        setting_up = hass.async_create_task(
            hass.config_entries.async_setup(entry.entry_id)
        )
        await asked.wait()
        assert bus.opened == 0
        read.set()
        assert await setting_up
        assert bus.opened == 1
        await hass.config_entries.async_unload(entry.entry_id)


@pytest.mark.parametrize("allowed", [True, False])
async def test_an_evbox_hears_its_orders_first_after_a_crash(
    hass: HomeAssistant,
    hass_storage: dict[str, Any],
    allowed: bool,  # noqa: FBT001 - a parameter of a test
) -> None:
    """In the middle of a charge."""
    car = Car(reaction=0.0, ramp=0.1)
    box = EvboxChargePoint(1923054, [Module(car)], min_interval=0)
    with VirtualBus.in_loop(box) as bus:
        car.plug_in()
        entry = await setup_bus(
            hass, "evbox", bus.url, charger_of(box, poll_interval=0.3)
        )
        limit = await get_entity(hass, "number", entry, "charging_current")
        maximum = await get_entity(hass, "sensor", entry, "maximum_current")
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        await wait_for_state(hass, maximum, "35.0")
        await call(hass, "number.set_value", limit, value=16)
        await call(hass, "number.set_value", limit, value=9)
        if not allowed:
            await call(hass, "switch.turn_off", switch)
        await crash(hass, entry, hass_storage)
        before = len(orders_in(bus.log.bursts()))

        await hass.config_entries.async_setup(entry.entry_id)
        expected = (9, 9, 9) if allowed else (0, 0, 0)
        await bus.wait_for_async(
            lambda: len(box.orders) and box.limits_in_force == expected
        )
        await wait_for_state(hass, limit, "9.0")
        assert state_of(hass, switch) == ("on" if allowed else "off")
        sent = [one.limits for one in orders_in(bus.log.bursts())[before:]]
        # 6 A at most, until it has told its maximum; never 16 A again.
        first = (6, 6, 6) if allowed else (0, 0, 0)
        assert sent[0] == first
        assert set(sent) <= {first, expected}
        await hass.config_entries.async_unload(entry.entry_id)


async def test_an_abl_box_is_lowered_after_a_crash(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    """A raise that was not stored yet is lost: lower is what remains."""
    car = Car(reaction=0.0, ramp=0.1)
    box = AblBox(1, car=car)
    with VirtualBus.in_loop(box) as bus:
        car.plug_in()
        entry = await setup_bus(hass, "abl", bus.url, charger_of(box))
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=8)
        await call(hass, "number.set_value", limit, value=16)
        assert box.ic_amps > 15
        await crash(hass, entry, hass_storage)
        key = f"serial:abl_{box.serial}"
        hass_storage[ORDERS_KEY]["data"][key]["limit"]["current"] = 8.0
        written = len(box.limits_written)

        await hass.config_entries.async_setup(entry.entry_id)
        await bus.wait_for_async(lambda: box.ic_amps <= 8)
        await wait_for_state(hass, limit, "8.0")
        # 8 A is 13.3 % of duty, and nothing else was written.
        assert set(box.limits_written[written:]) == {133}
        await hass.config_entries.async_unload(entry.entry_id)


async def test_what_an_evbox_does_when_home_assistant_stops(
    hass: HomeAssistant,
) -> None:
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    async with running(
        hass, box, poll_interval=0.3, fail_safe_current=7.0, fail_safe_timeout=2
    ) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        maximum = await get_entity(hass, "sensor", entry, "maximum_current")
        await wait_for_state(hass, maximum, "35.0")
        await call(hass, "number.set_value", limit, value=16)
        hass.bus.async_fire(EVENT_HOMEASSISTANT_STOP)
        await hass.async_block_till_done()
        sent = len(orders_in(bus.log.bursts()))
        # Its own fail-safe takes over; nobody has told it anything else.
        await bus.wait_for_async(lambda: box.failed_back, timeout=10)
        assert box.limits_in_force == (7, 7, 7)
        assert len(orders_in(bus.log.bursts())) == sent


async def test_a_raise_is_on_disk_after_a_clean_stop(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    async with running(hass, AblBox(1)) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=14)
        await hass.async_stop(force=True)
        assert stored_order(hass_storage, "abl1")["limit"]["current"] == 14.0


async def test_the_adapter_is_plugged_in_after_the_start(
    hass: HomeAssistant, tmp_path: Path
) -> None:
    name = tmp_path / "usb-adapter"
    entry = await setup_bus(hass, "abl", str(name), charger("abl", 1))
    assert entry.state is ConfigEntryState.SETUP_RETRY
    with VirtualBus.in_loop(AblBox(1)) as bus:
        name.symlink_to(bus.url)
        async_fire_time_changed(hass, dt_util.utcnow() + timedelta(minutes=5))
        await get_entity(hass, "sensor", entry, "1_status")
        assert entry.state is ConfigEntryState.LOADED
        assert bus.opened == 1
        await hass.config_entries.async_unload(entry.entry_id)


async def test_disabled_and_enabled_again(hass: HomeAssistant) -> None:
    async with running(hass, AblBox(1)) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=12)
        await hass.config_entries.async_set_disabled_by(
            entry.entry_id, ConfigEntryDisabler.USER
        )
        await hass.async_block_till_done()
        assert entry.state is ConfigEntryState.NOT_LOADED
        assert state_of(hass, limit) == STATE_UNAVAILABLE
        await bus.wait_for_async(lambda: not bus.connected)

        await hass.config_entries.async_set_disabled_by(entry.entry_id, None)
        await hass.async_block_till_done()
        await wait_for_state(hass, limit, "12.0")


def complaints(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the warnings and errors that are about us."""
    return [
        record.getMessage()
        for record in caplog.records
        if record.levelno >= logging.WARNING
        and (DOMAIN in record.name or DOMAIN in record.getMessage())
        # Said of every custom integration.
        and "has not been tested by Home Assistant" not in record.getMessage()
    ]


async def test_nothing_to_complain_about(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    """No deprecation, no warning, from start to end, of every protocol."""
    for box in (
        AblBox(1),
        EvboxChargePoint(1923054, 2, min_interval=0),
        SmartEvse(),
        SmartEvse(load_balance=2),
        EwsBox(rfid=True, manual_io=True),
    ):
        async with running(hass, box, poll_interval=0.3) as (entry, _):
            await get_entity(hass, "binary_sensor", entry, "1_charging")
            await hass.async_block_till_done()
            await hass.config_entries.async_reload(entry.entry_id)
            await hass.async_block_till_done()
            await get_entity(hass, "binary_sensor", entry, "1_charging")
        await hass.config_entries.async_remove(entry.entry_id)
        await hass.async_block_till_done()
    assert not complaints(caplog)


@pytest.mark.usefixtures("socket_enabled")
async def test_nothing_to_complain_about_of_a_listener(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    box = EwsBox(rfid=True, manual_io=True)
    async with listening(hass, box) as (entry, _):
        await get_entity(hass, "binary_sensor", entry, "2_charging")
        await hass.async_block_till_done()
        await hass.config_entries.async_reload(entry.entry_id)
        await get_entity(hass, "binary_sensor", entry, "2_charging")
        await hass.async_block_till_done()
        await hass.config_entries.async_remove(entry.entry_id)
        await hass.async_block_till_done()
    assert not complaints(caplog)


async def test_ids_never_contain_the_port_or_an_address(hass: HomeAssistant) -> None:
    """A better adapter, or another device-ID, and all history is still there."""
    box = AblBox(7, serial="2W22xy01234567")
    async with running(hass, box) as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_status")
        entities = er.async_entries_for_config_entry(er.async_get(hass), "bus")
        devices = dr.async_entries_for_config_entry(dr.async_get(hass), "bus")
        ids = [one.unique_id for one in entities]
        ids += [key for one in devices for _, key in one.identifiers]
        own = ("bus", f"abl_{box.serial}")
        assert all(one in own or one.startswith(("bus_", f"{own[1]}_")) for one in ids)
        port = bus.url.rsplit("/", 1)[-1]
        assert not any(bus.url in one or one.endswith(f"/{port}") for one in ids)
        assert entry.unique_id is None
