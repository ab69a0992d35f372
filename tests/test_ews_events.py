"""What happens at an EWS-Box: keys, cards, starts that are asked for, charges."""

from typing import Any

from homeassistant.core import HomeAssistant, State, callback
from homeassistant.helpers.event import async_track_state_change_event
from homeassistant.setup import async_setup_component
import pytest

from tests.common import (
    call,
    entity_id,
    get_entity,
    running,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.ews import START, charge, orders, plug_in, polled, quick_car
from tests.virtual import EwsBox, EwsCard

OWN = {"event_types", "friendly_name", "device_class", "event_type"}
"""What is the entity's and not the event's."""


def told(hass: HomeAssistant, *entities: str) -> list[tuple[str, dict[str, Any]]]:
    """Return a list that grows with each event: its type, and what is told of it."""
    heard: list[tuple[str, dict[str, Any]]] = []

    @callback
    def hear(event: Any) -> None:  # noqa: ANN401 - of Home Assistant's
        state: State = event.data["new_state"]
        if (kind := state.attributes.get("event_type")) is not None:
            rest = {
                key: value for key, value in state.attributes.items() if key not in OWN
            }
            heard.append((kind, rest))

    async_track_state_change_event(hass, entities, hear)
    return heard


# -- Charges -------------------------------------------------------------------------


async def test_a_charge_begins_and_ends(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(), quick_car()))
    port = box.ports[0]
    async with running(hass, box, fail_safe_current=16.0, time_scale=60) as (
        entry,
        bus,
    ):
        events = told(hass, await get_entity(hass, "event", entry, "1_charge"))
        others = told(hass, await get_entity(hass, "event", entry, "2_charge"))
        switch = await charge(hass, entry, bus, box)
        await wait_until(hass, lambda: events)
        assert events == [("started", {})]
        # A pause of ours and of the car are none's end.
        await call(hass, "switch.turn_off", switch)
        await call(hass, "switch.turn_on", switch)
        await bus.wait_for_async(lambda: port.session.wh > 100)
        box.press_key(1, 2)
        await wait_until(hass, lambda: len(events) > 1)
        (kind, ended), *more = events[1:]
        assert kind == "ended"
        assert not more
        assert ended == {
            "result": "stopped",
            "energy": int(port.session.last_wh),
            "duration": int(port.session.last_seconds),
        }
        assert ended["energy"] > 100
        await polled(bus, box, 10)
        assert len(events) == 2
        assert not others


async def test_a_car_that_goes_away(hass: HomeAssistant) -> None:
    car = quick_car()
    box = EwsBox(cars=(None, car))
    async with running(hass, box) as (entry, bus):
        events = told(hass, await get_entity(hass, "event", entry, "2_charge"))
        await charge(hass, entry, bus, box, 2)
        await wait_until(hass, lambda: events)
        car.leave()
        await wait_until(hass, lambda: len(events) == 2)
        assert events[1][0] == "ended"
        assert events[1][1]["result"] == "pilot_lost"


# -- Starts that are asked for -------------------------------------------------------


async def test_a_key_asks_and_an_automation_answers(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(), quick_car()))
    async with running(hass, box) as (entry, bus):
        request = await get_entity(hass, "event", entry, "1_start_request")
        asked = await get_entity(hass, "binary_sensor", entry, "1_start_requested")
        switch = await get_entity(hass, "switch", entry, "1_charging_allowed")
        status = await get_entity(hass, "sensor", entry, "1_status")
        events = told(hass, request)
        await plug_in(bus, box)
        await polled(bus, box)
        assert not events

        # Nobody answers: nothing begins.
        box.press_key(1, 1)
        await wait_for_state(hass, asked, "on")
        await wait_until(hass, lambda: events)
        assert events == [("requested", {"optimised": False})]
        await polled(bus, box, 10)
        assert not orders(box)
        assert len(events) == 1

        # Away and back, and an automation is there.
        car = box.ports[0].car
        assert car is not None
        car.leave()
        await wait_for_state(hass, asked, "off")
        wanted = {
            "alias": "Let them charge",
            "triggers": {"trigger": "state", "entity_id": request},
            "actions": {"action": "switch.turn_on", "target": {"entity_id": switch}},
        }
        assert await async_setup_component(hass, "automation", {"automation": wanted})
        await hass.async_block_till_done()
        await plug_in(bus, box)
        await polled(bus, box)
        assert not orders(box)
        box.press_key(1, 3)
        box.press_key(1, 1)
        await wait_for_state(hass, status, "charging")
        assert events[1] == ("requested", {"optimised": True})
        assert orders(box) == [START]
        await wait_for_state(hass, asked, "off")
        assert not orders(box, 2)
        await call(hass, "automation.turn_off", "automation.let_them_charge")


async def test_who_asks_with_a_card_is_told_by_number(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),), rfid=True)
    async with running(hass, box) as (entry, bus):
        request = await get_entity(hass, "event", entry, "1_start_request")
        events = told(hass, request)
        await plug_in(bus, box)
        box.press_key(1, 1)
        await polled(bus, box)
        assert not events
        box.present_card(EwsCard(group=7, number=42, name="SCHMIDT"))
        await wait_until(hass, lambda: events)
        assert events == [("requested", {"optimised": False, "group": 7, "number": 42})]
        assert not orders(box)


