"""Another device-ID for an ABL box, as a person gives it: no box needs a service tool.

The oracle are the boxes: what each of them was sent.
"""

import asyncio
from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

from homeassistant.const import EVENT_STATE_CHANGED, STATE_UNAVAILABLE
from homeassistant.core import callback
from homeassistant.helpers import device_registry as dr, entity_registry as er
import pytest

from custom_components.evse_bus.evse.address_change import Problem
from tests.common import (
    call,
    charger as stored_charger,
    get_entity,
    running,
    setup_bus,
    state_of,
    wait_for_state,
)
from tests.flow import Flow, charger, english, fields, port_step
from tests.virtual import AblBox, Car, VirtualBus, requests_in

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigSubentry
    from homeassistant.core import HomeAssistant
    from pytest_homeassistant_custom_component.common import MockConfigEntry

pytestmark = pytest.mark.usefixtures("quick_search")

A1, E0, E2, RESET = 0xA1A1, 0xE0E0, 0xE2E2, 0x5A5A


def abl(device_id: int, number: int | None = None, car: Car | None = None) -> AblBox:
    return AblBox(device_id, serial=serial(number or device_id), car=car)


def serial(number: int) -> str:
    return f"2W22xy{number:08d}"


def written(box: AblBox) -> list[int]:
    """Return what a box was sent beside limits."""
    return [one.value for one in box.writes if one.register != 0x14]


def one_at_a_time(*boxes: AblBox) -> bool:
    """Return whether no write has reached two boxes, and none one with a car."""
    times = [one.t for box in boxes for one in box.writes]
    cars = [one for box in boxes for one in box.writes if one.plugged]
    return len(times) == len(set(times)) and not cars


async def happens(bus: VirtualBus, what: Callable[[], object]) -> None:
    """Wait for something at the boxes; a change takes its time."""
    await bus.wait_for_async(what, 60)


def get(entry: MockConfigEntry, title: str) -> ConfigSubentry:
    return next(one for one in entry.subentries.values() if one.title == title)


# -- Several boxes with one device-ID --------------------------------------------------


async def duplicates(hass: HomeAssistant, bus: VirtualBus) -> Flow:
    flow = await port_step(hass, "abl", bus.url)
    await flow.wait()
    assert flow.step == "duplicates"
    return await flow.choose("sort_out")


async def test_three_new_boxes_get_ids_of_their_own(hass: HomeAssistant) -> None:
    boxes = [abl(1, number) for number in (21, 22, 23)]
    first, second, third = boxes
    with VirtualBus.in_loop(*boxes, abl(2)) as bus:
        flow = await duplicates(hass, bus)
        assert flow.step == "sort_out"
        assert flow.tells("device ID 1", "Switch off all of these boxes but one")
        # 2 was found by the search.
        assert fields(flow) == {"new_address": "3"}

        # Not switched off yet.
        await flow.submit({"new_address": "3"})
        assert flow.tells("device ID 1 and none at 3")
        await flow.wait()
        assert flow.errors == {"base": "address_several"}
        assert flow.tells("More than one box answers at device ID 1")
        assert not any(box.writes for box in boxes)

        second.switch_off()
        third.switch_off()
        await flow.submit({"new_address": "3"})
        await flow.wait()
        assert flow.step == "sorted_out"
        assert flow.tells(serial(21), "device ID 3")
        assert flow.progress[-1] == 1
        assert first.device_id == 3
        assert flow.result["menu_options"] == ["sort_out", "scan"]

        await flow.choose("sort_out")
        assert fields(flow) == {"new_address": "4"}
        second.switch_on()
        await flow.submit({"new_address": "4"})
        await flow.wait()
        assert flow.tells(serial(22), "device ID 4")

        third.switch_on()
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        found = [box.device_id for box in boxes]
        assert found == [3, 4, 1]
        assert one_at_a_time(*boxes)
        assert written(third) == []
        await flow.submit({"chargers": ["1", "3"], "installation_limit": 16})
        await flow.submit(charger("One"))
        await flow.submit(charger("Three"))
        await flow.submit()
        await hass.async_block_till_done()
    one, three = flow.result["result"].subentries.values()
    assert (one.data["serial"], three.data["serial"]) == (serial(23), serial(21))
    assert await hass.config_entries.async_unload(flow.result["result"].entry_id)


