"""An EWS-Box that dials and is not set up is offered, added, ignored, or taken back."""

from typing import TYPE_CHECKING

from homeassistant.config_entries import (
    ConfigEntryDisabler,
    ConfigEntryState,
    ConfigSubentry,
)
from homeassistant.const import EVENT_HOMEASSISTANT_STARTED
from homeassistant.core import CoreState
from homeassistant.data_entry_flow import FlowResultType, UnknownFlow
from homeassistant.helpers.discovery_flow import DISCOVERY_FLOW_DISPATCHER
import pytest

from custom_components.evse_bus.diagnostics import async_get_config_entry_diagnostics
from custom_components.evse_bus.discovery import MOST_OFFERS
from custom_components.evse_bus.evse.dialling import UnknownBox
from custom_components.evse_bus.evse.readings import ChargerInfo
from tests.common import bus_entry, get_entity, state_of, wait_for_state, wait_until
from tests.flow import Flow, box as typed_box, fields, ignore, offers
from tests.listening import (
    OTHER,
    SERIAL,
    dialling,
    listener_of,
    listening,
    offered,
    stored_box,
)
from tests.virtual import EwsBox, EwsDialler

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant
    from pytest_homeassistant_custom_component.common import MockConfigEntry

pytestmark = pytest.mark.usefixtures("socket_enabled")

FAST = {"poll_interval": 0.2}


async def dial_again(dialler: EwsDialler, entry: MockConfigEntry) -> None:
    """Let a box that is not set up dial once more, and say who it is."""
    before = listener_of(entry).statistics.unknown
    dialler.hang_up()
    await dialler.wait_for_async(lambda: listener_of(entry).statistics.unknown > before)


# -- Added -------------------------------------------------------------------------


async def test_box_that_dials_is_offered_and_added(hass: HomeAssistant) -> None:
    box = EwsBox(serial=SERIAL)
    async with listening(hass) as entry:
        running = entry.runtime_data
        with dialling(entry, box) as dialler:
            flow = await Flow.discovered(hass, await offered(hass))
            assert flow.step == "discovered"
            assert flow.tells(f"EWS-Box {SERIAL} wants to connect")
            assert flow.tells(SERIAL, "M165300103", "127.0.0.1", "Boxes")
            assert {one.name for one in box.commands} == {"id", "rs"}

            await flow.submit()
            assert flow.step == "box"
            assert flow.tells(SERIAL, "firmware M165300103", "for each port: ?.")
            # It has not been asked for its ports, so nothing is known of them.
            assert fields(flow) == {
                "name": f"EWS-Box {SERIAL[-8:]}",
                "ports": "2",
                "installation_limit": 16,
                "installation_limit_2": 16,
                "fail_safe_current": 6,
                "expert": {"poll_interval": 2},
            }
            assert "box_serial" not in flow.result["data_schema"].schema
            await flow.submit(typed_box("Yard", 13, ports="2"))
            assert flow.errors == {"installation_limit_2": "second_limit_missing"}
            await flow.submit(typed_box("Yard", 13, 10, expert=FAST))
            await flow.reload()
            assert flow.step == "confirm_ews_network"
            assert flow.tells(f"| Yard | {SERIAL} | 13 A + 10 A | 6 A |")
            assert flow.tells("10 minutes", "unlocks the cable", "dials again")
            assert not entry.subentries
            assert not box.writes
            await flow.submit()
            assert flow.result["type"] is FlowResultType.ABORT
            assert flow.result["reason"] == "box_added"
            assert flow.tells("Yard was added to Boxes.")

            await hass.async_block_till_done()
            [yard] = entry.subentries.values()
            assert (yard.title, yard.unique_id) == ("Yard", f"ews_{SERIAL}")
            assert yard.subentry_type == "charger"
            assert yard.data == {
                "address": SERIAL,
                "serial": SERIAL,
                "identity": f"ews_{SERIAL}",
                "ports": 2,
                "installation_limit": 13,
                "installation_limit_2": 10,
                "poll_interval": 0.2,
                "order_lifetime": None,
                "fail_safe_current": 6,
            }
            for port in (1, 2):
                status = await get_entity(hass, "sensor", entry, f"{port}_status")
                await wait_for_state(hass, status, "available")
            assert state_of(hass, "sensor.boxes_connected_boxes") == "1"
            # In place, and with the connection that was there.
            assert entry.runtime_data is running
            assert dialler.attempts == 1
            assert not offers(hass)

            # Whoever is set up is not asked about again.
            dialler.hang_up()
            await wait_until(hass, lambda: running.connections.connected == 0)
            await wait_until(hass, lambda: running.connections.connected == 1)
            assert not offers(hass)


