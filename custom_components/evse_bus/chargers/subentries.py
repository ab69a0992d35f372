"""The chargers of one bus, kept in step with the subentries of its config entry.

Adding, changing or removing one is done in place: the others are polled without a break.
"""

import asyncio
from functools import partial
from typing import Protocol

from homeassistant.config_entries import (
    SIGNAL_CONFIG_ENTRY_CHANGED,
    ConfigEntry,
    ConfigEntryChange,
    ConfigEntryState,
    ConfigSubentry,
)
from homeassistant.const import CONF_ADDRESS
from homeassistant.core import CALLBACK_TYPE, HomeAssistant, callback
from homeassistant.helpers.dispatcher import async_dispatcher_connect
from homeassistant.util import dt as dt_util

from ..configuration import (
    changes_in_place,
    charger_configs,
    initial_orders,
    protocol_of,
)
from ..connections import Connections
from ..const import (
    CONF_REFUSED,
    CONF_SERIAL,
    DOMAIN,
    LOGGER,
    SUBENTRY_CHARGER,
)
from ..discovery import async_set_up_now
from ..energy import TOTALS
from ..evse.model import ChargerConfig, FailSafe, Fault, Orders
from ..evse.safety import cautious
from ..identity import Holder, holders, identity_of, older_holder, stands_on_serial
from ..issues import BusIssues
from ..stores.orders import ORDERS, charger_keys, stopped
from .devices import BusDevices
from .managed import ManagedCharger, async_shut_down_chargers


class ChargerWatcher(Protocol):
    """What a coordinator wants to know of its chargers."""

    def on_added(self, managed: ManagedCharger) -> None:
        """Handle a new charger, or another one in its place."""

    def on_charger(self, managed: ManagedCharger) -> None:
        """Handle a changed reading, state or configuration of a charger."""

    def on_own_bus(self, managed: ManagedCharger) -> None:
        """Handle a box that has connected or disconnected."""

    def on_removed(self) -> None:
        """Handle that there is a charger less."""


