"""A polled box whose own maximum is above its wiring: reported, and lowered on request."""

from homeassistant.core import HomeAssistant
from homeassistant.data_entry_flow import FlowResultType
from homeassistant.helpers import issue_registry as ir
import pytest

from custom_components.evse_bus.evse.model import Setting
from tests.common import call, get_entity, running, state_of, wait_until
from tests.flow import Flow, issue
from tests.smartevse import car, shorten_quiet
from tests.virtual import SmartEvse


def key(box: SmartEvse) -> str:
    return f"begins_above_limit_smartevse{box.unit}"


def issues(hass: HomeAssistant) -> dict[tuple[str, str], ir.IssueEntry]:
    return ir.async_get(hass).issues


async def reported(hass: HomeAssistant, box: SmartEvse) -> ir.IssueEntry:
    await wait_until(hass, lambda: issue(hass, key(box)) is not None)
    found = issue(hass, key(box))
    assert found is not None
    return found


@pytest.mark.parametrize("dialect", ["2.17", "2.20", "2.30", "2.30+"])
async def test_the_maximum_is_lowered_from_the_repair_issue(
    hass: HomeAssistant, monkeypatch: pytest.MonkeyPatch, dialect: str
) -> None:
    shorten_quiet(monkeypatch)
    box = SmartEvse(dialect, max_current=32, car=car())
    async with running(hass, box, installation_limit=16) as (entry, _):
        found = await reported(hass, box)
        assert found.severity is ir.IssueSeverity.WARNING
        assert found.is_fixable
        allowed = await get_entity(hass, "switch", entry, "charging_allowed")
        await call(hass, "switch.turn_off", allowed)
        box.car.plug_in()

        flow = await Flow.repair(hass, key(box))
        assert flow.step == "confirm"
        assert flow.tells("32 A", "installation limit is 16 A", "MAX = 16 A", "EEPROM")
        assert not box.eeprom_writes
        await flow.submit()
        await flow.wait()
        assert flow.result["type"] is FlowResultType.CREATE_ENTRY
        assert sum(box.eeprom_writes.values()) == 1
        assert box.outlet.settings["max_current"] == 16
        assert not box.access
        assert not issues(hass)


async def test_it_is_not_certain_that_it_was_lowered(hass: HomeAssistant) -> None:
    box = SmartEvse("2.20", max_current=32)
    async with running(hass, box, installation_limit=16):
        await reported(hass, box)
        flow = await Flow.repair(hass, key(box))
        box.faults.dead = True
        await flow.submit()
        await flow.wait()
        assert flow.result["type"] is FlowResultType.ABORT
        assert flow.result["reason"] == "not_lowered"
        assert flow.tells("not certain", "MAX = 16 A")
        # It may be tried again.
        assert issue(hass, key(box)) is not None
        box.faults.dead = False
        assert not box.eeprom_writes


async def test_a_charger_that_is_gone_cannot_be_repaired(hass: HomeAssistant) -> None:
    box = SmartEvse("2.20", max_current=32)
    async with running(hass, box, installation_limit=16) as (entry, _):
        await reported(hass, box)
        flow = await Flow.repair(hass, key(box))
        await hass.config_entries.async_unload(entry.entry_id)
        await flow.submit()
        assert flow.result["reason"] == "charger_gone"
        assert not box.eeprom_writes


@pytest.mark.usefixtures("all_entities_enabled")
async def test_the_issue_goes_with_what_causes_it(hass: HomeAssistant) -> None:
    """Lowered with the number, or at the box; or the wiring carries more."""
    box = SmartEvse("2.20", max_current=32)
    async with running(hass, box, installation_limit=16) as (entry, _):
        await reported(hass, box)
        highest = await get_entity(hass, "number", entry, "setting_maximum_current")
        assert state_of(hass, highest) == "32"
        await call(hass, "number.set_value", highest, value=16)
        await wait_until(hass, lambda: not issues(hass))


async def test_the_issue_goes_with_a_corrected_installation_limit(
    hass: HomeAssistant,
) -> None:
    box = SmartEvse("2.20", max_current=20)
    async with running(hass, box, installation_limit=16) as (entry, _):
        await reported(hass, box)
        [subentry] = entry.subentries.values()
        hass.config_entries.async_update_subentry(
            entry, subentry, data={**subentry.data, "installation_limit": 20}
        )
        await wait_until(hass, lambda: not issues(hass))
        assert not box.eeprom_writes


async def test_below_its_minimum_it_cannot_be_lowered_from_here(
    hass: HomeAssistant,
) -> None:
    box = SmartEvse("2.20", max_current=32, min_current=10)
    async with running(hass, box, installation_limit=8):
        found = await reported(hass, box)
        assert not found.is_fixable
        assert found.translation_key == "begins_above_limit"
        assert found.translation_placeholders is not None
        assert found.translation_placeholders["minimum"] == "10"


async def test_within_its_wiring_nothing_is_reported(hass: HomeAssistant) -> None:
    box = SmartEvse("2.20", max_current=16)
    async with running(hass, box, installation_limit=16.5) as (entry, _):
        await get_entity(hass, "sensor", entry, "fail_safe")
        [managed] = entry.runtime_data.chargers.values()
        await wait_until(
            hass, lambda: Setting.MAXIMUM_CURRENT in managed.charger.settings
        )
        assert not issues(hass)


async def test_a_slave_begins_with_what_it_is_sent(hass: HomeAssistant) -> None:
    """There the broadcast decides, and MAX bounds nothing."""
    box = SmartEvse("2.17", load_balance=2, max_current=32)
    async with running(hass, box, installation_limit=16) as (entry, _):
        [managed] = entry.runtime_data.chargers.values()
        await wait_until(
            hass, lambda: Setting.MAXIMUM_CURRENT in managed.charger.settings
        )
        assert managed.charger.begins_with is None
        assert not issues(hass)