async def test_two_boxes_are_two_offers(hass: HomeAssistant) -> None:
    async with listening(hass) as entry:
        with dialling(entry), dialling(entry, EwsBox(serial=OTHER)):
            first, second = await offered(hass), await offered(hass, OTHER)
            flow = await Flow.discovered(hass, second)
            await flow.submit()
            await flow.submit(typed_box("Second", 16, expert=FAST))
            await flow.submit()
            assert flow.result["reason"] == "box_added"
            await get_entity(hass, "sensor", entry, "1_status")
            assert list(offers(hass).values()) == [first]
            [box] = entry.subentries.values()
            assert box.unique_id == f"ews_{OTHER}"


async def test_box_that_dials_twice_is_one_offer(hass: HomeAssistant) -> None:
    box = EwsBox(serial=SERIAL)
    async with listening(hass) as entry:
        with dialling(entry, box) as dialler:
            flow_id = await offered(hass)
            await dial_again(dialler, entry)
            box.firmware = b"M165300104\0"
            await dial_again(dialler, entry)
            await hass.async_block_till_done(wait_background_tasks=True)
            assert list(offers(hass).values()) == [flow_id]
            assert len(hass.config_entries.flow.async_progress()) == 1


async def test_box_that_is_set_up_on_a_serial_line_is_not_offered(
    hass: HomeAssistant,
) -> None:
    serial = bus_entry("ews", "/dev/serial/by-id/usb-none", stored_box(SERIAL))
    serial.add_to_hass(hass)
    # Disabled: its port would be tried again all the time.
    user = ConfigEntryDisabler.USER
    await hass.config_entries.async_set_disabled_by(serial.entry_id, user)
    async with listening(hass) as entry:
        with dialling(entry) as dialler:
            await dialler.wait_for_async(lambda: listener_of(entry).unknown_boxes)
            await dial_again(dialler, entry)
            await hass.async_block_till_done(wait_background_tasks=True)
            assert not hass.config_entries.flow.async_progress()


async def test_firmware_that_is_no_firmware_is_no_link(hass: HomeAssistant) -> None:
    async with listening(hass) as entry:
        with dialling(entry, EwsBox(serial=SERIAL, firmware="[A1](//b.c)")):
            flow = await Flow.discovered(hass, await offered(hass))
            assert flow.tells("firmware A1b.c")
            assert not flow.tells("](")
            await flow.submit()
            assert not flow.tells("](")
            flow.abort()


@pytest.mark.parametrize("starting", [False, True], ids=["running", "starting"])
async def test_many_serial_numbers_are_not_that_many_offers(
    hass: HomeAssistant, *, starting: bool
) -> None:
    if starting:
        hass.set_state(CoreState.starting)
    async with listening(hass) as entry:
        for number in range(MOST_OFFERS + 4):
            serial = f"{number:012d}"
            info = ChargerInfo(manufacturer="P-CHARGE", model="EWS-Box", firmware="X")
            stranger = UnknownBox(serial=serial, info=info, peer=None)
            listener_of(entry).on_unknown_box(stranger)
        if starting:
            # Home Assistant would keep an offer for each until it has started.
            dispatcher = hass.data.get(DISCOVERY_FLOW_DISPATCHER)
            assert dispatcher is None or not dispatcher.pending_flows
            hass.set_state(CoreState.running)
            hass.bus.async_fire(EVENT_HOMEASSISTANT_STARTED)
        await hass.async_block_till_done(wait_background_tasks=True)
        assert len(offers(hass)) == (0 if starting else MOST_OFFERS)


