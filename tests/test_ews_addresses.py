"""Addresses from which boxes have dialled: kept over a restart of Home Assistant."""

from datetime import timedelta
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any

from homeassistant.const import EVENT_HOMEASSISTANT_FINAL_WRITE
from homeassistant.util import dt as dt_util
import pytest
from pytest_homeassistant_custom_component.common import async_fire_time_changed

from custom_components.evse_bus.evse.ews.network.admission import group_of
from custom_components.evse_bus.stores.addresses import (
    ADDRESSES,
    ADDRESSES_DELAY,
    ADDRESSES_KEY,
    AddressStore,
)
from tests.common import wait_until
from tests.listening import (
    HOST,
    OTHER,
    SERIAL,
    dialling,
    listener_of,
    listening,
    stored_box,
)

if TYPE_CHECKING:
    from homeassistant.core import HomeAssistant
    from pytest_homeassistant_custom_component.common import MockConfigEntry

pytestmark = pytest.mark.usefixtures("socket_enabled")

STORED = {
    "version": 1,
    "minor_version": 1,
    "key": ADDRESSES_KEY,
    "data": {SERIAL: ["192.0.2.7", "192.0.2.8"], OTHER: ["192.0.2.9"]},
}


def kept_for(entry: MockConfigEntry, address: str) -> bool:
    """Return whether the listener keeps places for this address."""
    return group_of(ip_address(address)) in listener_of(entry)._admission._known


async def test_the_address_of_a_box_is_stored_and_kept_a_place_for(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    async with listening(hass, stored_box(SERIAL)) as entry:
        assert not kept_for(entry, HOST)
        with dialling(entry):
            await wait_until(hass, lambda: kept_for(entry, HOST))
            assert ADDRESSES_KEY not in hass_storage
            later = dt_util.utcnow() + timedelta(seconds=ADDRESSES_DELAY + 1)
            async_fire_time_changed(hass, later)
            await hass.async_block_till_done(wait_background_tasks=True)
        assert hass_storage[ADDRESSES_KEY]["data"] == {SERIAL: [HOST]}
        assert await hass.config_entries.async_unload(entry.entry_id)
        hass.data[ADDRESSES] = AddressStore(hass)
        assert await hass.config_entries.async_setup(entry.entry_id)
        assert kept_for(entry, HOST)


async def test_the_last_address_is_stored_when_home_assistant_stops(
    hass: HomeAssistant, hass_storage: dict[str, Any]
) -> None:
    """What belongs to no box that is set up is not stored again."""
    hass_storage[ADDRESSES_KEY] = STORED
    async with listening(hass, stored_box(SERIAL)) as entry:
        assert kept_for(entry, "192.0.2.7")
        assert not kept_for(entry, "192.0.2.9")
        with dialling(entry):
            await wait_until(hass, lambda: kept_for(entry, HOST))
            hass.bus.async_fire(EVENT_HOMEASSISTANT_FINAL_WRITE)
            await hass.async_block_till_done()
            assert hass_storage[ADDRESSES_KEY]["data"] == {
                SERIAL: [HOST, "192.0.2.7", "192.0.2.8"]
            }


@pytest.mark.parametrize("data", [{SERIAL: ["nowhere"]}, {SERIAL: 7}, []])
async def test_a_file_that_cannot_be_read_costs_the_places_only(
    hass: HomeAssistant, hass_storage: dict[str, Any], data: object
) -> None:
    hass_storage[ADDRESSES_KEY] = {**STORED, "data": data}
    async with listening(hass, stored_box(SERIAL)) as entry:
        assert not kept_for(entry, "192.0.2.7")
        with dialling(entry):
            await wait_until(hass, lambda: kept_for(entry, HOST))
