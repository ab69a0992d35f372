"""Adding a charger to a running bus, and changing one, as a person does it."""

from typing import TYPE_CHECKING, Any

from homeassistant.config_entries import ConfigEntryState, ConfigSubentry
from homeassistant.data_entry_flow import FlowResultType
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry

from tests.common import charger as stored_charger, setup_bus
from tests.flow import NOWHERE, Flow, charger, fields
from tests.virtual import AblBox, EvboxChargePoint, VirtualBus, requests_in

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

pytestmark = pytest.mark.usefixtures("quick_search")


def abl(address: int) -> AblBox:
    return AblBox(address, serial=serial(address))


def serial(address: int) -> str:
    return f"2W22xy{address:08d}"


def get(entry: MockConfigEntry, title: str) -> ConfigSubentry:
    return next(one for one in entry.subentries.values() if one.title == title)


async def abl_bus(
    hass: HomeAssistant, bus: VirtualBus, *addresses: int
) -> MockConfigEntry:
    return await setup_bus(
        hass,
        "abl",
        bus.url,
        *(stored_charger("abl", one, serial=serial(one)) for one in addresses),
    )


async def take_down(hass: HomeAssistant, entry: MockConfigEntry) -> None:
    assert await hass.config_entries.async_unload(entry.entry_id)
    await hass.async_block_till_done()


# -- Adding -----------------------------------------------------------------------


