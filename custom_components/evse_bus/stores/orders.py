"""Storage of the orders of all chargers and buses.

Restored entity states may be minutes old after a crash, and are missing for a disabled
entity; a limit must be neither. A restart must never allow more than the user's last
order, so:

- A lowering is on disk before it is sent. A raise is written soon after the charger
  has confirmed it: losing one only means a lower limit.
- What the disk refuses stays pending and is written again. Until then a file that
  allows more than was ordered is deleted, which also works on a full disk.
- A second file lists the chargers that have had orders. One of them without a usable
  record has lost it, and is stopped until the user allows it to charge.
- A new charger is not started before both files have it.

Orders belong to a charger's serial number, where it is known, and not to its bus: they
stay when the charger moves to another bus or is removed and added again.
"""

import asyncio
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, Final

from homeassistant.core import (
    HomeAssistant,
)
from homeassistant.util.hass_dict import HassKey

from ..const import DOMAIN, LOGGER
from ..evse.errors import RefusedOrderError
from ..evse.listeners import Observable
from ..evse.model import ChargerConfig, CurrentLimit, Orders, Phases
from ..evse.protocol import Protocol
from ..evse.safety import cautious, number
from .file import UNREADABLE, PlannedWrite, StoredFile

ORDERS_KEY: Final = f"{DOMAIN}.orders"
KNOWN_KEY: Final = f"{DOMAIN}.known_chargers"
"""File names in the storage folder of Home Assistant."""

RAISE_DELAY: Final = 1.0
"""Delay before a raise is written, to combine several, s."""
RETRY_FIRST: Final = 5.0
"""First pause before a refused write is tried again, s; doubles."""
RETRY_LIMIT: Final = 300.0
"""Longest such pause, s."""

_SERIAL: Final = "serial:"
_SUBENTRY: Final = "subentry:"
_BUS: Final = "bus:"
"""Prefixes of the keys of records, by what they belong to."""


async def async_run_uncancelled[T](
    hass: HomeAssistant, coroutine: Coroutine[Any, Any, T], name: str
) -> T:
    """Run a coroutine to its end, even when the caller is cancelled.

    Returns its result; raises what it raises. An automation that restarts cancels
    the action it waits for: that ends the wait, not the action. (`asyncio.shield`
    would log a failure that has no caller left.)
    """
    task = hass.async_create_task(coroutine, name)
    task.add_done_callback(_retrieve_exception)
    await asyncio.wait({task})
    return task.result()


def _retrieve_exception(task: asyncio.Task[Any]) -> None:
    """Mark a failure as seen: asyncio warns of exceptions never retrieved."""
    if not task.cancelled():
        task.exception()


# -- Records ---------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SupplyOrder:
    """The user's order for the shared supply of a bus."""

    limit: float | None
    """A per phase; ``None``: not set by the user, so the installation's limit."""

    def raises(self, before: SupplyOrder) -> bool:
        """Return whether this allows more than ``before``."""
        if self.limit is None or before.limit is None:
            return self.limit is None and before.limit is not None
        return self.limit > before.limit


type Order = Orders | SupplyOrder


@dataclass(frozen=True, slots=True)
class Record[O: Order]:
    """One order as it is stored."""

    order: O
    owner: str = ""
    """Id of the subentry that the charger was added with."""
    lost: bool = False
    """The real order was lost; this one stands until the user gives another."""


def allows_more(one: Order, other: Order) -> bool:
    """Return whether one order allows more than another, in any respect."""
    if isinstance(one, SupplyOrder) or isinstance(other, SupplyOrder):
        return (
            not isinstance(one, SupplyOrder)
            or not isinstance(other, SupplyOrder)
            or one.raises(other)
        )
    # Whether a longer time-out is safer is not known, so `cautious` keeps the old one.
    return cautious(one, other) != one


def stopped(orders: Orders) -> Orders:
    """Return orders that replace lost ones: no permission, the limits as they are."""
    return replace(orders, allowed=False)


def bus_key(entry_id: str) -> str:
    """Return the key of the order for the shared supply of a bus."""
    return f"{_BUS}{entry_id}"