# -- Cards ---------------------------------------------------------------------------


async def test_a_card_is_told_without_a_name_or_a_judgement(
    hass: HomeAssistant,
) -> None:
    box = EwsBox(rfid=True)
    async with running(hass, box) as (entry, bus):
        events = told(hass, await get_entity(hass, "event", entry, "card"))
        card = EwsCard(
            group=7, number=42, name="SCHMIDT", tag=bytes.fromhex("04aabbccddeeff")
        )
        box.present_card(card)
        await wait_until(hass, lambda: events)
        expected = {
            "tag": "04aabbccddeeff",
            "readable": True,
            "group": 7,
            "number": 42,
        }
        assert events == [("presented", expected)]
        # The same card again is one more event.
        box.remove_card()
        await polled(bus, box, 10)
        assert len(events) == 1
        box.present_card(card)
        await wait_until(hass, lambda: len(events) == 2)
        assert events[1] == events[0]
        everything = [str(state.as_dict()) for state in hass.states.async_all()]
        assert not any("SCHMIDT" in one or "valid" in one for one in everything)


async def test_a_card_of_another_format_has_only_a_tag(hass: HomeAssistant) -> None:
    box = EwsBox(rfid=True)
    async with running(hass, box) as (entry, _):
        events = told(hass, await get_entity(hass, "event", entry, "card"))
        box.present_card(EwsCard(group=7, number=42, foreign=True))
        await wait_until(hass, lambda: events)
        assert events == [("presented", {"tag": "04112233445566", "readable": False})]


@pytest.mark.usefixtures("all_entities_enabled")
async def test_who_charges_is_told_to_whoever_wants_to_know(
    hass: HomeAssistant,
) -> None:
    car = quick_car()
    box = EwsBox(cars=(car,), rfid=True)
    async with running(hass, box) as (entry, bus):
        user = await get_entity(hass, "sensor", entry, "1_user")
        assert state_of(hass, user) == "unknown"
        await plug_in(bus, box)
        box.press_key(1, 1)
        box.present_card(EwsCard(name="SCHMIDT"))
        await wait_for_state(hass, user, "SCHMIDT")
        other = entity_id(hass, "sensor", entry, "2_user")
        assert state_of(hass, other or "") == "unknown"
        car.leave()
        await wait_for_state(hass, user, "unknown")


async def test_a_box_without_a_reader_has_no_cards(hass: HomeAssistant) -> None:
    async with running(hass, EwsBox()) as (entry, _):
        await get_entity(hass, "sensor", entry, "2_status")
        await hass.async_block_till_done()
        assert entity_id(hass, "event", entry, "1_charge")
        for key in ("card", "1_key_1", "2_key_4"):
            assert not entity_id(hass, "event", entry, key)
        assert not entity_id(hass, "sensor", entry, "1_user")


# -- Keys ----------------------------------------------------------------------------


async def test_keys_are_told_when_they_are_ours_to_watch(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(), quick_car()), manual_io=True)
    async with running(hass, box) as (entry, bus):
        key = told(hass, await get_entity(hass, "event", entry, "2_key_3"))
        names = [
            await get_entity(hass, "event", entry, f"{port}_key_{number}")
            for port in (1, 2)
            for number in range(1, 5)
        ]
        assert len(set(names)) == 8
        others = told(hass, *(one for one in names if "port_2_key_3" not in one))
        await plug_in(bus, box, 2)
        box.key_down(2, 3)
        await wait_until(hass, lambda: key)
        assert key == [("press_start", {})]
        bus.advance(1.0)
        box.key_up(2, 3)
        await wait_until(hass, lambda: len(key) == 2)
        kind, rest = key[1]
        assert kind == "press_end"
        assert list(rest) == ["duration"]
        assert rest["duration"] == pytest.approx(1.1, abs=0.3)
        # Very short, both are one record, or two.
        box.press_key(2, 3, 0.1)
        await wait_until(hass, lambda: key[-1] == ("press_end", {"duration": 0.1}))
        assert not others
        # In this mode a key is a key: it starts, stops and optimises nothing.
        assert not box.ports[1].optimised
        assert not orders(box, 2)


async def test_an_event_is_not_told_again_after_a_restart(
    hass: HomeAssistant,
) -> None:
    box = EwsBox(cars=(quick_car(),), rfid=True)
    async with running(hass, box) as (entry, bus):
        cards = await get_entity(hass, "event", entry, "card")
        charges = await get_entity(hass, "event", entry, "1_charge")
        box.present_card()
        await charge(hass, entry, bus, box)
        await wait_for_state(hass, charges, lambda state: state.state)
        before = state_of(hass, cards), state_of(hass, charges)
        await hass.config_entries.async_reload(entry.entry_id)
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "charging")
        await polled(bus, box, 10)
        # What was told before is shown as told then.
        assert (state_of(hass, cards), state_of(hass, charges)) == before
