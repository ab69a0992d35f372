"""One bus in Home Assistant: its chargers, their orders, and who is told what.

It pushes: the bus decides when a charger is asked. Who listens does so for one
context (the bus, its statistics, a charger, a connector), and is called only
when something of that context changed.
"""

import asyncio
from collections.abc import Callable
from datetime import datetime, timedelta
from functools import partial
from typing import Any, Final, override

from homeassistant.config_entries import ConfigEntry, ConfigSubentry
from homeassistant.core import CALLBACK_TYPE, Event, HomeAssistant, callback
from homeassistant.helpers.event import async_track_time_interval
from homeassistant.helpers.update_coordinator import BaseDataUpdateCoordinatorProtocol
from homeassistant.util import dt as dt_util

from .configuration import (
    changes_in_place,
    charger_configs,
    charger_unique_id,
    first_orders,
    made_of,
    protocol_of,
    supply_of,
)
from .connections import lines_of
from .const import CONF_SERIAL, LOGGER, SUBENTRY_CHARGER
from .devices import BusDevices, connector_key
from .discovery import async_set_up_now, async_wants_to_connect
from .evse.bus import Bus
from .evse.ews import EwsPort
from .evse.listeners import tell
from .evse.model import ChargerConfig, Orders, Supply
from .issues import BusIssues
from .orders import OrderStore, async_run_uncancelled
from .supply import SharedSupply
from .unit import ChargerUnit, async_say_farewell

type EvseBusConfigEntry = ConfigEntry[BusCoordinator]
type Context = tuple[str, int | None]
"""What a listener is interested in."""

BUS: Final[Context] = ("bus", None)
STATISTICS: Final[Context] = ("statistics", None)
STATISTICS_INTERVAL: Final = timedelta(seconds=30)
"""Counters change with every exchange; they are told this often."""


