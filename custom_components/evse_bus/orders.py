"""The orders of a bus and of its chargers on disk.

Entity states are restored from minutes ago after a crash, and not at all for a
disabled entity; a limit is a promise. So orders have a file of their own, one a
bus. A lowering is on disk before it is sent; a raise is written soon after the
charger has confirmed it, since losing one only means a lower limit.
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
"""How long a raise waits for others before it is written, s."""

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
    """The stored orders of one config entry: of all chargers, and of the bus."""

    def __init__(
        self,
        hass: HomeAssistant,
        entry_id: str,
        on_write: Callable[[Exception | None], None] = lambda _error: None,
    ) -> None:
        """Read nothing yet; ``on_write`` is told how each write went."""
        self._hass = hass
        self._store = _WatchedStore(hass, entry_id, on_write)
        self._bus_key = entry_id
        self._orders: dict[str, Orders] = {}
        self._supply: SupplyOrder | None = None
        self._pending = False
        self._writing = asyncio.Lock()

    async def async_load(self) -> None:
        """Read the file; one that cannot be read counts as none."""
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
        """Return a charger's orders; ``None``: there are no usable ones."""
        return self._orders.get(key)

    @property
    def supply(self) -> SupplyOrder | None:
        """Return the order about what the bus shares; ``None``: no usable one."""
        return self._supply

    async def async_commit(self, key: str, orders: Orders) -> None:
        """Keep a charger's orders: a lowering is on disk when this returns.

        Raises nothing when the disk refuses: the order is sent all the same, and
        ``on_write`` knows.
        """
        before = self._orders.get(key)
        if orders == before:
            return
        self._orders[key] = orders
        await self._write(
            soon=before is not None and cautious(before, orders) != orders
        )

    async def async_commit_supply(self, supply: SupplyOrder) -> None:
        """Keep what the bus shares; otherwise as `async_commit`."""
        before = self._supply
        if supply == before:
            return
        self._supply = supply
        await self._write(soon=before is not None and supply.raises(before))

    async def _write(self, *, soon: bool) -> None:
        """Write now, or ``soon``: together with what comes next."""
        if not soon:
            await self.async_flush()
            return
        self._pending = True
        self._store.async_delay_save(self._encoded, RAISE_DELAY)

    async def async_keep_only(self, keys: Iterable[str]) -> None:
        """Forget the orders of chargers that are no more."""
        gone = self._orders.keys() - set(keys)
        for key in gone:
            del self._orders[key]
        if gone:
            await self.async_flush()

    async def async_flush(self) -> None:
        """Write now what has not been written."""
        self._pending = False
        await async_run_uncancelled(self._hass, self._async_save(), "evse_bus orders")

    async def _async_save(self) -> None:
        async with self._writing:
            await self._store.async_save(self._encoded())

    async def async_close(self) -> None:
        """Leave nothing unwritten and no timer behind."""
        if self._pending:
            await self.async_flush()
        # Whoever reads the file next must not be quicker than what is being written.
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
    """What the chargers of a bus may draw together, as the user wants it to stand."""

    limit: float | None
    """A a phase; ``None``: nobody has said so, all that the installation gives."""

    def raises(self, before: SupplyOrder) -> bool:
        """Return whether this allows more than another one."""
        if self.limit is None or before.limit is None:
            return self.limit is None and before.limit is not None
        return self.limit > before.limit


class _WatchedStore(Store[_Stored]):
    """A store that tells whether a write worked; Store only logs that it did not."""

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
    """Return orders as they are stored."""
    return {
        "allowed": orders.allowed,
        "limit": _encode_limit(orders.limit),
        "fail_safe": _encode_limit(orders.fail_safe),
        "fail_safe_timeout": orders.fail_safe_timeout,
    }


def decode(record: Mapping[str, Any]) -> Orders:
    """Return stored orders.

    Raises RefusedOrderError for a number that is none, is not finite or is
    negative, and TypeError or KeyError for a record of another shape.
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
    """Return a stored order about the supply; raises as `decode` does."""
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