async def test_two_ids_that_boxes_share(hass: HomeAssistant) -> None:
    pairs = [abl(1, 11), abl(1, 12), abl(5, 51), abl(5, 52)]
    with VirtualBus.in_loop(*pairs) as bus:
        flow = await duplicates(hass, bus)
        assert fields(flow) == {"old_address": "1", "new_address": "2"}
        pairs[3].switch_off()
        await flow.submit({"old_address": "5", "new_address": "2"})
        await flow.wait()
        assert flow.step == "sorted_out"
        assert [box.device_id for box in pairs] == [1, 1, 2, 5]
        assert one_at_a_time(*pairs)
        flow.abort()


async def test_the_search_goes_on_after_the_bus_was_lost(hass: HomeAssistant) -> None:
    boxes = abl(1, 11), abl(1, 12)
    with VirtualBus.in_loop(*boxes) as bus:
        flow = await duplicates(hass, bus)
        boxes[1].switch_off()
        await flow.submit({"new_address": "2"})
        waiting = asyncio.create_task(flow.wait())
        await happens(bus, lambda: boxes[0].state == "E2")
        bus.unplug()
        await waiting
        assert flow.errors == {"base": "address_interrupted"}
        assert flow.tells("set-up mode", "1 or 2")
        await flow.submit({"new_address": "2"})
        await flow.wait()
        assert flow.errors == {"base": "port_missing"}
        bus.replug()
        # The box that is halfway has to be finished first.
        boxes[0].switch_off()
        boxes[1].switch_on()
        await flow.submit({"new_address": "2"})
        await flow.wait()
        assert flow.errors == {"base": "address_other_charger"}
        assert flow.tells(serial(11))
        boxes[1].switch_off()
        boxes[0].switch_on()
        await flow.submit({"new_address": "2"})
        await flow.wait()
        assert flow.step == "sorted_out"
        assert boxes[0].device_id == 2
        assert written(boxes[1]) == []
        flow.abort()


async def test_a_disabled_outlet_needs_a_word_of_the_user(hass: HomeAssistant) -> None:
    boxes = abl(1, 11), abl(1, 12)
    with VirtualBus.in_loop(*boxes) as bus:
        flow = await duplicates(hass, bus)
        boxes[1].switch_off()
        boxes[0].stop_locally()
        await flow.submit({"new_address": "2"})
        await flow.wait()
        assert flow.errors == {"base": "address_car_unknown"}
        assert flow.tells("state E0")
        assert fields(flow) == {"new_address": "2", "unplugged": False}
        await flow.submit({"new_address": "2", "unplugged": False})
        await flow.wait()
        assert flow.errors == {"base": "address_car_unknown"}
        assert written(boxes[0]) == []
        execute = boxes[0].outlet.execute
        boxes[0].outlet.execute = lambda value: (  # type: ignore[method-assign]
            value != E0 and execute(value)
        )
        await flow.submit({"new_address": "2", "unplugged": True})
        await flow.wait()
        assert flow.step == "sorted_out_enabled"
        assert flow.tells("could not be disabled again")
        await flow.reload()
        assert flow.step == "sorted_out_enabled"
        flow.abort()


async def test_a_dialogue_closed_in_the_middle_leaves_no_box_in_set_up(
    hass: HomeAssistant,
) -> None:
    boxes = abl(1, 11), abl(1, 12)
    with VirtualBus.in_loop(*boxes) as bus:
        flow = await duplicates(hass, bus)
        boxes[1].switch_off()
        await flow.submit({"new_address": "2"})
        await happens(bus, lambda: boxes[0].state == "E2")
        flow.abort()
        await happens(bus, lambda: not bus.connected)
        assert (boxes[0].device_id, boxes[0].state) == (2, "A1")


async def test_a_dialogue_closed_before_the_first_write_changes_nothing(
    hass: HomeAssistant,
) -> None:
    boxes = abl(1, 11), abl(1, 12)
    with VirtualBus.in_loop(*boxes) as bus:
        flow = await duplicates(hass, bus)
        boxes[1].switch_off()
        before = len(requests_in(bus.log.bursts()))
        await flow.submit({"new_address": "2"})
        await happens(bus, lambda: len(requests_in(bus.log.bursts())) > before + 5)
        flow.abort()
        await happens(bus, lambda: not bus.connected)
        await asyncio.sleep(60)
        assert written(boxes[0]) == []


