"""A bus added in the frontend runs; the port of one that runs is changed."""

from pathlib import Path
from typing import TYPE_CHECKING

from homeassistant.config_entries import ConfigEntryState
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry

from custom_components.evse_bus.const import DOMAIN
from tests.common import (
    charger as stored_charger,
    get_entity,
    setup_bus,
    wait_for_state,
)
from tests.flow import IMPOSED, NOWHERE, Flow, charger, fields, port_step
from tests.virtual import AblBox, EvboxChargePoint, VirtualBus

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant

pytestmark = pytest.mark.usefixtures("quick_search")


# -- A reply time-out by hand ---------------------------------------------------------


@pytest.mark.parametrize("wait", [None, 8])
async def test_a_reply_time_out_by_hand(
    hass: HomeAssistant, wait: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An adapter with a round trip of 6 s is slower than what is learnt by itself."""
    monkeypatch.setattr("tests.flow.PATIENCE", 900.0)
    monkeypatch.setattr("tests.common.PATIENCE", 900.0)
    box = AblBox(1)
    with VirtualBus.in_loop(box) as bus:
        bus.adapter.delay_out = bus.adapter.delay_in = 3.0
        line = {} if wait is None else {"reply_timeout": wait}
        flow = await port_step(hass, "abl", bus.url, **line)
        await flow.wait()
        if wait is None:
            assert flow.step != "select"
            flow.abort()
            return
        await flow.submit({"chargers": ["1"], "installation_limit": 16})
        await flow.submit(charger("Box"))
        await flow.submit()
        entry = flow.result["result"]
        assert entry.data["reply_timeout"] == wait
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "available")
        assert entry.runtime_data.bus.wire.round_trip.timeout == wait

        # Left empty again, it is learnt again.
        flow = await Flow.change_bus(hass, entry)
        assert fields(flow)["line"]["reply_timeout"] == wait
        await flow.submit({"device": bus.url, "line": {}})
        assert "reply_timeout" not in entry.data
        await hass.async_block_till_done()
        assert entry.runtime_data.bus.wire.round_trip.timeout < wait
        await hass.config_entries.async_unload(entry.entry_id)


# -- Added ------------------------------------------------------------------------


async def test_abl_bus_runs_right_after_it_was_added(hass: HomeAssistant) -> None:
    box = AblBox(3, default_current=32)
    with VirtualBus.in_loop(box) as bus:
        flow = await port_step(hass, "abl", bus.url)
        await flow.wait()
        await flow.submit({"chargers": ["3"], "installation_limit": 16})
        await flow.submit(charger("Box", fail_safe_current=8))
        await flow.submit()
        await hass.async_block_till_done()
        entry = flow.result["result"]
        assert entry.state is ConfigEntryState.LOADED
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "available")
        # The box offered 32 A of its own: now it is what was confirmed.
        await bus.wait_for_async(lambda: box.ic_amps <= 8)
        assert await hass.config_entries.async_unload(entry.entry_id)


async def test_evbox_bus_runs_right_after_it_was_added(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054)
    with VirtualBus.in_loop(box) as bus:
        flow = await port_step(hass, "evbox", bus.url)
        await flow.choose("search_addresses")
        await flow.submit(IMPOSED | {"serial_numbers": ["1923054"]})
        await flow.wait()
        await flow.submit({"chargers": ["1923054"], "installation_limit": 16})
        found = len(box.orders)
        await flow.submit(charger("Box", fail_safe_current=5.5, fail_safe_timeout=90))
        assert len(box.orders) == found
        await flow.submit()
        await hass.async_block_till_done()
        entry = flow.result["result"]
        assert entry.state is ConfigEntryState.LOADED
        await bus.wait_for_async(lambda: len(box.orders) > found)
        first = box.orders[found]
        assert first.fallback == (5.5, 5.5, 5.5)
        assert first.timeout == 90
        # Less than 6 A is no current for a car.
        assert first.limits == (0, 0, 0)
        assert await hass.config_entries.async_unload(entry.entry_id)


# -- Changed while it runs --------------------------------------------------------


async def test_better_name_of_the_same_port_is_taken_without_opening_it_twice(
    hass: HomeAssistant, tmp_path: Path
) -> None:
    with VirtualBus.in_loop(AblBox(1)) as bus:
        entry = await setup_bus(
            hass, "abl", bus.url, stored_charger("abl", 1), title="My bus"
        )
        link = tmp_path / "usb-adapter"
        link.symlink_to(bus.url)
        flow = await Flow.change_bus(hass, entry)
        await flow.submit({"device": str(link), "line": {}})
        assert flow.result["reason"] == "reconfigure_successful"
        await hass.async_block_till_done()
        assert entry.data == {"protocol": "abl", "device": str(link)}
        assert entry.title == "My bus"
        assert entry.state is ConfigEntryState.LOADED
        assert entry.runtime_data.bus.line.url == str(link)
        assert await hass.config_entries.async_unload(entry.entry_id)


async def test_running_bus_moves_to_another_port(hass: HomeAssistant) -> None:
    with VirtualBus.in_loop(AblBox(1)) as bus, VirtualBus.in_loop(AblBox(1)) as other:
        entry = await setup_bus(hass, "abl", bus.url, stored_charger("abl", 1))
        flow = await Flow.change_bus(hass, entry)
        await flow.submit({"device": other.url, "line": {"stop_bits": "2"}})
        assert flow.result["reason"] == "reconfigure_successful"
        await hass.async_block_till_done()
        await bus.wait_for_async(lambda: not bus.connected)
        await other.wait_for_async(lambda: other.connected)
        assert entry.data["stop_bits"] == 2
        assert entry.state is ConfigEntryState.LOADED
        assert await hass.config_entries.async_unload(entry.entry_id)


async def test_port_that_cannot_be_opened_leaves_the_bus_running(
    hass: HomeAssistant,
) -> None:
    with VirtualBus.in_loop(AblBox(1)) as bus:
        entry = await setup_bus(hass, "abl", bus.url, stored_charger("abl", 1))
        flow = await Flow.change_bus(hass, entry)
        await flow.submit({"device": NOWHERE, "line": {}})
        assert flow.errors == {"base": "port_missing"}
        flow.abort()
        assert entry.data["device"] == bus.url
        assert bus.opened == 1
        assert await hass.config_entries.async_unload(entry.entry_id)


# -- Changed while it does not run ------------------------------------------------


def bus_entry(hass: HomeAssistant, device: str, **more: object) -> MockConfigEntry:
    entry = MockConfigEntry(
        domain=DOMAIN,
        title=f"EVBox bus ({Path(device).name})",
        data={"protocol": "evbox", "device": device} | more,
    )
    entry.add_to_hass(hass)
    return entry


@pytest.mark.usefixtures("not_set_up")
async def test_port_is_changed_once_it_can_be_opened(hass: HomeAssistant) -> None:
    entry = bus_entry(hass, NOWHERE, baudrate=9600)
    with VirtualBus.in_loop() as bus:
        flow = await Flow.change_bus(hass, entry)
        assert flow.step == "reconfigure"
        assert fields(flow) == {
            "device": NOWHERE,
            "line": {"baudrate": 9600, "parity": "n", "stop_bits": "1"},
        }
        await flow.submit({"device": NOWHERE, "line": {}})
        assert flow.errors == {"base": "port_missing"}
        assert entry.data["baudrate"] == 9600
        await flow.submit({"device": bus.url, "line": {}})
        assert flow.result["reason"] == "reconfigure_successful"
        await hass.async_block_till_done()
    assert entry.data == {"protocol": "evbox", "device": bus.url}
    assert entry.title.endswith(f" ({Path(bus.url).name})")


@pytest.mark.usefixtures("not_set_up")
async def test_own_name_of_a_bus_is_kept(hass: HomeAssistant) -> None:
    entry = bus_entry(hass, NOWHERE)
    hass.config_entries.async_update_entry(entry, title="Car park")
    with VirtualBus.in_loop() as bus:
        flow = await Flow.change_bus(hass, entry)
        await flow.submit({"device": bus.url, "line": {}})
        assert flow.result["reason"] == "reconfigure_successful"
        # The reload opens the port, so the bus must still be there.
        await hass.async_block_till_done()
    assert entry.title == "Car park"


@pytest.mark.usefixtures("not_set_up")
async def test_port_of_another_bus_is_refused(hass: HomeAssistant) -> None:
    entry = bus_entry(hass, NOWHERE)
    bus_entry(hass, "/dev/ttyOther")
    flow = await Flow.change_bus(hass, entry)
    await flow.submit({"device": "/dev/ttyOther", "line": {}})
    assert flow.result["reason"] == "already_configured"
    assert entry.data["device"] == NOWHERE
