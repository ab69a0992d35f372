"""Energy totals that only grow by what has really flowed. Pure.

The recorder takes every rise of a total as consumption. A meter's own value may
rise for other reasons: another module has moved behind a number, a box was
exchanged. Then the total goes on from where it was, with the new meter.
"""

from dataclasses import dataclass
from typing import Final

HIGHEST_POWER: Final = 3 * 80.0 * 250.0
"""What no connector can exceed, W: three phases, IEC 61851's 80 A, 250 V."""


@dataclass(slots=True)
class MeterTotal:
    """The total of a charger's own meter."""

    offset: float = 0.0
    """What is added to the meter, Wh."""
    total: float | None = None
    """Wh; as long as the first meter stays, this is what it shows."""
    generation: int | None = None
    """Of the meter last seen; ``None``: not seen since the start."""

    def take(self, meter: float, generation: int, away: float = 0.0) -> float:
        """Return the total for a meter's value, Wh.

        ``away``: how long ago the total before a restart was kept, s.
        """
        now = self.offset + meter
        if self.total is not None and not self._goes_on(now, generation, away):
            self.offset = self.total - meter
            now = self.total
        self.generation = generation
        self.total = now
        return now

    def _goes_on(self, now: float, generation: int, away: float) -> bool:
        """Return whether this can be the same meter as before."""
        if self.total is None:
            return True
        if self.generation is not None:
            return generation == self.generation and now >= self.total
        # After a restart nobody knows; what cannot have flowed was not this meter.
        return 0 <= now - self.total <= HIGHEST_POWER * away / 3600 + 1


@dataclass(slots=True)
class SummedTotal:
    """The total of an energy that the library sums from its start on."""

    total: float = 0.0
    """Wh"""
    counted: float = 0.0
    """What the library had summed when we looked last, Wh."""
    source: object = None
    """Who sums; another one begins at 0."""

    def take(self, summed: float, source: object) -> float:
        """Return the total, Wh."""
        if source is not self.source or summed < self.counted:
            self.source = source
            self.counted = 0.0
        self.total += summed - self.counted
        self.counted = summed
        return self.total
