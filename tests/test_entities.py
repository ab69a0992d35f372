"""All entities of every protocol as Home Assistant shows them, as snapshots."""

from collections.abc import Mapping
from contextlib import AbstractAsyncContextManager
from typing import Any

from attrs import evolve, fields
from homeassistant.const import Platform
from homeassistant.core import HomeAssistant
from homeassistant.helpers import device_registry as dr, entity_registry as er
import pytest
from syrupy.assertion import SnapshotAssertion

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.evse.protocols import PROTOCOLS
from custom_components.evse_bus.sensor_tables import BUS_SENSORS, CHARGER_STATISTICS
from tests.common import (
    call,
    get_entity,
    identity,
    running,
    wait_for_state,
    wait_until,
)
from tests.entity_table import VARYING, device_table, entity_table
from tests.ews import listening
from tests.virtual import AblBox, EvboxChargePoint, EwsBox, SmartEvse
from tests.virtual.device import Device

# What depends on when one looks, or on what flowed meanwhile.
UNSTEADY = (
    *("round_trip", "utilisation", "requests", "timeouts", "reasserted"),
    "missed_deadlines",
)
SUPPLY = {"smartevse_master": {"supply_limit": 20.0}}
READ_BACK = {
    "abl": ("offered_current",),
    **dict.fromkeys(("ews", "ews_network"), ("1_offered_current", "2_offered_current")),
}


@pytest.fixture(params=PROTOCOLS)
def protocol(request: pytest.FixtureRequest) -> str:
    """Return one protocol after the other; the sockets of those that need some."""
    key: str = request.param
    if PROTOCOLS[key].dials_in:
        request.getfixturevalue("socket_enabled")
    return key


def up(
    hass: HomeAssistant,
    protocol: str,
    device: Device,
    *,
    supply: Mapping[str, float] | None = None,
    **data: object,
) -> AbstractAsyncContextManager[tuple[Any, Any]]:
    """Run a bus or a listener with one virtual charger set up."""
    if PROTOCOLS[protocol].dials_in:
        assert isinstance(device, EwsBox)
        return listening(hass, device, **data)
    return running(hass, device, supply=supply, **data)


def boxes(protocol: str) -> tuple[Device, str, str]:
    """Return a virtual charger, and platform and key of what is there last."""
    if protocol == "abl":
        return AblBox(1), "sensor", "1_estimated_energy"
    if protocol == "evbox":
        return EvboxChargePoint(1923054, 2, min_interval=0), "sensor", "2_energy"
    if protocol == "smartevse":
        # Everything that a SmartEVSE can have.
        box = SmartEvse("2.30+", mode=1)
        return box, "select", "setting_mode_at_start"
    if protocol in ("ews", "ews_network"):
        # A lock, cards and keys; ventilation has no condition.
        return EwsBox(rfid=True, manual_io=True), "sensor", "2_energy"
    return SmartEvse(load_balance=2), "number", "setting_maximum_current"


@pytest.mark.usefixtures("all_entities_enabled")
async def test_entities(
    hass: HomeAssistant, snapshot: SnapshotAssertion, protocol: str
) -> None:
    device, platform, last = boxes(protocol)
    supply = SUPPLY.get(protocol)
    async with up(
        hass, protocol, device, supply=supply, poll_interval=0.5, order_lifetime=60
    ) as (entry, _):
        entity = await get_entity(hass, platform, entry, last)
        await wait_for_state(hass, entity, lambda state: state.state)
        for key in READ_BACK.get(protocol, ()):
            # Read back above the order, it is brought down right away.
            offered = await get_entity(hass, "sensor", entry, key)
            await wait_for_state(hass, offered, "6.0")
        await hass.async_block_till_done()
        registry = er.async_get(hass)
        entries = er.async_entries_for_config_entry(registry, entry.entry_id)
        assert {one.domain for one in entries} <= set(Platform)
        assert entity_table(hass, entries, UNSTEADY) == snapshot


@pytest.mark.usefixtures("all_entities_enabled")
async def test_devices(
    hass: HomeAssistant, snapshot: SnapshotAssertion, protocol: str
) -> None:
    device, platform, last = boxes(protocol)
    async with up(hass, protocol, device, poll_interval=0.5) as (entry, _):
        await get_entity(hass, platform, entry, last)
        registry = dr.async_get(hass)
        charger = identity(entry)
        find = registry.async_get_device_by_identifier
        child = registry.async_get_child_device_by_identifier
        devices = [
            find((DOMAIN, "bus"), "bus"),
            find((DOMAIN, charger), "bus"),
            child((DOMAIN, f"{charger}_1"), "bus"),
            child((DOMAIN, f"{charger}_2"), "bus"),
        ]
        assert device_table(filter(None, devices)) == snapshot


