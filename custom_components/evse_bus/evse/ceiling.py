"""The ceiling of a charger: what the house permits now, beside the user's orders.

    effective = min(order, charger and cable, shared supply, ceiling)

A ceiling is neither an order nor a reading. It is volatile: whoever governs the charger
(the house: its sun, its main fuse) renews it all the time. It goes to the wire like a
limit, through `safety.clamp`: a ceiling below the minimum is a pause, several that wait
are one, a pause goes before a raise. It renews no order and changes none, except when
the charger is released. The rules:

1. Expiry and silence only lower. A ceiling that is not renewed for `LIFETIME` becomes
   min(ceiling, safe value), until the next one is set: what is paused stays paused.
2. "No ceiling yet" is not "no ceiling". That the charger is governed, by which safe
   value, and that it was paused is noted with its orders. So from its first request on
   the ceiling is 0 if it was paused, else the safe value.
3. A ceiling undoes only a pause of ours, sent for lack of current to a box that was read
   as not paused. Which pause that is, each protocol follows by itself (`Charger.
   waits_for_current`). After a restart it must be proved that box and visit are the
   same (`CeilingPause`), else the pause waits for the user. Raising it again is a
   conversation of its own (`Charger.follow_ceiling`): no change of orders is made up.
4. Access that a driver opens at the box during such a pause is the driver's word: at
   least the minimum for this visit, within what the fuse permits (``guard``).
5. A pause is never withheld, and a box whose access bit is in flash memory has none
   written for it.
6. While a box that falls back by itself is paused, its fail-safe current is 0, else it
   is within the safe value.
7. A ceiling wakes nothing and enables no outlet.
8. A charger is released with its orders lowered to what the ceiling permits without
   renewal: raising them is the user's word.

Pure: time comes in as an argument.
"""

from dataclasses import dataclass, replace
from math import inf
from typing import Final, Self

from .errors import RefusedOrderError
from .model import Orders
from .safety import number

LIFETIME: Final = 60.0
"""Time after which a ceiling that is not renewed becomes the safe value or less, s."""
RETRY: Final = 10.0
"""Shortest pause before a ceiling that the charger did not follow is sent again, s."""

GOVERNED: Final = "governed"
"""Note with the orders: the safe value of a governed charger, A."""
PAUSED_BY_CEILING: Final = "paused_by_ceiling"
"""Note with the orders: box and visit that a ceiling has paused (`CeilingPause`)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ceiling:
    """What one charger may offer by the word of the house."""

    value: float
    """A."""
    safe: float
    """A, at most, once it is not renewed any more."""
    guard: float = inf
    """What the fuse permits whatever the driver says, A; at least ``value``."""
    renewed: float = -inf
    """Loop time at which it was set; ``-inf``: not yet, or given up."""

    @classmethod
    def first(cls, safe: float, *, paused: bool) -> Self:
        """Return the ceiling of a charger before one is set."""
        return cls(value=0.0 if paused else safe, safe=safe, guard=safe)

    @property
    def expires_at(self) -> float:
        """Return the loop time at which it expires unless it is renewed."""
        return self.renewed + LIFETIME

    def amperes(self, now: float) -> float:
        """Return what it permits now, A."""
        return self.value if now < self.expires_at else min(self.value, self.safe)

    def guard_amperes(self, now: float) -> float:
        """Return what the fuse permits now, A."""
        return self.guard if now < self.expires_at else min(self.guard, self.safe)

    def renew(self, value: float, guard: float | None, now: float) -> Self:
        """Return the next one; raises RefusedOrderError for an unusable number."""
        highest = inf if guard is None else number(guard, "guard")
        own = min(number(value, "ceiling"), highest)
        return replace(self, value=own, guard=highest, renewed=now)

    def give_up(self, now: float) -> Self:
        """Return it as if it had just expired."""
        return replace(
            self,
            value=min(self.amperes(now), self.safe),
            guard=min(self.guard_amperes(now), self.safe),
            renewed=-inf,
        )

    def with_safe(self, safe: float, now: float) -> Self:
        """Return it with another safe value; one that has expired is not raised."""
        lowered = self if now < self.expires_at else self.give_up(now)
        return replace(lowered, safe=safe)


@dataclass(frozen=True, slots=True)
class CeilingPause:
    """A pause that a ceiling has brought about."""

    serial: str | None
    """Serial number of the box, if it has one."""
    visit: str | None
    """What proves that the same car is still there; ``None``: the box has no such."""

    @property
    def note(self) -> str:
        """Return it as it is stored."""
        return f"{self.serial or ''} {self.visit or ''}"

    @classmethod
    def from_note(cls, note: str) -> Self:
        """Return a stored one; an unreadable one proves nothing."""
        serial, _, visit = note.partition(" ")
        return cls(serial or None, visit or None)


def lowered(orders: Orders, amperes: float) -> Orders:
    """Return orders under a ceiling, A."""
    limit = replace(orders.limit, current=min(orders.limit.current, amperes))
    return replace(orders, limit=limit)


def with_fail_safe(orders: Orders, amperes: float) -> Orders:
    """Return orders whose fail-safe current is within a value, A."""
    fail_safe = replace(
        orders.fail_safe, current=min(orders.fail_safe.current, amperes)
    )
    return replace(orders, fail_safe=fail_safe)


def released(orders: Orders, safe: float, *, stop: bool) -> Orders:
    """Return the orders with which a charger is released, without the notes.

    Never higher than before. ``safe``: A.
    """
    notes = dict(orders.remembered)
    for name in (GOVERNED, PAUSED_BY_CEILING):
        notes.pop(name, None)
    allowed = False if stop else orders.allowed
    return replace(lowered(orders, safe), allowed=allowed, remembered=notes)


def safe_from_note(note: str) -> float:
    """Return a stored safe value, A; 0 for an unreadable one."""
    try:
        return number(float(note), "safe value")
    except RefusedOrderError, ValueError:
        return 0.0