def charger_keys(
    protocol: Protocol, identity: str, config: ChargerConfig
) -> tuple[str, ...]:
    """Return the keys of a charger's orders: its own, then one it may have had before.

    A charger that was added without a serial number has the orders of its serial
    number as soon as that is read: it may have been set up before.
    """
    port = f"_{config.address}" if protocol.ports > 1 else ""
    by_subentry = f"{_SUBENTRY}{identity}{port}"
    if (by_serial := protocol.identity(config.serial)) is None:
        return (by_subentry,)
    return (f"{_SERIAL}{by_serial}{port}", by_subentry)


def subentry_keys(identity: str, ports: int) -> list[str]:
    """Return all keys that a charger without a serial number can have."""
    key = f"{_SUBENTRY}{identity}"
    return [key, *(f"{key}_{port}" for port in range(1, ports + 1))]


# -- The store -------------------------------------------------------------------


class OrderStore(Observable):
    """The stored orders of all chargers and buses of Home Assistant.

    Listeners are called after each successful write.
    """

    def __init__(
        self,
        hass: HomeAssistant,
        on_write: Callable[[Exception | None], None] = lambda _error: None,
    ) -> None:
        """Read nothing yet; ``on_write`` is called after each write, with its error."""
        super().__init__()
        self._hass = hass
        self._orders_file = StoredFile(hass, ORDERS_KEY)
        self._known_file = StoredFile(hass, KNOWN_KEY)
        self._on_write = on_write
        self._failed = False
        self._loaded = False
        self._records: dict[str, Record[Any]] = {}
        self._known: set[str] = set()
        """Keys of all chargers and buses that have had orders."""
        self._on_disk: dict[str, list[Order]] = {}
        """All orders that a restart could find: more than one after a failed write."""
        self._known_on_disk: frozenset[str] = frozenset()
        self._pending = False
        self._retry_pause = RETRY_FIRST
        self._next_write = PlannedWrite(hass, self.async_flush)
        self._busy = asyncio.Lock()
        """Held while a file is read or written."""

    async def async_load(self) -> None:
        """Read the files, once; an unreadable one is treated as missing."""
        async with self._busy:
            if self._loaded:
                return
            known = await self._async_read(self._known_file)
            stored = await self._async_read(self._orders_file)
            keys = known.get("keys")
            if isinstance(keys, list):
                self._known = {key for key in keys if isinstance(key, str)}
            self._known_on_disk = frozenset(self._known)
            for key, record in stored.items():
                try:
                    self._records[key] = decode(record)
                except (RefusedOrderError, *UNREADABLE) as error:
                    LOGGER.error("A stored order cannot be used: %s", error)
            self._known |= self._records.keys()
            self._on_disk = {key: [one.order] for key, one in self._records.items()}
            self._loaded = True

    async def _async_read(self, file: StoredFile) -> dict[str, Any]:
        try:
            return dict(await file.async_load() or {})
        except UNREADABLE as error:
            LOGGER.error("The stored orders cannot be read: %s", error)
            return {}

    def get(self, key: str) -> Order | None:
        """Return an order; ``None``: none stored, or unreadable."""
        record = self._records.get(key)
        return None if record is None else record.order

    def supply(self, key: str) -> SupplyOrder | None:
        """Return the order for a shared supply; ``None``: none, or unreadable."""
        order = self.get(key)
        return order if isinstance(order, SupplyOrder) else None

    def is_lost(self, key: str) -> bool:
        """Return whether the real order was lost and the user gave no other."""
        record = self._records.get(key)
        return record is not None and record.lost

    async def async_begin[O: Order](
        self,
        keys: Sequence[str],
        first: O,
        fallback: O,
        *,
        owner: str = "",
        registered: bool = False,
    ) -> O | None:
        """Return the order that a charger or bus starts with.

        ``keys``: its own key, then others under which it may be stored. ``first`` is
        the order of a new one, ``fallback`` that of one whose order is lost.
        ``registered``: it is known from elsewhere that it has had orders.

        Returns ``None`` for a new one that cannot be stored: if it were started, a
        restart could not tell that it has had orders. Listeners are called when it
        can be.
        """
        key = keys[0]
        kind = type(first)
        found = [
            record
            for one in reversed(keys)
            if (record := self._records.get(one)) is not None
            and isinstance(record.order, kind)
        ]
        had_orders = registered or any(one in self._known for one in keys)
        if found:
            record = self._merged(found, first, owner)
        elif had_orders:
            record = Record(fallback, owner, lost=True)
        else:
            record = Record(first, owner)
        safe = registered or any(one in self._known_on_disk for one in keys)
        self._replace(keys, record)
        if self._pending or key not in self._known_on_disk:
            await self.async_flush()
        return record.order if safe or key in self._known_on_disk else None

    @staticmethod
    def _merged(found: Sequence[Record[Any]], first: Order, owner: str) -> Record[Any]:
        """Return one record of those found; the lower counts where they differ."""
        newest = found[0]
        order = newest.order
        if isinstance(order, Orders):
            order = reduce(cautious, [record.order for record in found])
            if newest.owner != owner and isinstance(first, Orders):
                # Added anew: the fail-safe values were confirmed just now.
                order = replace(
                    order,
                    fail_safe=first.fail_safe,
                    fail_safe_timeout=first.fail_safe_timeout,
                )
        return Record(order, owner, lost=any(one.lost for one in found))

    def _replace(self, keys: Sequence[str], record: Record[Any]) -> None:
        """Put a record under the first key, and drop it from subentry keys."""
        key = keys[0]
        if self._records.get(key) != record:
            self._records[key] = record
            self._pending = True
        self._known.add(key)
        for other in keys[1:]:
            if (
                other.startswith(_SUBENTRY)
                and self._records.pop(other, None) is not None
            ):
                # On disk it stays the order of this charger until the next write.
                self._on_disk.setdefault(key, []).extend(self._on_disk.pop(other, []))
                self._pending = True

    def move(self, keys: Sequence[str], old_key: str, owner: str) -> Orders | None:
        """Give a charger's orders a new key: its serial number has become known.

        Returns its orders, not written yet. They are lower than before if there was a
        record under the new key: the box was known before.
        """
        records = [self._records.get(one) for one in (old_key, keys[0])]
        found = [one for one in records if one and isinstance(one.order, Orders)]
        if not found:
            return None
        record: Record[Orders] = Record(
            reduce(cautious, [one.order for one in found]),
            owner,
            lost=any(one.lost for one in found),
        )
        self._replace((keys[0], old_key), record)
        return record.order

    def hand_over(self, owner: str, key: str, first: Orders, port: str = "") -> None:
        """Give a box that replaces another its orders, not written yet.

        ``first``: those of a new box. They are never higher than those of the box
        before it, nor than those that it had itself. ``owner``: the subentry of both;
        ``port``: the end of the keys of one port.
        """
        before = [
            one
            for one, record in self._records.items()
            if record.owner == owner and one.endswith(port)
        ]
        found = [self._records[one] for one in {*before, key} if one in self._records]
        order = reduce(cautious, [record.order for record in found], first)
        for one in before:
            # It keeps them for the time when it is used elsewhere.
            self._records[one] = replace(self._records[one], owner="")
        lost = any(one.lost for one in found)
        self._records[key] = Record(order, owner, lost=lost)
        self._known.add(key)
        self._pending = True

    async def async_commit(self, key: str, order: Order) -> None:
        """Store an order: a lowering is on disk when this returns.

        A failed write raises nothing: the order is sent all the same, and written as
        soon as the disk takes it; ``on_write`` gets the error.
        """
        before = self._records.get(key)
        lost = before is not None and before.lost
        if isinstance(order, SupplyOrder) or order.allowed:
            lost = False
        after = Record(order, before.owner if before else "", lost=lost)
        if after == before:
            return
        self._records[key] = after
        self._known.add(key)
        self._pending = True
        if before is not None and allows_more(order, before.order):
            self._next_write.plan(RAISE_DELAY)
        else:
            await self.async_flush()

    async def async_accept(self, key: str) -> None:
        """Store that the user has decided what to do about a lost order."""
        record = self._records.get(key)
        if record is not None and record.lost:
            self._records[key] = replace(record, lost=False)
            self._pending = True
            await self.async_flush()

    async def async_forget(self, keys: Iterable[str]) -> None:
        """Delete orders, except those of a serial number: the charger may return."""
        for key in keys:
            if not key.startswith(_SERIAL):
                self._pending |= self._records.pop(key, None) is not None
                self._on_disk.pop(key, None)
                self._known.discard(key)
        if self._pending:
            await self.async_flush()

    # -- Writing -----------------------------------------------------------------

    async def async_flush(self) -> None:
        """Write pending changes now, and wait for writes in progress.

        Changes that the disk refuses stay pending.
        """
        await async_run_uncancelled(self._hass, self._async_write(), "evse_bus orders")

    async def _async_write(self) -> None:
        async with self._busy:
            if not self._pending and self._known == self._known_on_disk:
                return
            self._next_write.cancel()
            self._pending = False
            error = await self._async_write_files()
            if error is None:
                self._failed = False
                self._retry_pause = RETRY_FIRST
            else:
                self._pending = True
                if not self._failed:
                    LOGGER.error("Orders cannot be stored: %s", error)
                self._failed = True
                self._next_write.plan(self._retry_pause)
                self._retry_pause = min(self._retry_pause * 2, RETRY_LIMIT)
        self._on_write(error)
        if error is None:
            self.updated()

    async def _async_write_files(self) -> Exception | None:
        """Write the orders, then the list of those that have had orders."""
        orders = {key: record.order for key, record in self._records.items()}
        data = {key: encode(record) for key, record in self._records.items()}
        known = frozenset(self._known)
        error = await self._orders_file.async_write(data)
        if error is None:
            self._on_disk = {key: [order] for key, order in orders.items()}
        else:
            # It may have been written all the same.
            for key, order in orders.items():
                self._may_be_on_disk(key, order)
            await self._async_withdraw()
            return error
        if known != self._known_on_disk:
            error = await self._known_file.async_write({"keys": sorted(known)})
            # Removed ones may still be there, new ones may not.
            self._known_on_disk = (
                known if error is None else self._known_on_disk & known
            )
        return error

    def _may_be_on_disk(self, key: str, order: Order) -> None:
        """Take note of an order that a restart may find, unless another allows more."""
        others = self._on_disk.get(key, [])
        if not any(not allows_more(order, one) for one in others):
            self._on_disk[key] = [
                order,
                *(one for one in others if allows_more(one, order)),
            ]

    async def _async_withdraw(self) -> None:
        """Delete the stored orders if they allow more than those that stand.

        A restart then finds no orders, and all chargers are stopped.
        """
        if any(
            allows_more(found, self._records[key].order)
            for key, orders in self._on_disk.items()
            if key in self._records
            for found in orders
        ):
            try:
                await self._orders_file.async_remove()
            except OSError as error:
                LOGGER.debug("The stored orders cannot be deleted: %s", error)
            else:
                self._on_disk = {}


