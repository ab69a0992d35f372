"""Whether the grid meter reports, how often, and how old its values are.

A meter that is silent is never taken for one whose value stays: after `SILENCE`, or
two and a half of its own periods, nothing new is known.
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Sequence
from enum import StrEnum
from math import exp, inf
from statistics import median
from typing import Final

SILENCE: Final = 90.0
"""A sensor that has reported nothing for so long is silent, s."""
PERIODS: Final = 2.5
"""A slower sensor is silent after so many of its periods."""
LONGEST_PERIOD: Final = 120.0
"""A sensor is never taken to be slower, s: silence must be noticed."""
DEAD: Final = 600.0
"""After so much silence no mode charges, s."""
SETTLE: Final = 1.0
"""Reports that are closer together count as one, s."""
AHEAD: Final = 2.0
"""A report of so long after now is of a wrong clock, s."""
_GAPS: Final = 9
"""So many gaps between reports tell the period (their median)."""


class Silence(StrEnum):
    """Whether a sensor reports."""

    NEW = "new"
    """No report, or a single one: it may be the last."""
    NONE = "none"
    SILENT = "silent"
    """What charges goes down to the minimum; what is paused stays paused."""
    DEAD = "dead"
    """Nothing charges."""


class Rhythm:
    """The reports of one sensor in time."""

    def __init__(self, silence: float = SILENCE) -> None:
        """Know nothing; after ``silence``, s, without a report it is silent."""
        self._silence = silence
        self.last: float | None = None
        """Time of the last report."""
        self._gaps: deque[float] = deque(maxlen=_GAPS)
        self._in_a_row = 0
        self._since: float | None = None
        """Time since when it is silent, while it never reported."""
        self._now = -inf

    @property
    def period(self) -> float | None:
        """Return its usual time between two reports, s; ``None``: not known yet."""
        return min(median(self._gaps), LONGEST_PERIOD) if self._gaps else None

    @property
    def patience(self) -> float:
        """Return the time after which it counts as silent, s."""
        return max(self._silence, PERIODS * (self.period or 0.0))

    def take(self, at: float, now: float) -> float | None:
        """Return the time that this report stands for, s; ``None``: it is none.

        0 after a gap, in which nothing was known.
        """
        self._look(now)
        if at > now + AHEAD or (self.last is not None and at < self.last + SETTLE):
            return None
        gap = inf if self.last is None else at - self.last
        broken = gap > self.patience
        self._in_a_row = 1 if broken else self._in_a_row + 1
        self.last = at
        if gap < inf:
            self._gaps.append(gap)
        if broken:
            return 0.0
        return min(gap, PERIODS * (self.period or 0.0))

    def age(self, now: float) -> float:
        """Return the time since the last report, or since the first question, s."""
        self._look(now)
        since = self._since if self.last is None else self.last
        return max(0.0, now - (now if since is None else since))

    def silence(self, now: float) -> Silence:
        """Return whether it reports."""
        age = self.age(now)
        if age > DEAD:
            return Silence.DEAD
        if age > self.patience:
            return Silence.SILENT
        return Silence.NONE if self._in_a_row > 1 else Silence.NEW

    def _look(self, now: float) -> None:
        """Forget the reports if the clock went back: their ages are not known."""
        if now < self._now - AHEAD:
            self.last = None
            self._in_a_row = 0
            self._since = None
        self._now = now
        if self._since is None:
            self._since = now


class History:
    """The power of the cars over the last minutes, as it was measured."""

    def __init__(self, length: float) -> None:
        """Keep this much, s."""
        self._length = length
        self._times: list[float] = []
        self._values: list[float] = []

    def note(self, at: float, power: float) -> None:
        """Note a measurement; one from before the last is not for keeping."""
        times, values = self._times, self._values
        if times and at <= times[-1]:
            if at < times[-1] - self._length:
                # The clock went back.
                times.clear()
                values.clear()
            elif at == times[-1]:
                values[-1] = power
                return
            else:
                return
        if len(values) > 1 and values[-1] == power == values[-2]:
            times[-1] = at
            return
        times.append(at)
        values.append(power)
        old = bisect_right(times, at - self._length) - 1
        if old > _OLD:
            del times[:old], values[:old]

    @property
    def last(self) -> float:
        """Return the time of the last measurement; -inf: there was none."""
        return self._times[-1] if self._times else -inf

    def at(self, when: float) -> float:
        """Return the power at this time, W, between two measurements in proportion."""
        times, values = self._times, self._values
        index = bisect_right(times, when) - 1
        if index < 0:
            return values[0] if values else 0.0
        if index + 1 == len(times):
            return values[index]
        part = (when - times[index]) / (times[index + 1] - times[index])
        return values[index] + (values[index + 1] - values[index]) * part

    def spread(self, start: float, end: float) -> float:
        """Return the difference between the greatest and the least in a time, W."""
        low = max(bisect_right(self._times, start) - 1, 0)
        found = self._values[low : bisect_right(self._times, end)]
        return max(found) - min(found) if found else 0.0


_OLD: Final = 60
"""Old entries of the history are removed together."""

LAGS: Final[Sequence[float]] = (0, 3, 6, 9, 12, 15, 18, 21, 25, 30, 35, 40, 50, 60)
"""Ages of a meter's values that are compared, s."""
CHANGE: Final = 800.0
"""W; a smaller change of the car cannot be told from the rest of the house."""
_MEMORY: Final = 3600.0
"""Time over which a judgement fades, s; only times after a change are judged."""
_SMOOTH: Final = 40.0
"""Time over which the rest of the house is expected to stay what it is, s."""
_NEAR: Final = 1.15
"""An age that leaves at most so many times the least unexplained may be the right one."""
_ENOUGH: Final = 60 * CHANGE
"""Ws; differences below it show nothing."""
_APART: Final = 2.5
"""Reports that are closer together are not all looked at, s."""


