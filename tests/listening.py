"""Helpers of the tests in which EWS-Boxes dial the integration."""

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from typing import TYPE_CHECKING

from homeassistant.config_entries import ConfigEntryState
from pytest_homeassistant_custom_component.common import MockConfigEntry

from custom_components.evse_bus.const import DOMAIN
from tests.common import charger, wait_until
from tests.flow import offers
from tests.virtual import EwsBox, EwsDialler

if TYPE_CHECKING:
    from homeassistant.config_entries import ConfigSubentryData
    from homeassistant.core import HomeAssistant

    from custom_components.evse_bus.evse.ews import Listener

HOST = "127.0.0.1"
SERIAL = "012345678901"
OTHER = "000000000077"
RETRY = 0.1
"""Time after which a box dials again, s."""


def stored_box(serial: str, **data: object) -> ConfigSubentryData:
    """Return a box as the config flow stores it; polled fast."""
    stored = charger("ews", serial, serial=serial, title="Yard", **data)
    return {**stored, "subentry_id": f"ews{serial[-2:]}"}


@asynccontextmanager
async def listening(
    hass: HomeAssistant,
    *boxes: ConfigSubentryData,
    title: str = "Boxes",
    **options: object,
) -> AsyncIterator[MockConfigEntry]:
    """Listen at any free port; unloads when it is over, if it is still there."""
    entry = MockConfigEntry(
        domain=DOMAIN,
        title=title,
        data={"protocol": "ews_network", "host": HOST, "port": 0},
        options=options,
        subentries_data=boxes,
    )
    entry.add_to_hass(hass)
    await hass.config_entries.async_setup(entry.entry_id)
    await hass.async_block_till_done()
    assert entry.state is ConfigEntryState.LOADED, entry.reason
    try:
        yield entry
    finally:
        if entry.state is ConfigEntryState.LOADED:
            await hass.config_entries.async_unload(entry.entry_id)
            await hass.async_block_till_done()


def listener_of(entry: MockConfigEntry) -> Listener:
    return entry.runtime_data.connections.listener


@contextmanager
def dialling(
    entry: MockConfigEntry, box: EwsBox | None = None, *, port: int | None = None
) -> Iterator[EwsDialler]:
    """Let a box dial the listener of an entry, or another port."""
    with EwsDialler(
        box or EwsBox(serial=SERIAL),
        HOST,
        listener_of(entry).port if port is None else port,
        retry=RETRY,
        source_ports=0,
        own_thread=False,
    ) as dialler:
        yield dialler


async def offered(hass: HomeAssistant, serial: str = SERIAL) -> str:
    """Wait until a box appears under Discovered; return the id of its flow."""
    name = f"EWS-Box {serial}"
    await wait_until(hass, lambda: name in offers(hass))
    return offers(hass)[name]
