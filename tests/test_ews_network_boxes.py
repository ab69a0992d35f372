"""Several EWS-Boxes that dial one listener, and those that nobody knows."""

import asyncio
from typing import Any

from homeassistant.config_entries import ConfigEntryState
from homeassistant.core import HomeAssistant
import pytest

from custom_components.evse_bus.const import DOMAIN
from tests.common import (
    call,
    entity_id,
    get_entity,
    shut_down,
    state_of,
    stored_order,
    wait_for_state,
    wait_until,
)
from tests.ews import BOXES, charge, dialler_of, listening, polled, quick_car, said
from tests.virtual import EwsBox

pytestmark = pytest.mark.usefixtures("socket_enabled")

SERIAL = "012345678901"


def offered(hass: HomeAssistant) -> list[str | None]:
    """Return the unique ids of the boxes that are offered to the user."""
    return [
        flow["context"].get("unique_id")
        for flow in hass.config_entries.flow.async_progress_by_handler(DOMAIN)
        if flow["context"]["source"] == "integration_discovery"
    ]


async def test_a_stranger_hears_who_are_you_and_nothing_else(
    hass: HomeAssistant,
) -> None:
    car = quick_car()
    stranger = EwsBox(serial="555555555555", cars=(car,), mode="server")
    stranger.ports[0].limit = 20
    box = EwsBox()
    async with listening(hass, box) as (entry, (dialler,)):
        await get_entity(hass, "sensor", entry, "1_status")
        with dialler_of(entry, stranger) as other:
            car.plug_in()
            await other.wait_for_async(lambda: stranger.ports[0].status == 0x30)
            await wait_until(hass, lambda: offered(hass))
            stranger.press_key(1, 1)
            await polled(dialler, box, 30)
            assert {one.name for one in stranger.commands} == {"id", "rs"}
            assert not stranger.writes
            assert stranger.ports[0].limit == 20
            assert stranger.ports[0].start_mode == 1
            assert not stranger.ports[0].contactor
        assert state_of(hass, BOXES) == "1"
        assert entry.runtime_data.connections.listener.statistics.unknown >= 1


