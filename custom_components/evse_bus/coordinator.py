"""Coordinator of one bus: its chargers, their stored orders, their entities.

The library polls the chargers by its own schedule and calls back when something has
changed. An entity listens in one context (the bus, its statistics, a charger or a
connector) and is called only for changes in that context.
"""

import asyncio
from collections.abc import Callable
from datetime import datetime, timedelta
from functools import partial
from typing import Any, Final, override

from homeassistant.config_entries import (
    SIGNAL_CONFIG_ENTRY_CHANGED,
    ConfigEntry,
    ConfigEntryChange,
    ConfigEntryState,
    ConfigSubentry,
)
from homeassistant.const import CONF_ADDRESS
from homeassistant.core import CALLBACK_TYPE, Event, HomeAssistant, callback
from homeassistant.exceptions import ConfigEntryNotReady
from homeassistant.helpers.dispatcher import async_dispatcher_connect
from homeassistant.helpers.event import async_track_time_interval
from homeassistant.helpers.update_coordinator import BaseDataUpdateCoordinatorProtocol
from homeassistant.util import dt as dt_util

from .configuration import (
    changes_in_place,
    charger_configs,
    initial_orders,
    protocol_of,
    rebuild_data,
    supply_of,
)
from .connections import make_connections
from .const import CONF_SERIAL, DOMAIN, LOGGER, SUBENTRY_CHARGER
from .devices import BusDevices
from .discovery import async_set_up_now, async_wants_to_connect
from .energy import TOTALS
from .evse.bus import Bus
from .evse.listeners import notify
from .evse.model import ChargerConfig, Circuit, Fault, Orders
from .evse.safety import cautious
from .identity import Holder, identity_of, older_holder, stands_on_serial
from .issues import NOT_STORED, BusIssues
from .managed_charger import ManagedCharger, async_shut_down_chargers
from .stores.orders import (
    ORDERS,
    async_run_uncancelled,
    bus_key,
    charger_keys,
    stopped,
)
from .supply import SharedSupply

type EvseBusConfigEntry = ConfigEntry[BusCoordinator]
type Context = tuple[str, int | None]
"""Key of a managed charger and number of a connector, or one of the two below."""

BUS: Final[Context] = ("bus", None)
STATISTICS: Final[Context] = ("statistics", None)
STATISTICS_INTERVAL: Final = timedelta(seconds=30)
"""Counters change with every exchange; their listeners are called this often."""


