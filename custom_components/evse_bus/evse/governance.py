"""A charger under a ceiling: what counts of its orders, and how it is made to follow.

The rules are those of `ceiling`. A ceiling that is set, that expires or is given up is
sent like a limit, without a caller who waits; one that was not followed is sent again.
That a ceiling has paused the charger is noted with its orders, for the time after a
restart.

The charger is known here as a `Governed`.
"""

import asyncio
from functools import partial
import logging
from math import inf
from typing import Protocol

from .ceiling import (
    GOVERNED,
    PAUSED_BY_CEILING,
    RETRY,
    Ceiling,
    CeilingPause,
    lowered,
    released,
    safe_from_note,
    with_fail_safe,
)
from .errors import RefusedOrderError
from .exchange import Turn
from .jobs import Job
from .model import Limits, OrderChange, Orders, PauseReason
from .readings import ChargerInfo, ChargerReading
from .safety import Setpoint, clamp, number, pause_reason
from .schedule import Kind
from .scheduler import CommandQueue
from .standing_orders import Follower, StandingOrders

_LOGGER = logging.getLogger(__name__)


class Governed(Follower, Protocol):
    """A charger, as its governance knows it."""

    @property
    def limits(self) -> Limits:
        """Return the limits that no order may exceed now."""

    @property
    def bus(self) -> CommandQueue | None:
        """Return its bus, if it is on one."""

    @property
    def available(self) -> bool:
        """Return whether it answers, and its reading is up to date."""

    @property
    def reading(self) -> ChargerReading | None:
        """Return its last reading."""

    @property
    def info(self) -> ChargerInfo | None:
        """Return what was read of the box itself, such as its serial number."""

    async def follow_ceiling(self, turn: Turn) -> None:
        """Have the ceiling followed; a conversation (see `Charger.follow_ceiling`)."""

    @property
    def holds_ceiling_pause(self) -> bool:
        """Return whether it is paused by us for lack of current."""

    @property
    def may_be_paused(self) -> bool:
        """Return whether a pause may stand at the box, whoever has sent it."""

    @property
    def visit(self) -> str | None:
        """Return what proves, after a restart, that the same car is still there."""

    def continues(self, pause: CeilingPause) -> bool:
        """Return whether box and visit are provably those of a pause noted before."""