async def test_a_second_box_with_the_same_number_is_refused(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    box, double = EwsBox(), EwsBox()
    async with listening(hass, box) as (entry, (dialler,)):
        status = await get_entity(hass, "sensor", entry, "1_status")
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        listener = entry.runtime_data.connections.listener
        with dialler_of(entry, double) as second:
            await second.wait_for_async(lambda: len(second.dropped) > 2, timeout=20)
            assert listener.statistics.duplicates > 1
            await call(hass, "number.set_value", limit, value=10)
            assert box.ports[0].limit == 10
            assert double.ports[0].limit == 0
            assert {one.name for one in double.commands} == {"id", "rs"}
        assert state_of(hass, status) == "available"
        assert dialler.attempts == 1
        assert said(caplog, "gives the number of Yard") == 1
        # Once the first one is gone the number is free.
        dialler.hang_up(redial=False)
        await wait_for_state(hass, status, "unavailable")
        with dialler_of(entry, double) as second:
            await wait_for_state(hass, status, "available")
            await second.wait_for_async(lambda: double.ports[0].limit == 10)


async def test_a_box_that_is_removed_is_offered_again(hass: HomeAssistant) -> None:
    box, stays = EwsBox(cars=(quick_car(),)), EwsBox(serial="012345678902")
    async with listening(hass, box, stays) as (entry, (dialler, other)):
        await charge(hass, entry, dialler, box)
        remains = await get_entity(hass, "sensor", entry, "1_status", index=1)
        assert not offered(hass)
        hass.config_entries.async_remove_subentry(entry, "ews01")
        await hass.async_block_till_done()
        told = len(box.writes)
        await wait_until(hass, lambda: offered(hass))
        assert offered(hass) == [f"ews_{SERIAL}"]
        await dialler.wait_for_async(lambda: box.link_up)
        assert len(box.writes) == told
        # The other one has not noticed.
        assert state_of(hass, remains) == "available"
        assert other.attempts == 1
        await wait_for_state(hass, BOXES, "1")


async def test_another_box_takes_the_place_of_one(hass: HomeAssistant) -> None:
    """The user says that it is a new one: entities stay, the old box is an unknown one."""
    old, new = EwsBox(), EwsBox(serial="012345678902")
    async with listening(hass, old) as (entry, (dialler,)):
        limit = await get_entity(hass, "number", entry, "2_charging_current")
        await call(hass, "number.set_value", limit, value=9)
        with dialler_of(entry, new) as other:
            await wait_until(hass, lambda: offered(hass) == ["ews_012345678902"])
            subentry = entry.subentries["ews01"]
            hass.config_entries.async_update_subentry(
                entry,
                subentry,
                data={
                    **subentry.data,
                    "address": new.serial,
                    "serial": new.serial,
                    "identity": f"ews_{new.serial}",
                },
                unique_id=f"ews_{new.serial}",
            )
            await other.wait_for_async(
                lambda: (new.ports[0].limit, new.ports[1].limit) == (6, 6), timeout=10
            )
            # What was ordered was meant for the other box.
            await wait_for_state(hass, limit, "6.0")
            await wait_for_state(hass, BOXES, "1")
            told = len(old.writes)
            await dialler.wait_for_async(lambda: old.link_up)
            await wait_until(hass, lambda: f"ews_{SERIAL}" in offered(hass))
            await polled(other, new)
            assert len(old.writes) == told


async def test_who_may_dial_can_change(hass: HomeAssistant) -> None:
    box = EwsBox()
    async with listening(hass, box) as (entry, (dialler,)):
        status = await get_entity(hass, "sensor", entry, "1_status")
        hass.config_entries.async_update_entry(
            entry, options={"allowed": ["192.0.2.0/24"]}
        )
        await wait_for_state(hass, status, "unavailable")
        attempts = dialler.attempts
        await dialler.wait_for_async(lambda: dialler.attempts > attempts + 2)
        assert state_of(hass, status) == "unavailable"
        hass.config_entries.async_update_entry(
            entry, options={"allowed": ["192.0.2.0/24", "127.0.0.1/32"]}
        )
        await wait_for_state(hass, status, "available")
        assert entry.state is ConfigEntryState.LOADED


async def test_a_dead_box_does_not_delay_another(hass: HomeAssistant) -> None:
    """Connected and silent: each exchange with it takes its whole time-out of 2 s."""
    dead, alive = EwsBox(), EwsBox(serial="012345678902")
    async with listening(hass, dead, alive) as (entry, (_, other)):
        limit = await get_entity(hass, "number", entry, "1_charging_current", index=1)
        status = await get_entity(hass, "sensor", entry, "1_status", index=1)
        silent = entry.runtime_data.chargers["ews01_1"].charger
        before = len(alive.commands_named("rc"))
        dead.faults.dead = True
        loop = asyncio.get_running_loop()
        begin, longest = loop.time(), 0.0
        while (took := loop.time() - begin) < 5:
            start = loop.time()
            value = 7 + int(start * 10) % 9
            await call(hass, "number.set_value", limit, value=value)
            assert alive.ports[0].limit == value
            longest = max(longest, loop.time() - start)
            await asyncio.sleep(0.05)
        assert silent.statistics.timeouts
        assert longest < 1.0
        assert len(alive.commands_named("rc")) - before > 2 * took
        assert state_of(hass, status) == "available"
        assert other.attempts == 1


async def test_orders_come_back_for_each_port_of_each_box(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    one, two = EwsBox(), EwsBox(serial="012345678902")
    async with listening(hass, one, two) as (entry, (first, second)):
        wanted = {(0, 1): 7, (0, 2): 8, (1, 1): 9, (1, 2): 10}
        for (index, port), amperes in wanted.items():
            limit = await get_entity(
                hass, "number", entry, f"{port}_charging_current", index=index
            )
            await call(hass, "number.set_value", limit, value=amperes)
        await shut_down(hass, entry)
        for (index, port), amperes in wanted.items():
            record = stored_order(hass_storage, f"ews0{index + 1}", port)
            assert record["limit"]["current"] == amperes
        for dialler, box in ((first, one), (second, two)):
            dialler.call(lambda box=box: [setattr(p, "limit", 0) for p in box.ports])
        await hass.config_entries.async_setup(entry.entry_id)
        for dialler, box, amperes in ((first, one, (7, 8)), (second, two, (9, 10))):
            await dialler.wait_for_async(
                lambda box=box, amperes=amperes: (
                    tuple(port.limit for port in box.ports) == amperes
                ),
                timeout=10,
            )
        found = entity_id(hass, "number", entry, "2_charging_current", index=1)
        await wait_for_state(hass, found or "", "10.0")
