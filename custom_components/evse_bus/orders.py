"""Storage of the orders of a bus and of its chargers.

Restored entity states may be minutes old after a crash, and are missing for a disabled
entity; a limit must be neither. So each bus has a file for its orders. A lowering is on
disk before it is sent. A raise is written soon after the charger has confirmed it:
losing one only means a lower limit.
"""

import asyncio
from collections.abc import Callable, Coroutine, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, override

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError
from homeassistant.helpers.storage import Store
from homeassistant.util.file import WriteError
from homeassistant.util.json import SerializationError

from .const import DOMAIN, LOGGER
from .evse.errors import RefusedOrderError
from .evse.model import CurrentLimit, Orders, Phases
from .evse.safety import cautious, number

STORAGE_VERSION: Final = 1
RAISE_DELAY: Final = 1.0
"""Delay before a raise is written, to combine several, s."""

type _Stored = dict[str, dict[str, Any]]

_UNREADABLE = (
    HomeAssistantError,  # also a version from the future
    NotImplementedError,  # no migration from that version
    OSError,
    AttributeError,
    KeyError,
    TypeError,
    ValueError,
)


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


class OrderStore:
    """The stored orders of one config entry: of its chargers, and of its bus."""

    def __init__(
        self,
        hass: HomeAssistant,
        entry_id: str,
        on_write: Callable[[Exception | None], None] = lambda _error: None,
    ) -> None:
        """Read nothing yet; ``on_write`` is called after each write, with its error."""
        self._hass = hass
        self._store = _WatchedStore(hass, entry_id, on_write)
        self._bus_key = entry_id
        self._orders: dict[str, Orders] = {}
        self._supply: SupplyOrder | None = None
        self._pending = False
        self._writing = asyncio.Lock()

    async def async_load(self) -> None:
        """Read the file; an unreadable one is treated as missing."""
        self._orders = {}
        self._supply = None
        try:
            stored = await self._store.async_load()
            records = dict(stored or {})
        except _UNREADABLE as error:
            LOGGER.error("The stored orders cannot be read: %s", error)
            return
        for key, record in records.items():
            try:
                if key == self._bus_key:
                    self._supply = decode_supply(record)
                else:
                    self._orders[key] = decode(record)
            except (RefusedOrderError, *_UNREADABLE) as error:
                LOGGER.error("A stored order cannot be used: %s", error)

    def get(self, key: str) -> Orders | None:
        """Return a charger's orders; ``None``: none stored, or unreadable."""
        return self._orders.get(key)

    @property
    def supply(self) -> SupplyOrder | None:
        """Return the order for the shared supply; ``None``: none, or unreadable."""
        return self._supply

    async def async_commit(self, key: str, orders: Orders) -> None:
        """Store a charger's orders: a lowering is on disk when this returns.

        A failed write raises nothing: the order is sent all the same, and ``on_write``
        gets the error.
        """
        before = self._orders.get(key)
        if orders == before:
            return
        self._orders[key] = orders
        await self._write(
            soon=before is not None and cautious(before, orders) != orders
        )

    async def async_commit_supply(self, supply: SupplyOrder) -> None:
        """Store the order for the shared supply, in the same way as `async_commit`."""
        before = self._supply
        if supply == before:
            return
        self._supply = supply
        await self._write(soon=before is not None and supply.raises(before))

    async def _write(self, *, soon: bool) -> None:
        """Write now; ``soon``: after a delay, together with further changes."""
        if not soon:
            await self.async_flush()
            return
        self._pending = True
        self._store.async_delay_save(self._encoded, RAISE_DELAY)

    async def async_keep_only(self, keys: Iterable[str]) -> None:
        """Delete the orders of all other chargers."""
        obsolete = self._orders.keys() - set(keys)
        for key in obsolete:
            del self._orders[key]
        if obsolete:
            await self.async_flush()

    async def async_flush(self) -> None:
        """Write pending changes now."""
        self._pending = False
        await async_run_uncancelled(self._hass, self._async_save(), "evse_bus orders")

    async def _async_save(self) -> None:
        async with self._writing:
            await self._store.async_save(self._encoded())

    async def async_close(self) -> None:
        """Write pending changes and wait for writes in progress."""
        if self._pending:
            await self.async_flush()
        # The file may be read again at once, after a reload.
        async with self._writing:
            pass

    async def async_remove(self) -> None:
        """Delete the file."""
        self._pending = False
        await self._store.async_remove()

    def _encoded(self) -> _Stored:
        encoded = {key: encode(orders) for key, orders in self._orders.items()}
        if self._supply is not None:
            encoded[self._bus_key] = {"supply": self._supply.limit}
        return encoded


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


class _WatchedStore(Store[_Stored]):
    """A store that reports the result of each write; `Store` only logs errors."""

    def __init__(
        self,
        hass: HomeAssistant,
        entry_id: str,
        on_write: Callable[[Exception | None], None],
    ) -> None:
        super().__init__(
            hass, STORAGE_VERSION, f"{DOMAIN}.{entry_id}", atomic_writes=True
        )
        self._on_write = on_write
        self._failed = False

    @override
    async def _async_write_data(self, data: dict[str, Any]) -> None:
        try:
            await super()._async_write_data(data)
        except (WriteError, SerializationError, OSError) as error:
            if not self._failed:
                LOGGER.error("Orders cannot be stored: %s", error)
            self._failed = True
            self._on_write(error)
        else:
            self._failed = False
            self._on_write(None)


def encode(orders: Orders) -> dict[str, Any]:
    """Return the stored form of orders."""
    return {
        "allowed": orders.allowed,
        "limit": _encode_limit(orders.limit),
        "fail_safe": _encode_limit(orders.fail_safe),
        "fail_safe_timeout": orders.fail_safe_timeout,
    }


def decode(record: Mapping[str, Any]) -> Orders:
    """Return orders from their stored form.

    Raises RefusedOrderError for a number that is negative, not finite or no number,
    and TypeError or KeyError for a record of another shape.
    """
    allowed = record["allowed"]
    if not (allowed is None or isinstance(allowed, bool)):
        message = f"allowed is {allowed!r}"
        raise TypeError(message)
    return Orders(
        allowed=allowed,
        limit=_decode_limit(record["limit"]),
        fail_safe=_decode_limit(record["fail_safe"]),
        fail_safe_timeout=int(number(record["fail_safe_timeout"], "time-out")),
    )


def decode_supply(record: Mapping[str, Any]) -> SupplyOrder:
    """Return an order for the supply from its stored form; raises as `decode` does."""
    stored = record["supply"]
    return SupplyOrder(None if stored is None else number(stored, "supply"))


def _encode_limit(limit: CurrentLimit) -> dict[str, Any]:
    return {"current": limit.current, "phases": list(limit.phases)}


def _decode_limit(record: Mapping[str, Any]) -> CurrentLimit:
    one, two, three = (
        None if value is None else number(value, "phase") for value in record["phases"]
    )
    phases: Phases[float | None] = (one, two, three)
    return CurrentLimit(current=number(record["current"], "current"), phases=phases)
