"""Energy totals that grow only by measured consumption. Pure.

The recorder counts every rise of a total as consumption. The value of a meter may
jump for other reasons: a box was exchanged, or another module took its address. Then
the total continues from its old value, with the new meter.
"""

from dataclasses import dataclass
from typing import Final

HIGHEST_POWER: Final = 3 * 80.0 * 250.0
"""Upper bound for any connector, W: three phases, 80 A (IEC 61851-1), 250 V."""


@dataclass(slots=True)
class MeterTotal:
    """The total of a charger's own meter."""

    offset: float = 0.0
    """Added to the value of the meter, Wh."""
    total: float | None = None
    """Wh; equal to the value of the first meter as long as that stays."""
    generation: int | None = None
    """Generation of the last meter; ``None``: none read since the start."""

    def update(self, meter: float, generation: int, downtime: float = 0.0) -> float:
        """Return the total for a value of the meter, both in Wh.

        ``downtime``: time since the total was stored before a restart, s.
        """
        now = self.offset + meter
        if self.total is not None and not self._is_same_meter(
            now, generation, downtime
        ):
            self.offset = self.total - meter
            now = self.total
        self.generation = generation
        self.total = now
        return now

    def _is_same_meter(self, now: float, generation: int, downtime: float) -> bool:
        """Return whether this can be the same meter as before."""
        if self.total is None:
            return True
        if self.generation is not None:
            return generation == self.generation and now >= self.total
        # After a restart the generation is unknown: judge by the possible energy.
        return 0 <= now - self.total <= HIGHEST_POWER * downtime / 3600 + 1


@dataclass(slots=True)
class SummedTotal:
    """The total of an energy that the library sums up from its start on."""

    total: float = 0.0
    """Wh"""
    counted: float = 0.0
    """Sum of the library at the last update, Wh."""
    source: object = None
    """Object that sums up; another one starts at 0."""

    def update(self, summed: float, source: object) -> float:
        """Return the total for a sum of the library, both in Wh."""
        if source is not self.source or summed < self.counted:
            self.source = source
            self.counted = 0.0
        self.total += summed - self.counted
        self.counted = summed
        return self.total
