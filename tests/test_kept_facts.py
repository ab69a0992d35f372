"""What is read of a box and kept with it: its serial number, the dialect of its firmware."""

from typing import Any
from unittest.mock import patch

from homeassistant.core import HomeAssistant
from homeassistant.helpers import device_registry as dr
import pytest
from pytest_homeassistant_custom_component.common import MockConfigEntry

from custom_components.evse_bus.diagnostics import async_get_config_entry_diagnostics
from tests.common import get_entity, running, state_of, wait_for_state, wait_until
from tests.flow import Flow
from tests.smartevse import shorten_quiet
from tests.test_coordinator import issue
from tests.virtual import SmartEvse

pytestmark = pytest.mark.usefixtures("quick_search")


@pytest.fixture(autouse=True)
def short_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poll a later box more often than a real one may be."""
    shorten_quiet(monkeypatch)


def kept(entry: MockConfigEntry) -> dict[str, Any]:
    """Return what is kept of the one box of a bus."""
    [subentry] = entry.subentries.values()
    return {key: subentry.data.get(key) for key in ("dialect", "serial")}


def firmware(hass: HomeAssistant, entry: MockConfigEntry) -> str | None:
    """Return the firmware that the device of the box shows."""
    [device] = [
        one
        for one in dr.async_entries_for_config_entry(dr.async_get(hass), entry.entry_id)
        if one.config_subentry_id
    ]
    return device.sw_version


async def test_the_dialect_found_is_kept_and_written_once(hass: HomeAssistant) -> None:
    entries = hass.config_entries
    with patch.object(
        entries, "async_update_subentry", wraps=entries.async_update_subentry
    ) as written:
        async with running(hass, SmartEvse("2.30", serial=4711), time_scale=10) as (
            entry,
            bus,
        ):
            await get_entity(hass, "sensor", entry, "1_status")
            assert kept(entry) == {"dialect": "2.30", "serial": "4711"}
            assert firmware(hass, entry) == "2.30"
            # A new connection probes it again, and finds the same.
            bus.unplug()
            bus.replug()
            replies = bus.log.total
            await bus.wait_for_async(lambda: bus.log.total > replies + 10)
            await get_entity(hass, "sensor", entry, "1_status")
            assert written.call_count == 1
            data = await async_get_config_entry_diagnostics(hass, entry)
            [charger] = data["chargers"]
            assert charger["config"]["dialect"] == "2.30"


@pytest.mark.parametrize("expected", ["2.30+", "9.99"])
async def test_a_box_is_probed_whatever_is_expected(
    hass: HomeAssistant, expected: str
) -> None:
    """Its firmware was changed while Home Assistant was off; or this was downgraded."""
    box = SmartEvse("2.30")
    async with running(hass, box, time_scale=10, dialect=expected) as (entry, _):
        await get_entity(hass, "sensor", entry, "1_status")
        assert kept(entry)["dialect"] == "2.30"
        assert firmware(hass, entry) == "2.30"


async def test_a_new_firmware_replaces_the_dialect(hass: HomeAssistant) -> None:
    before, after = SmartEvse("2.30", serial=4711), SmartEvse("2.30+", serial=4711)
    async with running(hass, before, time_scale=10) as (entry, bus):
        status = await get_entity(hass, "sensor", entry, "1_status")
        bus.remove(before)
        await wait_for_state(hass, status, "unavailable")
        bus.add(after)
        await wait_until(hass, lambda: kept(entry)["dialect"] == "2.30+")
        await wait_until(
            hass, lambda: firmware(hass, entry) == "2.30, development version"
        )


async def test_nothing_is_kept_of_a_box_that_is_not_the_right_one(
    hass: HomeAssistant,
) -> None:
    before, after = SmartEvse("2.30", serial=4711), SmartEvse("2.30+", serial=4712)
    async with running(hass, before, time_scale=10) as (entry, bus):
        status = await get_entity(hass, "sensor", entry, "1_status")
        bus.remove(before)
        await wait_for_state(hass, status, "unavailable")
        bus.add(after)
        key = f"wrong_charger_{next(iter(entry.subentries))}"
        await wait_until(hass, lambda: issue(hass, key))
        assert kept(entry) == {"dialect": "2.30", "serial": "4711"}


async def test_a_changed_configuration_keeps_it_and_another_box_does_not(
    hass: HomeAssistant,
) -> None:
    async with running(hass, SmartEvse("2.30", serial=4711), time_scale=10) as (
        entry,
        bus,
    ):
        status = await get_entity(hass, "sensor", entry, "1_status")
        [subentry] = entry.subentries.values()
        flow = await Flow.change_settings(hass, entry, subentry)
        await flow.submit(
            {
                "name": "Yard",
                "unit": "1",
                "installation_limit": 13,
                "stop_on_shutdown": False,
                "expert": {"poll_interval": 2, "voltage": 230},
            }
        )
        assert kept(entry) == {"dialect": "2.30", "serial": "4711"}
        assert state_of(hass, status) == "available"
        bus.unplug()
        flow = await Flow.replace_charger(hass, entry, subentry)
        await flow.submit({"serial": "4712"})
        assert kept(entry) == {"dialect": None, "serial": "4712"}
