"""Another EWS-Box, or one with fewer ports, behind what was set up."""

from dataclasses import replace
import logging
from typing import TYPE_CHECKING

from homeassistant.core import HomeAssistant
import pytest

from custom_components.evse_bus.const import DOMAIN
from custom_components.evse_bus.evse.ews.reader import EwsReader
from tests.common import (
    call,
    charger,
    entity_id,
    get_entity,
    running,
    setup_bus,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.ews import charge, limits, names, polled, quick_car
from tests.flow import issue
from tests.virtual import EwsBox, VirtualBus

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigSubentryDataWithId

SERIAL = "012345678901"
OTHER = "999999999999"
READS = {"id", "rs", "rp", "rz", "rc", "rd"}


def box_of(serial: str, **data: object) -> ConfigSubentryDataWithId:
    made = charger("ews", serial, serial=serial, title="Yard", **data)
    return {**made, "subentry_id": "ews01"}


async def test_another_box_is_told_nothing(
    hass: HomeAssistant,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG)
    quick = replace(EwsReader.timing, backoff=0.3, backoff_limit=0.3)
    monkeypatch.setattr(EwsReader, "timing", quick)
    box = EwsBox(serial=OTHER, cars=(quick_car(),))
    with VirtualBus.in_loop(box) as bus:
        entry = await setup_bus(hass, "ews", bus.url, box_of(SERIAL))
        problem = await get_entity(hass, "binary_sensor", entry, "1_problem")
        await wait_for_state(hass, problem, "on")
        fault = entity_id(hass, "sensor", entry, "1_fault") or ""
        assert state_of(hass, fault) == "wrong_charger"
        # Of a box with two ports, once.
        other = entity_id(hass, "sensor", entry, "2_fault") or ""
        await wait_for_state(hass, other, "wrong_charger")
        found = issue(hass, "wrong_charger_ews01_1")
        assert found is not None
        assert found.translation_placeholders is not None
        assert found.translation_placeholders["expected"] == SERIAL
        assert issue(hass, "wrong_charger_ews01_2") is None
        for port in (1, 2):
            limit = entity_id(hass, "number", entry, f"{port}_charging_current") or ""
            assert state_of(hass, limit) == "unavailable"
        await bus.wait_for_async(lambda: len(box.commands) > 10, timeout=20)
        assert not box.writes
        assert names(box.commands) <= READS

        # The right one comes back, and its order is there at once.
        box.serial = SERIAL
        await wait_for_state(hass, problem, "off")
        assert issue(hass, "wrong_charger_ews01_1") is None
        await bus.wait_for_async(
            lambda: box.ports[0].limit == box.ports[1].limit == 6, timeout=20
        )
        await hass.config_entries.async_unload(entry.entry_id)
    ours = [one.getMessage() for one in caplog.records if DOMAIN in one.name]
    assert any("another box answers" in one for one in ours)
    assert not any(SERIAL in one or OTHER in one for one in ours)


async def test_a_box_that_is_swapped_while_it_charges(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        switch = await charge(hass, entry, bus, box)
        other = EwsBox(serial=OTHER)
        bus.remove(box)
        # Cables are not swapped between two polls.
        await wait_for_state(hass, switch, "unavailable")
        bus.add(other)
        await wait_until(hass, lambda: issue(hass, "wrong_charger_ews01_1"))
        assert not other.writes
        assert names(other.commands) <= READS


async def test_a_port_that_there_is_not(hass: HomeAssistant) -> None:
    box = EwsBox(ports=1, cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        await wait_until(hass, lambda: issue(hass, "no_such_port_ews01_2"))
        assert issue(hass, "no_such_port_ews01_1") is None
        switch = await charge(hass, entry, bus, box)
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        await call(hass, "number.set_value", limit, value=9)
        assert box.ports[0].limit == 9
        other = entity_id(hass, "number", entry, "2_charging_current") or ""
        assert state_of(hass, other) == "unavailable"
        assert not limits(box, 2)
        fault = entity_id(hass, "sensor", entry, "2_fault") or ""
        await wait_for_state(hass, fault, "no_such_port")

        # The user corrects the set-up: port 1 does not notice.
        subentry = entry.subentries["ews01"]
        opened = bus.opened
        hass.config_entries.async_update_subentry(
            entry, subentry, data={**subentry.data, "ports": 1}
        )
        await hass.async_block_till_done()
        assert issue(hass, "no_such_port_ews01_2") is None
        assert hass.states.get(other) is None
        await polled(bus, box)
        assert (state_of(hass, switch), state_of(hass, limit)) == ("on", "9.0")
        assert bus.opened == opened
