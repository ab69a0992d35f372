"""Adding a bus of ABL boxes, as a person does it in the frontend."""

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

from homeassistant.data_entry_flow import FlowResultType
import pytest

from custom_components.evse_bus.evse.protocols import PROTOCOLS
from tests.common import bus_entry, charger as stored_charger
from tests.flow import NOWHERE, charger, fields, port_step
from tests.virtual import (
    AblBox,
    VirtualBus,
    requests_in,
)

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant


pytestmark = pytest.mark.usefixtures("not_set_up", "quick_search")


async def test_abl_boxes_are_found_and_added(hass: HomeAssistant) -> None:
    boxes = (
        AblBox(1, serial="2W22xy00000001"),
        AblBox(5, serial="2W22xy00000005"),
        AblBox(16, serial="2W22xy00000016"),
    )
    with VirtualBus.in_loop(*boxes) as bus:
        flow = await port_step(hass, "abl", bus.url)
        assert flow.step == "scan"
        await flow.wait()

        assert flow.step == "select"
        assert fields(flow) == {
            "chargers": ["1", "5", "16"],
            "installation_limit": 16,
        }
        assert flow.progress == sorted(flow.progress)
        assert flow.progress[-1] == 1
        await bus.wait_for_async(lambda: not bus.connected)
        assert not any(box.writes for box in boxes)

        await flow.submit({"chargers": ["5", "16"], "installation_limit": 13})
        assert flow.step == "charger"
        assert fields(flow)["installation_limit"] == 13
        assert flow.tells("Charger 1 of 2", "2W22xy00000005")
        await flow.submit(charger(" Left ", 13))
        assert flow.step == "charger"
        assert flow.tells("Charger 2 of 2")
        await flow.submit(
            charger(
                "Right",
                10,
                fail_safe_current=8,
                expert={
                    "poll_interval": 3,
                    "voltage": 235,
                    "order_lifetime": 15,
                    "phase_order": "321",
                },
            )
        )

        # Nothing is taken for a confirmation that is none.
        await flow.reload()
        assert flow.step == "confirm_abl"
        table = flow.result["description_placeholders"]["chargers"]
        assert table == "| Left | 5 | 13 A | 6 A |\n| Right | 16 | 10 A | 8 A |"
        assert flow.tells("full current", "F4")
        await flow.submit()

    assert flow.result["type"] is FlowResultType.CREATE_ENTRY
    entry = flow.result["result"]
    assert entry.title == f"ABL bus ({Path(bus.url).name})"
    assert entry.unique_id is None
    assert entry.data == {"protocol": "abl", "device": bus.url}
    left, right = entry.subentries.values()
    assert (left.title, left.unique_id) == ("Left", "abl_2W22xy00000005")
    assert left.subentry_type == "charger"
    assert left.data == {
        "address": 5,
        "serial": "2W22xy00000005",
        "identity": "abl_2W22xy00000005",
        "installation_limit": 13,
        "voltage": 230,
        "poll_interval": PROTOCOLS["abl"]
        .config(key="", name="", address=1)
        .poll_interval,
        "order_lifetime": None,
        "fail_safe_current": 6,
        "phase_order": [3, 2, 1],
        "enable_again": False,
    }
    assert (right.title, right.unique_id) == ("Right", "abl_2W22xy00000016")
    assert right.data["address"] == 16
    assert right.data["poll_interval"] == 3
    assert right.data["voltage"] == 235
    assert right.data["order_lifetime"] == 15
    assert right.data["phase_order"] == [3, 2, 1]


