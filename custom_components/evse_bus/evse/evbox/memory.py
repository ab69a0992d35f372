"""The rhythm of the ChargePoints on one line, kept from one bus to the next.

A ChargePoint that is asked sooner than its minimum interval may stay silent; what it
does with such a request is not documented. So the interval that it has reported and
the time of the last request outlive a search and a reload.
"""

from math import inf

from .frames import ANY_SERIAL
from .plausibility import ConfirmedValue, new_interval


class EvboxMemory:
    """Minimum intervals and last requests, by serial number."""

    def __init__(self) -> None:
        """Know no ChargePoint."""
        self._intervals: dict[int, ConfirmedValue] = {}
        self._sent: dict[int, float] = {}

    def interval(self, serial: int) -> ConfirmedValue:
        """Return the minimum interval of a ChargePoint, s; its replies update it."""
        return self._intervals.setdefault(serial, new_interval())

    def sent(self, serial: int, at: float) -> None:
        """Take note of a request to a ChargePoint (0: to all) sent at a loop time."""
        self._sent[serial] = at

    def sent_at(self, serial: int) -> float:
        """Return when a ChargePoint (0: any of them) was last sent a request, or -inf.

        One that was sent to all counts for each.
        """
        if serial == ANY_SERIAL:
            return max(self._sent.values(), default=-inf)
        return max(self._sent.get(one, -inf) for one in (serial, ANY_SERIAL))
