"""Adding an EWS-Box on RS-232, as a person does it in the frontend."""

from pathlib import Path
from typing import TYPE_CHECKING

from homeassistant.config_entries import ConfigEntryState
from homeassistant.data_entry_flow import FlowResultType
import pytest

from tests.common import get_entity, wait_for_state, wait_until
from tests.flow import Flow, box as typed_box, ews_step, fields
from tests.virtual import EwsBox, VirtualBus

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

pytestmark = pytest.mark.usefixtures("quick_search")

SERIAL = "012345678901"
FAST = {"poll_interval": 0.2}
READS = {"id", "rs", "rp", "rz"}
"""All that a search may say."""


async def searched(hass: HomeAssistant, bus: VirtualBus) -> Flow:
    flow = await ews_step(hass, "ews_serial", bus.url)
    assert flow.step == "scan"
    return await flow.wait()


async def by_hand(hass: HomeAssistant, bus: VirtualBus) -> Flow:
    """Go past the search, which finds nobody, to the form for a box."""
    flow = await searched(hass, bus)
    assert flow.step == "nothing_found"
    await flow.choose("manual")
    assert flow.step == "box"
    return flow


def table(flow: Flow) -> str:
    return flow.result["description_placeholders"]["chargers"]


# -- Search ------------------------------------------------------------------------


async def test_box_is_found_added_and_runs(hass: HomeAssistant) -> None:
    box = EwsBox(serial=SERIAL, jumper=20, max_current=13)
    box.extra.max_current_2 = 10
    with VirtualBus.in_loop(box) as bus:
        flow = await searched(hass, bus)
        assert flow.progress == sorted(flow.progress)
        assert flow.progress[-1] == 1
        assert flow.step == "select"
        # What its ports may carry is asked once, in the next form.
        assert fields(flow) == {"chargers": SERIAL}
        [option] = flow.result["data_schema"].schema["chargers"].config["options"]
        assert SERIAL in option["label"]
        assert "EWS-Box, firmware M165300103" in option["label"]
        await bus.wait_for_async(lambda: not bus.connected)
        assert {one.name for one in box.commands} <= READS

        await flow.submit({"chargers": SERIAL})
        assert flow.step == "box"
        assert flow.tells(SERIAL, "firmware M165300103", "for each port: 13 A + 10 A")
        # Nothing that it has told is asked, and no more offered than it can.
        assert fields(flow) == {
            "name": "EWS-Box",
            "ports": "2",
            "installation_limit": 13,
            "installation_limit_2": 10,
            "fail_safe_current": 6,
            "expert": {"poll_interval": 2},
        }
        assert "box_serial" not in flow.result["data_schema"].schema
        more = {"fail_safe_current": 8, "expert": FAST | {"order_lifetime": 15}}
        await flow.submit(typed_box(" Yard ", 13, 9, **more))

        # Nothing is taken for a confirmation that is none.
        await flow.reload()
        assert flow.step == "confirm_ews"
        assert table(flow) == f"| Yard | {SERIAL} | 13 A + 9 A | 8 A |"
        assert flow.tells("10 minutes", "unlocks the cable", "jumper")
        assert not box.writes
        await flow.submit()

        assert flow.result["type"] is FlowResultType.CREATE_ENTRY
        entry = flow.result["result"]
        assert entry.title == f"EWS-Box bus ({Path(bus.url).name})"
        assert entry.data == {"protocol": "ews", "device": bus.url}
        [yard] = entry.subentries.values()
        assert (yard.title, yard.unique_id) == ("Yard", f"ews_{SERIAL}")
        assert yard.subentry_type == "charger"
        assert yard.data == {
            "address": SERIAL,
            "serial": SERIAL,
            "identity": f"ews_{SERIAL}",
            "ports": 2,
            "installation_limit": 13,
            "installation_limit_2": 9,
            "poll_interval": 0.2,
            "order_lifetime": 15,
            "fail_safe_current": 8,
        }

        await hass.async_block_till_done()
        assert entry.state is ConfigEntryState.LOADED
        for port in (1, 2):
            status = await get_entity(hass, "sensor", entry, f"{port}_status")
            await wait_for_state(hass, status, "available")
        # Each port begins with what was confirmed.
        for port in (1, 2):
            await bus.wait_for_async(
                lambda port=port: [
                    one.amps for one in box.currents_set if one.port == port
                ]
            )
        assert {one.amps for one in box.currents_set} == {8}
        assert await hass.config_entries.async_unload(entry.entry_id)


async def test_box_with_one_port_is_one_charger(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(EwsBox(serial=SERIAL, ports=1)) as bus:
        flow = await searched(hass, bus)
        await flow.submit({"chargers": SERIAL})
        assert flow.tells("for each port: 32 A.")
        offered = fields(flow)
        assert offered["ports"] == "1"
        assert offered["installation_limit"] == 16
        assert "installation_limit_2" not in offered
        await flow.submit(typed_box("Garage", 16, expert=FAST))
        assert table(flow) == f"| Garage | {SERIAL} | 16 A | 6 A |"
        await flow.submit()
        entry = flow.result["result"]
        [garage] = entry.subentries.values()
        assert garage.data["ports"] == 1
        assert "installation_limit_2" not in garage.data
        await hass.async_block_till_done()
        [managed] = entry.runtime_data.chargers.values()
        assert managed.name == "Garage"
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "available")
        assert await hass.config_entries.async_unload(entry.entry_id)


@pytest.mark.usefixtures("not_set_up")
async def test_household_socket_is_offered_what_it_needs(hass: HomeAssistant) -> None:
    box = EwsBox(serial=SERIAL, jumper=32, max_current=10, mode1=(False, True))
    with VirtualBus.in_loop(box) as bus:
        flow = await searched(hass, bus)
        await flow.submit({"chargers": SERIAL})
        assert flow.tells("for each port: 10 A + 16 A")
        assert fields(flow)["installation_limit"] == 10
        assert fields(flow)["installation_limit_2"] == 16
        flow.abort()


