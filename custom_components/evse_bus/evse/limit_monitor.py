"""Check that a car keeps to the limits of the last seconds."""

from collections import deque
from math import inf
from typing import Final

from .model import Phases

TOLERANCE_SHARE: Final = 0.05
TOLERANCE: Final = 1.0
"""Used currents may be this much above the limit (meters, rounding), A."""
READINGS: Final = 2
"""Readings in a row that must be above it: a car may overshoot for a moment."""
_NO_LIMIT: Final[Phases[float]] = (inf, inf, inf)


class LimitMonitor:
    """Compares used currents with the limits of the last seconds.

    A car may take some seconds to follow, so a reading is compared with the highest
    limit that was in force within that time.
    """

    def __init__(self) -> None:
        """Start without a limit: earlier ones are not known."""
        self._limits: deque[tuple[float, Phases[float]]] = deque([(-inf, _NO_LIMIT)])
        self._above = 0

    @property
    def unconfirmed(self) -> bool:
        """Return whether the last reading was above the limits, as the first in a row.

        It may be damaged: the next one decides.
        """
        return 0 < self._above < READINGS

    def sent(self, now: float, currents: Phases[float], *, answered: bool) -> None:
        """Record limits that were sent (A); unanswered, they may be in force or not."""
        if not answered:
            one, two, three = map(max, self._limits[-1][1], currents, strict=True)
            currents = (one, two, three)
        if currents != self._limits[-1][1]:
            self._limits.append((now, currents))

    def exceeded(self, now: float, used: Phases[float], grace: float) -> bool:
        """Return whether used currents (A) exceed every limit of the last ``grace`` s.

        True from the second such reading in a row.
        """
        above = self.is_above(now, used, grace)
        self._above = self._above + 1 if above else 0
        return self._above >= READINGS

    def is_above(self, now: float, used: Phases[float], grace: float) -> bool:
        """Return whether these currents exceed every limit of the last ``grace`` s."""
        # The limit in force at the beginning of that time counts too.
        while len(self._limits) > 1 and self._limits[1][0] <= now - grace:
            self._limits.popleft()
        allowed = (
            max(limits[phase] for _, limits in self._limits) for phase in range(3)
        )
        return any(
            amperes > limit * (1 + TOLERANCE_SHARE) + TOLERANCE
            for amperes, limit in zip(used, allowed, strict=True)
        )
