"""The current that the chargers of one bus share, where we are their master.

The installation sets an upper bound, which a reconfiguration changes. The user's order
stays within it: an automation may lower it to the solar surplus, for example. As with
a charger's orders, a lowering is on disk before it takes effect.
"""

from collections.abc import Awaitable, Callable
from typing import Final

from .evse.errors import RefusedOrderError
from .evse.model import Circuit
from .evse.safety import number, round_down
from .stores.orders import OrderStore, SupplyOrder

STEP: Final = 0.1
"""Resolution of the shared current, A."""


class SharedSupply:
    """The supply that the chargers of one bus share."""

    def __init__(
        self,
        installed: Circuit,
        orders: OrderStore,
        key: str,
        apply: Callable[[Circuit], Awaitable[None]],
    ) -> None:
        """Read and apply nothing yet.

        ``installed`` is the limit of the installation, ``key`` that of the stored
        order. ``apply`` passes a supply to the master of the bus and returns when it
        has been broadcast.
        """
        self.installed = installed
        self._orders = orders
        self._key = key
        self._apply = apply

    @property
    def order(self) -> SupplyOrder | None:
        """Return the user's order; ``None`` before the start."""
        return self._orders.supply(self._key)

    @property
    def is_lost(self) -> bool:
        """Return whether the stored order was lost and the user gave no other."""
        return self._orders.is_lost(self._key)

    @property
    def limit(self) -> float:
        """Return the current limit in effect, for all chargers together, A per phase."""
        order = self.order
        if order is None or order.limit is None:
            return self.installed.limit
        return min(order.limit, self.installed.limit)

    async def async_start(self, *, registered: bool) -> bool:
        """Apply the stored order; return false when it cannot be stored.

        A new bus has none and may use the limit of the installation. When a stored
        order is missing, the limit becomes the least that lets one car charge.
        ``registered``: the bus is known to be no new one.
        """
        least = min(self.installed.minimum, self.installed.limit)
        order = await self._orders.async_begin(
            (self._key,),
            first=SupplyOrder(None),
            fallback=SupplyOrder(least),
            registered=registered,
        )
        if order is None:
            return False
        await self._async_apply()
        return True

    async def async_order(self, value: float) -> None:
        """Limit the sum of all chargers, A per phase; rounded down to `STEP`.

        Raises RefusedOrderError unless it is a finite number from 0 to the limit of
        the installation.
        """
        limit = number(value, "supply")
        if limit > self.installed.limit:
            message = f"{limit:g} A is above the {self.installed.limit:g} A limit"
            raise RefusedOrderError(message)
        await self._orders.async_commit(self._key, SupplyOrder(round_down(limit, STEP)))
        # Reads the limit again: a newer order may have been stored in the meantime.
        await self._async_apply()

    async def async_update_installed(self, installed: Circuit) -> None:
        """Apply a changed limit of the installation."""
        if installed != self.installed:
            self.installed = installed
            await self._async_apply()

    async def _async_apply(self) -> None:
        await self._apply(Circuit(limit=self.limit, minimum=self.installed.minimum))
