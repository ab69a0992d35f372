"""Energy totals that grow only by measured consumption. Pure.

The recorder counts every rise of a total as consumption. The value of a meter may
jump for other reasons: a box was exchanged, or another module took its address. Then
the total continues from its old value, with the new meter.
"""

from dataclasses import dataclass, field
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
    _offsets: dict[int, float] = field(default_factory=dict)
    """Offsets of former generations, which the meter may resume, Wh."""

    def update(self, meter: float, generation: int, downtime: float = 0.0) -> float:
        """Return the total for a value of the meter, both in Wh.

        ``downtime``: time since the total was stored before a restart, s.
        """
        if self.generation is None:
            # After a restart the generation is unknown: judge by the possible energy.
            is_known = self.total is None or (
                0
                <= self.offset + meter - self.total
                <= HIGHEST_POWER * downtime / 3600 + 1
            )
        else:
            self._offsets[self.generation] = self.offset
            is_known = generation in self._offsets
            self.offset = self._offsets.get(generation, 0.0)
        if self.total is not None and (
            not is_known or self.offset + meter < self.total
        ):
            # What it has counted before is no consumption.
            self.offset = self.total - meter
        self.generation = generation
        self.total = max(self.offset + meter, self.total or 0.0)
        return self.total


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