async def test_a_new_box_beside_one_that_is_set_up(hass: HomeAssistant) -> None:
    own, new, other = abl(1), abl(1, 99), abl(3)
    new.on = False
    async with running(hass, own, other) as (entry, bus):
        bus.add(new)
        status = await get_entity(hass, "sensor", entry, "1_status", index=1)
        await wait_for_state(hass, status, "available")
        new.switch_on()
        await asyncio.sleep(1)
        flow = await Flow.add_charger(hass, entry)
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "duplicates"
        await flow.choose("sort_out")
        # Its own is taken, and so is that of the other charger.
        assert fields(flow) == {"new_address": "2"}
        own.switch_off()
        begun = bus.time()
        await flow.submit({"new_address": "2"})
        await flow.wait()
        assert flow.step == "sorted_out"
        assert new.device_id == 2
        # The others were polled all the while, and the absent one is still at 1.
        polls = [
            one.t
            for one in requests_in(bus.log.bursts())
            if one.device_id == 3 and one.register == 0x2E and one.t > begun
        ]
        assert max(later - poll for poll, later in pairwise(polls)) < 2
        assert state_of(hass, status) == "available"
        assert get(entry, "Charger 1").data["address"] == 1
        own.switch_on()
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        await flow.submit({"chargers": "2"})
        await flow.submit(charger("New"))
        await flow.submit()
        await hass.async_block_till_done()
        assert get(entry, "New").data["serial"] == serial(99)
        assert one_at_a_time(new, other)


async def test_the_box_that_stays_on_may_be_one_that_is_set_up(
    hass: HomeAssistant,
) -> None:
    own, new = abl(1), abl(1, 99)
    new.on = False
    async with running(hass, own) as (entry, bus):
        bus.add(new)
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "available")
        new.switch_on()
        await asyncio.sleep(1)
        flow = await Flow.add_charger(hass, entry)
        await flow.choose("scan")
        await flow.wait()
        await flow.choose("sort_out")
        new.switch_off()
        await flow.submit({"new_address": "2"})
        await flow.wait()
        assert flow.step == "sorted_out"
        assert get(entry, "Charger 1").data["address"] == 2
        new.switch_on()
        await flow.choose("scan")
        await flow.wait()
        assert flow.step == "select"
        assert fields(flow) == {"chargers": "1"}
        await wait_for_state(hass, status, "available")
        assert written(new) == []
        flow.abort()


# -- One charger -----------------------------------------------------------------------


async def new_address(
    hass: HomeAssistant, entry: MockConfigEntry, title: str = "Charger 1"
) -> Flow:
    flow = await Flow.change_charger(hass, entry, get(entry, title))
    await flow.choose("new_address")
    assert flow.step == "new_address"
    return flow


async def test_a_charger_keeps_all_but_its_device_id(hass: HomeAssistant) -> None:
    one, other = abl(1), abl(3)
    async with running(hass, one, other) as (entry, bus):
        status = await get_entity(hass, "sensor", entry, "1_status")
        limit = await get_entity(hass, "number", entry, "charging_current")
        neighbour = await get_entity(hass, "sensor", entry, "1_status", index=1)
        for each in (status, neighbour):
            await wait_for_state(hass, each, "available")
        await call(hass, "number.set_value", limit, value=10)
        entities = {
            one.entity_id: one.unique_id for one in er.async_get(hass).entities.values()
        }
        devices = {one.id for one in dr.async_get(hass).devices}
        coordinator = entry.runtime_data
        running_charger = coordinator.bus.chargers["abl1"]

        flow = await new_address(hass, entry)
        assert flow.tells("device ID of Charger 1")
        assert flow.tells("The present one is 1")
        assert fields(flow) == {"new_address": "2"}
        gone: list[str] = []

        @callback
        def watch(_event: object) -> None:
            if state_of(hass, neighbour) == STATE_UNAVAILABLE:
                gone.append(neighbour)

        stop = hass.bus.async_listen(EVENT_STATE_CHANGED, watch)
        await flow.submit({"new_address": "7"})
        await flow.wait()
        stop()
        assert flow.result["reason"] == "address_changed"
        assert flow.tells("Charger 1 has the device ID 7 now.")
        await hass.async_block_till_done()
        assert one.device_id == 7
        assert written(one) == [E2, 0xF007, RESET]
        subentry = get(entry, "Charger 1")
        assert subentry.data["address"] == 7
        assert subentry.unique_id == f"abl_{serial(1)}"
        # In place: the same charger, the same bus, nothing made anew.
        assert entry.runtime_data is coordinator
        assert coordinator.bus.chargers["abl1"] is running_charger
        assert bus.opened == 1
        assert gone == []
        assert entities == {
            one.entity_id: one.unique_id for one in er.async_get(hass).entities.values()
        }
        assert devices == {one.id for one in dr.async_get(hass).devices}
        # The order stands; the reset had forgotten it.
        await happens(bus, lambda: one.ic_amps < 10.1)
        await wait_for_state(hass, status, "available")
        assert state_of(hass, limit) == "10.0"
        assert one_at_a_time(one, other)

        # And after a restart.
        await hass.config_entries.async_reload(entry.entry_id)
        await wait_for_state(hass, status, "available")
        assert one.ic_amps < 10.1