# -- Nobody there ------------------------------------------------------------------


async def test_nobody_answers_then_the_first_box_that_comes_is_kept(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(baud=115200) as bus:
        flow = await searched(hass, bus)
        assert flow.step == "nothing_found"
        assert flow.result["menu_options"] == ["scan", "manual", "port"]
        assert flow.tells("TxD and RxD", "configuration bridge", "115200 8N1", bus.url)

        await flow.choose("manual")
        assert flow.step == "box"
        assert flow.tells("serial number ?, firmware ?", "maximum", ": ?.")
        assert fields(flow) == {
            "name": "EWS-Box",
            "box_serial": "",
            "ports": "2",
            "installation_limit": 16,
            "installation_limit_2": 16,
            "fail_safe_current": 6,
            "expert": {"poll_interval": 2},
        }
        await flow.submit(typed_box("Yard", 16, 16, box_serial=" ", expert=FAST))
        assert table(flow) == "| Yard | - | 16 A + 16 A | 6 A |"
        await flow.submit()
        entry = flow.result["result"]
        [yard] = entry.subentries.values()
        assert (yard.data["address"], yard.data["serial"]) == ("", None)
        assert yard.unique_id is None
        await hass.async_block_till_done()
        assert entry.state is ConfigEntryState.LOADED

        first = EwsBox(serial=SERIAL)
        bus.add(first)

        def is_known() -> bool:
            [box] = entry.subentries.values()
            return box.data["serial"] is not None

        await wait_until(hass, is_known)
        [yard] = entry.subentries.values()
        assert yard.data["serial"] == SERIAL
        # Its entities stay what they are.
        assert yard.unique_id is None
        # From now on it is this one, and no other.
        chargers = entry.runtime_data.chargers.values()
        await wait_until(
            hass, lambda: all(one.charger.config.serial == SERIAL for one in chargers)
        )

        # Changing a name does not lose it.
        opened = bus.opened
        flow = await Flow.change_settings(hass, entry, yard)
        assert "box_serial" not in fields(flow)
        typed = typed_box("Garden", 16, 16, expert=FAST)
        del typed["fail_safe_current"]
        await flow.submit(typed)
        assert flow.result["reason"] == "reconfigure_successful"
        await hass.async_block_till_done()
        [garden] = entry.subentries.values()
        assert (garden.title, garden.data["serial"]) == ("Garden", SERIAL)
        assert garden.unique_id is None
        assert bus.opened == opened
        assert await hass.config_entries.async_unload(entry.entry_id)


@pytest.mark.usefixtures("not_set_up")
async def test_searching_again_finds_a_box_switched_on_meanwhile(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(baud=115200) as bus:
        flow = await searched(hass, bus)
        assert flow.step == "nothing_found"
        bus.add(EwsBox(serial=SERIAL))
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        flow.abort()


@pytest.mark.usefixtures("not_set_up")
async def test_answers_that_make_no_sense(hass: HomeAssistant) -> None:
    box = EwsBox(serial=SERIAL)
    box.faults.byte_error_rate = 0.5
    with VirtualBus.in_loop(box) as bus:
        flow = await searched(hass, bus)
        assert flow.step == "unreadable"
        assert flow.result["menu_options"] == ["scan", "manual", "port"]
        assert flow.tells("115200 8N1", bus.url)
        flow.abort()


# -- What is refused ---------------------------------------------------------------


@pytest.mark.usefixtures("not_set_up")
async def test_what_is_wrong_with_the_form_is_said_at_its_field(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(baud=115200) as bus:
        flow = await by_hand(hass, bus)
        for wrong, errors in (
            ({"box_serial": "12-34"}, {"box_serial": "bad_box_serial"}),
            ({"box_serial": "1234567890123"}, {"box_serial": "bad_box_serial"}),
            ({"name": " "}, {"name": "name_empty"}),
            ({"installation_limit": "nan"}, {"installation_limit": "not_a_number"}),
            ({"installation_limit_2": "nan"}, {"installation_limit_2": "not_a_number"}),
            ({"fail_safe_current": "nan"}, {"fail_safe_current": "not_a_number"}),
            (
                {"fail_safe_current": 13.1},
                {"fail_safe_current": "above_second_limit"},
            ),
            (
                {"fail_safe_current": 16.1},
                {"fail_safe_current": "above_installation_limit"},
            ),
            ({"expert": {"poll_interval": "nan"}}, {"base": "expert_not_a_number"}),
            ({"expert": {"order_lifetime": "nan"}}, {"base": "expert_not_a_number"}),
        ):
            typed = typed_box("Yard", 16, 13, box_serial=SERIAL) | wrong
            await flow.submit(typed)
            assert flow.step == "box"
            assert flow.errors == errors, wrong

        # What was typed is still there, and nothing is filled in that was not.
        await flow.submit(typed_box("Yard", 15, ports="2"))
        assert fields(flow)["installation_limit"] == 15
        assert flow.errors == {"installation_limit_2": "second_limit_missing"}
        assert "installation_limit_2" not in fields(flow)

        # Nobody asks for the limit of a port that is not used.
        await flow.submit(typed_box("Yard", 10, box_serial="AB12", ports="1"))
        assert flow.step == "confirm_ews"
        assert table(flow) == "| Yard | AB12 | 10 A | 6 A |"
        await flow.submit()
    [yard] = flow.result["result"].subentries.values()
    assert yard.data["serial"] == "AB12"
    assert yard.unique_id == "ews_AB12"
    assert "installation_limit_2" not in yard.data