async def test_new_box_is_found_while_the_others_are_polled(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(abl(1), abl(2)) as bus:
        entry = await abl_bus(hass, bus, 1)
        running = entry.runtime_data.bus
        flow = await Flow.add_charger(hass, entry)
        assert flow.step == "user"
        assert flow.result["menu_options"] == ["scan", "manual"]
        await flow.choose("scan")
        begun = bus.time()
        await flow.wait()
        assert flow.step == "select"
        # What its wiring may carry is asked once, in the next form.
        assert fields(flow) == {"chargers": "2"}
        assert flow.progress[-1] == 1
        # The box that is there was asked for its readings all the while.
        asked = [
            one.device_id
            for one in requests_in(bus.log.bursts())
            if one.register == 0x2E and one.t > begun
        ]
        assert asked.count(1) > 3

        await flow.submit({"chargers": "2"})
        assert flow.tells("Charger 1 of 1", serial(2))
        assert fields(flow)["installation_limit"] == 16
        await flow.submit(charger("New", "nan"))
        assert flow.errors == {"installation_limit": "not_a_number"}
        await flow.submit(charger("New", 13))
        assert flow.step == "confirm_abl"
        await flow.submit()
        assert flow.result["type"] is FlowResultType.CREATE_ENTRY
        await hass.async_block_till_done()

        new = get(entry, "New")
        assert new.unique_id == f"abl_{serial(2)}"
        assert new.subentry_type == "charger"
        assert new.data["address"] == 2
        assert new.data["installation_limit"] == 13
        # In place: the bus was neither closed nor opened again.
        assert entry.runtime_data.bus is running
        assert bus.opened == 1
        assert new.subentry_id in running.chargers
        await take_down(hass, entry)


async def test_nothing_new_on_the_bus(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(abl(1)) as bus:
        entry = await abl_bus(hass, bus, 1)
        flow = await Flow.add_charger(hass, entry)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "nothing_new"
        await flow.choose("manual")
        await flow.submit({"device_id": "1"})
        assert flow.errors == {"device_id": "address_taken"}
        await flow.submit({"device_id": "9"})
        await flow.submit(charger("Not there yet"))
        await flow.submit()
        await hass.async_block_till_done()
        later = get(entry, "Not there yet")
        assert later.unique_id is None
        assert later.data["serial"] is None
        await take_down(hass, entry)


async def test_two_new_boxes_with_one_id(hass: HomeAssistant) -> None:
    twins = AblBox(2, serial=serial(21)), AblBox(2, serial=serial(22))
    with VirtualBus.in_loop(abl(1), *twins) as bus:
        entry = await abl_bus(hass, bus, 1)
        flow = await Flow.add_charger(hass, entry)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "duplicates"
        assert flow.result["menu_options"] == ["sort_out", "scan", "manual"]
        assert not any(twin.writes for twin in twins)
        flow.abort()
        await take_down(hass, entry)


async def test_box_found_at_another_address_is_the_same_box(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(AblBox(5, serial=serial(1))) as bus:
        entry = await abl_bus(hass, bus, 1)
        flow = await Flow.add_charger(hass, entry)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "nothing_new"
        assert flow.tells("Charger 1 (Bus)")
        flow.abort()
        await take_down(hass, entry)


async def test_adapter_unplugged_during_the_search(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(abl(1)) as bus:
        entry = await abl_bus(hass, bus, 1)
        flow = await Flow.add_charger(hass, entry)
        await flow.choose("scan")
        bus.unplug()
        await flow.wait()
        assert flow.step == "manual"
        assert flow.errors == {"base": "port_lost"}
        flow.abort()
        await take_down(hass, entry)


async def test_bus_taken_down_before_the_search(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(abl(1)) as bus:
        entry = await abl_bus(hass, bus, 1)
        flow = await Flow.add_charger(hass, entry)
        await take_down(hass, entry)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "manual"
        assert flow.errors == {"base": "entry_not_loaded"}
        flow.abort()


async def test_closing_the_dialogue_in_mid_search_leaves_the_bus_running(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(abl(1)) as bus:
        entry = await abl_bus(hass, bus, 1)
        flow = await Flow.add_charger(hass, entry)
        await flow.choose("scan")
        await bus.wait_for_async(
            lambda: any(one.device_id > 3 for one in requests_in(bus.log.bursts()))
        )
        flow.abort()
        seen = bus.log.total
        await bus.wait_for_async(lambda: bus.log.total > seen + 6)
        [running] = entry.runtime_data.bus.chargers.values()
        assert running.available
        await take_down(hass, entry)


async def test_charger_is_added_to_a_bus_that_is_not_running(
    hass: HomeAssistant,
) -> None:
    entry = await setup_bus(hass, "abl", NOWHERE)
    assert entry.state is ConfigEntryState.SETUP_RETRY
    flow = await Flow.add_charger(hass, entry)
    assert flow.step == "manual"
    assert not flow.errors
    await flow.submit({"device_id": "3"})
    await flow.submit(charger("Three"))
    await flow.submit()
    await hass.async_block_till_done()
    assert get(entry, "Three").data["address"] == 3


async def test_evbox_is_added_without_a_search(hass: HomeAssistant) -> None:
    first, second = EvboxChargePoint(1923054), EvboxChargePoint(777)
    with VirtualBus.in_loop(first, second) as bus:
        known = stored_charger("evbox", 1923054, serial="1923054")
        entry = await setup_bus(hass, "evbox", bus.url, known)
        flow = await Flow.add_charger(hass, entry)
        assert flow.step == "manual"
        await flow.submit({"serial_number": "seven"})
        assert flow.errors == {"serial_number": "bad_serial_number"}
        await flow.submit({"serial_number": ""})
        assert flow.errors == {"serial_number": "no_address"}
        await flow.submit({"serial_number": "01923054"})
        assert flow.errors == {"serial_number": "address_taken"}
        await flow.submit({"serial_number": "0"})
        assert flow.errors == {"serial_number": "any_not_alone"}
        await flow.submit({"serial_number": "777"})
        assert not second.orders
        typed = charger("Second", fail_safe_current=0, fail_safe_timeout=60)
        await flow.submit(typed | {"expert": {"command": "69"}})
        assert flow.errors == {"base": "command_not_alone"}
        await flow.submit(typed)
        assert flow.step == "confirm_evbox"
        await flow.submit()
        await hass.async_block_till_done()
        assert get(entry, "Second").unique_id == "evbox_777"
        # What was confirmed is what it is told, first of all.
        await bus.wait_for_async(lambda: second.orders)
        assert second.orders[0].limits == (0, 0, 0)
        assert second.orders[0].fallback == (0, 0, 0)
        assert second.orders[0].timeout == 60
        assert bus.opened == 1
        await take_down(hass, entry)


async def test_no_second_evbox_beside_one_that_speaks_to_everybody(
    hass: HomeAssistant,
) -> None:
    only = stored_charger("evbox", 1923054, serial="1923054", command=69)
    entry = await setup_bus(hass, "evbox", NOWHERE, only)
    flow = await Flow.add_charger(hass, entry)
    await flow.submit({"serial_number": "777"})
    await flow.submit(charger("Second", fail_safe_timeout=60))
    assert flow.errors == {"base": "command_not_alone"}
    flow.abort()


# -- Changing ---------------------------------------------------------------------


def changed(**more: object) -> dict[str, Any]:
    return {
        "name": "Box",
        "device_id": "1",
        "installation_limit": 16,
        "expert": {"poll_interval": 0.2, "voltage": 230, "phase_order": "123"},
    } | more


async def test_abl_charger_is_changed_in_place(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(abl(1), abl(2)) as bus:
        entry = await abl_bus(hass, bus, 1, 2)
        one = get(entry, "Charger 1")
        flow = await Flow.change_charger(hass, entry, one)
        assert flow.step == "change"
        assert flow.result["menu_options"] == ["settings", "new_address", "replace"]
        await flow.choose("settings")
        assert flow.step == "reconfigure"
        assert fields(flow) == {
            "name": "Charger 1",
            "device_id": "1",
            "installation_limit": 16,
            "expert": {
                "poll_interval": 0.1,
                "voltage": 230,
                "phase_order": "123",
                "enable_again": False,
            },
        }
        await flow.submit(changed(device_id="2"))
        assert flow.errors == {"device_id": "address_taken"}
        await flow.submit(changed(name=" ", installation_limit="nan"))
        assert flow.errors == {
            "name": "name_empty",
            "installation_limit": "not_a_number",
        }
        expert = {"poll_interval": 0.5, "voltage": 240, "order_lifetime": 30}
        await flow.submit(
            changed(
                name="Car port",
                installation_limit=10,
                expert=expert | {"phase_order": "312", "enable_again": True},
            )
        )
        assert flow.result["reason"] == "reconfigure_successful"
        await hass.async_block_till_done()
        assert one.subentry_id in entry.subentries
        one = get(entry, "Car port")
        assert one.unique_id == f"abl_{serial(1)}"
        assert one.data == {
            "address": 1,
            "serial": serial(1),
            "identity": f"abl_{serial(1)}",
            "installation_limit": 10,
            "voltage": 240,
            "poll_interval": 0.5,
            "order_lifetime": 30,
            "fail_safe_current": 6,
            "phase_order": [3, 1, 2],
            "enable_again": True,
        }
        running = entry.runtime_data.bus.chargers[one.subentry_id]
        assert running.config.installation_limit == 10
        assert running.config.order_lifetime == 30 * 60
        assert bus.opened == 1

        # What was set once can be taken away again.
        flow = await Flow.change_charger(hass, entry, one)
        await flow.choose("settings")
        await flow.reload()
        assert fields(flow)["expert"]["order_lifetime"] == 30
        await flow.submit(changed(name="Car port", installation_limit=10))
        await hass.async_block_till_done()
        assert get(entry, "Car port").data["order_lifetime"] is None
        await take_down(hass, entry)


async def test_serial_number_can_be_typed_as_long_as_it_is_not_known(
    hass: HomeAssistant,
) -> None:
    beside = stored_charger("abl", 2, serial=serial(2), title="Beside")
    entry = await setup_bus(hass, "abl", NOWHERE, stored_charger("abl", 1), beside)
    flow = await Flow.change_settings(hass, entry, get(entry, "Charger 1"))
    await flow.submit(changed(serial=f" {serial(2)} "))
    assert flow.errors == {"base": "box_already_set_up"}
    assert flow.tells("Beside (Bus)")
    await flow.submit(changed(serial=f" {serial(1)} "))
    assert flow.result["reason"] == "reconfigure_successful"
    box = get(entry, "Box")
    assert box.data["serial"] == serial(1)
    # Its entities stay what they are.
    assert "identity" not in box.data
    assert box.unique_id is None
    flow = await Flow.change_settings(hass, entry, box)
    assert "serial" not in fields(flow)


async def test_abl_box_is_replaced_by_whichever_answers(hass: HomeAssistant) -> None:
    entry = await setup_bus(
        hass, "abl", NOWHERE, stored_charger("abl", 1, serial=serial(1))
    )
    flow = await Flow.replace_charger(hass, entry, get(entry, "Charger 1"))
    await flow.submit({"serial": serial(1)})
    assert flow.errors == {"serial": "same_box"}
    await flow.submit({})
    assert flow.result["reason"] == "reconfigure_successful"
    box = get(entry, "Charger 1")
    assert (box.data["serial"], box.data["address"]) == (None, 1)
    assert box.unique_id is None
    # Another box, of which nothing is known yet.
    assert box.data["identity"] not in (f"abl_{serial(1)}", box.subentry_id)


async def test_lower_limit_takes_the_fail_safe_current_with_it(
    hass: HomeAssistant,
) -> None:
    known = stored_charger(
        "evbox", 42, serial="42", title="Box", fail_safe_current=10.0
    )
    entry = await setup_bus(hass, "evbox", NOWHERE, known)
    flow = await Flow.change_settings(hass, entry, get(entry, "Box"))
    offered = fields(flow)
    assert "serial_number" not in offered
    assert offered["expert"]["command"] == "68"
    assert offered["expert"]["information"] == "00" * 16
    await flow.submit(
        {
            "name": "Box",
            "installation_limit": 8,
            "expert": {"command": "69", "information": "FF" * 16},
        }
    )
    assert flow.result["reason"] == "reconfigure_successful"
    box = get(entry, "Box")
    assert box.unique_id == "evbox_42"
    assert box.data["address"] == 42
    assert box.data["serial"] == "42"
    assert box.data["installation_limit"] == 8
    assert box.data["fail_safe_current"] == 8
    assert box.data["fail_safe_timeout"] == 60
    assert box.data["command"] == 69
    assert box.data["information"] == "FF" * 16


async def test_evbox_is_replaced_by_another_serial_number(hass: HomeAssistant) -> None:
    beside = stored_charger("evbox", 7, serial="7", title="Beside")
    known = stored_charger("evbox", 42, serial="42", title="Box")
    entry = await setup_bus(hass, "evbox", NOWHERE, known, beside)
    flow = await Flow.replace_charger(hass, entry, get(entry, "Box"))
    for wrong, error in (
        ("7", "address_taken"),
        ("42", "same_box"),
        ("0", "any_not_alone"),
        ("x", "bad_serial_number"),
    ):
        await flow.submit({"serial_number": wrong})
        assert flow.errors == {"serial_number": error}
    await flow.submit({"serial_number": "00000043"})
    assert flow.result["reason"] == "reconfigure_successful"
    box = get(entry, "Box")
    assert box.unique_id == box.data["identity"] == "evbox_43"
    assert (box.data["address"], box.data["serial"]) == (43, "43")