async def test_a_car_is_plugged_in(hass: HomeAssistant) -> None:
    car = Car()
    car.plug_in(request=False)
    one = abl(1, car=car)
    async with running(hass, one) as (entry, _):
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "suspended_ev")
        flow = await new_address(hass, entry)
        await flow.submit({"new_address": "2"})
        await flow.wait()
        assert flow.step == "new_address"
        assert flow.errors == {"base": "address_plugged"}
        assert flow.tells("A car is plugged in (state B2)")
        assert written(one) == []
        car.leave()
        await wait_for_state(hass, status, "available")
        await flow.submit({"new_address": "2"})
        await flow.wait()
        assert flow.result["reason"] == "address_changed"


async def test_a_box_that_is_off_has_its_device_id_all_the_same(
    hass: HomeAssistant,
) -> None:
    off = abl(2)
    off.on = False
    async with running(hass, abl(1), off) as (entry, _):
        flow = await new_address(hass, entry)
        # 2 is set up, though it does not answer.
        assert fields(flow) == {"new_address": "3"}
        flow.abort()


async def test_another_box_answers_at_the_old_device_id(hass: HomeAssistant) -> None:
    one, other = abl(1), abl(1, 99)
    other.on = False
    async with running(hass, one) as (entry, bus):
        bus.add(other)
        flow = await new_address(hass, entry)
        await flow.submit({"new_address": "2"})
        waiting = asyncio.create_task(flow.wait())
        await happens(bus, lambda: one.device_id == 2)
        other.switch_on()
        await waiting
        assert flow.result["reason"] == "address_changed_old_in_use"
        assert written(other) == []


async def test_an_interrupted_change_is_taken_up_again(hass: HomeAssistant) -> None:
    one = abl(1)
    one.id_applies = "write"
    async with running(hass, one) as (entry, bus):
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "available")
        flow = await new_address(hass, entry)
        await flow.submit({"new_address": "2"})
        waiting = asyncio.create_task(flow.wait())
        await happens(bus, lambda: one.device_id == 2)
        bus.unplug()
        await waiting
        assert flow.errors == {"base": "address_interrupted"}
        # Asked for again at once: nothing can be sent.
        await flow.submit({"new_address": "2"})
        await flow.wait()
        assert flow.errors == {"base": "address_not_begun"}
        bus.replug()
        await happens(bus, lambda: bus.connected)
        await flow.submit({"new_address": "2"})
        await flow.wait()
        assert flow.result["reason"] == "address_changed"
        assert get(entry, "Charger 1").data["address"] == 2
        await wait_for_state(hass, status, "available")


async def test_a_dialogue_closed_in_the_middle_is_followed_all_the_same(
    hass: HomeAssistant,
) -> None:
    one = abl(1)
    async with running(hass, one) as (entry, bus):
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "available")
        flow = await new_address(hass, entry)
        await flow.submit({"new_address": "2"})
        await happens(bus, lambda: one.state == "E2")
        flow.abort()
        await happens(bus, lambda: get(entry, "Charger 1").data["address"] == 2)
        await wait_for_state(hass, status, "available")
        assert entry.runtime_data.bus.chargers["abl1"].config.address == 2


async def test_a_bus_that_does_not_run_offers_only_the_settings(
    hass: HomeAssistant,
) -> None:
    entry = await setup_bus(
        hass, "abl", "/dev/nothing", stored_charger("abl", 1, serial=serial(1))
    )
    flow = await Flow.change_charger(hass, entry, get(entry, "Charger 1"))
    assert flow.result["menu_options"] == ["settings", "replace"]
    flow.abort()


def test_each_problem_has_a_text_in_both_flows() -> None:
    for texts in (english()["config"], english()["config_subentries"]["charger"]):
        named = {key for key in texts["error"] if key.startswith("address_")}
        # The last one is of a flow that was closed.
        problems = {f"address_{one}" for one in Problem if one is not Problem.GIVEN_UP}
        others = {"address_not_begun", "address_taken", "address_twice"}
        assert named == problems | others
