"""Adding a SmartEVSE to a bus that runs, and changing one, as a person does it."""

from itertools import pairwise
from typing import TYPE_CHECKING

from homeassistant.config_entries import ConfigEntryState, ConfigSubentry
from homeassistant.data_entry_flow import FlowResultType
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry

from tests.common import (
    call,
    charger as stored_charger,
    get_entity,
    setup_bus,
    wait_for_state,
    wait_until,
)
from tests.flow import NOWHERE, Flow, charger, fields
from tests.virtual import SmartEvse, VirtualBus

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

pytestmark = pytest.mark.usefixtures("quick_search")

SUPPLY = {"supply_limit": 20.0, "supply_minimum": 6.0}
LONGEST_SILENCE = 2.5
"""Between two broadcasts, which are due every 2 s; a slave stops after 10 s."""


def slave(unit: int) -> SmartEvse:
    return SmartEvse(load_balance=unit)


def get(entry: MockConfigEntry, title: str) -> ConfigSubentry:
    return next(one for one in entry.subentries.values() if one.title == title)


async def master_bus(
    hass: HomeAssistant, url: str, *units: int, **options: object
) -> MockConfigEntry:
    stored = [
        stored_charger("smartevse_master", unit, poll_interval=1) for unit in units
    ]
    return await setup_bus(hass, "smartevse_master", url, *stored, **SUPPLY, **options)


async def take_down(hass: HomeAssistant, entry: MockConfigEntry) -> None:
    assert await hass.config_entries.async_unload(entry.entry_id)
    await hass.async_block_till_done()


# -- Adding ------------------------------------------------------------------------


async def test_searches_leave_the_broadcasts_in_time(hass: HomeAssistant) -> None:
    box = slave(2)
    with VirtualBus.in_loop(box, slave(3)) as bus:
        entry = await master_bus(hass, bus.url, 2)
        await bus.wait_for_async(lambda: box.broadcasts)
        while len(box.broadcasts) < 3:
            flow = await Flow.add_charger(hass, entry)
            await flow.choose("scan")
            await flow.wait()
            assert flow.step == "select"
            flow.abort()
        heard = [one.t for one in box.broadcasts]
        gaps = [later - earlier for earlier, later in pairwise(heard)]
        assert max(gaps) < LONGEST_SILENCE
        assert not box.error
        await take_down(hass, entry)


async def test_slave_is_added_to_a_bus_that_runs(hass: HomeAssistant) -> None:
    first, second = slave(2), slave(3)
    with VirtualBus.in_loop(first, second) as bus:
        entry = await master_bus(hass, bus.url, 2)
        running = entry.runtime_data.bus
        await bus.wait_for_async(lambda: first.broadcasts)
        flow = await Flow.add_charger(hass, entry)
        assert flow.step == "user"
        assert flow.result["menu_options"] == ["scan", "manual"]
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        assert fields(flow)["chargers"] == "3"
        assert flow.progress[-1] == 1
        assert not second.writes
        await flow.submit({"chargers": "3"})
        assert flow.tells("firmware 2.17 at Slave 2")
        await flow.submit(charger("New", 13))
        assert flow.step == "confirm_smartevse_master"
        assert flow.tells("allowed 20 A per phase", "12 s at most")
        await flow.submit()
        assert flow.result["type"] is FlowResultType.CREATE_ENTRY
        await hass.async_block_till_done()

        new = get(entry, "New")
        assert new.unique_id is None
        assert new.data["address"] == 3
        # In place: the bus was neither closed nor opened again, and nobody stopped.
        assert entry.runtime_data.bus is running
        assert bus.opened == 1
        assert new.subentry_id in running.chargers
        await bus.wait_for_async(
            lambda: second.broadcasts and second.broadcasts[-1].currents[2] > 0
        )
        await take_down(hass, entry)