async def test_nobody_answers_then_typed_in_by_hand(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(parity="E") as bus:
        flow = await port_step(hass, "abl", bus.url)
        await flow.wait()
        assert flow.step == "nothing_found"
        assert flow.result["menu_options"] == ["scan", "manual", "port"]
        assert flow.tells("38400 8E1", bus.url)

        await flow.choose("manual")
        await flow.submit({"device_ids": []})
        assert flow.errors == {"device_ids": "no_address"}
        await flow.submit({"device_ids": ["2", "3"]})
        await flow.submit(charger("Two"))
        await flow.submit(charger("Three"))
        await flow.submit()

    two, three = flow.result["result"].subentries.values()
    assert (two.data["address"], two.data["serial"]) == (2, None)
    assert (three.title, three.unique_id) == ("Three", None)


async def test_searching_again_finds_a_box_switched_on_meanwhile(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(parity="E") as bus:
        flow = await port_step(hass, "abl", bus.url)
        await flow.wait()
        assert flow.step == "nothing_found"
        bus.add(AblBox(1))
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        flow.abort()


async def test_box_that_another_bus_has_is_shown_and_not_offered(
    hass: HomeAssistant,
) -> None:
    here = stored_charger("abl", 9, serial="2W22xy00000005", title="Left")
    bus_entry("abl", NOWHERE, here, title="Garage").add_to_hass(hass)
    moved = AblBox(5, serial="2W22xy00000005")
    with VirtualBus.in_loop(moved) as bus:
        flow = await port_step(hass, "abl", bus.url)
        await flow.wait()
        assert flow.step == "nothing_new"
        assert flow.result["menu_options"] == ["scan", "manual", "port"]
        assert flow.tells("Left (Garage)", "remove it where it is set up")
        bus.add(AblBox(6, serial="2W22xy00000006"))
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        assert flow.tells("Already set up: Left (Garage)")
        assert fields(flow)["chargers"] == ["6"]
        await flow.submit({"chargers": ["6"], "installation_limit": 16})
        assert flow.step == "charger"
        flow.abort()
        assert not moved.writes


async def test_typed_by_hand_keeps_the_serial_that_was_read(
    hass: HomeAssistant,
) -> None:
    twin = AblBox(1, serial="2W22xy00000001")
    other = AblBox(1, serial="2W22xy00000002")
    third = AblBox(4, serial="2W22xy00000004")
    with VirtualBus.in_loop(twin, other, third) as bus:
        flow = await port_step(hass, "abl", bus.url)
        await flow.wait()
        assert flow.step == "duplicates"
        assert flow.result["menu_options"] == [
            *("sort_out", "select", "scan", "manual", "port"),
        ]
        await flow.choose("manual")
        await flow.submit({"device_ids": ["4", "1"]})
        assert flow.tells("2W22xy00000004")
        await flow.submit(charger("Four"))
        await flow.submit(charger("One"))
        await flow.submit()
    four, one = flow.result["result"].subentries.values()
    assert four.unique_id == "abl_2W22xy00000004"
    assert one.unique_id is None


async def test_two_boxes_with_one_id_are_told_and_not_written_to(
    hass: HomeAssistant,
) -> None:
    twins = AblBox(1, serial="2W22xy00000001"), AblBox(1, serial="2W22xy00000002")
    with VirtualBus.in_loop(*twins) as bus:
        flow = await port_step(hass, "abl", bus.url)
        await flow.wait()
        assert flow.step == "duplicates"
        assert flow.result["menu_options"] == ["sort_out", "scan", "manual", "port"]
        assert flow.result["description_placeholders"]["addresses"] == "1"
        assert not any(twin.writes for twin in twins)

        # One is switched off, as the text says: now there is just one.
        bus.remove(twins[1])
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        flow.abort()


async def test_the_others_can_be_added_beside_two_with_one_id(
    hass: HomeAssistant,
) -> None:
    boxes = AblBox(1, serial="2W22xy00000001"), AblBox(1, serial="2W22xy00000002")
    with VirtualBus.in_loop(*boxes, AblBox(7)) as bus:
        flow = await port_step(hass, "abl", bus.url)
        await flow.wait()
        await flow.choose("select")
        assert fields(flow)["chargers"] == ["7"]
        await flow.submit({"chargers": [], "installation_limit": 16})
        assert flow.errors == {"chargers": "nothing_chosen"}
        await flow.submit({"chargers": ["7"], "installation_limit": "nan"})
        assert flow.errors == {"installation_limit": "not_a_number"}
        await flow.submit({"chargers": ["7"], "installation_limit": 16})
        assert flow.step == "charger"
        flow.abort()


async def test_noise_in_place_of_answers_is_told_as_such(hass: HomeAssistant) -> None:
    boxes = tuple(AblBox(address) for address in range(1, 17))
    with VirtualBus.in_loop(*boxes) as bus:
        for box in boxes:
            # What an even parity looks like to who expects none, more or less.
            box.faults.byte_error_rate = 1.0
        flow = await port_step(hass, "abl", bus.url)
        await flow.wait()
        assert flow.step == "unreadable"
        assert flow.result["menu_options"] == ["scan", "manual", "port"]
        await flow.choose("port")
        assert flow.step == "port"
        flow.abort()


async def test_adapter_unplugged_during_the_search(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(parity="E") as bus:
        flow = await port_step(hass, "abl", bus.url)
        await bus.wait_for_async(lambda: len(requests_in(bus.log.bursts())) > 2)
        bus.unplug()
        await flow.wait()
        assert flow.step == "port"
        assert flow.errors == {"base": "port_lost"}
        # Said once.
        await flow.submit({"device": NOWHERE, "line": {}})
        assert flow.errors == {"base": "port_missing"}
        flow.abort()


async def test_port_gone_before_the_search(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(parity="E") as bus:
        flow = await port_step(hass, "abl", bus.url)
        await flow.wait()
        bus.unplug()
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "port"
        assert flow.errors == {"base": "port_missing"}
        flow.abort()


@pytest.mark.parametrize("after", [0, 1, 5])
async def test_closing_the_dialogue_in_mid_search_leaves_nothing_open(
    hass: HomeAssistant, after: int
) -> None:
    before = asyncio.all_tasks()
    with VirtualBus.in_loop(parity="E") as bus:
        flow = await port_step(hass, "abl", bus.url)
        await bus.wait_for_async(lambda: len(requests_in(bus.log.bursts())) >= after)
        flow.abort()
        await bus.wait_for_async(lambda: not bus.connected)
        left = asyncio.all_tasks() - before
        if left:
            _, left = await asyncio.wait(left, timeout=10)
        assert not left
        # The lock is gone too: who opens it next is not told that it is busy.
        again = await port_step(hass, "abl", bus.url)
        assert again.step == "scan"
        again.abort()
        await bus.wait_for_async(lambda: not bus.connected)
