"""EWS-Boxes that dial a listener: they come, go, and come back."""

import asyncio
import logging
import socket
from typing import Any

from homeassistant.config_entries import ConfigEntryState
from homeassistant.core import HomeAssistant
import pytest

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.evse.ews import accepted, listener as listening_to
from tests.common import (
    call,
    entity_id,
    get_entity,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.ews import (
    HOST,
    PAUSE,
    START,
    charge,
    dialler_of,
    free_port,
    limits,
    listener_entry,
    listening,
    orders,
    polled,
    quick_car,
)
from tests.flow import english
from tests.virtual import EwsBox

pytestmark = pytest.mark.usefixtures("socket_enabled")

SERIAL = "012345678901"
BOXES = "sensor.bus_connected_boxes"


def said(caplog: pytest.LogCaptureFixture, words: str) -> int:
    """Return how often we have said something that a user sees."""
    return sum(
        words in record.getMessage()
        for record in caplog.records
        if record.levelno >= logging.WARNING and DOMAIN in record.name
    )


async def test_a_listener_without_boxes(hass: HomeAssistant) -> None:
    async with listening(hass) as (entry, _):
        assert entry.state is ConfigEntryState.LOADED
        assert state_of(hass, BOXES) == "0"
        with socket.create_connection((HOST, entry.data["port"]), timeout=5):
            pass


async def test_a_box_dials_and_charges(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    async with listening(hass, box) as (entry, (dialler,)):
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        connected = await get_entity(hass, "binary_sensor", entry, "connected")
        assert state_of(hass, connected) == "on"
        await wait_for_state(hass, BOXES, "1")
        await call(hass, "number.set_value", limit, value=9.7)
        assert box.ports[0].limit == 9
        switch = await charge(hass, entry, dialler, box)
        await call(hass, "switch.turn_off", switch)
        assert orders(box) == [START, PAUSE]
        assert box.ports[0].locked
        assert dialler.attempts == 1


async def test_a_lost_connection_is_told_and_logged_once(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    box = EwsBox()
    async with listening(hass, box) as (entry, (dialler,)):
        status = await get_entity(hass, "sensor", entry, "1_status")
        other = await get_entity(hass, "sensor", entry, "2_status")
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        connected = await get_entity(hass, "binary_sensor", entry, "connected")
        await call(hass, "number.set_value", limit, value=11)
        for times in (1, 2):
            dialler.hang_up(redial=False)
            await wait_for_state(hass, status, "unavailable")
            await wait_for_state(hass, other, "unavailable")
            await wait_for_state(hass, connected, "off")
            await wait_for_state(hass, BOXES, "0")
            assert said(caplog, "Yard: the connection was lost") == times
            dialler.dial()
            await wait_for_state(hass, status, "available")
            await wait_for_state(hass, other, "available")
            assert state_of(hass, connected) == "on"
            await wait_for_state(hass, BOXES, "1")
            assert said(caplog, "Yard: connected again") == times
        assert said(caplog, "") == 4
        assert set(limits(box)) <= {6, 11}
        await dialler.wait_for_async(lambda: box.ports[0].limit == 11)


async def test_a_box_that_loses_its_power(
    hass: HomeAssistant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It goes without a word, comes back without a limit, and gets it."""
    monkeypatch.setattr(listening_to, "PROOF_TIME", 1.0)
    box = EwsBox(cars=(quick_car(),), restart_after_power=True)
    async with listening(hass, box, fail_safe_current=8.0) as (entry, (dialler,)):
        status = await get_entity(hass, "sensor", entry, "1_status")
        await charge(hass, entry, dialler, box)
        box.power_cycle(1.0)
        await dialler.wait_for_async(lambda: dialler.dial_port.opened == 2, timeout=20)
        await dialler.wait_for_async(lambda: box.ports[0].limit == 8, timeout=30)
        await dialler.wait_for_async(lambda: box.ports[0].contactor, timeout=30)
        await wait_for_state(hass, status, "charging")
        assert set(limits(box)) == {8}
        assert orders(box) == [START]


async def test_a_half_open_connection_ends(
    hass: HomeAssistant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A box that vanished is gone for us, too, and its next connection counts."""
    monkeypatch.setattr(accepted, "ANSWER_PATIENCE", 1.5)
    box = EwsBox()
    async with listening(hass, box) as (entry, (dialler,)):
        status = await get_entity(hass, "sensor", entry, "1_status")
        connected = await get_entity(hass, "binary_sensor", entry, "connected")
        dialler.vanish(redial=False)
        await wait_for_state(hass, connected, "off")
        assert state_of(hass, status) == "unavailable"
        dialler.dial()
        await wait_for_state(hass, status, "available")


async def test_a_new_connection_takes_the_place_of_a_half_open_one(
    hass: HomeAssistant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listening_to, "PROOF_TIME", 1.0)
    box = EwsBox()
    async with listening(hass, box) as (entry, (dialler,)):
        status = await get_entity(hass, "sensor", entry, "1_status")
        listener = entry.runtime_data.lines.listener
        dialler.vanish()
        await wait_until(hass, lambda: listener.statistics.replaced == 1)
        await wait_for_state(hass, status, "available")
        await polled(dialler, box)
        assert listener.statistics.seconds == 0


async def test_a_second_box_with_the_same_number_is_refused(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    box, double = EwsBox(), EwsBox()
    async with listening(hass, box) as (entry, (dialler,)):
        status = await get_entity(hass, "sensor", entry, "1_status")
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        listener = entry.runtime_data.lines.listener
        with dialler_of(entry, double) as second:
            await second.wait_for_async(lambda: len(second.dropped) > 2, timeout=20)
            assert listener.statistics.seconds > 1
            await call(hass, "number.set_value", limit, value=10)
            assert box.ports[0].limit == 10
            assert double.ports[0].limit == 0
            assert {one.name for one in double.commands} == {"id", "rs"}
        assert state_of(hass, status) == "available"
        assert dialler.attempts == 1
        assert said(caplog, "says that it is Yard") == 1
        # Once the first one is gone the number is free.
        dialler.hang_up(redial=False)
        await wait_for_state(hass, status, "unavailable")
        with dialler_of(entry, double) as second:
            await wait_for_state(hass, status, "available")
            await second.wait_for_async(lambda: double.ports[0].limit == 10)


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
        assert entry.runtime_data.lines.listener.statistics.strangers >= 1


def offered(hass: HomeAssistant) -> list[str | None]:
    """Return the unique ids of the boxes that are offered to the user."""
    return [
        flow["context"].get("unique_id")
        for flow in hass.config_entries.flow.async_progress_by_handler(DOMAIN)
        if flow["context"]["source"] == "integration_discovery"
    ]


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


# -- Nothing is left behind ------------------------------------------------------


def tasks() -> set[str]:
    """Return the names of our tasks."""
    return {
        name
        for one in asyncio.all_tasks()
        if (name := one.get_name()).startswith(("bus ", "EWS-Box"))
    }


async def test_a_reload_and_an_unload_leave_nothing_behind(
    hass: HomeAssistant,
) -> None:
    box, stranger = EwsBox(), EwsBox(serial="555555555555")
    async with listening(hass, box) as (entry, (dialler,)):
        status = await get_entity(hass, "sensor", entry, "1_status")
        assert tasks() == {"bus Yard"}
        with dialler_of(entry, stranger) as other:
            await other.wait_for_async(lambda: stranger.link_up)
            await hass.config_entries.async_reload(entry.entry_id)
            await wait_for_state(hass, status, "available")
            assert tasks() == {"bus Yard"}
            await other.wait_for_async(
                lambda: stranger.link_up and other.dial_port.opened == 2
            )
            await hass.config_entries.async_unload(entry.entry_id)
            assert entry.state is ConfigEntryState.NOT_LOADED
            assert not tasks()
            await dialler.wait_for_async(lambda: not dialler.connected)
            await other.wait_for_async(lambda: not other.connected)
            attempts = dialler.attempts
            await dialler.wait_for_async(lambda: dialler.attempts > attempts + 1)
            assert not dialler.connected
        # The port is free.
        with socket.socket() as one:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            one.bind((HOST, entry.data["port"]))
            one.listen()


async def test_a_port_that_is_taken(hass: HomeAssistant) -> None:
    port = free_port()
    entry = listener_entry(port)
    entry.add_to_hass(hass)
    with socket.socket() as taken:
        taken.bind((HOST, port))
        taken.listen()
        await hass.config_entries.async_setup(entry.entry_id)
        assert entry.state is ConfigEntryState.SETUP_RETRY
        assert entry.error_reason_translation_key == "listen_busy"
        text = english()["exceptions"]["listen_busy"]["message"]
        said = text.format(**entry.error_reason_translation_placeholders)
        assert f"{HOST}:{port}" in said
        assert not tasks()
    await hass.config_entries.async_reload(entry.entry_id)
    assert entry.state is ConfigEntryState.LOADED
    await hass.config_entries.async_unload(entry.entry_id)


async def test_an_address_that_is_not_ours(hass: HomeAssistant) -> None:
    entry = listener_entry(free_port())
    entry.add_to_hass(hass)
    data: dict[str, Any] = {**entry.data, "host": "192.0.2.1"}
    hass.config_entries.async_update_entry(entry, data=data)
    await hass.config_entries.async_setup(entry.entry_id)
    assert entry.state is ConfigEntryState.SETUP_RETRY
    assert entry.error_reason_translation_key == "listen_missing"


# -- Several boxes -------------------------------------------------------------------


async def test_a_dead_box_does_not_delay_another(hass: HomeAssistant) -> None:
    """Connected and silent: each exchange with it takes its whole time-out of 2 s."""
    dead, alive = EwsBox(), EwsBox(serial="012345678902")
    async with listening(hass, dead, alive) as (entry, (_, other)):
        limit = await get_entity(hass, "number", entry, "1_charging_current", index=1)
        status = await get_entity(hass, "sensor", entry, "1_status", index=1)
        silent = entry.runtime_data.units["ews01_1"].charger
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
        await hass.config_entries.async_unload(entry.entry_id)
        stored = hass_storage["evse_bus.bus"]["data"]
        assert {key: value["limit"]["current"] for key, value in stored.items()} == {
            "ews01_1": 7,
            "ews01_2": 8,
            "ews02_1": 9,
            "ews02_2": 10,
        }
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