@pytest.mark.parametrize("meanwhile", ["nothing", "set up", "listener removed"])
async def test_box_that_dials_while_home_assistant_starts(
    hass: HomeAssistant, meanwhile: str
) -> None:
    """It is offered afterwards, if that still makes sense then."""
    hass.set_state(CoreState.starting)
    async with listening(hass) as entry:
        with dialling(entry) as dialler:
            await dialler.wait_for_async(lambda: listener_of(entry).unknown_boxes)
            assert not hass.config_entries.flow.async_progress()
            if meanwhile == "set up":
                hass.config_entries.async_add_subentry(
                    entry, ConfigSubentry(**stored_box(SERIAL))
                )
                await hass.async_block_till_done()
            if meanwhile == "listener removed":
                await hass.config_entries.async_remove(entry.entry_id)
            hass.set_state(CoreState.running)
            hass.bus.async_fire(EVENT_HOMEASSISTANT_STARTED)
            await hass.async_block_till_done(wait_background_tasks=True)
            assert bool(offers(hass)) is (meanwhile == "nothing")


# -- Ignored -----------------------------------------------------------------------


async def test_ignored_box_is_not_offered_until_it_is_no_longer_ignored(
    hass: HomeAssistant,
) -> None:
    async with listening(hass) as entry:
        with dialling(entry) as dialler:
            ignored = await ignore(hass, await offered(hass))
            assert not offers(hass)
            await dial_again(dialler, entry)
            await hass.async_block_till_done(wait_background_tasks=True)
            assert not offers(hass)

            # The frontend lists all entries, this one with them.
            assert ignored.as_json_fragment
            assert not ignored.supports_options
            assert not ignored.supported_subentry_types
            assert await async_get_config_entry_diagnostics(hass, ignored) == {
                "set_up": {}
            }
            # It is in nobody's way when a port is chosen.
            flow = await Flow.add_bus(hass)
            await flow.submit({"protocol": "abl"})
            await flow.submit({"device": "/dev/serial/by-id/usb-none", "line": {}})
            assert flow.errors == {"base": "port_missing"}
            flow.abort()

            attempts = dialler.attempts
            await hass.config_entries.async_remove(ignored.entry_id)
            await offered(hass)
            # At once: it was not necessary that it dials anew.
            assert dialler.attempts == attempts


# -- Taken back --------------------------------------------------------------------


async def test_offer_goes_when_the_box_is_set_up_by_hand(hass: HomeAssistant) -> None:
    async with listening(hass) as entry:
        with dialling(entry):
            flow = await Flow.discovered(hass, await offered(hass))
            await flow.submit()
            by_hand = await Flow.add_charger(hass, entry)
            await by_hand.submit({"box_serial": SERIAL})
            await by_hand.submit(typed_box("By hand", 16, expert=FAST))
            await by_hand.submit()
            assert by_hand.result["type"] is FlowResultType.CREATE_ENTRY
            await wait_until(hass, lambda: not offers(hass))
            with pytest.raises(UnknownFlow):
                await flow.submit(typed_box("Too late", 16))
            await get_entity(hass, "sensor", entry, "1_status")


async def test_offers_go_with_their_listener(hass: HomeAssistant) -> None:
    async with listening(hass) as entry:
        with dialling(entry), dialling(entry, EwsBox(serial=OTHER)):
            open_one = await Flow.discovered(hass, await offered(hass))
            await offered(hass, OTHER)
            await open_one.submit()
            assert open_one.step == "box"
            await hass.config_entries.async_remove(entry.entry_id)
            # Somebody is looking at this one, and is told why it comes to nothing.
            assert list(offers(hass).values()) == [open_one.flow_id]
            await open_one.submit(typed_box("Yard", 16))
            await open_one.submit()
            assert open_one.result["type"] is FlowResultType.ABORT
            assert open_one.result["reason"] == "listener_gone"


@pytest.mark.parametrize("at", ["charger", "confirm"])
async def test_box_set_up_elsewhere_meanwhile_is_not_added(
    hass: HomeAssistant, at: str
) -> None:
    async with listening(hass) as entry:
        with dialling(entry):
            flow = await Flow.discovered(hass, await offered(hass))
            await flow.submit()
            if at == "confirm":
                await flow.submit(typed_box("Yard", 16))
                assert flow.step == "confirm_ews_network"
            elsewhere = bus_entry("ews", "/dev/serial/by-id/none", stored_box(SERIAL))
            elsewhere.add_to_hass(hass)
            await flow.submit(typed_box("Yard", 16) if at == "charger" else {})
            assert flow.result["reason"] == "box_already_set_up"
            assert flow.tells("Yard (Bus)")
            assert not entry.subentries
            assert entry.state is ConfigEntryState.LOADED
