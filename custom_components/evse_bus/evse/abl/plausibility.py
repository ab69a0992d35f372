"""How many agreeing replies make a status count (register 0x002E). Pure.

The checksum of Modbus ASCII is the sum of the bytes: two errors that cancel each other
pass it. So a status that differs from the one before, other than in its currents, or
whose currents exceed what the box offers, counts when a second reply agrees; and one
with more than the box can carry, when a third does. A real over-current is shown then:
hiding it would be worse.
"""

from collections.abc import Iterable
from math import inf
from typing import Final

from ..limit_monitor import LimitMonitor
from ..meter import CONFIRMATIONS
from ..model import Phases
from ..plausibility import CURRENT_AGREEMENT, agree, highest_plausible
from .registers import Reading

MOST_READS: Final = 2 * CONFIRMATIONS
"""Most reads in a row until enough replies agree."""
_UNEXPLAINED: Final = 2
"""Replies for a change, and for more current than is offered."""


class StatusCheck:
    """The replies of one box that count, one after the other."""

    def __init__(self) -> None:
        """Start without a reply."""
        self._kept: Reading | None = None
        self._replies = 0
        """Replies that the currents of the last status have needed."""
        self._monitor = LimitMonitor()
        self.limit_exceeded = False
        """More flows than the box has offered, in two statuses in a row."""

    def needed(
        self, reading: Reading, now: float, *, maximum: float, grace: float
    ) -> int:
        """Return how many replies that agree with this one make it count.

        ``maximum``: of the box, A. ``grace``: time to follow another limit, s.
        """
        kept = self._kept
        has_changed = kept is None or _key(kept) != _key(reading)
        least = _UNEXPLAINED if has_changed else 1
        currents = self._needed_by_currents(reading, now, maximum, grace)
        if currents <= self._replies and kept is not None and agreeing(kept, reading):
            # As high as before.
            return least
        return max(least, currents)

    def _needed_by_currents(
        self, reading: Reading, now: float, maximum: float, grace: float
    ) -> int:
        used = _known(reading.currents)
        if max(used) > highest_plausible(maximum):
            return CONFIRMATIONS
        return _UNEXPLAINED if self._monitor.is_above(now, used, grace) else 1

    def keep(
        self,
        reading: Reading,
        now: float,
        *,
        offered: float | None,
        maximum: float,
        grace: float,
    ) -> None:
        """Take a status that counts; ``offered``: what the box offers, A."""
        self._replies = self._needed_by_currents(reading, now, maximum, grace)
        self._kept = reading
        used = _known(reading.currents)
        self.limit_exceeded = self._monitor.exceeded(now, used, grace)
        limit = inf if offered is None else offered
        self._monitor.sent(now, (limit, limit, limit), answered=True)

    @property
    def over_current(self) -> bool:
        """Return whether more flows than the box can carry."""
        return self._replies >= CONFIRMATIONS


def agreeing(one: Reading, two: Reading) -> bool:
    """Return whether two replies say the same, as far as currents can."""
    return _key(one) == _key(two) and all(
        first is second
        if first is None or second is None
        else agree(first, second, CURRENT_AGREEMENT)
        for first, second in zip(one.currents, two.currents, strict=True)
    )


def _key(reading: Reading) -> tuple[object, ...]:
    return (reading.state, reading.plugged, reading.reduced, reading.duty)


def _known(currents: Iterable[float | None]) -> Phases[float]:
    one, two, three = (0.0 if current is None else current for current in currents)
    return one, two, three