class BusCoordinator(BaseDataUpdateCoordinatorProtocol):
    """Class to manage one bus and the chargers on it."""

    config_entry: EvseBusConfigEntry

    def __init__(self, hass: HomeAssistant, entry: EvseBusConfigEntry) -> None:
        """Initialize the coordinator; nothing is opened or read."""
        self.hass = hass
        self.config_entry = entry
        self.rebuild_data = rebuild_data(entry.data)
        """Entry data the bus was made from; a change requires a new bus."""
        self.protocol = protocol_of(entry.data)
        self.connections = make_connections(
            hass, entry, partial(async_wants_to_connect, hass, entry)
        )
        self.chargers: dict[str, ManagedCharger] = {}
        self.issues = BusIssues(hass, entry)
        self.devices = BusDevices(hass, entry, self.protocol.name)
        self.orders = hass.data[ORDERS]
        self.supply: SharedSupply | None = None
        """What the chargers share; ``None``: they share nothing."""
        if (installed := supply_of(entry.data)) is not None:
            self.supply = SharedSupply(
                installed,
                self.orders,
                bus_key(entry.entry_id),
                self._async_apply_supply,
            )
        self._not_stored: dict[str, tuple[str, ...]] = {}
        """New chargers whose first orders cannot be stored, with their order keys."""
        self._duplicates: dict[str, Holder] = {}
        """Subentries that are not started: their box is set up with an older one."""
        self._listeners: dict[Context, list[CALLBACK_TYPE]] = {}
        self._platforms: list[Callable[[ManagedCharger], None]] = []
        self._unsubscribe: list[CALLBACK_TYPE] = []
        self._unsubscribe_statistics: CALLBACK_TYPE | None = None
        self._lock = asyncio.Lock()
        """Held while chargers are added, changed or removed, and while stopping."""
        self._stopped = False

    @property
    def bus(self) -> Bus | None:
        """Return the bus of all chargers; ``None``: each box has its own."""
        return self.connections.shared_bus

    @property
    def port(self) -> str:
        """Return the name of the port or address, for messages."""
        return self.connections.name

    # -- Start and stop ----------------------------------------------------------

    async def async_start(self) -> None:
        """Load the orders and open the port.

        Raises LineError, and ConfigEntryNotReady when the first order of a new bus
        cannot be stored.
        """
        await self.orders.async_load()
        self._unsubscribe.append(self.orders.subscribe(self._on_orders_stored))
        self._unsubscribe.append(
            async_dispatcher_connect(
                self.hass, SIGNAL_CONFIG_ENTRY_CHANGED, self._on_entry_changed
            )
        )
        await self._async_start_supply()
        await self.async_sync_subentries()
        if self.bus is not None:
            self._unsubscribe.append(self.bus.subscribe(partial(self._notify, BUS)))
        await self.connections.start()

    async def _async_start_supply(self) -> None:
        if self.supply is None or self.connections.master is None:
            return
        registered = self.devices.has(self.config_entry.entry_id)
        if not await self.supply.async_start(registered=registered):
            raise ConfigEntryNotReady(
                translation_domain=DOMAIN, translation_key=NOT_STORED
            )
        if self.supply.is_lost:
            self.issues.supply_lost(self.supply.limit)
        self._unsubscribe.append(self.connections.master.subscribe(self._on_master))

    async def async_shutdown(self, _event: Event) -> None:
        """Send the shutdown commands and stop, when Home Assistant stops."""
        await async_shut_down_chargers(
            [managed.charger for managed in self.chargers.values()]
        )
        await self.async_stop()

    async def async_stop(self) -> None:
        """Close the port, end all subscriptions and write pending orders."""
        async with self._lock:
            self._stopped = True
            while self._unsubscribe:
                self._unsubscribe.pop()()
            await self.connections.stop()
            for managed in self.chargers.values():
                managed.unsubscribe()
            await self.orders.async_flush()
            self.issues.clear()

    # -- Shared supply -----------------------------------------------------------

    async def async_update_supply(self) -> None:
        """Apply the supply of the entry data, which may have changed."""
        installed = supply_of(self.config_entry.data)
        if self.supply is not None and installed is not None:
            await self.supply.async_update_installed(installed)

    async def async_order_supply(self, value: float) -> None:
        """Limit the sum of all chargers, A per phase; raises RefusedOrderError."""
        if self.supply is not None:
            # Once it is on disk it must take effect, even if the caller is cancelled.
            order = self.supply.async_order(value)
            await async_run_uncancelled(self.hass, order, "evse_bus shared supply")
            self.issues.supply_renewed()

    async def _async_apply_supply(self, circuit: Circuit) -> None:
        self._notify(BUS)
        if self.connections.master is not None:
            await self.connections.master.change_circuit(circuit)

    @callback
    def _on_master(self) -> None:
        if self.connections.master is not None:
            self.issues.check_bus(self.connections.master.noticed)
        self._notify(BUS)

    # -- Add, change and remove chargers -----------------------------------------

    async def async_sync_subentries(self) -> None:
        """Add, change and remove chargers to match the subentries.

        Chargers whose configuration has not changed are polled without a break.
        """
        async with self._lock:
            if self._stopped:
                return
            entry = self.config_entry
            self.connections.rename(entry.title)
            self.connections.update_options(entry.options)
            self.devices.register_bus()
            time_zone = dt_util.get_default_time_zone()
            configured = {
                config.key: (subentry, config)
                for subentry in entry.get_subentries_of_type(SUBENTRY_CHARGER)
                for config in charger_configs(entry.data, subentry, time_zone)
            }
            for key in self.chargers.keys() - configured.keys():
                await self._async_remove_charger(self.chargers[key])
            self._duplicates = self._find_duplicates()
            self.issues.set_up_twice(self._duplicates)
            # All ports of a box together, before the first one of another box.
            for one in tuple(self.chargers.values()):
                if one.subentry_id in self._duplicates or one.identity != identity_of(
                    configured[one.key][0]
                ):
                    await self._async_take_off(one)
            for key, (subentry, config) in configured.items():
                if subentry.subentry_id in self._duplicates:
                    continue
                if (managed := self.chargers.get(key)) is None:
                    await self._async_add_charger(subentry, config)
                else:
                    await self._async_change_charger(managed, subentry, config)
            for key in self._not_stored.keys() - configured.keys():
                await self.orders.async_forget(self._not_stored.pop(key))

    def _find_duplicates(self) -> dict[str, Holder]:
        """Return the subentries whose box is set up with an older subentry, too."""
        return {
            subentry.subentry_id: other
            for subentry in self.config_entry.get_subentries_of_type(SUBENTRY_CHARGER)
            if (other := older_holder(self.hass, self.protocol, subentry)) is not None
        }

    @callback
    def _on_entry_changed(
        self, _change: ConfigEntryChange, entry: EvseBusConfigEntry
    ) -> None:
        """Follow another entry that has added, removed or identified a box."""
        if entry.domain != DOMAIN:
            return
        for managed in self.chargers.values():
            if Fault.WRONG_CHARGER in managed.charger.noticed:
                # Where the wrong box is set up may have changed.
                self.issues.check(managed)
        if self._find_duplicates() != self._duplicates:
            self.config_entry.async_create_task(
                self.hass,
                self._async_follow(entry),
                "evse_bus boxes",
                eager_start=False,
            )

    async def _async_follow(self, other: EvseBusConfigEntry) -> None:
        if other.state is ConfigEntryState.LOADED:
            # First it takes off what it no longer has: a box has one master.
            await other.runtime_data.async_settle()
        await self.async_sync_subentries()

    async def async_settle(self) -> None:
        """Wait until changes under way are made."""
        async with self._lock:
            return

    @callback
    def _on_orders_stored(self) -> None:
        """Start new chargers that waited for their first orders to be stored."""
        if self._not_stored:
            self.hass.async_create_task(
                self.async_sync_subentries(), "evse_bus waiting chargers"
            )

    async def _async_add_charger(
        self, subentry: ConfigSubentry, config: ChargerConfig
    ) -> None:
        key = config.key
        identity = identity_of(subentry)
        order_keys = charger_keys(self.protocol, identity, config)
        port_number = config.address if self.protocol.ports > 1 else None
        first = initial_orders(subentry, config)
        await self._async_hand_over(subentry)
        orders = await self.orders.async_begin(
            order_keys,
            first=first,
            fallback=stopped(first),
            owner=subentry.subentry_id,
            # The device registry outlives restarts.
            registered=self.devices.has_charger(identity, port_number),
        )
        if orders is None:
            self._not_stored[key] = order_keys
            return
        self._not_stored.pop(key, None)
        charger = self.protocol.charger(config, orders)
        bus = await self.connections.acquire_bus(config, subentry.title)
        managed = ManagedCharger(subentry, charger, bus, order_keys[0], port_number)
        self.chargers[key] = managed
        self.devices.register_charger(managed)
        self._put_on_bus(managed)
        self._report_lost_orders(managed)
        self._add_entities(managed)
        async_set_up_now(self.hass, self.protocol.identity(config.serial))

    async def _async_change_charger(
        self, managed: ManagedCharger, subentry: ConfigSubentry, config: ChargerConfig
    ) -> None:
        managed.subentry = subentry
        old = managed.charger
        if config == old.config:
            return
        LOGGER.debug("%s: configuration changed", config.name)
        # Its new serial number may be that of a box that is being offered.
        async_set_up_now(self.hass, self.protocol.identity(config.serial))
        earlier = self._move_orders(managed, config)
        if earlier is None and changes_in_place(old.config, config):
            old.reconfigure(config)
        else:
            managed.unsubscribe()
            await managed.bus.remove(old)
            await self.connections.release_bus(managed.bus)
            self.issues.forget(managed)
            orders = old.orders if earlier is None else cautious(old.orders, earlier)
            managed.charger = self.protocol.charger(config, orders)
            managed.address = config.address
            managed.bus = await self.connections.acquire_bus(config, subentry.title)
        self.devices.register_charger(managed)
        if managed.charger is not old:
            self._put_on_bus(managed)
            self._report_lost_orders(managed)
        self._on_charger(managed)
        await self.orders.async_flush()

    def _report_lost_orders(self, managed: ManagedCharger) -> None:
        if self.orders.is_lost(managed.order_key):
            self.issues.orders_lost(managed, managed.charger.orders)

    def _move_orders(
        self, managed: ManagedCharger, config: ChargerConfig
    ) -> Orders | None:
        """Give the orders another key, if the serial number has changed.

        Returns the orders that the box had earlier, if they lower those it has now.
        """
        keys = charger_keys(self.protocol, managed.identity, config)
        if keys[0] == managed.order_key:
            return None
        orders = self.orders.move(keys, managed.order_key, managed.subentry_id)
        managed.order_key = keys[0]
        now = managed.charger.orders
        if orders is None or cautious(now, orders) == now:
            return None
        LOGGER.info("%s: its earlier, lower orders count again", config.name)
        return orders

    async def _async_remove_charger(self, managed: ManagedCharger) -> None:
        managed.unsubscribe()
        await async_shut_down_chargers([managed.charger], removed=True)
        await managed.bus.remove(managed.charger)
        await self.connections.release_bus(managed.bus)
        await managed.async_remove_entities()
        del self.chargers[managed.key]
        self.devices.remove_port(managed)
        self.issues.forget(managed)
        await self.orders.async_forget(
            charger_keys(self.protocol, managed.identity, managed.charger.config)
        )
        if (
            managed.subentry_id not in self.config_entry.subentries
            and not stands_on_serial(self.protocol, managed.subentry)
        ):
            await self.hass.data[TOTALS].async_forget(managed.identity)
        self._notify(BUS)

    async def _async_take_off(self, managed: ManagedCharger) -> None:
        """Take a charger off the bus that stays set up.

        Its orders, devices and registered entities stay.
        """
        managed.unsubscribe()
        await managed.bus.remove(managed.charger)
        await self.connections.release_bus(managed.bus)
        await managed.async_remove_entities()
        del self.chargers[managed.key]
        self.issues.forget(managed)

    async def _async_hand_over(self, subentry: ConfigSubentry) -> None:
        """Let what belonged to another box of this subentry belong to its present one.

        Also after a restart in between: files first, then the registries.
        """
        identity = identity_of(subentry)
        before = self.devices.registered_identity(subentry.subentry_id)
        if before is None or before == identity:
            return
        LOGGER.info("%s is another box now", subentry.title)
        for config in charger_configs(self.config_entry.data, subentry):
            keys = charger_keys(self.protocol, identity, config)
            self.orders.hand_over(
                subentry.subentry_id,
                keys[0],
                initial_orders(subentry, config),
                f"_{config.address}" if self.protocol.ports > 1 else "",
            )
        await self.orders.async_flush()
        await self.hass.data[TOTALS].async_hand_over(before, identity)
        self.devices.hand_over(subentry.subentry_id, before, identity)

    def _put_on_bus(self, managed: ManagedCharger) -> None:
        charger = managed.charger
        charger.commit = partial(self._async_commit, managed)
        managed.subscriptions.append(
            charger.subscribe(partial(self._on_charger, managed))
        )
        if self.bus is None:
            managed.subscriptions.append(
                managed.bus.subscribe(partial(self._on_own_bus, managed))
            )
            # A box that waited for its registration is connected already.
            self._notify(BUS)
        managed.bus.add(charger)
        managed.subscriptions.append(charger.subscribe_events(managed.events.publish))

    async def _async_commit(self, managed: ManagedCharger, orders: Orders) -> None:
        await self.orders.async_commit(managed.order_key, orders)
        if not self.orders.is_lost(managed.order_key):
            self.issues.orders_renewed(managed)

    async def async_permission_set(self, managed: ManagedCharger) -> None:
        """Accept that the user has decided whether a charger may charge."""
        await self.orders.async_accept(managed.order_key)
        self.issues.orders_renewed(managed)

    # -- Updates from the library ------------------------------------------------

    @callback
    def _on_own_bus(self, managed: ManagedCharger) -> None:
        """Handle a box that has connected or disconnected."""
        self._notify((managed.key, None))
        if managed.is_primary_port:
            self._notify(BUS)

    @callback
    def _on_charger(self, managed: ManagedCharger) -> None:
        """Handle a changed reading, state or configuration of a charger."""
        charger = managed.charger
        self._store_address(managed)
        reading = charger.reading
        before = managed.connectors
        managed.connectors = (
            dict(reading.connectors)
            if reading is not None and charger.available
            else {}
        )
        self._update_structure(managed)
        self.issues.check(managed)
        self._notify((managed.key, None))
        for number in before.keys() | managed.connectors.keys():
            if before.get(number) != managed.connectors.get(number):
                self._notify((managed.key, number))

    def _update_structure(self, managed: ManagedCharger) -> None:
        """Add the devices and entities for newly found capabilities and connectors."""
        managed.connector_numbers |= managed.connectors.keys()
        charger = managed.charger
        structure = (
            charger.capabilities,
            charger.config.order_lifetime is None,
            frozenset(managed.connector_numbers),
            charger.info,
            frozenset(charger.settings),
        )
        if structure == managed.structure:
            return
        managed.structure = structure
        self._store_serial(managed)
        self.devices.register_charger(managed)
        self._add_entities(managed)

    def _store_address(self, managed: ManagedCharger) -> None:
        """Store the address that a charger was given over the wire, at once.

        Whoever has asked for it may have gone meanwhile.
        """
        address = managed.charger.config.address
        if address == managed.address:
            return
        LOGGER.info("%s has the address %s now", managed.name, address)
        managed.address = address
        self.hass.config_entries.async_update_subentry(
            self.config_entry,
            managed.subentry,
            data={**managed.subentry.data, CONF_ADDRESS: address},
        )

    def _store_serial(self, managed: ManagedCharger) -> None:
        """Store the first serial number read: no other box is accepted from then on."""
        info = managed.charger.info
        subentry = managed.subentry
        if info is None or info.serial is None or subentry.data.get(CONF_SERIAL):
            return
        self.hass.config_entries.async_update_subentry(
            self.config_entry,
            subentry,
            data={**subentry.data, CONF_SERIAL: info.serial},
        )

    # -- Entities and devices ----------------------------------------------------

    @callback
    def async_add_platform(
        self, add_entities: Callable[[ManagedCharger], None]
    ) -> None:
        """Call a platform for each charger, now and when more entities are found."""
        self._platforms.append(add_entities)
        for managed in self.chargers.values():
            add_entities(managed)

    def _add_entities(self, managed: ManagedCharger) -> None:
        for add_entities in self._platforms:
            add_entities(managed)

    def other_serial(self, subentry_id: str) -> str | None:
        """Return the serial number of a wrong box that answers in a charger's place."""
        for managed in self.chargers.values():
            charger = managed.charger
            if (
                managed.subentry_id == subentry_id
                and Fault.WRONG_CHARGER in charger.noticed
            ):
                return charger.other_serial
        return None

    def remove_device(self, identifiers: set[str]) -> bool:
        """Return whether a device may be removed: only that of a missing connector."""
        in_use = {self.config_entry.entry_id}
        for managed in self.chargers.values():
            in_use |= {managed.identity, managed.unique_key}
            for number in tuple(managed.connector_numbers):
                key = managed.connector_key(number)
                # A port is part of the configuration, even while its box is off.
                is_missing = (
                    managed.port_number is None and number not in managed.connectors
                )
                if is_missing and key in identifiers:
                    managed.remove_connector(number)
                else:
                    in_use.add(key)
        return not in_use & identifiers

    # -- Listeners ---------------------------------------------------------------

    @callback
    @override
    def async_add_listener(
        self, update_callback: CALLBACK_TYPE, context: Any = None
    ) -> Callable[[], None]:
        """Listen for updates in a context; without one, of the bus."""
        key: Context = context or BUS
        self._listeners.setdefault(key, []).append(update_callback)
        if key == STATISTICS and self._unsubscribe_statistics is None:
            self._unsubscribe_statistics = async_track_time_interval(
                self.hass, self._notify_statistics, STATISTICS_INTERVAL
            )
        return partial(self._remove_listener, key, update_callback)

    @callback
    def _remove_listener(self, key: Context, update_callback: CALLBACK_TYPE) -> None:
        listeners = self._listeners[key]
        listeners.remove(update_callback)
        if listeners:
            return
        del self._listeners[key]
        if key == STATISTICS and self._unsubscribe_statistics is not None:
            self._unsubscribe_statistics()
            self._unsubscribe_statistics = None

    @callback
    def _notify_statistics(self, _now: datetime) -> None:
        self._notify(STATISTICS)

    @callback
    def _notify(self, context: Context) -> None:
        notify(self._listeners.get(context, ()))
