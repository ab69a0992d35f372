"""EVSE Bus: EV chargers on serial buses.

A config entry is one bus (one port), each charger on it is a config subentry.
"""

from typing import Any, Final

from homeassistant.config_entries import ConfigEntryState
from homeassistant.const import (
    EVENT_CORE_CONFIG_UPDATE,
    EVENT_HOMEASSISTANT_STOP,
    Platform,
)
from homeassistant.core import Event, HomeAssistant
from homeassistant.helpers import config_validation as cv
from homeassistant.helpers.device_registry import ChildDeviceEntry, DeviceEntry
from homeassistant.helpers.typing import ConfigType

from .configuration import made_of
from .connections import ListenerLines
from .const import DOMAIN
from .coordinator import BusCoordinator, EvseBusConfigEntry
from .discovery import (
    async_follow_ignored,
    async_listener_gone,
    async_offer_when_started,
)
from .errors import not_ready
from .evse.errors import LineError
from .orders import OrderStore
from .services import async_register

CONFIG_SCHEMA = cv.config_entry_only_config_schema(DOMAIN)

PLATFORMS: Final = [
    Platform.BINARY_SENSOR,
    Platform.BUTTON,
    Platform.EVENT,
    Platform.NUMBER,
    Platform.SELECT,
    Platform.SENSOR,
    Platform.SWITCH,
]


async def async_setup(
    hass: HomeAssistant,
    config: ConfigType,  # noqa: ARG001 - there is no YAML
) -> bool:
    """Set up the actions; everything else belongs to a bus."""
    async_register(hass)
    return True


async def async_setup_entry(hass: HomeAssistant, entry: EvseBusConfigEntry) -> bool:
    """Set up a bus and the chargers on it."""
    # There from the beginning, so that diagnostics can tell of a bus that fails.
    entry.runtime_data = coordinator = BusCoordinator(hass, entry)
    # Before a charger is spoken to: it is told also when the stop comes right then.
    entry.async_on_unload(
        hass.bus.async_listen_once(EVENT_HOMEASSISTANT_STOP, coordinator.async_shutdown)
    )
    try:
        await coordinator.async_start()
        await hass.config_entries.async_forward_entry_setups(entry, PLATFORMS)
    except LineError as error:
        await coordinator.async_stop()
        listens = coordinator.bus is None
        raise not_ready(error, coordinator.port, listens=listens) from error
    except BaseException:
        # A bus left running would hold the port against the next try.
        await coordinator.async_stop()
        raise
    entry.async_on_unload(entry.add_update_listener(_async_updated))
    if isinstance(coordinator.lines, ListenerLines):
        listener = coordinator.lines.listener
        entry.async_on_unload(async_follow_ignored(hass, entry, listener))
        entry.async_on_unload(async_offer_when_started(hass, entry, listener))

    async def follow_time_zone(_event: Event[Any]) -> None:
        await coordinator.async_match_subentries()

    entry.async_on_unload(
        hass.bus.async_listen(EVENT_CORE_CONFIG_UPDATE, follow_time_zone)
    )
    return True


async def async_unload_entry(hass: HomeAssistant, entry: EvseBusConfigEntry) -> bool:
    """Close the port; the chargers' own fail-safe takes over."""
    unloaded = await hass.config_entries.async_unload_platforms(entry, PLATFORMS)
    if unloaded:
        await entry.runtime_data.async_stop()
    return unloaded


async def async_remove_entry(hass: HomeAssistant, entry: EvseBusConfigEntry) -> None:
    """Delete the stored orders of a bus that is no more, and what it offered."""
    async_listener_gone(hass, entry)
    await OrderStore(hass, entry.entry_id).async_remove()


async def async_remove_config_entry_device(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
    device: DeviceEntry | ChildDeviceEntry,
) -> bool:
    """Return whether a device may be deleted: only a connector that is gone."""
    if entry.state is not ConfigEntryState.LOADED:
        # Nobody knows what is still there.
        return False
    return entry.runtime_data.forget_connector(
        {key for domain, key in device.identifiers if domain == DOMAIN}
    )


async def _async_updated(hass: HomeAssistant, entry: EvseBusConfigEntry) -> None:
    """Follow a changed set-up, without silencing chargers that did not change."""
    coordinator = entry.runtime_data
    if made_of(entry.data) != coordinator.data:
        hass.config_entries.async_schedule_reload(entry.entry_id)
        return
    await coordinator.async_follow_supply()
    await coordinator.async_match_subentries()
