"""EWS-Boxes that dial a listener: they come, go, and come back."""

import asyncio
import socket
from typing import Any

from homeassistant.config_entries import ConfigEntryState
from homeassistant.core import HomeAssistant
import pytest

from custom_components.evse_bus.diagnostics import (
    async_get_config_entry_diagnostics,
)
from custom_components.evse_bus.evse.ews.network import line, listener as listening_to
from tests.common import (
    call,
    ews_charger,
    free_port,
    get_entity,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.ews import (
    BOXES,
    HOST,
    PAUSE,
    START,
    charge,
    dialler_of,
    limits,
    listener_entry,
    listening,
    orders,
    polled,
    quick_car,
    said,
)
from tests.flow import english
from tests.virtual import EwsBox

pytestmark = pytest.mark.usefixtures("socket_enabled")


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
    monkeypatch.setattr(line, "ANSWER_PATIENCE", 1.5)
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
        listener = entry.runtime_data.connections.listener
        dialler.vanish()
        await wait_until(hass, lambda: listener.statistics.replaced == 1)
        await wait_for_state(hass, status, "available")
        await polled(dialler, box)
        assert listener.statistics.duplicates == 0


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
            await other.wait_for_async(lambda: stranger.requests)
            asked = stranger.requests
            await hass.config_entries.async_reload(entry.entry_id)
            await wait_for_state(hass, status, "available")
            assert tasks() == {"bus Yard"}
            await other.wait_for_async(
                lambda: stranger.requests > asked and other.dial_port.opened == 2
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
    box = EwsBox()
    entry = listener_entry(port, ews_charger(box))
    entry.add_to_hass(hass)
    with socket.socket() as taken:
        taken.bind((HOST, port))
        taken.listen()
        await hass.config_entries.async_setup(entry.entry_id)
        assert entry.state is ConfigEntryState.SETUP_RETRY
        assert entry.error_reason_translation_key == "listen_busy"
        text = english()["exceptions"]["listen_busy"]["message"]
        shown = text.format(**entry.error_reason_translation_placeholders)
        assert f"{HOST}:{port}" in shown
        assert not tasks()
        # What helps to find out why can be downloaded all the same.
        told = await async_get_config_entry_diagnostics(hass, entry)
        assert [one["bus"]["connected"] for one in told["boxes"]] == [False]
    await asyncio.sleep(10)
    assert entry.state is ConfigEntryState.LOADED
    with dialler_of(entry, box):
        await get_entity(hass, "sensor", entry, "1_status")
        await hass.config_entries.async_unload(entry.entry_id)


async def test_an_address_that_is_not_ours(hass: HomeAssistant) -> None:
    entry = listener_entry(free_port())
    entry.add_to_hass(hass)
    data: dict[str, Any] = {**entry.data, "host": "192.0.2.1"}
    hass.config_entries.async_update_entry(entry, data=data)
    await hass.config_entries.async_setup(entry.entry_id)
    assert entry.state is ConfigEntryState.SETUP_RETRY
    assert entry.error_reason_translation_key == "listen_missing"
