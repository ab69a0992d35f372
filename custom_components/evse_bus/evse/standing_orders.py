"""The orders of one charger: what stands, what was requested, what is stored.

- A lowering counts (and is stored) before it is sent, a raise only after the charger
  has confirmed it.
- Permission and limit are independent of each other.
- Orders that are not renewed within their lifetime become the fail-safe value.

A ceiling lowers what counts of them (`governance`); it changes none of them. The
charger is known here as a `Follower`.
"""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from functools import partial
import logging
from typing import Protocol

from .conversation import Conversation, nothing
from .exchange import Turn
from .jobs import Job, JobOwner, merge_key
from .memory import Renewals
from .model import ChargerConfig, OrderChange, Orders
from .safety import cautious, expired
from .schedule import Kind
from .scheduler import CommandQueue

_LOGGER = logging.getLogger(__name__)


class Follower(JobOwner, Protocol):
    """A charger, as its orders know it."""

    @property
    def config(self) -> ChargerConfig:
        """Return how it is set up: its name, its key, the lifetime of its orders."""

    def require_bus(self) -> CommandQueue:
        """Return its bus; raises NotAvailableError while it is on none."""

    def order_job(
        self, conversation: Conversation[object], change: OrderChange, kind: Kind
    ) -> Job:
        """Return a command that sends orders to it; raises as `require_bus`."""

    def order_to_send(self, change: OrderChange) -> Orders:
        """Return the orders to send for a change, under its ceiling."""

    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        """Have the orders followed; a conversation (see `Charger.apply`)."""

    def updated(self) -> None:
        """Call the listeners."""


class StandingOrders:
    """What stands of the orders of one charger."""

    def __init__(self, charger: Follower, orders: Orders) -> None:
        """Begin with the orders that stand; nothing is sent for them."""
        self._charger = charger
        self.orders = orders
        """What stands: confirmed by the charger, or lower."""
        self._requested = orders
        """What was requested last, field by field: what stands is never above it."""
        self.expired = False
        """They were not renewed within their lifetime: the fail-safe counts."""
        self.commit: Callable[[Orders], Awaitable[None]] = _no_commit
        """Stores orders; awaited before a lowering is sent, after a raise."""
        self.renewals = Renewals()
        """That of the line, once the charger is on a bus."""

    @property
    def valid(self) -> Orders:
        """Return the orders that stand, their lifetime considered."""
        return expired(self.orders) if self.expired else self.orders

    # -- A change ----------------------------------------------------------------

    async def change(self, checked: OrderChange) -> None:
        """Lower what stands, have a change sent, and let it stand when confirmed.

        ``checked``: by `check_change`. Raises as `Charger.change_orders`.
        """
        charger = self._charger
        if checked.is_about_now:
            now = asyncio.get_running_loop().time()
            self.renewals.at[charger.config.key] = now
            self.expired = False
        self._requested = checked.apply(self._requested)
        lowered = cautious(self.orders, checked.apply(self.orders))
        if lowered != self.orders:
            self.orders = lowered
            charger.updated()
            await self._store(lowered)
        bus = charger.require_bus()
        kind = Kind.COMMAND
        if checked.allowed is False:
            kind = Kind.PAUSE
            bus.supersede(charger, lambda waiting: waiting.allowed is True)
        job = charger.order_job(nothing, checked, kind)
        job.merge_key = merge_key(checked)
        # Its change may be another one by its turn: waiting changes are merged.
        job.conversation = partial(self._apply, job)
        await bus.submit(job)

    async def _apply(self, job: Job, turn: Turn) -> None:
        """Apply the change of a job; let it stand once it is confirmed."""
        change = job.change or OrderChange()
        charger = self._charger
        await charger.apply(turn, charger.order_to_send(change), change)
        confirmed = self.confirmed_target(change)
        changed = confirmed != self.orders
        self.orders = confirmed
        charger.updated()
        if changed:
            await self._store(confirmed)

    def confirmed_target(self, change: OrderChange) -> Orders:
        """Return the orders that stand once a change under way is confirmed.

        Other changes may have been confirmed meanwhile. A newer lowering stands from
        the moment of its request, whether or not it has been sent.
        """
        return cautious(change.apply(self.orders), self._requested)

    def valid_target(self, change: OrderChange) -> Orders:
        """Return the target of a change, unless the orders have expired.

        A change of the fail-safe alone renews nothing.
        """
        target = self.confirmed_target(change)
        return expired(target) if self.expired else target

    async def lower(self, lowering: Callable[[Orders], Orders]) -> None:
        """Lower what stands and what was requested, and store it; nothing is sent."""
        self._requested = lowering(self._requested)
        self.orders = lowering(self.orders)
        await self._store(self.orders)

    # -- Their lifetime ----------------------------------------------------------

    def expire(self, now: float) -> bool:
        """Expire orders whose lifetime is over; return whether they just expired.

        ``now``: loop time, s.
        """
        config = self._charger.config
        lifetime = config.order_lifetime
        if lifetime is None or self.expired:
            return False
        # Counted from the first turn, so that automations can renew after a restart.
        renewed = self.renewals.at.setdefault(config.key, now)
        if now - renewed < lifetime:
            return False
        self.expired = True
        _LOGGER.warning(
            "%s: no automation has renewed its orders for %g s; "
            "the fail-safe current counts until one does",
            config.name,
            lifetime,
        )
        self._charger.updated()
        return True

    # -- Their store -------------------------------------------------------------

    async def remember(self, name: str, value: str | None) -> None:
        """Store a note with the orders; ``None`` deletes it."""
        if self.orders.remembered.get(name) == value:
            return
        notes = {**self.orders.remembered, name: value}
        kept = {key: note for key, note in notes.items() if note is not None}
        self.orders = replace(self.orders, remembered=kept)
        await self._store(self.orders)

    async def _store(self, orders: Orders) -> None:
        try:
            await self.commit(orders)
        except Exception:
            # A full disk must not keep a pause from the wire.
            _LOGGER.exception("%s: orders were not stored", self._charger.config.name)


async def _no_commit(_orders: Orders) -> None:
    """Store nothing: the default for a script without a store."""