class BusCoordinator(BaseDataUpdateCoordinatorProtocol):
    """One bus."""

    def __init__(self, hass: HomeAssistant, entry: EvseBusConfigEntry) -> None:
        """Prepare the bus; nothing is opened or read yet."""
        self.hass = hass
        self.entry = entry
        self.data = made_of(entry.data)
        """What the bus was made of: when that changes, it is made anew."""
        self.protocol = protocol_of(entry.data)
        self.lines = lines_of(entry, partial(async_wants_to_connect, hass, entry))
        installed = supply_of(entry.data)
        self.units: dict[str, ChargerUnit] = {}
        self.issues = BusIssues(hass, entry)
        self.devices = BusDevices(hass, entry, self.protocol.name)
        self.orders = OrderStore(hass, entry.entry_id, self.issues.orders_written)
        self.supply = (
            SharedSupply(installed, self.orders, self._async_share)
            if installed
            else None
        )
        """What the chargers share; ``None``: each is on its own."""
        self._listeners: dict[Context, list[CALLBACK_TYPE]] = {}
        self._adders: list[Callable[[ChargerUnit], None]] = []
        self._stop_statistics: CALLBACK_TYPE | None = None
        self._unsubscribe: list[CALLBACK_TYPE] = []
        self._changing = asyncio.Lock()
        self._stopped = False

    @property
    def bus(self) -> Bus | None:
        """Return the bus of all chargers; ``None``: each box has its own."""
        return self.lines.only

    @property
    def port(self) -> str:
        """Return the name of the port or address, for messages."""
        return self.lines.name

    # -- Life --------------------------------------------------------------------

    async def async_start(self) -> None:
        """Load the orders, then open the port; raises LineError."""
        await self.orders.async_load()
        await self._async_begin_sharing()
        await self.async_match_subentries()
        if self.bus is not None:
            self._unsubscribe.append(self.bus.subscribe(partial(self._notify, BUS)))
        await self.lines.start()

    async def _async_begin_sharing(self) -> None:
        if self.supply is None or self.lines.duty is None:
            return
        # Its device outlives restarts: there is one, so there was an order.
        new = not self.devices.has(self.entry.entry_id)
        if not await self.supply.async_begin(new=new):
            self.issues.supply_lost(self.supply.limit)
        self._unsubscribe.append(self.lines.duty.subscribe(self._on_duty))

    async def async_shutdown(self, _event: Event) -> None:
        """Stop with Home Assistant: chargers that are to be told so are told."""
        await async_say_farewell([unit.charger for unit in self.units.values()])
        await self.async_stop()

    async def async_stop(self) -> None:
        """Close the port and leave nothing behind."""
        async with self._changing:
            self._stopped = True
            while self._unsubscribe:
                self._unsubscribe.pop()()
            await self.lines.stop()
            for unit in self.units.values():
                unit.unsubscribe()
                unit.unsubscribe = lambda: None
            await self.orders.async_close()
            self.issues.clear()

    # -- What all chargers share -------------------------------------------------

    async def async_follow_supply(self) -> None:
        """Share what the set-up says now."""
        installed = supply_of(self.entry.data)
        if self.supply is not None and installed is not None:
            await self.supply.async_set_up(installed)

    async def async_order_supply(self, value: float) -> None:
        """Let the chargers share this much, A a phase; raises RefusedOrderError."""
        if self.supply is not None:
            # What is on disk must count, also where nobody waits for it any more.
            order = self.supply.async_order(value)
            await async_run_uncancelled(self.hass, order, "evse_bus shared supply")
            self.issues.supply_renewed()

    async def _async_share(self, supply: Supply) -> None:
        self._notify(BUS)
        if self.lines.duty is not None:
            await self.lines.duty.change_supply(supply)

    @callback
    def _on_duty(self) -> None:
        if self.lines.duty is not None:
            self.issues.check_bus(self.lines.duty.noticed)
        self._notify(BUS)

    # -- Chargers come, change and go --------------------------------------------

    async def async_match_subentries(self) -> None:
        """Make the chargers on the bus those of the subentries.

        Only what differs is touched: the others keep talking.
        """
        async with self._changing:
            if self._stopped:
                return
            self.lines.rename(self.entry.title)
            self.lines.follow_options(self.entry.options)
            self.devices.show_bus()
            zone = dt_util.get_default_time_zone()
            wanted = {
                config.key: (subentry, config)
                for subentry in self.entry.get_subentries_of_type(SUBENTRY_CHARGER)
                for config in charger_configs(self.entry.data, subentry, zone)
            }
            for key in self.units.keys() - wanted.keys():
                await self._remove(self.units[key])
            for key, (subentry, config) in wanted.items():
                if (unit := self.units.get(key)) is None:
                    await self._add(subentry, config)
                else:
                    await self._change(unit, subentry, config)
            await self.orders.async_keep_only(wanted)

    async def _add(self, subentry: ConfigSubentry, config: ChargerConfig) -> None:
        key = config.key
        charger_orders = self.orders.get(key)
        # Its device outlives restarts: there is one, so there were orders.
        lost = charger_orders is None and self.devices.has(key, subentry.subentry_id)
        orders = charger_orders or first_orders(subentry, config)
        if charger_orders is None:
            await self.orders.async_commit(key, orders)
        charger = self.protocol.charger(config, orders)
        part = config.address if self.protocol.ports > 1 else None
        bus = await self.lines.join(config, subentry.title)
        unit = ChargerUnit(subentry, charger, bus, part)
        self.units[key] = unit
        self.devices.show_charger(unit)
        if lost:
            self.issues.orders_lost(unit, orders)
        self._connect(unit)
        self._add_entities(unit)
        async_set_up_now(self.hass, subentry)

    def _connect(self, unit: ChargerUnit) -> None:
        charger = unit.charger
        charger.commit = partial(self._async_commit, unit)
        stop = [charger.subscribe(partial(self._on_charger, unit))]
        if self.bus is None:
            stop.append(unit.bus.subscribe(partial(self._on_line, unit)))

        def unsubscribe() -> None:
            while stop:
                stop.pop()()

        unit.unsubscribe = unsubscribe
        unit.bus.add(charger)
        if isinstance(charger, EwsPort):
            stop.append(charger.subscribe_events(unit.events.tell))

    @callback
    def _on_line(self, unit: ChargerUnit) -> None:
        """Tell that the line which a box has for itself has come or gone."""
        self._notify((unit.key, None))
        if unit.leads:
            self._notify(BUS)

    async def _async_commit(self, unit: ChargerUnit, orders: Orders) -> None:
        self.issues.orders_renewed(unit)
        await self.orders.async_commit(unit.key, orders)

    async def _change(
        self, unit: ChargerUnit, subentry: ConfigSubentry, config: ChargerConfig
    ) -> None:
        unit.subentry = subentry
        old = unit.charger
        if config == old.config:
            return
        LOGGER.debug("%s: its set-up was changed", config.name)
        # It may have become a box that is being offered.
        async_set_up_now(self.hass, subentry)
        if changes_in_place(old.config, config):
            old.set_up(config)
            self.devices.show_charger(unit)
            self._on_charger(unit)
            return
        unit.unsubscribe()
        await unit.bus.remove(old)
        await self.lines.leave(unit.bus)
        self.issues.forget(unit)
        unit.charger = self.protocol.charger(config, old.orders)
        unit.bus = await self.lines.join(config, subentry.title)
        self.devices.show_charger(unit)
        self._connect(unit)
        self._on_charger(unit)

    async def _remove(self, unit: ChargerUnit) -> None:
        unit.unsubscribe()
        await async_say_farewell([unit.charger], for_good=True)
        await unit.bus.remove(unit.charger)
        await self.lines.leave(unit.bus)
        del self.units[unit.key]
        self.devices.forget_port(unit)
        self.issues.forget(unit)
        self._notify(BUS)

    # -- What a charger tells ----------------------------------------------------

    @callback
    def _on_charger(self, unit: ChargerUnit) -> None:
        charger = unit.charger
        reading = charger.reading
        before = unit.connectors
        unit.connectors = (
            dict(reading.connectors)
            if reading is not None and charger.available
            else {}
        )
        self._learn(unit)
        self.issues.check(unit)
        self._notify((unit.key, None))
        for number in before.keys() | unit.connectors.keys():
            if before.get(number) != unit.connectors.get(number):
                self._notify((unit.key, number))

    def _learn(self, unit: ChargerUnit) -> None:
        """Show what was not known of a charger before."""
        unit.numbers |= unit.connectors.keys()
        charger = unit.charger
        shape = (
            charger.capabilities,
            charger.config.order_lifetime is None,
            frozenset(unit.numbers),
            charger.info,
            frozenset(charger.settings),
        )
        if shape == unit.shape:
            return
        unit.shape = shape
        self._bind_serial(unit)
        self.devices.show_charger(unit)
        self._add_entities(unit)

    def _bind_serial(self, unit: ChargerUnit) -> None:
        """Keep the serial number first found: from now on no other box will do."""
        info = unit.charger.info
        subentry = unit.subentry
        if info is None or info.serial is None or subentry.data.get(CONF_SERIAL):
            return
        unique_id = charger_unique_id(self.protocol.key, info.serial)
        if any(
            other.unique_id == unique_id
            for other in self.entry.subentries.values()
            if other is not subentry
        ):
            return
        self.hass.config_entries.async_update_subentry(
            self.entry,
            subentry,
            data={**subentry.data, CONF_SERIAL: info.serial},
            unique_id=unique_id,
        )

    def forget_connector(self, keys: set[str]) -> bool:
        """Forget a connector by its device's identifiers, if it is gone."""
        for unit in self.units.values():
            # The ports of a box are what the set-up says, also while it is off.
            numbers = () if unit.part is not None else tuple(unit.numbers)
            for number in numbers:
                key = connector_key(unit, number)
                if key in keys and number not in unit.connectors:
                    unit.numbers.discard(number)
                    unit.added = {
                        (platform, unique_id)
                        for platform, unique_id in unit.added
                        if not unique_id.startswith(f"{key}_")
                    }
                    unit.shape = None
                    return True
        # Connectors of an earlier run that have not come back since.
        return (
            not any(
                key in keys
                for unit in self.units.values()
                for key in (
                    unit.subentry_id,
                    unit.key,
                    *(connector_key(unit, number) for number in unit.numbers),
                )
            )
            and self.entry.entry_id not in keys
        )

    # -- Entities ----------------------------------------------------------------

    @callback
    def async_add_platform(self, adder: Callable[[ChargerUnit], None]) -> None:
        """Let a platform add entities for each charger, now and as more is learnt."""
        self._adders.append(adder)
        for unit in self.units.values():
            adder(unit)

    def _add_entities(self, unit: ChargerUnit) -> None:
        for adder in self._adders:
            adder(unit)

    # -- Listeners ---------------------------------------------------------------

    @callback
    @override
    def async_add_listener(
        self, update_callback: CALLBACK_TYPE, context: Any = None
    ) -> Callable[[], None]:
        """Call back when something of this context has changed."""
        key: Context = context or BUS
        self._listeners.setdefault(key, []).append(update_callback)
        if key == STATISTICS and self._stop_statistics is None:
            self._stop_statistics = async_track_time_interval(
                self.hass, self._tell_statistics, STATISTICS_INTERVAL
            )
        return partial(self._remove_listener, key, update_callback)

    def _remove_listener(self, key: Context, update_callback: CALLBACK_TYPE) -> None:
        listeners = self._listeners[key]
        listeners.remove(update_callback)
        if listeners:
            return
        del self._listeners[key]
        if key == STATISTICS and self._stop_statistics is not None:
            self._stop_statistics()
            self._stop_statistics = None

    @callback
    def _tell_statistics(self, _now: datetime) -> None:
        self._notify(STATISTICS)

    @callback
    def _notify(self, context: Context) -> None:
        tell(self._listeners.get(context, ()))