ORDERS: Final[HassKey[OrderStore]] = HassKey(ORDERS_KEY)


# -- The stored form -------------------------------------------------------------


def encode(record: Record[Any]) -> dict[str, Any]:
    """Return the stored form of a record."""
    order = record.order
    data: dict[str, Any] = (
        {"supply": order.limit}
        if isinstance(order, SupplyOrder)
        else {
            "owner": record.owner,
            "allowed": order.allowed,
            "limit": _encode_limit(order.limit),
            "fail_safe": _encode_limit(order.fail_safe),
            "fail_safe_timeout": order.fail_safe_timeout,
            "remembered": dict(order.remembered),
        }
    )
    return data | {"lost": record.lost}


def decode(stored: Mapping[str, Any]) -> Record[Any]:
    """Return a record from its stored form.

    Raises RefusedOrderError for a number that is negative, not finite or no number,
    and TypeError or KeyError for a record of another shape.
    """
    lost = _flag(stored["lost"], "lost")
    if "supply" in stored:
        limit = stored["supply"]
        supply = SupplyOrder(None if limit is None else number(limit, "supply"))
        return Record(supply, lost=lost)
    allowed = stored["allowed"]
    orders = Orders(
        allowed=None if allowed is None else _flag(allowed, "allowed"),
        limit=_decode_limit(stored["limit"]),
        fail_safe=_decode_limit(stored["fail_safe"]),
        fail_safe_timeout=int(number(stored["fail_safe_timeout"], "time-out")),
        remembered={
            str(name): str(note) for name, note in stored.get("remembered", {}).items()
        },
    )
    return Record(orders, str(stored["owner"]), lost=lost)


def _flag(value: object, what: str) -> bool:
    if not isinstance(value, bool):
        message = f"{what} is {value!r}"
        raise TypeError(message)
    return value


def _encode_limit(limit: CurrentLimit) -> dict[str, Any]:
    return {"current": limit.current, "phases": list(limit.phases)}


def _decode_limit(record: Mapping[str, Any]) -> CurrentLimit:
    one, two, three = (
        None if value is None else number(value, "phase") for value in record["phases"]
    )
    phases: Phases[float | None] = (one, two, three)
    return CurrentLimit(current=number(record["current"], "current"), phases=phases)