class Lag:
    """The age of a meter's values when it reports them, learnt.

    The right one leaves the rest of the house alone: with a wrong age the car's own
    change is seen twice, once in the car and once in the grid.
    """

    def __init__(self) -> None:
        """Take it for a meter without delay."""
        self.seconds: float = LAGS[0]
        self._unexplained = [0.0] * len(LAGS)
        self._usual: list[float] = []
        """For each age: the power of the rest of the house of late, W."""
        self._last = -inf

    def learn(
        self, at: float, rest: Callable[[float], float], spread: float, *, gap: bool
    ) -> None:
        """Learn from a report.

        ``rest`` returns the power of the house without the car, W, if the report were
        of that age; ``spread`` is how much the car has changed in the last time, W.
        """
        if gap or spread <= CHANGE:
            self._usual = []
            self._last = at
        elapsed = at - self._last
        if spread <= CHANGE or 0 < elapsed < _APART:
            return
        now = [rest(age) for age in LAGS]
        if self._usual:
            fading = exp(-elapsed / _MEMORY)
            self._unexplained = [
                fading * left + abs(new - old) * elapsed
                for left, new, old in zip(
                    self._unexplained, now, self._usual, strict=True
                )
            ]
            self._choose()
            following = 1 - exp(-elapsed / _SMOOTH)
            self._usual = [
                old + (new - old) * following
                for new, old in zip(now, self._usual, strict=True)
            ]
        else:
            self._usual = now
        self._last = at

    def _choose(self) -> None:
        """Take the youngest of those that leave little more than the best does.

        A slow meter cannot tell them apart, and in a regular swing of the car one age
        explains as much as the next that is a whole swing older.
        """
        near = _NEAR * min(self._unexplained) + _ENOUGH
        self.seconds = next(
            age
            for age, left in zip(LAGS, self._unexplained, strict=True)
            if left <= near
        )
