"""Setting up, changing and taking down a bus in Home Assistant."""

import asyncio
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
import socket
from types import MappingProxyType
from typing import Any
from unittest.mock import patch

from homeassistant.config_entries import ConfigEntry, ConfigEntryState, ConfigSubentry
from homeassistant.const import EVENT_HOMEASSISTANT_STOP
from homeassistant.core import HomeAssistant
from homeassistant.helpers import (
    device_registry as dr,
    entity_registry as er,
    issue_registry as ir,
)
import pytest

from custom_components.evse_bus import async_remove_config_entry_device
from custom_components.evse_bus.const import DOMAIN, SUBENTRY_CHARGER
from tests.common import (
    bus_entry,
    call,
    charger,
    charger_of,
    entity_id,
    get_entity,
    running,
    setup_bus,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.virtual import AblBox, Car, EvboxChargePoint, VirtualBus, requests_in


def open_files() -> set[str]:
    """Return what this process has open, ptys and sockets by name."""
    found = set()
    for link in Path("/proc/self/fd").iterdir():
        try:
            found.add(str(link.readlink()))
        except FileNotFoundError:
            continue
    return found


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
    with VirtualBus.pty(AblBox(1)) as bus:
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


@pytest.mark.usefixtures("socket_enabled")
async def test_a_network_port_that_refuses(hass: HomeAssistant) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        port = server.getsockname()[1]
    entry = await setup_bus(hass, "abl", f"socket://127.0.0.1:{port}")
    assert entry.state is ConfigEntryState.SETUP_RETRY
    assert entry.error_reason_translation_key == "port_missing"


async def test_unloading_leaves_nothing_open(hass: HomeAssistant) -> None:
    with VirtualBus.pty(AblBox(1), AblBox(2)) as bus:
        before = open_files()
        entry = await setup_bus(
            hass, "abl", bus.url, charger("abl", 1), charger("abl", 2)
        )
        await get_entity(hass, "sensor", entry, "1_status")
        coordinator = entry.runtime_data
        assert bus_tasks()
        assert await hass.config_entries.async_unload(entry.entry_id)
        await hass.async_block_till_done()
        assert entry.state is ConfigEntryState.NOT_LOADED
        assert not bus_tasks()
        assert not coordinator._listeners
        assert open_files() <= before
        await bus.wait_for_async(lambda: not bus.connected)


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
    with VirtualBus.pty(AblBox(1)) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        await get_entity(hass, "sensor", entry, "1_status")
        assert "evse_bus.bus" in hass_storage
        await hass.config_entries.async_remove(entry.entry_id)
        await hass.async_block_till_done()
    assert "evse_bus.bus" not in hass_storage
    assert not er.async_entries_for_config_entry(er.async_get(hass), "bus")
    assert not dr.async_entries_for_config_entry(dr.async_get(hass), "bus")
    assert not ir.async_get(hass).issues
    assert not hass.states.async_all()


async def test_devices_hang_together(hass: HomeAssistant) -> None:
    async with running(hass, EvboxChargePoint(1923054, 2), poll_interval=1.0) as (
        entry,
        _,
    ):
        await get_entity(hass, "sensor", entry, "2_power")
        devices = dr.async_get(hass)
        find = devices.async_get_device_by_identifier
        bus = find((DOMAIN, "bus"), "bus")
        box = find((DOMAIN, "evbox1923054"), "bus")
        assert bus.via_device_id is None
        assert bus.config_subentry_id is None
        assert box.via_device_id == bus.id
        assert box.config_subentry_id == "evbox1923054"
        assert (box.manufacturer, box.serial_number) == ("EVBox", "1923054")
        for number in (1, 2):
            module = devices.async_get_child_device_by_identifier(
                (DOMAIN, f"evbox1923054_{number}"), "bus"
            )
            assert module.parent_device_id == box.id
            assert module.name == f"Module {number}"
            power = entity_id(hass, "sensor", entry, f"{number}_power")
            assert er.async_get(hass).async_get(power).device_id == module.id


async def test_the_only_connector_is_no_device(hass: HomeAssistant) -> None:
    async with running(hass, AblBox(3)) as (entry, _):
        status = await get_entity(hass, "sensor", entry, "1_status")
        box = dr.async_get(hass).async_get_device_by_identifier((DOMAIN, "abl3"), "bus")
        assert er.async_get(hass).async_get(status).device_id == box.id
        assert (box.manufacturer, box.sw_version) == ("ABL", "1.2")
        assert not dr.async_get(hass).async_get_child_device_by_identifier(
            (DOMAIN, "abl3_1"), "bus"
        )


def add_charger(hass: HomeAssistant, entry: ConfigEntry, data: dict[str, Any]) -> None:
    fields = {**data, "data": MappingProxyType(data["data"])}
    hass.config_entries.async_add_subentry(entry, ConfigSubentry(**fields))


async def test_a_charger_is_added_and_removed_while_the_others_go_on(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    one, two = AblBox(1), AblBox(2, serial="2W22xy00000002")
    with VirtualBus.pty(one, two) as bus:
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
        assert "abl2" in hass_storage["evse_bus.bus"]["data"]

        hass.config_entries.async_remove_subentry(entry, "abl2")
        await hass.async_block_till_done()
        assert hass.states.get(second) is None
        assert "abl2" not in hass_storage["evse_bus.bus"]["data"]
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
        unit = entry.runtime_data.units["abl1"]
        before = unit.charger
        subentry = entry.subentries["abl1"]
        hass.config_entries.async_update_subentry(
            entry,
            subentry,
            title="Garage",
            data={**subentry.data, "installation_limit": 10.0},
        )
        await wait_until(hass, lambda: hass.states.get(limit).attributes["max"] == 10)
        await bus.wait_for_async(lambda: box.ic_amps == pytest.approx(9.96))
        assert unit.charger is before
        assert bus.opened == 1
        device = dr.async_get(hass).async_get_device_by_identifier(
            (DOMAIN, "abl1"), "bus"
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
    with VirtualBus.pty(box) as bus:
        entry = await setup_bus(
            hass, "abl", bus.url, charger("abl", 1, serial=box.serial)
        )
        unit = entry.runtime_data.units["abl1"]
        orders = unit.charger.orders
        subentry = entry.subentries["abl1"]
        hass.config_entries.async_update_subentry(
            entry, subentry, data={**subentry.data, "address": 2}
        )
        await get_entity(hass, "sensor", entry, "1_status")
        assert unit.charger.config.address == 2
        assert unit.charger.orders == orders
        assert list(entry.runtime_data.bus.chargers) == ["abl1"]
        await hass.config_entries.async_unload(entry.entry_id)


async def test_a_new_port_reloads_the_bus(hass: HomeAssistant) -> None:
    with VirtualBus.pty(AblBox(1)) as old, VirtualBus.pty(AblBox(1)) as new:
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
    with VirtualBus.pty(box) as bus:
        entry = await setup_bus(hass, "abl", bus.url, charger("abl", 1))
        status = await get_entity(hass, "sensor", entry, "1_status")
        await hass.async_block_till_done()
        subentry = entry.subentries["abl1"]
        assert subentry.data["serial"] == "2W22xy00000001"
        assert subentry.unique_id == "abl_2W22xy00000001"
        assert entry.runtime_data.units["abl1"].charger.config.serial == (
            "2W22xy00000001"
        )
        assert state_of(hass, status) == "available"
        assert bus.opened == 1
        await hass.config_entries.async_unload(entry.entry_id)


@pytest.fixture
def two_modules() -> Iterator[EvboxChargePoint]:
    return EvboxChargePoint(1923054, 2)


async def test_a_module_that_is_gone_can_be_deleted(
    hass: HomeAssistant, two_modules: EvboxChargePoint
) -> None:
    async with running(hass, two_modules, poll_interval=1.0) as (entry, _):
        power = await get_entity(hass, "sensor", entry, "2_power")
        devices = dr.async_get(hass)
        module = devices.async_get_child_device_by_identifier(
            (DOMAIN, "evbox1923054_2"), "bus"
        )
        for device in (
            devices.async_get_device_by_identifier((DOMAIN, "bus"), "bus"),
            devices.async_get_device_by_identifier((DOMAIN, "evbox1923054"), "bus"),
            module,
        ):
            assert not await async_remove_config_entry_device(hass, entry, device)

        two_modules.remove_module()
        await wait_for_state(hass, power, "unavailable")
        assert await async_remove_config_entry_device(hass, entry, module)
        devices.async_remove_device(module.id)
        await hass.async_block_till_done()
        assert hass.states.get(power) is None

        # It comes back as a module that was never seen.
        two_modules.add_module()
        await get_entity(hass, "sensor", entry, "2_power")


async def test_the_second_module_makes_devices_of_both(hass: HomeAssistant) -> None:
    # A box that answers at once after a reload: it asks for no interval.
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    async with running(hass, box, poll_interval=1.0) as (entry, _):
        first = await get_entity(hass, "sensor", entry, "1_power")
        entities = er.async_get(hass)
        charger_id = entities.async_get(first).device_id
        box.add_module()
        second = await get_entity(hass, "sensor", entry, "2_power")
        assert entities.async_get(first).device_id != charger_id
        parents = {
            dr.async_get(hass)
            .async_get(entities.async_get(one).device_id)
            .parent_device_id
            for one in (first, second)
        }
        assert parents == {charger_id}
        assert state_of(hass, first) == "0.0"

        # So it stays, also when only one is left at the next start.
        box.remove_module()
        await wait_for_state(hass, second, "unavailable")
        await hass.config_entries.async_reload(entry.entry_id)
        await wait_for_state(hass, first, "0.0")
        assert entities.async_get(first).device_id != charger_id
        assert entry.subentries["evbox1923054"].subentry_type == SUBENTRY_CHARGER
