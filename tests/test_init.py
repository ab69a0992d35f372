"""Setting up, changing and taking down a bus in Home Assistant."""

import asyncio
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
import socket
from types import MappingProxyType
from typing import Any
from unittest.mock import patch

from homeassistant.config_entries import (
    ConfigEntry,
    ConfigEntryDisabler,
    ConfigEntryState,
    ConfigSubentry,
)
from homeassistant.const import EVENT_HOMEASSISTANT_STOP
from homeassistant.core import HomeAssistant
from homeassistant.helpers import (
    device_registry as dr,
    entity_registry as er,
    issue_registry as ir,
)
import pytest

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.stores.orders import ORDERS_KEY
from tests.common import (
    bus_entry,
    call,
    charger,
    charger_of,
    entity_id,
    get_entity,
    identity,
    running,
    setup_bus,
    state_of,
    stored_order,
    wait_for_state,
    wait_until,
)
from tests.virtual import AblBox, Car, VirtualBus, requests_in


def is_open(url: str) -> bool:
    """Return whether this process has a serial port open."""
    port = Path(url).resolve()
    for link in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):
            if link.readlink() == port:
                return True
    return False


def bus_tasks() -> list[str]:
    return [
        task.get_name()
        for task in asyncio.all_tasks()
        if task.get_name().startswith("bus ")
    ]


async def test_from_the_wire_to_a_state_and_back(hass: HomeAssistant) -> None:
    car = Car(max_current=16, reaction=0.0, ramp=0.1)
    box = AblBox(1, car=car)
    async with running(hass, box) as (entry, _):
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "available")

        car.plug_in()
        await wait_for_state(hass, status, "charging")
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=10)
        assert box.ic_amps == pytest.approx(9.96)  # 16.6 %, rounded down
        assert state_of(hass, limit) == "10.0"


async def test_a_port_that_is_not_there(hass: HomeAssistant) -> None:
    entry = await setup_bus(hass, "abl", "/dev/serial/by-id/none", charger("abl", 1))
    assert entry.state is ConfigEntryState.SETUP_RETRY
    assert entry.error_reason_translation_key == "port_missing"
    assert entry.error_reason_translation_placeholders["port"] == (
        "/dev/serial/by-id/none"
    )
    assert not bus_tasks()


