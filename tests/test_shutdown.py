"""What a polled SmartEVSE is told when Home Assistant stops: only what was chosen."""

import asyncio
from collections.abc import Awaitable, Callable, Iterable
from typing import Any

from homeassistant.config_entries import ConfigEntries, ConfigEntry
from homeassistant.const import EVENT_HOMEASSISTANT_STOP, Platform
from homeassistant.core import HomeAssistant
import pytest

from custom_components.evse_bus.chargers import managed
from custom_components.evse_bus.evse.smartevse import PolledSmartEvse
from custom_components.evse_bus.stores.orders import ORDERS_KEY
from tests.common import (
    call,
    get_entity,
    running,
    state_of,
    stored_order,
    wait_for_state,
)
from tests.smartevse import ACCESS, access_writes, car, shorten_quiet
from tests.virtual import SmartEvse


async def stop(hass: HomeAssistant) -> None:
    """Stop as Home Assistant does, as far as this integration can see."""
    hass.bus.async_fire(EVENT_HOMEASSISTANT_STOP)
    await hass.async_block_till_done()


@pytest.fixture
def short_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(managed, "SHUTDOWN_TIMEOUT", 0.5)


@pytest.mark.parametrize("dialect", ACCESS)
async def test_it_stops_with_home_assistant(
    hass: HomeAssistant,
    hass_storage: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    dialect: str,
) -> None:
    shorten_quiet(monkeypatch)
    box = SmartEvse(dialect, car=car())
    async with running(hass, box, time_scale=10, stop_on_shutdown=True) as (entry, bus):
        box.car.plug_in()
        status = await get_entity(hass, "sensor", entry, "1_status")
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        await call(hass, "switch.turn_on", allowed)
        await wait_for_state(hass, status, "charging")
        await entry.runtime_data.orders.async_flush()
        orders = hass_storage[ORDERS_KEY]["data"]

        await hass.async_stop(force=True)
        assert not box.access
        assert access_writes(box)[-1] == 0
        await bus.wait_for_async(lambda: not box.contactor)
        await bus.wait_for_async(lambda: not bus.connected)
        # What the user wants to stand is not what it was told.
        assert hass_storage[ORDERS_KEY]["data"] == orders
        assert stored_order(hass_storage, f"smartevse{box.unit}")["allowed"] is True


async def test_it_stays_off_until_somebody_switches_it_on(hass: HomeAssistant) -> None:
    box = SmartEvse(car=car())
    async with running(hass, box, stop_on_shutdown=True) as (entry, bus):
        box.car.plug_in()
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        await call(hass, "switch.turn_on", allowed)
        await stop(hass)
        await hass.config_entries.async_reload(entry.entry_id)
        await wait_for_state(hass, allowed, "off")
        polls = box.requests
        await bus.wait_for_async(lambda: box.requests > polls + 10)
        assert not box.access
        await call(hass, "switch.turn_on", allowed)
        assert box.access


async def test_without_the_option_it_goes_on(hass: HomeAssistant) -> None:
    box = SmartEvse(car=car())
    async with running(hass, box) as (entry, _):
        box.car.plug_in()
        charging = await get_entity(hass, "binary_sensor", entry, "1_charging")
        await wait_for_state(hass, charging, "on")
        await stop(hass)
        assert box.contactor
        assert not access_writes(box)


async def test_a_stop_right_at_the_start(
    hass: HomeAssistant, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The box is spoken to already, and its entities are not there yet."""
    forward = ConfigEntries.async_forward_entry_setups

    async def stopped_meanwhile(
        self: ConfigEntries, entry: ConfigEntry, platforms: Iterable[Platform]
    ) -> None:
        await stop(hass)
        await forward(self, entry, platforms)

    monkeypatch.setattr(ConfigEntries, "async_forward_entry_setups", stopped_meanwhile)
    box = SmartEvse(car=car())
    async with running(hass, box, stop_on_shutdown=True) as (_, bus):
        assert not box.access
        await bus.wait_for_async(lambda: not bus.connected)


async def test_a_reload_stops_nothing(hass: HomeAssistant) -> None:
    box = SmartEvse(car=car())
    async with running(hass, box, stop_on_shutdown=True) as (entry, bus):
        box.car.plug_in()
        charging = await get_entity(hass, "binary_sensor", entry, "1_charging")
        await wait_for_state(hass, charging, "on")
        await hass.config_entries.async_reload(entry.entry_id)
        await wait_for_state(hass, charging, "on")
        await hass.config_entries.async_unload(entry.entry_id)
        await bus.wait_for_async(lambda: not bus.connected)
        assert box.contactor
        assert not access_writes(box)


async def test_the_option_is_changed_without_an_interruption(
    hass: HomeAssistant,
) -> None:
    box = SmartEvse()
    async with running(hass, box) as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_status")
        subentry = entry.subentries["smartevse0"]
        charger = entry.runtime_data.chargers["smartevse0"].charger
        hass.config_entries.async_update_subentry(
            entry, subentry, data={**subentry.data, "stop_on_shutdown": True}
        )
        await hass.async_block_till_done()
        assert entry.runtime_data.chargers["smartevse0"].charger is charger
        await stop(hass)
        assert access_writes(box) == [0]
        assert bus.opened == 1


@pytest.mark.usefixtures("short_patience")
async def test_a_box_that_does_not_answer_holds_nothing_up(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    box = SmartEvse()
    async with running(hass, box, stop_on_shutdown=True) as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_status")
        bus.remove(box)
        begin = hass.loop.time()
        async with asyncio.timeout(5):
            await stop(hass)
        assert hass.loop.time() - begin < 4
        await bus.wait_for_async(lambda: not bus.connected)
    assert (
        "The shutdown command to Charger 0 failed (Home Assistant stops)" in caplog.text
    )


async def test_an_unplugged_adapter_holds_nothing_up(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    box = SmartEvse()
    async with running(hass, box, stop_on_shutdown=True) as (entry, bus):
        status = await get_entity(hass, "sensor", entry, "1_status")
        bus.unplug()
        await wait_for_state(hass, status, "unavailable")
        await stop(hass)
        assert state_of(hass, status) == "unavailable"
    assert (
        "The shutdown command to Charger 0 failed (Home Assistant stops)" in caplog.text
    )


async def fail(_charger: object, **_how: bool) -> None:
    message = "unforeseen"
    raise RuntimeError(message)


async def hang(_charger: object, **_how: bool) -> None:
    await asyncio.Event().wait()


@pytest.mark.usefixtures("short_patience")
@pytest.mark.parametrize(
    ("farewell", "said"),
    [(fail, "RuntimeError('unforeseen')"), (hang, "TimeoutError()")],
)
async def test_a_mistake_of_ours_holds_nothing_up(
    hass: HomeAssistant,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
    farewell: Callable[..., Awaitable[None]],
    said: str,
) -> None:
    monkeypatch.setattr(PolledSmartEvse, "on_shutdown", farewell)
    async with running(hass, SmartEvse()) as (entry, bus):
        await get_entity(hass, "sensor", entry, "1_status")
        async with asyncio.timeout(5):
            await stop(hass)
        await bus.wait_for_async(lambda: not bus.connected)
    message = "The shutdown command to Charger 0 failed (Home Assistant stops): "
    assert message + said in caplog.text