class BusChargers:
    """All chargers of one bus."""

    def __init__(
        self,
        hass: HomeAssistant,
        entry: ConfigEntry,
        connections: Connections,
        watcher: ChargerWatcher,
    ) -> None:
        """Start without chargers."""
        self.devices = BusDevices(hass, entry, protocol_of(entry.data).name)
        self.issues = BusIssues(hass, entry)
        self.all: dict[str, ManagedCharger] = {}
        self._hass = hass
        self._entry = entry
        self._protocol = protocol_of(entry.data)
        self._connections = connections
        self._orders = hass.data[ORDERS]
        self._watcher = watcher
        self._not_stored: dict[str, tuple[str, ...]] = {}
        """New chargers whose first orders cannot be stored, with their order keys."""
        self._duplicates: dict[str, Holder] = {}
        """Subentries that are not started: their box is set up with an older one."""
        self._unsubscribe: list[CALLBACK_TYPE] = []
        self._lock = asyncio.Lock()
        """Held while chargers are added, changed or removed, and while stopping."""
        self._stopped = False

    # -- Start and stop ----------------------------------------------------------

    async def async_start(self) -> None:
        """Add the chargers of all subentries, and follow what changes."""
        self._unsubscribe = [
            self._orders.subscribe(self._on_orders_stored),
            async_dispatcher_connect(
                self._hass, SIGNAL_CONFIG_ENTRY_CHANGED, self._on_entry_changed
            ),
        ]
        await self.async_sync()

    async def async_shut_down(self) -> None:
        """Send all shutdown commands, when Home Assistant stops."""
        await async_shut_down_chargers([one.charger for one in self.all.values()])

    async def async_stop_unproven(self) -> None:
        """Stop the chargers that might go on for ever when no message comes."""
        if self._stopped:
            # With Home Assistant, which has sent all shutdown commands.
            return
        chargers = [one.charger for one in self.all.values()]
        await async_shut_down_chargers(
            [one for one in chargers if one.fail_safe is FailSafe.UNPROVEN],
            why="its bus is unloaded",
        )

    async def async_stop(self) -> None:
        """Close the connections, end all subscriptions and write pending orders."""
        async with self._lock:
            self._stopped = True
            while self._unsubscribe:
                self._unsubscribe.pop()()
            await self._connections.stop()
            for managed in self.all.values():
                managed.unsubscribe()
            await self._orders.async_flush()

    # -- Follow the subentries -----------------------------------------------------

    async def async_sync(self) -> None:
        """Add, change and remove chargers to match the subentries.

        Chargers whose configuration has not changed are polled without a break.
        """
        async with self._lock:
            if self._stopped:
                return
            entry = self._entry
            self._connections.rename(entry.title)
            self._connections.update_options(entry.options)
            self.devices.register_bus()
            time_zone = dt_util.get_default_time_zone()
            configured = {
                config.key: (subentry, config)
                for subentry in entry.get_subentries_of_type(SUBENTRY_CHARGER)
                for config in charger_configs(entry.data, subentry, time_zone)
            }
            for key in self.all.keys() - configured.keys():
                await self._async_remove_charger(self.all[key])
            self._duplicates = self._find_duplicates()
            # All ports of a box together, before the first one of another box.
            for one in tuple(self.all.values()):
                if one.subentry_id in self._duplicates or one.identity != identity_of(
                    configured[one.key][0]
                ):
                    await self._async_take_off(one)
            self.issues.set_up_twice(self._duplicates)
            for key, (subentry, config) in configured.items():
                if subentry.subentry_id in self._duplicates:
                    continue
                if (managed := self.all.get(key)) is None:
                    await self._async_add_charger(subentry, config)
                else:
                    await self._async_change_charger(managed, subentry, config)
            for key in self._not_stored.keys() - configured.keys():
                await self._orders.async_forget(self._not_stored.pop(key))

    @callback
    def _on_orders_stored(self) -> None:
        """Start new chargers that waited for their first orders to be stored."""
        if self._not_stored:
            self._hass.async_create_task(self.async_sync(), "evse_bus waiting chargers")

    # -- A box with two subentries -------------------------------------------------

    def _find_duplicates(self) -> dict[str, Holder]:
        """Return the subentries whose box is set up with an older subentry, too."""
        return {
            subentry.subentry_id: other
            for subentry in self._entry.get_subentries_of_type(SUBENTRY_CHARGER)
            if (other := older_holder(self._hass, self._protocol, subentry)) is not None
        }

    @callback
    def _on_entry_changed(self, _change: ConfigEntryChange, entry: ConfigEntry) -> None:
        """Follow another entry that has added, removed or identified a box."""
        if entry.domain != DOMAIN:
            return
        for managed in self.all.values():
            if Fault.WRONG_CHARGER in managed.charger.noticed:
                # Where the wrong box is set up may have changed.
                self.issues.check(managed)
        if self._find_duplicates() != self._duplicates:
            self._entry.async_create_task(
                self._hass,
                self._async_follow(entry),
                "evse_bus boxes",
                eager_start=False,
            )

    async def _async_follow(self, other: ConfigEntry) -> None:
        if other.state is ConfigEntryState.LOADED:
            # First it takes off what it no longer has: a box has one master.
            await other.runtime_data.all_chargers.async_settle()
        await self.async_sync()

    def _accepts(self, managed: ManagedCharger, serial: str) -> bool:
        """Return whether a box is no older subentry's: that would be its master."""
        own = Holder(self._entry, managed.subentry)
        identity = self._protocol.identity(serial)
        found = [] if identity is None else holders(self._hass, identity)
        return not any(one.is_older(own) for one in found)

    async def async_settle(self) -> None:
        """Wait until changes under way are made."""
        async with self._lock:
            return

    # -- Add, change and remove ----------------------------------------------------

    async def _async_add_charger(
        self, subentry: ConfigSubentry, config: ChargerConfig
    ) -> None:
        key = config.key
        identity = identity_of(subentry)
        order_keys = charger_keys(self._protocol, identity, config)
        port_number = config.address if self._protocol.ports > 1 else None
        first = initial_orders(subentry, config)
        await self._async_hand_over(subentry)
        orders = await self._orders.async_begin(
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
        charger = self._protocol.charger(config, orders)
        bus = await self._connections.acquire_bus(config, subentry.title)
        managed = ManagedCharger(subentry, charger, bus, order_keys[0], port_number)
        self.all[key] = managed
        self.devices.register_charger(managed)
        self._put_on_bus(managed)
        self._report_lost_orders(managed)
        self._watcher.on_added(managed)
        async_set_up_now(self._hass, self._protocol.identity(config.serial))

    async def _async_change_charger(
        self, managed: ManagedCharger, subentry: ConfigSubentry, config: ChargerConfig
    ) -> None:
        managed.subentry = subentry
        old = managed.charger
        if config == old.config:
            return
        LOGGER.debug("%s: configuration changed", config.name)
        # Its new serial number may be that of a box that is being offered.
        async_set_up_now(self._hass, self._protocol.identity(config.serial))
        earlier = self._move_orders(managed, config)
        if earlier is None and changes_in_place(old.config, config):
            old.reconfigure(config)
        else:
            managed.unsubscribe()
            await managed.bus.remove(old)
            await self._connections.release_bus(managed.bus)
            self.issues.forget(managed)
            orders = old.orders if earlier is None else cautious(old.orders, earlier)
            managed.charger = self._protocol.charger(config, orders)
            managed.address = config.address
            managed.bus = await self._connections.acquire_bus(config, subentry.title)
        self.devices.register_charger(managed)
        if managed.charger is not old:
            self._put_on_bus(managed)
            self._report_lost_orders(managed)
        self._watcher.on_charger(managed)
        await self._orders.async_flush()

    def _report_lost_orders(self, managed: ManagedCharger) -> None:
        if self._orders.is_lost(managed.order_key):
            self.issues.orders_lost(managed, managed.charger.orders)

    def _move_orders(
        self, managed: ManagedCharger, config: ChargerConfig
    ) -> Orders | None:
        """Give the orders another key, if the serial number has changed.

        Returns the orders that the box had earlier, if they lower those it has now.
        """
        keys = charger_keys(self._protocol, managed.identity, config)
        if keys[0] == managed.order_key:
            return None
        orders = self._orders.move(keys, managed.order_key, managed.subentry_id)
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
        await self._connections.release_bus(managed.bus)
        await managed.async_remove_entities()
        del self.all[managed.key]
        self.devices.remove_port(managed)
        self.issues.forget(managed)
        await self._orders.async_forget(
            charger_keys(self._protocol, managed.identity, managed.charger.config)
        )
        if managed.subentry_id not in self._entry.subentries and not stands_on_serial(
            self._protocol, managed.subentry
        ):
            await self._hass.data[TOTALS].async_forget(managed.identity)
        self._watcher.on_removed()

    async def _async_take_off(self, managed: ManagedCharger) -> None:
        """Take a charger off the bus that stays set up.

        Its orders, devices and registered entities stay.
        """
        managed.unsubscribe()
        await managed.bus.remove(managed.charger)
        await self._connections.release_bus(managed.bus)
        await managed.async_remove_entities()
        del self.all[managed.key]
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
        for config in charger_configs(self._entry.data, subentry):
            keys = charger_keys(self._protocol, identity, config)
            self._orders.hand_over(
                subentry.subentry_id,
                keys[0],
                initial_orders(subentry, config),
                f"_{config.address}" if self._protocol.ports > 1 else "",
            )
        await self._orders.async_flush()
        await self._hass.data[TOTALS].async_hand_over(before, identity)
        self.devices.hand_over(subentry.subentry_id, before, identity)

    def _put_on_bus(self, managed: ManagedCharger) -> None:
        charger, watcher = managed.charger, self._watcher
        charger.accepts = partial(self._accepts, managed)
        charger.standing_orders.commit = partial(self._async_commit, managed)
        managed.subscriptions.append(
            charger.subscribe(partial(watcher.on_charger, managed))
        )
        if self._connections.shared_bus is None:
            managed.subscriptions.append(
                managed.bus.subscribe(partial(watcher.on_own_bus, managed))
            )
            # A box that waited for its registration is connected already.
            watcher.on_own_bus(managed)
        managed.bus.add(charger)
        managed.subscriptions.append(charger.subscribe_events(managed.events.publish))

    async def _async_commit(self, managed: ManagedCharger, orders: Orders) -> None:
        await self._orders.async_commit(managed.order_key, orders)
        if not self._orders.is_lost(managed.order_key):
            self.issues.orders_renewed(managed)

    # -- What a charger has reported of itself ---------------------------------------

    def store_address(self, managed: ManagedCharger) -> None:
        """Store the address that a charger was given over the wire, at once.

        Whoever has asked for it may have gone meanwhile.
        """
        address = managed.charger.config.address
        if address == managed.address:
            return
        LOGGER.info("%s has the address %s now", managed.name, address)
        managed.address = address
        self._hass.config_entries.async_update_subentry(
            self._entry,
            managed.subentry,
            data={**managed.subentry.data, CONF_ADDRESS: address},
        )

    def store_facts(self, managed: ManagedCharger) -> bool:
        """Store what was read of the box; return whether it differs from what was kept."""
        charger, subentry = managed.charger, managed.subentry
        data = dict(subentry.data)
        for name, text in charger.facts.items():
            # After the first serial number no other box is accepted.
            if not (charger.config.facts[name].identifies and data.get(name)):
                data[name] = text
        if Fault.WRONG_CHARGER not in charger.noticed:
            if charger.available:
                data.pop(CONF_REFUSED, None)
        elif not data.get(CONF_SERIAL) and charger.other_serial is not None:
            # A restart knows then whose box it is, and still accepts any other.
            data[CONF_REFUSED] = charger.other_serial
        if data == subentry.data:
            return False
        self._hass.config_entries.async_update_subentry(
            self._entry, subentry, data=data
        )
        return True