class Governance:
    """Whether a charger is governed, and what follows from that."""

    def __init__(self, charger: Governed, standing: StandingOrders) -> None:
        """Begin with what is noted with the orders."""
        self._charger = charger
        self._standing = standing
        self.ceiling: Ceiling | None = None
        """The ceiling set last; ``None``: it is not governed."""
        self.unproved: CeilingPause | None = None
        """A pause of an earlier run, as long as it is not proved to be still ours."""
        self.driver_allows = False
        """The driver has opened access at the box in this visit."""
        self._expired = True
        """It is not renewed; its lowering has been sent."""
        self._pending = False
        """The charger has not confirmed the ceiling that counts."""
        self._retry_at = -inf
        """Loop time from which it is sent again."""
        self._job: Job | None = None
        """The command that has sent it last."""
        self._clamped: tuple[tuple[Orders, Limits], Setpoint] | None = None
        self._reason: (
            tuple[tuple[Orders, Orders, Limits], PauseReason | None] | None
        ) = None
        notes = standing.orders.remembered
        safe = notes.get(GOVERNED)
        if safe is None:
            return
        note = notes.get(PAUSED_BY_CEILING)
        self.unproved = None if note is None else CeilingPause.from_note(note)
        self.ceiling = Ceiling.first(safe_from_note(safe), paused=note is not None)

    # -- What counts -------------------------------------------------------------

    def under_ceiling(self, orders: Orders) -> Orders:
        """Return what counts of orders now."""
        if self.ceiling is None:
            return orders
        return lowered(orders, self._amperes(self.ceiling))

    def _amperes(self, ceiling: Ceiling) -> float:
        """Return what the charger may offer now, A."""
        now = asyncio.get_running_loop().time()
        permitted = ceiling.amperes(now)
        if self.driver_allows:
            least = self._charger.limits.minimum
            return max(permitted, min(least, ceiling.guard_amperes(now)))
        return permitted

    @property
    def effective_orders(self) -> Orders:
        """Return the orders that count now: the valid ones under the ceiling."""
        return self.under_ceiling(self._standing.valid)

    @property
    def permitted(self) -> Setpoint:
        """Return the set-point of orders and ceiling, without any share of it."""
        inputs = (self.effective_orders, self._charger.limits)
        # Computed for every poll, and rarely different.
        if self._clamped is None or self._clamped[0] != inputs:
            self._clamped = (inputs, clamp(*inputs))
        return self._clamped[1]

    @property
    def pause_reason(self) -> PauseReason | None:
        """Return why orders and ceiling let no car charge; ``None``: they do."""
        inputs = (self._standing.valid, self.effective_orders, self._charger.limits)
        if self._reason is None or self._reason[0] != inputs:
            self._reason = (inputs, _reason_of(*inputs))
        return self._reason[1]

    @property
    def pauses(self) -> bool:
        """Return whether the ceiling alone allows no current."""
        valid = clamp(self._standing.valid, self._charger.limits)
        return not valid.paused and self.permitted.paused

    def fail_safe(self, orders: Orders, *, paused: bool) -> Orders:
        """Return orders with the fail-safe current that may be sent with them."""
        if self.ceiling is None:
            return orders
        return with_fail_safe(orders, 0.0 if paused else self.ceiling.safe)

    # -- The word of the house ---------------------------------------------------

    async def begin(self, safe: float) -> None:
        """Put the charger under a ceiling from now on, also after a restart.

        Until one is set (`set_ceiling`), and whenever none is any more, it gets no more
        than the safe value, A. Raises RefusedOrderError for an unusable number.
        """
        checked = number(safe, "safe value")
        before = self.permitted
        if self.ceiling is None:
            self.ceiling = Ceiling.first(checked, paused=False)
        else:
            now = asyncio.get_running_loop().time()
            self.ceiling = self.ceiling.with_safe(checked, now)
        self._on_ceiling(before)
        await self._standing.remember(GOVERNED, f"{checked:g}")

    def set_ceiling(self, amperes: float, *, guard: float | None = None) -> None:
        """Set the ceiling, A, or renew it; it is sent like a limit.

        Does not wait: one charger that is slow or silent must not hold up the others of
        the house. `permitted` follows at once, the reading when the charger does.
        ``guard``: what the main fuse permits, where the ceiling is lower for another
        reason. Raises RefusedOrderError for an unusable number, or while the charger is
        not governed.
        """
        before = self.permitted
        if self.ceiling is None:
            message = f"{self._charger.config.name} is not governed"
            raise RefusedOrderError(message)
        now = asyncio.get_running_loop().time()
        self.ceiling = self.ceiling.renew(amperes, guard, now)
        self._expired = False
        self._on_ceiling(before)

    def give_up_ceiling(self) -> None:
        """Let the ceiling expire now: the house is reloaded, disabled or has failed."""
        if self.ceiling is None:
            return
        before = self.permitted
        self.ceiling = self.ceiling.give_up(asyncio.get_running_loop().time())
        self._expired = True
        self._on_ceiling(before)

    async def release(self) -> None:
        """End that the charger is governed: the house is removed.

        Its orders are lowered to the safe value, and stored; where a ceiling pauses it,
        it stays stopped. Raising them is the user's word.
        """
        ceiling = self.ceiling
        if ceiling is None:
            return
        too_low = self._amperes(ceiling) < self._charger.limits.minimum
        stop = too_low or self.unproved is not None
        await self._standing.lower(partial(released, safe=ceiling.safe, stop=stop))
        self.ceiling = None
        self.allowed_or_stopped()
        self._send(lowers=True)
        self._charger.updated()

    def allowed_or_stopped(self) -> None:
        """Take note of the user's word: no pause of ours waits for it any more."""
        self.unproved = None
        self.driver_allows = False

    def expire_ceiling(self, now: float) -> float:
        """Lower a ceiling that was not renewed; return when it will have to be.

        Loop times, s.
        """
        if self.ceiling is None or self._expired:
            return inf
        if now < self.ceiling.expires_at:
            return self.ceiling.expires_at
        self._expired = True
        _LOGGER.warning(
            "%s: the house has set no ceiling in time; no more than %g A until it does",
            self._charger.config.name,
            self.ceiling.amperes(now),
        )
        self._pending = True
        self._send(lowers=True)
        self._charger.updated()
        return inf

    # -- To the charger ----------------------------------------------------------

    def _on_ceiling(self, before: Setpoint) -> None:
        """Send a ceiling that changes what counts, or that was not followed yet."""
        wanted = self.permitted
        changed = wanted.currents != before.currents
        lowers = all(
            new <= old
            for new, old in zip(wanted.currents, before.currents, strict=True)
        )
        now = asyncio.get_running_loop().time()
        if changed or (self._pending and now >= self._retry_at):
            self._pending = True
            self._send(lowers=lowers)
        if changed:
            self._charger.updated()

    def _send(self, *, lowers: bool) -> None:
        """Have the ceiling that counts sent; several that wait are one command."""
        bus = self._charger.bus
        if bus is None:
            return
        kind = Kind.PAUSE if self.permitted.paused else Kind.COMMAND
        waiting = self._job
        if waiting is not None and waiting.waits:
            waiting.kind = kind
            waiting.raises = not lowers
            bus.reschedule()
            return
        job = self._charger.order_job(self._follow, OrderChange(), kind)
        job.raises = not lowers
        if bus.queue(job):
            self._job = job

    async def _follow(self, turn: Turn) -> None:
        self._retry_at = turn.now + RETRY
        wanted = self.permitted
        await self._charger.follow_ceiling(turn)
        if self.permitted == wanted:
            self._pending = False
        self._charger.updated()

    # -- Its pause ---------------------------------------------------------------

    async def keep_pause(self) -> None:
        """Note with the orders that a ceiling has paused the charger, or no more."""
        charger = self._charger
        if self.ceiling is None or not charger.available or charger.reading is None:
            return
        if self.unproved is not None:
            if charger.may_be_paused and not charger.holds_ceiling_pause:
                return
            # There is no pause any more, or it has been proved to be ours.
            self.unproved = None
        holds = charger.holds_ceiling_pause
        noted = self._standing.orders.remembered.get(PAUSED_BY_CEILING)
        note = noted if holds else None
        if holds and self.pauses:
            known = None if noted is None else CeilingPause.from_note(noted)
            visit = charger.visit
            if known is None or (visit is not None and not charger.continues(known)):
                serial = charger.info.serial if charger.info is not None else None
                note = CeilingPause(serial, visit).note
        await self._standing.remember(PAUSED_BY_CEILING, note)


def _reason_of(valid: Orders, effective: Orders, limits: Limits) -> PauseReason | None:
    """Return why orders let no car charge, by themselves or under the ceiling."""
    if (reason := pause_reason(valid, limits)) is not None:
        return reason
    return PauseReason.CEILING_TOO_LOW if pause_reason(effective, limits) else None
