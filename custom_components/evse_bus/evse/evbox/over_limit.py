"""Watching whether a ChargePoint keeps to the limits we sent."""

from collections import deque
from math import inf
from typing import Final

from ..model import Phases

TOLERANCE_SHARE: Final = 0.05
TOLERANCE: Final = 1.0
"""Used currents may stand this much above the limit (meters, rounding), A."""
READINGS: Final = 2
"""Readings in a row that must show it: a car may overshoot for a moment."""
_NO_LIMIT: Final[Phases[float]] = (inf, inf, inf)


class LimitWatch:
    """Compares used currents with the limits of the last seconds.

    A car may take some seconds to follow, so a reading is held against the highest
    limit that was in force within that time.
    """

    def __init__(self) -> None:
        """Know of no limit: what the box did before us is its own affair."""
        self._limits: deque[tuple[float, Phases[float]]] = deque([(-inf, _NO_LIMIT)])
        self._above = 0

    def sent(self, now: float, currents: Phases[float], *, answered: bool) -> None:
        """Note what was sent, A; unanswered, it may be in force or not."""
        if not answered:
            one, two, three = map(max, self._limits[-1][1], currents, strict=True)
            currents = (one, two, three)
        if currents != self._limits[-1][1]:
            self._limits.append((now, currents))

    def exceeded(self, now: float, used: Phases[float], grace: float) -> bool:
        """Return whether more is used than was allowed within ``grace`` seconds."""
        # The limit that was in force when the grace began still counts.
        while len(self._limits) > 1 and self._limits[1][0] <= now - grace:
            self._limits.popleft()
        allowed = (
            max(limits[phase] for _, limits in self._limits) for phase in range(3)
        )
        above = any(
            amperes > limit * (1 + TOLERANCE_SHARE) + TOLERANCE
            for amperes, limit in zip(used, allowed, strict=True)
        )
        self._above = self._above + 1 if above else 0
        return self._above >= READINGS
