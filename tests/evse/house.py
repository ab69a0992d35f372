"""A house that sets ceilings, as the oracle of tests: it shares no code with the library.

What it permits at a moment, by the rules of docs/sun.md and its last word.
"""

from dataclasses import dataclass
from math import inf

from tests.simulated_time import now

LIFETIME = 60.0
NOTE = "paused_by_ceiling"
"""Note with the stored orders of a charger that a ceiling has paused."""


@dataclass
class House:
    """The last word of the house about one charger."""

    safe: float
    value: float = inf
    guard: float = inf
    said_at: float = -inf

    def says(self, value: float, guard: float | None = None) -> None:
        self.guard = inf if guard is None else guard
        self.value, self.said_at = min(value, self.guard), now()

    @property
    def silent(self) -> bool:
        return now() - self.said_at >= LIFETIME

    @property
    def permits(self) -> float:
        """Return what may be offered now, A."""
        return min(self.value, self.safe) if self.silent else self.value

    @property
    def guard_permits(self) -> float:
        return min(self.guard, self.safe) if self.silent else self.guard

    def falls_silent(self) -> None:
        self.value, self.guard = self.permits, self.guard_permits
        self.said_at = -inf

    def restarts(self, notes: object) -> None:
        """Home Assistant has restarted; ``notes``: those with the stored orders."""
        assert isinstance(notes, dict)
        self.value = 0.0 if NOTE in notes else self.safe
        self.guard, self.said_at = self.safe, -inf
