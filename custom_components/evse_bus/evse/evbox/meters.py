"""Energy meters of the modules, which have an index and no identity.

A total is shown only while it certainly continues the one before. When the number of
modules changes, or a total jumps and stays, the module at an index may be another one:
the generation of that index counts up, so that no total is carried from one module to
another (PROTOCOLS.md section 1).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

SLACK: Final = 100
"""Largest step of a coarse meter, Wh."""
HIGHEST_PHASE_VOLTAGE: Final = 265.0
"""230 V + 15 %, V: the highest voltage behind a total."""
_PHASES: Final = 3
_SECONDS_PER_HOUR: Final = 3600.0


def most_energy(seconds: float, current: float) -> float:
    """Return the most a meter can count in a time at a current on 3 phases, Wh."""
    power = current * _PHASES * HIGHEST_PHASE_VOLTAGE
    return SLACK + power * max(seconds, 0.0) / _SECONDS_PER_HOUR


@dataclass(frozen=True, slots=True)
class Totals:
    """The totals of all modules at one time."""

    totals: tuple[int, ...]
    """Wh, by index of the module."""
    at: float
    """s"""

    def can_grow_to(self, index: int, later: int, at: float, current: float) -> bool:
        """Return whether a later total at this index may be of the same meter.

        ``later``: Wh, ``at``: its time, s, ``current``: the most a module carries, A.
        """
        if index >= len(self.totals):
            return False
        growth = later - self.totals[index]
        return 0 <= growth <= most_energy(at - self.at, current)


class Meters:
    """The meters of one ChargePoint, reply after reply."""

    def __init__(self) -> None:
        """Start without totals."""
        self._confirmed: Totals | None = None
        self._unconfirmed: Totals | None = None
        self._generations: dict[int, int] = {}

    @property
    def unconfirmed(self) -> bool:
        """Return whether the totals need a second reply that agrees."""
        return self._unconfirmed is not None

    def generation(self, index: int) -> int:
        """Return how often the meter at this index has changed."""
        return self._generations.get(index, 0)

    def require_confirmation(self) -> None:
        """Show no total until two replies agree: the ChargePoint was away."""
        if self._confirmed is not None and self._unconfirmed is None:
            # Totals of no module: none can grow from them, so two more are needed.
            self._unconfirmed = Totals((), self._confirmed.at)

    def jumps(
        self, totals: Sequence[int], now: float, current: float
    ) -> dict[int, float]:
        """Return the totals that do not continue the ones before, Wh, by index.

        ``current`` is the most one module can carry, A. A change of the number of
        modules is no jump; `update` deals with it.
        """
        before = self._confirmed
        if self.unconfirmed or before is None or len(before.totals) != len(totals):
            return {}
        return {
            index: total
            for index, total in enumerate(totals)
            if not before.can_grow_to(index, total, now, current)
        }

    def update(
        self, totals: Sequence[int], now: float, current: float
    ) -> tuple[float | None, ...]:
        """Accept the totals of a reply; return those that may be shown, Wh."""
        new = Totals(tuple(totals), now)
        unknown = (None,) * len(new.totals)
        known = self._unconfirmed or self._confirmed
        if known is None or len(known.totals) != len(new.totals):
            self._unconfirmed = new
            return unknown
        if self._unconfirmed is not None:
            agrees = all(
                self._unconfirmed.can_grow_to(index, total, now, current)
                for index, total in enumerate(new.totals)
            )
            if not agrees:
                self._unconfirmed = new
                return unknown
            self._unconfirmed = None
        self._count_generations(new, current)
        self._confirmed = new
        return new.totals

    def _count_generations(self, new: Totals, current: float) -> None:
        """Count up the generation of each index whose meter may be another one."""
        before = self._confirmed or Totals((), new.at)
        same_count = len(before.totals) == len(new.totals)
        for index, total in enumerate(new.totals):
            if index >= len(before.totals):
                # An index that was gone for a while starts a new generation.
                if index in self._generations:
                    self._generations[index] += 1
                continue
            continues = before.can_grow_to(index, total, new.at, current)
            # Where the number of modules changed, a second match makes it ambiguous.
            ambiguous = not same_count and any(
                before.can_grow_to(other, total, new.at, current)
                for other in range(len(before.totals))
                if other != index
            )
            if not continues or ambiguous:
                self._generations[index] = self.generation(index) + 1
        for index in range(len(new.totals)):
            self._generations.setdefault(index, 0)
