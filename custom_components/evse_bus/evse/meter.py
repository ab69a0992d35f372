"""Meter totals: accepted as far as that much energy may have flowed.

The weak checksums of these protocols let damaged totals through, and a meter may be
set, exchanged or fail for a while. A total counts at once if it continues the one
before: no less, and no more than the highest current can add in the time between, by a
monotonic clock. Any other total counts once `CONFIRMATIONS` consistent ones were read.
It then belongs to another generation of the meter, so that the step to it is no
consumption. A meter that is soon back at its former total resumes that generation.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final

CONFIRMATIONS: Final = 3
"""Consistent totals in a row that are accepted although they continue nothing."""
SLACK: Final = 100
"""Largest step of a coarse meter, Wh."""
SESSION_SLACK: Final = 5.0
"""Error of the time that a charger counts, s."""
HIGHEST_PHASE_VOLTAGE: Final = 265.0
"""230 V + 15 %, V: the highest voltage behind a total."""
HIGHEST_CURRENT: Final = 80.0
"""Highest current that a control pilot can offer, A (IEC 61851-1, annex A)."""
RESUME_WITHIN: Final = 600.0
"""Time within which a meter may be back at its former total, s. After a longer one, a
total in reach of it may as well be that of another meter."""
_FORMER: Final = 4
"""Former generations that can be resumed."""
_PHASES: Final = 3
_SECONDS_PER_HOUR: Final = 3600.0


def most_energy(
    seconds: float, current: float = HIGHEST_CURRENT, *, slack: float = SLACK
) -> float:
    """Return the most a meter can count in a time at a current on 3 phases, Wh."""
    power = current * _PHASES * HIGHEST_PHASE_VOLTAGE
    return slack + power * max(seconds, 0.0) / _SECONDS_PER_HOUR


@dataclass(frozen=True, slots=True)
class Total:
    """A total as it was read."""

    energy: float
    """Wh"""
    at: float
    """Monotonic time, s."""

    def can_grow_to(self, later: Total, current: float = HIGHEST_CURRENT) -> bool:
        """Return whether a later total may be of the same meter.

        ``current``: the highest phase current behind the meter, A.
        """
        growth = later.energy - self.energy
        return 0 <= growth <= most_energy(later.at - self.at, current)


@dataclass(frozen=True, slots=True)
class MeterReading:
    """The accepted reading of a meter."""

    energy: float | None = None
    """Total, Wh; ``None``: none accepted yet."""
    generation: int = 0
    """Another one: another meter, or its total was set."""


class Meter:
    """One meter, total after total."""

    def __init__(self) -> None:
        """Start without a total."""
        self.last: Total | None = None
        """The last total that was accepted."""
        self._generation = 0
        self._newest = 0
        self._former: deque[tuple[int, Total]] = deque(maxlen=_FORMER)
        self._doubtful: list[Total] = []
        self._expected: float | None = None

    @property
    def reading(self) -> MeterReading:
        """Return the total that counts, and its generation."""
        if self.last is None:
            return MeterReading()
        return MeterReading(self.last.energy, self._generation)

    def check(self, total: Total, current: float = HIGHEST_CURRENT) -> bool:
        """Accept a total that is plausible or confirmed; return whether it is.

        ``current``: the highest phase current behind the meter, A. One that is not
        accepted should be read again soon.
        """
        expected = self._expected
        if expected is not None and 0 <= total.energy - expected <= SLACK:
            self.renew(total)
            return True
        if self.last is None or not self.last.can_grow_to(total, current):
            if self._doubtful and not self._doubtful[-1].can_grow_to(total, current):
                self._doubtful.clear()
            self._doubtful.append(total)
            if len(self._doubtful) < CONFIRMATIONS:
                return False
        self.take(total, current)
        return True

    def take(self, total: Total, current: float = HIGHEST_CURRENT) -> None:
        """Accept a total that is confirmed.

        It continues the last one, resumes a former generation or opens a new one.
        """
        if self.last is None or self.last.can_grow_to(total, current):
            self._accept(total)
            return
        for former in reversed(self._former):
            generation, last = former
            if total.at - last.at <= RESUME_WITHIN and last.can_grow_to(total, current):
                self._former.remove(former)
                self._former.append((self._generation, self.last))
                self._generation = generation
                self._accept(total)
                return
        self.renew(total)

    def renew(self, total: Total) -> None:
        """Accept a total as that of a new generation."""
        if self.last is not None:
            self._former.append((self._generation, self.last))
            self._newest += 1
            self._generation = self._newest
        self._accept(total)

    def expect(self, energy: float) -> None:
        """Expect a new generation from here on: the total is being set, Wh."""
        self._expected = energy

    def _accept(self, total: Total) -> None:
        self.last = total
        self._doubtful.clear()
        self._expected = None


# -- The charge under way ------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SessionReading:
    """The accepted reading of a charge under way; ``None``: none accepted yet."""

    energy: float | None = None
    """Wh"""
    time: int | None = None
    """s"""


@dataclass(frozen=True, slots=True)
class _Session:
    energy: Total
    time: int

    def leads_to(self, later: _Session, current: float) -> bool:
        """Return whether a later one may be of this charge, or of one begun since."""
        passed = later.energy.at - self.energy.at + SESSION_SLACK
        begun = Total(0.0, self.energy.at)
        return (
            self.energy.can_grow_to(later.energy, current)
            and 0 <= later.time - self.time <= passed
        ) or (begun.can_grow_to(later.energy, current) and later.time <= passed)


class SessionMeter:
    """Energy and time of the charge under way, which each charge begins at 0.

    They count if the charge before goes on, or another has begun since; any others
    once `CONFIRMATIONS` consistent ones were read.
    """

    def __init__(self) -> None:
        """Start without a charge."""
        self._last: _Session | None = None
        self._doubtful: list[_Session] = []

    @property
    def reading(self) -> SessionReading:
        """Return energy and time that count."""
        if self._last is None:
            return SessionReading()
        return SessionReading(self._last.energy.energy, self._last.time)

    def check(
        self, energy: Total, seconds: int, current: float = HIGHEST_CURRENT
    ) -> bool:
        """Accept what is plausible or confirmed; return whether it is.

        ``current``: the highest phase current behind the meter, A.
        """
        session = _Session(energy, seconds)
        doubtful = self._doubtful
        if self._last is None or not self._last.leads_to(session, current):
            if doubtful and not doubtful[-1].leads_to(session, current):
                doubtful.clear()
            doubtful.append(session)
            if len(doubtful) < CONFIRMATIONS:
                return False
        self._last = session
        doubtful.clear()
        return True
