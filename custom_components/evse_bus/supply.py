"""What the chargers of one bus share, where Home Assistant is their master.

The installation gives so much (a reconfiguration changes that); the user's order,
within it, is what they may share now: an automation brings it down to what the sun
leaves over, for instance. As with a charger's orders a lowering is on disk before it
counts, and the order is there before the port opens.
"""

from collections.abc import Awaitable, Callable
from typing import Final

from .evse.errors import RefusedOrderError
from .evse.model import Supply
from .evse.safety import number, round_down
from .orders import OrderStore, SupplyOrder

STEP: Final = 0.1
"""Step in which currents are shared out, A."""


class SharedSupply:
    """What one bus's chargers share."""

    def __init__(
        self,
        installed: Supply,
        orders: OrderStore,
        follow: Callable[[Supply], Awaitable[None]],
    ) -> None:
        """Begin with nothing read yet; ``follow`` tells the master what counts.

        It returns when the chargers have heard of it.
        """
        self.installed = installed
        self._orders = orders
        self._follow = follow

    @property
    def limit(self) -> float:
        """Return what the chargers may draw together now, A a phase."""
        order = self._orders.supply
        if order is None or order.limit is None:
            return self.installed.limit
        return min(order.limit, self.installed.limit)

    async def async_begin(self, *, new: bool) -> bool:
        """Follow the stored order; return false when it is lost.

        A ``new`` bus has none yet, and may share all that the installation gives.
        Where there must have been one, as little as lets one car charge counts.
        """
        lost = self._orders.supply is None and not new
        if self._orders.supply is None:
            least = min(self.installed.minimum, self.installed.limit)
            await self._orders.async_commit_supply(SupplyOrder(least if lost else None))
        await self._async_tell()
        return not lost

    async def async_order(self, value: float) -> None:
        """Let the chargers share this much, A a phase; rounded down.

        Raises RefusedOrderError for what is not a finite number from 0 to what the
        installation gives.
        """
        wish = number(value, "supply")
        if wish > self.installed.limit:
            message = f"{wish:g} A is above the {self.installed.limit:g} A limit"
            raise RefusedOrderError(message)
        await self._orders.async_commit_supply(SupplyOrder(round_down(wish, STEP)))
        # What was ordered meanwhile is newer and counts.
        await self._async_tell()

    async def async_set_up(self, installed: Supply) -> None:
        """Follow a changed set-up at once."""
        if installed != self.installed:
            self.installed = installed
            await self._async_tell()

    async def _async_tell(self) -> None:
        await self._follow(Supply(limit=self.limit, minimum=self.installed.minimum))
