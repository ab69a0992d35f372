"""Integration for EV chargers on serial buses.

A config entry is one port or listener; each charger on it is a config subentry.
"""

from functools import partial
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

from .configuration import protocol_of, rebuild_data
from .connections import ListenerConnections, async_set_up_when_open
from .const import DOMAIN
from .coordinator import BusCoordinator, EvseBusConfigEntry
from .discovery import (
    async_follow_ignored,
    async_listener_gone,
    async_offer_when_started,
)
from .energy import TOTALS, TotalStore
from .errors import not_ready
from .evse.errors import LineError
from .identity import identity_of, stands_on_serial
from .issues import forget_energy, report_orders_written
from .services import async_register
from .stores.addresses import ADDRESSES, AddressStore
from .stores.orders import ORDERS, OrderStore, bus_key, subentry_keys

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
    """Register the actions and the stores, which all config entries share."""
    hass.data[ORDERS] = OrderStore(hass, partial(report_orders_written, hass))
    hass.data[TOTALS] = TotalStore(hass)
    hass.data[ADDRESSES] = AddressStore(hass)
    async_register(hass)
    return True


async def async_setup_entry(hass: HomeAssistant, entry: EvseBusConfigEntry) -> bool:
    """Set up a bus and its chargers from a config entry."""
    # Set before the start, so that diagnostics also cover a bus that fails to start.
    entry.runtime_data = coordinator = BusCoordinator(hass, entry)
    # Before the first exchange: Home Assistant may stop during the setup.
    entry.async_on_unload(
        hass.bus.async_listen_once(EVENT_HOMEASSISTANT_STOP, coordinator.async_shutdown)
    )
    try:
        await coordinator.async_start()
        await hass.config_entries.async_forward_entry_setups(entry, PLATFORMS)
    except LineError as error:
        await coordinator.async_stop()
        async_set_up_when_open(hass, entry, coordinator.connections)
        listens = coordinator.bus is None
        raise not_ready(error, coordinator.port, listens=listens) from error
    except BaseException:
        # A bus left running would keep the port busy for the next attempt.
        await coordinator.async_stop()
        raise
    entry.async_on_unload(entry.add_update_listener(_async_updated))
    if isinstance(coordinator.connections, ListenerConnections):
        listener = coordinator.connections.listener
        entry.async_on_unload(async_follow_ignored(hass, entry, listener))
        entry.async_on_unload(async_offer_when_started(hass, entry, listener))

    async def async_update_time_zone(_event: Event[Any]) -> None:
        await coordinator.all_chargers.async_sync()

    entry.async_on_unload(
        hass.bus.async_listen(EVENT_CORE_CONFIG_UPDATE, async_update_time_zone)
    )
    return True


async def async_unload_entry(hass: HomeAssistant, entry: EvseBusConfigEntry) -> bool:
    """Unload a config entry: the chargers' own fail-safe takes over."""
    unloaded = await hass.config_entries.async_unload_platforms(entry, PLATFORMS)
    if unloaded:
        await entry.runtime_data.all_chargers.async_stop_unproven()
        await entry.runtime_data.async_stop()
    return unloaded


async def async_remove_entry(hass: HomeAssistant, entry: EvseBusConfigEntry) -> None:
    """Delete the stored orders and the discovery flows of a removed entry.

    The orders of a charger with a serial number stay: it may return on another bus.
    """
    async_listener_gone(hass, entry)
    orders = hass.data[ORDERS]
    await orders.async_load()
    keys = [bus_key(entry.entry_id)]
    protocol = protocol_of(entry.data)
    for subentry in entry.subentries.values():
        identity = identity_of(subentry)
        forget_energy(hass, subentry.subentry_id)
        keys += subentry_keys(identity, protocol.ports)
        if not stands_on_serial(protocol, subentry):
            await hass.data[TOTALS].async_forget(identity)
    await orders.async_forget(keys)


async def async_remove_config_entry_device(
    hass: HomeAssistant,  # noqa: ARG001 - Home Assistant's signature
    entry: EvseBusConfigEntry,
    device: DeviceEntry | ChildDeviceEntry,
) -> bool:
    """Return whether a device may be removed: only that of a missing connector."""
    if entry.state is not ConfigEntryState.LOADED:
        # Which connectors exist is known only while the bus runs.
        return False
    return entry.runtime_data.remove_device(
        {key for domain, key in device.identifiers if domain == DOMAIN}
    )


async def _async_updated(hass: HomeAssistant, entry: EvseBusConfigEntry) -> None:
    """Apply a changed config entry; unchanged chargers are polled without a break."""
    coordinator = entry.runtime_data
    if rebuild_data(entry.data) != coordinator.rebuild_data:
        hass.config_entries.async_schedule_reload(entry.entry_id)
        return
    await coordinator.async_update_supply()
    await coordinator.all_chargers.async_sync()
