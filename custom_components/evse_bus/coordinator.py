"""Coordinator of one bus: its chargers, their stored orders, their entities.

The library polls the chargers by its own schedule and calls back when something has
changed. An entity listens in one context (the bus, its statistics, a charger or a
connector) and is called only for changes in that context.
"""

from collections.abc import Callable, Mapping
from datetime import datetime, timedelta
from functools import partial
from typing import Any, Final, override

from homeassistant.config_entries import ConfigEntry
from homeassistant.core import CALLBACK_TYPE, Event, HomeAssistant, callback
from homeassistant.exceptions import ConfigEntryNotReady
from homeassistant.helpers.event import async_track_time_interval
from homeassistant.helpers.update_coordinator import BaseDataUpdateCoordinatorProtocol

from .chargers.managed import ManagedCharger
from .chargers.subentries import BusChargers
from .configuration import (
    protocol_of,
    rebuild_data,
    supply_of,
)
from .connections import make_connections
from .const import DOMAIN
from .discovery import async_wants_to_connect
from .evse.bus import Bus
from .evse.listeners import notify
from .evse.model import Circuit, Fault
from .issues import NOT_STORED
from .stores.orders import (
    ORDERS,
    async_run_uncancelled,
    bus_key,
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
        self.all_chargers = BusChargers(hass, entry, self.connections, self)
        self.devices = self.all_chargers.devices
        self.issues = self.all_chargers.issues
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
        self._listeners: dict[Context, list[CALLBACK_TYPE]] = {}
        self._platforms: list[Callable[[ManagedCharger], None]] = []
        self._unsubscribe: list[CALLBACK_TYPE] = []
        self._unsubscribe_statistics: CALLBACK_TYPE | None = None

    @property
    def chargers(self) -> Mapping[str, ManagedCharger]:
        """Return all chargers, by key."""
        return self.all_chargers.all

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
        await self._async_start_supply()
        await self.all_chargers.async_start()
        if self.bus is not None:
            self._unsubscribe.append(self.bus.subscribe(self._on_bus))
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
        await self.all_chargers.async_shut_down()
        await self.async_stop()

    async def async_stop(self) -> None:
        """Close the port, end all subscriptions and write pending orders."""
        while self._unsubscribe:
            self._unsubscribe.pop()()
        await self.all_chargers.async_stop()
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
    def _on_bus(self) -> None:
        """Handle a port that was lost or is back, or another change of the line."""
        if self.bus is not None:
            self.issues.check_line(self.bus)
        self._notify(BUS)

    @callback
    def _on_master(self) -> None:
        self._check_bus()
        self._notify(BUS)

    def _check_bus(self) -> None:
        if self.connections.master is not None:
            self.issues.check_bus(self.connections.master.noticed)

    async def async_permission_set(self, managed: ManagedCharger) -> None:
        """Accept that the user has decided whether a charger may charge."""
        await self.orders.async_accept(managed.order_key)
        self.issues.orders_renewed(managed)

    # -- Updates from the library ------------------------------------------------

    @callback
    def on_added(self, managed: ManagedCharger) -> None:
        """Add the entities of a new charger."""
        self._add_entities(managed)

    @callback
    def on_removed(self) -> None:
        """Count the chargers anew."""
        self._check_bus()
        self._notify(BUS)

    @callback
    def on_own_bus(self, managed: ManagedCharger) -> None:
        """Handle a box that has connected or disconnected."""
        self._notify((managed.key, None))
        if managed.is_primary_port:
            self._notify(BUS)

    @callback
    def on_charger(self, managed: ManagedCharger) -> None:
        """Handle a changed reading, state or configuration of a charger."""
        charger = managed.charger
        self.all_chargers.store_address(managed)
        if self.all_chargers.store_facts(managed):
            self._check_bus()
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
        self.devices.register_charger(managed)
        self._add_entities(managed)

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