async def test_slave_that_is_there_already_is_refused(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(slave(2)) as bus:
        entry = await master_bus(hass, bus.url, 2)
        flow = await Flow.add_charger(hass, entry)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "nothing_new"
        await flow.choose("manual")
        await flow.submit({"slave": "2"})
        assert flow.errors == {"slave": "address_taken"}
        await flow.submit({"slave": "4"})
        await flow.submit(charger("Not there yet"))
        await flow.submit()
        await hass.async_block_till_done()
        assert get(entry, "Not there yet").data["address"] == 4
        assert bus.opened == 1
        await take_down(hass, entry)


async def test_slave_with_another_firmware_is_refused(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(slave(2), SmartEvse("2.30+", load_balance=3)) as bus:
        entry = await master_bus(hass, bus.url, 2)
        [first] = entry.subentries.values()
        await wait_until(hass, lambda: first.data.get("dialect"))
        flow = await Flow.add_charger(hass, entry)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "mixed_firmware"
        assert flow.result["menu_options"] == ["scan"]
        shown = flow.result["description_placeholders"]["chargers"]
        assert (
            f"- {first.title} (Slave 1 / Node 1): SmartEVSE v2, firmware 2.17" in shown
        )
        assert "- Slave 2 / Node 2: SmartEVSE v2, firmware 2.30" in shown
        flow.abort()
        await take_down(hass, entry)


async def test_mix_that_comes_about_meanwhile_is_refused(hass: HomeAssistant) -> None:
    """Two flows at once, and a changed configuration of a box that is not there."""
    with VirtualBus.in_loop() as bus:
        entry = await master_bus(hass, bus.url, 2, 3)
        one, other = entry.subentries.values()
        for subentry, dialect in ((one, "2.20"), (other, "2.30")):
            hass.config_entries.async_update_subentry(
                entry, subentry, data={**subentry.data, "dialect": dialect}
            )
        flow = await Flow.change_settings(hass, entry, one)
        typed = {
            key: value
            for key, value in charger("New").items()
            if key != "fail_safe_current"
        }
        await flow.submit({**typed, "slave": "2"})
        assert flow.errors == {"base": "mixed_firmware"}
        assert flow.tells("firmware 2.20", "firmware 2.30")
        assert one.title != "New"
        flow = await Flow.add_charger(hass, entry)
        await flow.choose("manual")
        await flow.submit({"slave": "4"})
        await flow.submit(charger("Four"))
        await flow.submit()
        assert flow.result["reason"] == "mixed_firmware"
        assert len(entry.subentries) == 2
        await take_down(hass, entry)


async def test_search_beside_another_master(hass: HomeAssistant) -> None:
    first = slave(2)
    with VirtualBus.in_loop(first) as bus:
        entry = await master_bus(hass, bus.url, 2)
        await bus.wait_for_async(lambda: first.broadcasts)
        bus.add(SmartEvse(load_balance=1))
        flow = await Flow.add_charger(hass, entry)
        duty = entry.runtime_data.bus.master
        # Once the two did not speak at the same time.
        await bus.wait_for_async(lambda: duty.noticed, timeout=15)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "other_master"
        assert flow.result["menu_options"] == ["scan", "manual"]
        flow.abort()
        await take_down(hass, entry)


async def test_slave_is_added_to_a_bus_that_is_not_running(
    hass: HomeAssistant,
) -> None:
    entry = await master_bus(hass, NOWHERE)
    assert entry.state is ConfigEntryState.SETUP_RETRY
    flow = await Flow.add_charger(hass, entry)
    assert flow.step == "manual"
    await flow.submit({"slave": "3"})
    await flow.submit(charger("Three"))
    await flow.submit()
    await hass.async_block_till_done()
    assert get(entry, "Three").data["address"] == 3


async def test_no_second_box_on_a_bus_that_polls(hass: HomeAssistant) -> None:
    entry = await setup_bus(
        hass, "smartevse", NOWHERE, stored_charger("smartevse", 0, title="Box")
    )
    flow = await Flow.add_charger(hass, entry)
    assert flow.result["type"] is FlowResultType.ABORT
    assert flow.result["reason"] == "one_smartevse"

    # Its place is free again when it was removed.
    hass.config_entries.async_remove_subentry(entry, get(entry, "Box").subentry_id)
    flow = await Flow.add_charger(hass, entry)
    assert flow.step == "manual"
    await flow.submit({"unit": "1"})
    await flow.submit(charger("Other") | {"stop_on_shutdown": True})
    assert flow.step == "confirm_smartevse"
    await flow.submit()
    assert get(entry, "Other").data["stop_on_shutdown"] is True


async def test_two_dialogues_add_one_box_to_a_bus_that_polls(
    hass: HomeAssistant,
) -> None:
    entry = await setup_bus(hass, "smartevse", NOWHERE)
    dialogues = [await Flow.add_charger(hass, entry) for _ in range(2)]
    for unit, flow in enumerate(dialogues):
        await flow.submit({"unit": str(unit)})
        await flow.submit(charger(f"Box {unit}") | {"stop_on_shutdown": True})
        assert flow.step == "confirm_smartevse"
    for flow in dialogues:
        await flow.submit()
    assert dialogues[0].result["type"] is FlowResultType.CREATE_ENTRY
    assert dialogues[1].result["reason"] == "one_smartevse"
    assert [one.title for one in entry.subentries.values()] == ["Box 0"]


async def test_box_is_searched_on_a_bus_that_has_lost_its_own(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(SmartEvse()) as bus:
        entry = await setup_bus(hass, "smartevse", bus.url)
        flow = await Flow.add_charger(hass, entry)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        await flow.submit({"chargers": "0"})
        await flow.submit(charger("New") | {"stop_on_shutdown": False})
        await flow.submit()
        await hass.async_block_till_done()
        assert get(entry, "New").unique_id is None
        [running] = entry.runtime_data.bus.chargers.values()
        await bus.wait_for_async(lambda: running.available)
        await take_down(hass, entry)


# -- Changing ----------------------------------------------------------------------


async def test_polled_box_is_changed_in_place(hass: HomeAssistant) -> None:
    box = SmartEvse("2.30+", serial=4711)
    with VirtualBus.in_loop(box) as bus:
        stored = stored_charger("smartevse", 1, serial="4711", title="Box")
        entry = await setup_bus(hass, "smartevse", bus.url, stored)
        flow = await Flow.change_settings(hass, entry, get(entry, "Box"))
        offered = fields(flow)
        assert offered["unit"] == "1"
        assert "serial" not in offered
        assert offered["stop_on_shutdown"] is False
        assert "order_lifetime" not in offered
        typed = {
            "name": "Car port",
            "unit": "1",
            "installation_limit": 10,
            "order_lifetime": 20,
            "stop_on_shutdown": True,
            "expert": {"poll_interval": 5, "voltage": 230},
        }
        await flow.submit(typed | {"order_lifetime": "nan"})
        assert flow.errors == {"order_lifetime": "not_a_number"}
        await flow.submit(typed)
        assert flow.result["reason"] == "reconfigure_successful"
        await hass.async_block_till_done()
        changed = get(entry, "Car port")
        assert changed.unique_id is None
        assert changed.data["installation_limit"] == 10
        assert changed.data["order_lifetime"] == 20
        assert changed.data["stop_on_shutdown"] is True
        assert changed.data["fail_safe_current"] == 6
        [running] = entry.runtime_data.bus.chargers.values()
        assert running.config.installation_limit == 10
        assert running.config.order_lifetime == 20 * 60
        assert running.config.stop_on_shutdown is True
        assert bus.opened == 1

        flow = await Flow.change_settings(hass, entry, changed)
        offered = fields(flow)
        assert offered["order_lifetime"] == 20
        assert offered["stop_on_shutdown"] is True
        flow.abort()
        await take_down(hass, entry)


async def test_slave_is_changed_in_place(hass: HomeAssistant) -> None:
    first, second = slave(2), slave(3)
    with VirtualBus.in_loop(first, second) as bus:
        entry = await master_bus(hass, bus.url, 2, 3)
        flow = await Flow.change_settings(hass, entry, get(entry, "Charger 3"))
        assert fields(flow)["slave"] == "3"
        assert "serial" not in flow.result["data_schema"].schema
        typed = {
            "name": "Right",
            "slave": "2",
            "installation_limit": 13,
            "expert": {"poll_interval": 2, "voltage": 230},
        }
        await flow.submit(typed)
        assert flow.errors == {"slave": "address_taken"}
        await flow.submit(typed | {"slave": "4"})
        assert flow.result["reason"] == "reconfigure_successful"
        await hass.async_block_till_done()
        right = get(entry, "Right")
        assert right.unique_id is None
        assert right.data["address"] == 4
        assert right.data["installation_limit"] == 13
        assert bus.opened == 1
        await take_down(hass, entry)


async def test_slave_is_replaced_and_keeps_its_entities(hass: HomeAssistant) -> None:
    """Nothing tells one box from another; the user says that it is another one."""
    box = slave(2)
    with VirtualBus.in_loop(box) as bus:
        entry = await master_bus(hass, bus.url, 2)
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=12)
        flow = await Flow.replace_charger(hass, entry, get(entry, "Charger 2"))
        assert not fields(flow)
        await flow.submit({})
        assert flow.result["reason"] == "reconfigure_successful"
        await wait_for_state(hass, limit, "6.0")
        stored = get(entry, "Charger 2")
        assert stored.unique_id is None
        assert stored.data["identity"] != stored.subentry_id
        assert await get_entity(hass, "number", entry, "charging_current") == limit
        assert bus.opened == 1
        await take_down(hass, entry)


async def test_shared_supply_is_changed_while_the_slaves_hear_their_master(
    hass: HomeAssistant,
) -> None:
    box = slave(2)
    with VirtualBus.in_loop(box) as bus:
        entry = await master_bus(hass, bus.url, 2)
        await bus.wait_for_async(lambda: box.broadcasts)
        flow = await Flow.change_bus(hass, entry)
        assert fields(flow) == {
            "device": bus.url,
            "supply_limit": 20,
            "supply_minimum": 6,
            "line": {"baudrate": 9600, "parity": "n", "stop_bits": "1"},
        }
        typed = {"device": bus.url, "supply_limit": 9, "supply_minimum": 10, "line": {}}
        await flow.submit(typed)
        assert flow.errors == {"supply_minimum": "above_supply"}
        await flow.submit(typed | {"supply_minimum": 8})
        assert flow.result["reason"] == "reconfigure_successful"
        await hass.async_block_till_done()
        assert entry.data == {
            "protocol": "smartevse_master",
            "device": bus.url,
            "supply_limit": 9,
            "supply_minimum": 8,
        }
        assert entry.state is ConfigEntryState.LOADED
        supply = entry.runtime_data.bus.master.circuit
        assert (supply.limit, supply.minimum) == (9, 8)
        assert bus.opened == 1
        await take_down(hass, entry)