async def test_a_port_that_is_in_use(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(AblBox(1)) as bus:
        first = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        second = bus_entry("abl", bus.url, entry_id="second")
        second.add_to_hass(hass)
        await hass.config_entries.async_setup("second")
        await hass.async_block_till_done()
        assert second.state is ConfigEntryState.SETUP_RETRY
        assert second.error_reason_translation_key == "port_busy"

        # Once the port is free, the next try finds it so.
        await hass.config_entries.async_unload(first.entry_id)
        await hass.config_entries.async_reload("second")
        await hass.async_block_till_done()
        assert second.state is ConfigEntryState.LOADED
        await hass.config_entries.async_unload("second")


@pytest.mark.parametrize(
    ("error", "key"),
    [
        (PermissionError(13, "Permission denied"), "port_permission"),
        (OSError(22, "Invalid argument"), "port_settings"),
        (OSError(99, "something else"), "port_failed"),
    ],
)
async def test_a_port_that_cannot_be_opened(
    hass: HomeAssistant, error: OSError, key: str
) -> None:
    opener = "custom_components.evse_bus.evse.line.create_serial_connection"
    with patch(opener, side_effect=error):
        entry = await setup_bus(hass, "abl", "/dev/ttyUSB7", charger("abl", 1))
    assert entry.state is ConfigEntryState.SETUP_RETRY
    assert entry.error_reason_translation_key == key
    assert not bus_tasks()


@pytest.mark.parametrize("away", [3.0, 61.0, 601.0, 3600.0])
async def test_an_adapter_that_is_away_at_the_start(
    hass: HomeAssistant, away: float
) -> None:
    """Home Assistant's own pauses would be up to 10 min long."""
    with VirtualBus.in_loop(AblBox(1)) as bus:
        bus.unplug()
        entry = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        assert entry.state is ConfigEntryState.SETUP_RETRY
        await asyncio.sleep(away)
        assert entry.state is ConfigEntryState.SETUP_RETRY
        # It is tried quietly: the reason stays shown.
        assert entry.error_reason_translation_key == "port_missing"
        bus.replug()
        await asyncio.sleep(10)
        assert entry.state is ConfigEntryState.LOADED
        status = await get_entity(hass, "sensor", entry, "1_status")
        assert state_of(hass, status) == "available"
        assert port_waits() == 0
        await hass.config_entries.async_unload(entry.entry_id)


def port_waits() -> int:
    return sum(
        task.get_name().startswith("evse_bus port of ") for task in asyncio.all_tasks()
    )


@pytest.mark.parametrize("what", ["disable", "unload", "remove"])
async def test_a_port_that_is_not_wanted_any_more_is_not_tried(
    hass: HomeAssistant, what: str
) -> None:
    with VirtualBus.in_loop(AblBox(1)) as bus:
        bus.unplug()
        entry = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        # Some of Home Assistant's own attempts are among these.
        await asyncio.sleep(100)
        assert port_waits() == 1
        entries = hass.config_entries
        if what == "disable":
            await entries.async_set_disabled_by(
                entry.entry_id, ConfigEntryDisabler.USER
            )
        elif what == "unload":
            await entries.async_unload(entry.entry_id)
        else:
            await entries.async_remove(entry.entry_id)
        bus.replug()
        await asyncio.sleep(60)
        assert port_waits() == 0
        assert bus.opened == 0


@pytest.mark.usefixtures("socket_enabled")
async def test_a_network_port_that_refuses(hass: HomeAssistant) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        port = server.getsockname()[1]
    entry = await setup_bus(hass, "abl", f"socket://127.0.0.1:{port}")
    assert entry.state is ConfigEntryState.SETUP_RETRY
    assert entry.error_reason_translation_key == "port_missing"


@pytest.mark.real_time
async def test_unloading_leaves_nothing_open(hass: HomeAssistant) -> None:
    with VirtualBus.pty(AblBox(1), AblBox(2)) as bus:
        entry = await setup_bus(
            hass, "abl", bus.url, charger("abl", 1), charger("abl", 2)
        )
        await get_entity(hass, "sensor", entry, "1_status")
        coordinator = entry.runtime_data
        assert bus_tasks()
        assert is_open(bus.url)
        assert await hass.config_entries.async_unload(entry.entry_id)
        await hass.async_block_till_done()
        assert entry.state is ConfigEntryState.NOT_LOADED
        assert not bus_tasks()
        assert not coordinator._listeners
        # The other end sees it when the last of ours is closed.
        await bus.wait_for_async(lambda: not bus.connected)
        assert not is_open(bus.url)


async def test_unloading_while_the_adapter_is_gone(hass: HomeAssistant) -> None:
    async with running(hass, AblBox(1)) as (entry, bus):
        connected = er.async_get(hass).async_get_entity_id(
            "binary_sensor", DOMAIN, "bus_connected"
        )
        await wait_for_state(hass, connected, "on")
        bus.unplug()
        await wait_for_state(hass, connected, "off")
        assert await hass.config_entries.async_unload(entry.entry_id)
        assert not bus_tasks()


async def test_stopping_home_assistant_closes_the_port(hass: HomeAssistant) -> None:
    async with running(hass, AblBox(1)) as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_status")
        hass.bus.async_fire(EVENT_HOMEASSISTANT_STOP)
        await hass.async_block_till_done()
        await bus.wait_for_async(lambda: not bus.connected)
        assert not bus_tasks()


async def test_removal_leaves_nothing(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    box = AblBox(1)
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        await get_entity(hass, "sensor", entry, "1_status")
        await hass.async_block_till_done()
        assert ORDERS_KEY in hass_storage
        await hass.config_entries.async_remove(entry.entry_id)
        await hass.async_block_till_done()
    # Its orders stay: it has a serial number, and may return on another bus.
    assert list(hass_storage[ORDERS_KEY]["data"]) == [f"serial:abl_{box.serial}"]
    assert not er.async_entries_for_config_entry(er.async_get(hass), "bus")
    assert not dr.async_entries_for_config_entry(dr.async_get(hass), "bus")
    assert not ir.async_get(hass).issues
    assert not hass.states.async_all()


def add_charger(hass: HomeAssistant, entry: ConfigEntry, data: dict[str, Any]) -> None:
    fields = {**data, "data": MappingProxyType(data["data"])}
    hass.config_entries.async_add_subentry(entry, ConfigSubentry(**fields))


async def test_a_charger_is_added_and_removed_while_the_others_go_on(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    one, two = AblBox(1), AblBox(2, serial="2W22xy00000002")
    with VirtualBus.in_loop(one, two) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger_of(one))
        first = await get_entity(hass, "sensor", entry, "1_status")
        coordinator = entry.runtime_data
        states = []
        hass.bus.async_listen(
            "state_changed",
            lambda event: states.append(event.data["entity_id"] == first),
        )

        add_charger(hass, entry, charger_of(two))
        second = await get_entity(hass, "sensor", entry, "1_status", index=1)
        assert state_of(hass, second) == "available"
        assert stored_order(hass_storage, "abl2")

        hass.config_entries.async_remove_subentry(entry, "abl2")
        await hass.async_block_till_done()
        assert hass.states.get(second) is None
        asked = len([r for r in requests_in(bus.log.bursts()) if r.device_id == 2])
        polls = len([r for r in requests_in(bus.log.bursts()) if r.device_id == 1])
        await bus.wait_for_async(
            lambda: (
                len([r for r in requests_in(bus.log.bursts()) if r.device_id == 1])
                > polls + 3
            )
        )
        assert (
            len([r for r in requests_in(bus.log.bursts()) if r.device_id == 2]) == asked
        )
        # The first charger never noticed.
        assert entry.runtime_data is coordinator
        assert bus.opened == 1
        assert not any(states)
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_changed_set_up_is_followed_in_place(hass: HomeAssistant) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=16)
        managed = entry.runtime_data.chargers["abl1"]
        before = managed.charger
        subentry = entry.subentries["abl1"]
        hass.config_entries.async_update_subentry(
            entry,
            subentry,
            title="Garage",
            data={**subentry.data, "installation_limit": 10.0},
        )
        await wait_until(hass, lambda: hass.states.get(limit).attributes["max"] == 10)
        await bus.wait_for_async(lambda: box.ic_amps == pytest.approx(9.96))
        assert managed.charger is before
        assert bus.opened == 1
        device = dr.async_get(hass).async_get_device_by_identifier(
            (DOMAIN, identity(entry)), "bus"
        )
        assert device.name == "Garage"


async def test_a_new_name_of_the_bus(hass: HomeAssistant) -> None:
    async with running(hass, AblBox(1)) as (entry, bus):
        hass.config_entries.async_update_entry(entry, title="Car park")
        await hass.async_block_till_done()
        device = dr.async_get(hass).async_get_device_by_identifier(
            (DOMAIN, "bus"), "bus"
        )
        assert device.name == "Car park"
        assert bus.opened == 1


async def test_a_new_address_makes_the_charger_anew(hass: HomeAssistant) -> None:
    box = AblBox(2, serial="2W22xy00000002")
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(
            hass, "abl", bus.url, charger("abl", 1, serial=box.serial)
        )
        managed = entry.runtime_data.chargers["abl1"]
        orders = managed.charger.orders
        subentry = entry.subentries["abl1"]
        hass.config_entries.async_update_subentry(
            entry, subentry, data={**subentry.data, "address": 2}
        )
        await get_entity(hass, "sensor", entry, "1_status")
        assert managed.charger.config.address == 2
        assert replace(managed.charger.orders, remembered={}) == replace(
            orders, remembered={}
        )
        assert list(entry.runtime_data.bus.chargers) == ["abl1"]
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_new_port_reloads_the_bus(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(AblBox(1)) as old, VirtualBus.in_loop(AblBox(1)) as new:
        entry = await setup_bus(hass, "abl", old.url, charger("abl", 1))
        status = await get_entity(hass, "sensor", entry, "1_status")
        before = entry.runtime_data
        hass.config_entries.async_update_entry(
            entry, data={**entry.data, "device": new.url}
        )
        await wait_until(
            hass,
            lambda: (
                entry.state is ConfigEntryState.LOADED
                and entry.runtime_data is not before
            ),
        )
        await wait_for_state(hass, status, "available")
        assert new.connected
        assert not old.connected
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_charger_that_nobody_had_a_serial_number_for(
    hass: HomeAssistant,
) -> None:
    box = AblBox(1, serial="2W22xy00000001")
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        status = await get_entity(hass, "sensor", entry, "1_status")
        await hass.async_block_till_done()
        subentry = entry.subentries["abl1"]
        assert subentry.data["serial"] == "2W22xy00000001"
        # Its entities stay what they are.
        assert subentry.unique_id is None
        assert entity_id(hass, "sensor", entry, "1_status") == status
        assert identity(entry) == "abl1"
        assert entry.runtime_data.chargers["abl1"].charger.config.serial == (
            "2W22xy00000001"
        )
        assert state_of(hass, status) == "available"
        assert bus.opened == 1
        await hass.config_entries.async_unload(entry.entry_id)
