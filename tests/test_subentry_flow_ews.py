"""Adding an EWS-Box to a listener that runs, and changing one, as a person does it."""

from typing import TYPE_CHECKING, Any

from homeassistant.config_entries import ConfigSubentry
from homeassistant.data_entry_flow import FlowResultType
from homeassistant.helpers import (
    device_registry as dr,
    entity_registry as er,
    issue_registry as ir,
)
import pytest

from custom_components.evse_bus.const import DOMAIN
from tests.common import (
    bus_entry,
    call,
    entity_id,
    get_entity,
    identity,
    running,
    setup_bus,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.flow import Flow, box as typed_box, fields, offers
from tests.listening import (
    OTHER,
    SERIAL,
    dialling,
    listener_of,
    listening,
    offered,
    stored_box,
)
from tests.virtual import EwsBox, VirtualBus

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant
    from pytest_homeassistant_custom_component.common import MockConfigEntry

pytestmark = pytest.mark.usefixtures("socket_enabled", "quick_search")

FAST = {"poll_interval": 0.2}
BY_HAND = "/dev/serial/by-id/usb-none"


def get(entry: MockConfigEntry, title: str) -> ConfigSubentry:
    return next(one for one in entry.subentries.values() if one.title == title)


def changed(name: str, *limits: float, **more: object) -> dict[str, Any]:
    """Return what is typed to change a box; its fail-safe is an entity by now."""
    typed = typed_box(name, *limits, **{"expert": FAST, **more})
    del typed["fail_safe_current"]
    return typed


async def change(
    hass: HomeAssistant, entry: MockConfigEntry, typed: dict[str, Any]
) -> None:
    [box] = entry.subentries.values()
    flow = await Flow.change_settings(hass, entry, box)
    await flow.submit(typed)
    assert flow.result["reason"] == "reconfigure_successful", flow.errors
    await hass.async_block_till_done()


def port_device(
    hass: HomeAssistant, entry: MockConfigEntry, port: int
) -> dr.ChildDeviceEntry | None:
    return dr.async_get(hass).async_get_child_device_by_identifier(
        (DOMAIN, f"{identity(entry)}_{port}"), entry.entry_id
    )


# -- Adding ------------------------------------------------------------------------


async def test_box_is_added_before_it_dials(hass: HomeAssistant) -> None:
    async with listening(hass) as entry:
        flow = await Flow.add_charger(hass, entry)
        assert flow.step == "manual"
        await flow.submit({"box_serial": "0123-4567"})
        assert flow.errors == {"box_serial": "bad_box_serial"}
        await flow.submit({"box_serial": " "})
        assert flow.errors == {"box_serial": "no_address"}
        await flow.submit({"box_serial": f" {SERIAL} "})
        assert flow.step == "box"
        assert flow.tells(SERIAL, "firmware ?")
        assert "box_serial" not in flow.result["data_schema"].schema
        assert fields(flow)["name"] == f"EWS-Box {SERIAL[-8:]}"
        await flow.submit(typed_box("Yard", 13, 10, expert=FAST))
        assert flow.step == "confirm_ews_network"
        assert flow.tells(f"| Yard | {SERIAL} | 13 A + 10 A | 6 A |")
        await flow.submit()
        assert flow.result["type"] is FlowResultType.CREATE_ENTRY
        await hass.async_block_till_done()
        yard = get(entry, "Yard")
        assert yard.unique_id == f"ews_{SERIAL}"
        assert (yard.data["address"], yard.data["serial"]) == (SERIAL, SERIAL)
        assert yard.data["installation_limit_2"] == 10

        with dialling(entry):
            for port in (1, 2):
                status = await get_entity(hass, "sensor", entry, f"{port}_status")
                await wait_for_state(hass, status, "available")
            assert not offers(hass)


async def test_box_that_has_dialled_is_chosen_from_the_list(
    hass: HomeAssistant,
) -> None:
    async with listening(hass, stored_box(OTHER)) as entry:
        with dialling(entry) as dialler, dialling(entry, EwsBox(serial=OTHER)):
            await offered(hass)
            flow = await Flow.add_charger(hass, entry)
            assert flow.step == "manual"
            field = flow.result["data_schema"].schema["box_serial"]
            # The one that is set up is not in it, and others can be typed.
            assert field.config["options"] == [SERIAL]
            assert field.config["custom_value"]
            await flow.submit({"box_serial": SERIAL})
            assert flow.tells(SERIAL, "firmware M165300103")
            await flow.submit(typed_box("New", 16, expert=FAST))
            await flow.submit()
            await hass.async_block_till_done()
            assert get(entry, "New").unique_id == f"ews_{SERIAL}"
            status = await get_entity(hass, "sensor", entry, "1_status", index=1)
            await wait_for_state(hass, status, "available")
            assert dialler.attempts == 1


async def test_box_is_added_while_the_listener_is_off(hass: HomeAssistant) -> None:
    async with listening(hass) as entry:
        assert await hass.config_entries.async_unload(entry.entry_id)
        flow = await Flow.add_charger(hass, entry)
        await flow.submit({"box_serial": SERIAL})
        await flow.submit(typed_box("Yard", 16))
        await flow.submit()
        assert get(entry, "Yard").data["serial"] == SERIAL


async def test_box_that_is_set_up_is_not_added_twice(hass: HomeAssistant) -> None:
    serial_line = bus_entry("ews", BY_HAND, stored_box(OTHER), entry_id="serial")
    serial_line.add_to_hass(hass)
    async with listening(hass, stored_box(SERIAL)) as entry:
        flow = await Flow.add_charger(hass, entry)
        await flow.submit({"box_serial": SERIAL})
        assert flow.errors == {"box_serial": "address_taken"}
        await flow.submit({"box_serial": OTHER})
        assert flow.errors == {"box_serial": "box_already_set_up"}

        # Neither by two dialogues at once.
        first, second = [await Flow.add_charger(hass, entry) for _ in range(2)]
        for one in (first, second):
            await one.submit({"box_serial": "AB"})
            await one.submit(typed_box("Yard", 16))
            assert one.step == "confirm_ews_network"
        await first.submit()
        assert first.result["type"] is FlowResultType.CREATE_ENTRY
        await second.submit()
        assert second.result["reason"] == "already_configured"
        flow.abort()


async def test_one_box_on_a_serial_line(hass: HomeAssistant) -> None:
    async with running(hass, EwsBox(serial=SERIAL)) as (entry, _):
        flow = await Flow.add_charger(hass, entry)
        assert flow.result["type"] is FlowResultType.ABORT
        assert flow.result["reason"] == "one_ews"


async def test_serial_line_without_a_box_is_searched(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(EwsBox(serial=SERIAL, jumper=10)) as bus:
        entry = await setup_bus(hass, "ews", bus.url)
        flow = await Flow.add_charger(hass, entry)
        assert flow.step == "user"
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        assert fields(flow) == {"chargers": SERIAL}
        await flow.submit({"chargers": SERIAL})
        assert fields(flow)["installation_limit"] == 10
        await flow.submit(typed_box("Yard", 10, 10, expert=FAST))
        assert flow.step == "confirm_ews"
        await flow.submit()
        await hass.async_block_till_done()
        await get_entity(hass, "sensor", entry, "2_status")
        assert bus.opened == 1
        assert await hass.config_entries.async_unload(entry.entry_id)


# -- Changing ----------------------------------------------------------------------


async def test_name_and_limits_are_changed_in_place(hass: HomeAssistant) -> None:
    box = EwsBox(serial=SERIAL)
    async with listening(hass, stored_box(SERIAL, poll_interval=0.2)) as entry:
        with dialling(entry, box) as dialler:
            number = await get_entity(hass, "number", entry, "2_charging_current")
            assert hass.states.get(number).attributes["max"] == 16
            ports = {
                managed.charger for managed in entry.runtime_data.chargers.values()
            }

            [stored] = entry.subentries.values()
            flow = await Flow.change_settings(hass, entry, stored)
            assert flow.step == "reconfigure_box"
            assert fields(flow) == {
                "name": "Yard",
                "ports": "2",
                "installation_limit": 16,
                "installation_limit_2": 16,
                "expert": {"poll_interval": 0.2},
            }
            for wrong, errors in (
                ({"name": " "}, {"name": "name_empty"}),
                (
                    {"installation_limit_2": "nan"},
                    {"installation_limit_2": "not_a_number"},
                ),
            ):
                await flow.submit(changed("Garden", 13, 10) | wrong)
                assert flow.errors == errors, wrong
            await flow.submit(changed("Garden", 13, ports="2"))
            assert flow.errors == {"installation_limit_2": "second_limit_missing"}
            await flow.submit(changed(" Garden ", 13, 10))
            assert flow.result["reason"] == "reconfigure_successful"
            await hass.async_block_till_done()

            garden = get(entry, "Garden")
            assert garden.data["installation_limit"] == 13
            assert garden.data["installation_limit_2"] == 10
            assert garden.data["fail_safe_current"] == 6
            assert garden.unique_id == f"ews_{SERIAL}"
            chargers = entry.runtime_data.chargers.values()
            assert {managed.charger for managed in chargers} == ports
            assert [managed.name for managed in chargers] == ["Garden 1", "Garden 2"]
            assert hass.states.get(number).attributes["max"] == 10
            assert dialler.attempts == 1


async def test_second_port_goes_and_comes_back(hass: HomeAssistant) -> None:
    box = EwsBox(serial=SERIAL)
    async with listening(hass, stored_box(SERIAL, poll_interval=0.2)) as entry:
        with dialling(entry, box) as dialler:
            key = "charging_current"
            numbers = [
                await get_entity(hass, "number", entry, f"{port}_{key}")
                for port in (1, 2)
            ]
            for entity, amps in zip(numbers, (11, 9), strict=True):
                await call(hass, "number.set_value", entity, value=amps)
            first = entry.runtime_data.chargers[f"ews{SERIAL[-2:]}_1"].charger
            one_device = port_device(hass, entry, 1)
            assert one_device is not None
            assert port_device(hass, entry, 2) is not None

            await change(hass, entry, changed("Yard", 16))
            [stored] = entry.subentries.values()
            assert stored.data["ports"] == 1
            assert "installation_limit_2" not in stored.data
            assert port_device(hass, entry, 2) is None
            assert entity_id(hass, "number", entry, f"2_{key}") is None
            assert hass.states.get(numbers[1]) is None
            registry = er.async_get(hass)
            assert not [
                one.entity_id
                for one in registry.entities.values()
                if one.unique_id.startswith(f"{identity(entry)}_2")
            ]
            # The other one has not noticed anything.
            [managed] = entry.runtime_data.chargers.values()
            assert managed.charger is first
            assert managed.charger.available
            assert state_of(hass, numbers[0]) == "11.0"
            assert port_device(hass, entry, 1) == one_device
            assert dialler.attempts == 1
            flow = await Flow.change_settings(hass, entry, stored)
            assert fields(flow)["ports"] == "1"
            # There is no limit of a port that is not used.
            assert "installation_limit_2" not in fields(flow)
            flow.abort()

            await change(hass, entry, changed("Yard", 16, 13))
            back = await get_entity(hass, "number", entry, f"2_{key}")
            assert port_device(hass, entry, 2) is not None
            # Its orders are those of the box's serial number, so they are kept.
            assert state_of(hass, back) == "9.0"
            assert hass.states.get(back).attributes["max"] == 13
            assert state_of(hass, numbers[0]) == "11.0"
            assert (
                entry.runtime_data.chargers[f"{stored.subentry_id}_1"].charger is first
            )
            assert dialler.attempts == 1
            # The repair that asks for lost orders is not for it.
            assert not ir.async_get(hass).issues


async def test_box_is_replaced_by_one_that_has_dialled(hass: HomeAssistant) -> None:
    old, new = EwsBox(serial=SERIAL), EwsBox(serial=OTHER)
    async with listening(hass, stored_box(SERIAL, poll_interval=0.2)) as entry:
        with dialling(entry, old), dialling(entry, new):
            status = await get_entity(hass, "sensor", entry, "1_status")
            await offered(hass, OTHER)
            flow = await Flow.replace_charger(hass, entry, get(entry, "Yard"))
            assert flow.tells(SERIAL, "It starts with 6 A")
            for wrong, error in (
                ("-", "bad_box_serial"),
                ("", "no_address"),
                (SERIAL, "same_box"),
            ):
                await flow.submit({"box_serial": wrong})
                assert flow.errors == {"box_serial": error}
            await flow.submit({"box_serial": OTHER})
            assert flow.result["reason"] == "reconfigure_successful"
            await hass.async_block_till_done()
            [stored] = entry.subentries.values()
            assert stored.title == "Yard"
            assert stored.unique_id == stored.data["identity"] == f"ews_{OTHER}"
            assert (stored.data["address"], stored.data["serial"]) == (OTHER, OTHER)
            assert stored.data["poll_interval"] == 0.2
            # The new one is no longer offered, and the old one is.
            await offered(hass, SERIAL)
            await wait_until(hass, lambda: list(offers(hass)) == [f"EWS-Box {SERIAL}"])
            unknown = listener_of(entry).unknown_boxes
            assert [one.serial for one in unknown] == [SERIAL]
            await wait_for_state(hass, status, "available")
            chargers = entry.runtime_data.chargers.values()
            assert {managed.charger.info.serial for managed in chargers} == {OTHER}


async def test_serial_number_of_another_box_is_refused(hass: HomeAssistant) -> None:
    elsewhere = bus_entry("ews", BY_HAND, stored_box("AB"), entry_id="serial")
    elsewhere.add_to_hass(hass)
    boxes = [stored_box(SERIAL), {**stored_box(OTHER), "title": "Other"}]
    async with listening(hass, *boxes) as entry:
        flow = await Flow.replace_charger(hass, entry, get(entry, "Yard"))
        await flow.submit({"box_serial": OTHER})
        assert flow.errors == {"box_serial": "address_taken"}
        await flow.submit({"box_serial": "AB"})
        assert flow.errors == {"box_serial": "box_already_set_up"}
        assert flow.tells("Yard (Bus)")
        flow.abort()


async def test_box_on_a_serial_line_is_replaced_by_whichever_answers(
    hass: HomeAssistant,
) -> None:
    old, new = EwsBox(serial=SERIAL), EwsBox(serial=OTHER)
    async with running(hass, old) as (entry, bus):
        status = await get_entity(hass, "sensor", entry, "2_status")
        bus.remove(old)
        flow = await Flow.replace_charger(hass, entry, get(entry, "Yard"))
        await flow.submit({})
        assert flow.result["reason"] == "reconfigure_successful"
        [stored] = entry.subentries.values()
        assert (stored.data["address"], stored.data["serial"]) == ("", None)
        assert stored.unique_id is None
        assert stored.data["identity"] not in (f"ews_{SERIAL}", stored.subentry_id)
        bus.add(new)
        await wait_for_state(hass, status, "available")
        await wait_until(hass, lambda: stored.data["serial"] == OTHER)


async def test_box_that_is_removed_is_a_stranger(hass: HomeAssistant) -> None:
    async with listening(hass, stored_box(SERIAL)) as entry:
        with dialling(entry):
            await get_entity(hass, "sensor", entry, "1_status")
            [subentry_id] = entry.subentries
            assert not offers(hass)
            hass.config_entries.async_remove_subentry(entry, subentry_id)
            await offered(hass)
            assert not entry.runtime_data.chargers