async def test_the_table_shows_every_change(hass: HomeAssistant) -> None:
    """A field that the table leaves out would change without a snapshot failing."""
    async with running(hass, AblBox(1)) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        one = er.async_get(hass).async_get(limit)
        assert one is not None
        before = entity_table(hass, [one], UNSTEADY)
        state = hass.states.get(limit)
        assert state is not None
        hidden = {
            field.name
            for field in fields(er.RegistryEntry)
            if field.init and field.name not in {*VARYING, "entity_id"}
            if entity_table(hass, [changed(one, field.name)], UNSTEADY) == before
        }
        for name in state.attributes:
            attributes = {**state.attributes, name: "changed"}
            hass.states.async_set(limit, state.state, attributes)
            if entity_table(hass, [one], UNSTEADY) == before:
                hidden.add(name)
        hass.states.async_set(limit, "changed", state.attributes)
        assert entity_table(hass, [one], UNSTEADY) != before
    assert not hidden


def changed(entry: er.RegistryEntry, name: str) -> er.RegistryEntry:
    """Return a registry entry with another value of one field."""
    value: object = "changed"
    if name in ("capabilities", "options"):
        value = {"sensor": {"changed": 1}}
    return evolve(entry, **{name: value})


async def test_only_what_a_charger_has(hass: HomeAssistant) -> None:
    """A box without a meter tells no currents: there is nothing to estimate from."""
    async with running(hass, AblBox(1, meter=False)) as (entry, _):
        await get_entity(hass, "sensor", entry, "1_status")
        await hass.async_block_till_done()
        keys = {
            one.unique_id.removeprefix(f"{identity(entry)}_")
            for one in er.async_entries_for_config_entry(er.async_get(hass), "bus")
            if one.config_subentry_id
        }
    assert "1_status" in keys
    assert not {key for key in keys if "current_l" in key or "estimated" in key}
    assert not keys & {"fail_safe_current", "fail_safe_timeout", "orders_expired"}


async def test_a_dead_charger_is_unavailable_and_the_others_are_not(
    hass: HomeAssistant,
) -> None:
    one, two = AblBox(1), AblBox(2, serial="2W22xy00000002")
    async with running(hass, one, two) as (entry, bus):
        dead = await get_entity(hass, "sensor", entry, "1_status", index=1)
        switch = await get_entity(hass, "switch", entry, "charging_allowed", index=1)
        alive = await get_entity(hass, "sensor", entry, "1_status")
        bus.remove(two)
        await wait_for_state(hass, dead, "unavailable")
        await wait_for_state(hass, switch, "unavailable")
        assert hass.states.get(alive).state == "available"
        bus.add(two)
        await wait_for_state(hass, dead, "available")


async def test_actions_on_a_dead_charger_are_skipped(hass: HomeAssistant) -> None:
    """By Home Assistant itself, without an error; the README says so."""
    box = AblBox(1)
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=12)
        bus.remove(box)
        await wait_for_state(hass, limit, "unavailable")
        await call(hass, "number.set_value", limit, value=8)
        bus.add(box)
        await wait_for_state(hass, limit, "12.0")


async def test_counters_are_disabled_by_default(hass: HomeAssistant) -> None:
    async with running(hass, AblBox(1)) as (entry, _):
        await get_entity(hass, "sensor", entry, "1_status")
        disabled = {
            one.unique_id
            for one in er.async_entries_for_config_entry(er.async_get(hass), "bus")
            if one.disabled_by is er.RegistryEntryDisabler.INTEGRATION
        }
    assert disabled == {
        *(f"bus_{one.key}" for one in BUS_SENSORS),
        *(f"{identity(entry)}_{one.key}" for one in CHARGER_STATISTICS),
    }


async def test_an_unplugged_adapter_and_back(
    hass: HomeAssistant, caplog: pytest.LogCaptureFixture
) -> None:
    async with running(hass, AblBox(1)) as (entry, bus):
        status = await get_entity(hass, "sensor", entry, "1_status")
        bus.unplug()
        await wait_for_state(hass, status, "unavailable")
        bus.replug()
        await wait_for_state(hass, status, "available")
        assert bus.opened == 2
    warnings = [
        one
        for one in caplog.records
        if one.levelname == "WARNING" and "the port" in one.getMessage()
    ]
    assert len(warnings) == 2


async def test_statistics_are_told_when_somebody_looks(hass: HomeAssistant) -> None:
    async with running(hass, AblBox(1)) as (entry, _):
        coordinator = entry.runtime_data
        await get_entity(hass, "sensor", entry, "1_status")
        assert coordinator._unsubscribe_statistics is None
        registry = er.async_get(hass)
        requests = registry.async_get_entity_id("sensor", DOMAIN, "bus_requests")
        assert registry.async_get(requests).disabled_by
        registry.async_update_entity(requests, disabled_by=None)
        await hass.config_entries.async_reload(entry.entry_id)
        await wait_until(hass, lambda: hass.states.get(requests))
        assert entry.runtime_data._unsubscribe_statistics is not None
        coordinator = entry.runtime_data
        await hass.config_entries.async_unload(entry.entry_id)
        assert coordinator._unsubscribe_statistics is None
