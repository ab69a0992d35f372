"""A house that sets ceilings, as the oracle of tests: it shares no code with the library.

What it permits at a moment, by the rules of docs/sun.md and its last word.
"""

from dataclasses import dataclass, field
from math import inf

from tests.simulated_time import now

LIFETIME = 60.0
NOTE = "paused_by_ceiling"
"""Note with the stored orders of a charger that a ceiling has paused."""


class Recent:
    """A value that others may still use for a moment after it has changed."""

    def __init__(self, value: float) -> None:
        self.value = value
        self._before: list[tuple[float, float]] = []

    def set(self, value: float) -> None:
        self._before.append((now(), self.value))
        self.value = value

    def highest(self, within: float) -> float:
        """Return the highest value of the last seconds."""
        since = now() - within
        return max([self.value, *(old for at, old in self._before if at >= since)])


@dataclass
class House:
    """The last word of the house about one charger."""

    safe: float = inf
    value: float = inf
    guard: float = inf
    said_at: float = -inf
    _before: list[tuple[float, float]] = field(default_factory=list)

    def _leave(self) -> None:
        self._before.append((now(), self.permits))

    def highest(self, within: float) -> float:
        """Return the most that was permitted in the last seconds, A."""
        since = now() - within
        values = [self.permits, *(old for at, old in self._before if at >= since)]
        if now() - self.said_at < LIFETIME + within:
            values.append(self.value)
        return max(values)

    def governs(self, safe: float) -> None:
        """Begin: until it says something, the safe value counts."""
        self._leave()
        self.safe = self.value = safe

    def says(self, value: float, guard: float | None = None) -> None:
        self._leave()
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
        self._leave()
        self.value, self.guard = self.permits, self.guard_permits
        self.said_at = -inf

    def restarts(self, notes: object) -> None:
        """Home Assistant has restarted; ``notes``: those with the stored orders."""
        assert isinstance(notes, dict)
        self._leave()
        self.value = 0.0 if NOTE in notes else self.safe
        self.guard, self.said_at = self.safe, -inf
