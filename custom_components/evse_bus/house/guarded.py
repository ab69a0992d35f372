"""One charger behind the fuse: what it draws, what it was granted, when it may start."""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from math import floor, inf, isfinite
from typing import Final

from .fuse import PLAUSIBLE, Guarded, KeptPauses
from .phases import in_house
from .readings import FLOWING, ChargerReport, Phases

SPARE: Final = 1.0
"""A that must be left beside the minimum for a restart."""
RESTARTS: Final[Sequence[float]] = (300.0, 600.0, 1200.0, 2400.0)
"""Pauses at least, s: the first of a visit, the second, ... the last of all further ones."""
NEAR: Final = 2.0
"""So near to a report the lowest current of a car counts, s."""
STALE: Final = 30.0
"""A car whose current was last measured before that is not measured, s."""
IDLE: Final = 90.0
"""A car that has drawn nothing for so long leaves its headroom to others, s."""
TINY: Final = 1e-6
"""A; what binary fractions leave."""


class GuardedCharger:
    """What is known of a charger, and what it was granted."""

    def __init__(
        self, guarded: Guarded, kept: KeptPauses | None, safe: float, now: float
    ) -> None:
        """Begin with the safe current, or paused as before a restart."""
        self.guarded = guarded
        self.report = ChargerReport(at=-inf)
        self.pauses = kept.pauses if kept else 0
        self.paused = kept is not None and kept.paused
        self.grant = 0.0
        self.changed = now
        self.waits_until = now + self._wait if self.paused else -inf
        self.short_since: float | None = None
        self._draws: deque[tuple[float, Phases[float]]] = deque(maxlen=120)
        self._drew = -inf
        self._had: list[tuple[float, float]] = []
        """Until when the box may still offer a greater current of before, A."""
        if not self.paused:
            self.grant = self.whole(min(safe, guarded.settings.maximum))

    @property
    def minimum(self) -> float:
        """Return the least with which its car charges, A."""
        return self.guarded.settings.minimum

    @property
    def wanted(self) -> bool:
        """Return whether all else allows it to charge."""
        return self.guarded.settings.maximum >= self.minimum

    @property
    def least(self) -> float:
        """Return what must be left for a start, A."""
        return self.minimum + (SPARE if self.paused else 0.0)

    @property
    def kept(self) -> KeptPauses:
        """Return what must survive a restart."""
        return KeptPauses(pauses=self.pauses, paused=self.paused)

    @property
    def _wait(self) -> float:
        return RESTARTS[min(max(self.pauses, 1), len(RESTARTS)) - 1]

    def whole(self, current: float) -> float:
        """Return a current on the charger's step, A; 0, if it is below its minimum."""
        if current < self.minimum - TINY:
            return 0.0
        step = self.guarded.settings.step
        return max(self.minimum, round(floor(current / step + TINY) * step, 3))

    def draws(self, report: ChargerReport, now: float) -> None:
        """Take what the charger reports."""
        self.report = report
        currents = tuple(_measured(one) for one in report.currents)
        draws = self._draws
        while draws and draws[-1][0] >= report.at:
            # The same measurement once more, or a clock that went back.
            draws.pop()
        draws.append((report.at, (currents[0], currents[1], currents[2])))
        if max(currents) >= FLOWING:
            self._drew = now

    def lowest(self, at: float) -> Phases[float]:
        """Return the least that it drew near this time, by the house's phases, A."""
        near = [one for when, one in self._draws if abs(when - at) <= NEAR]
        return self._pick(min, near or self._last(at))

    def highest(self, at: float, now: float) -> Phases[float]:
        """Return the most that it may have drawn then, by the house's phases, A.

        A car that rises looks like an excess until the charger has reported it.
        """
        since = [one for when, one in self._draws if when >= at - NEAR]
        if since or all(one is None for one in self.report.currents):
            return self._pick(max, [*since, *self._last(at)])
        most = self.standing(now)
        guarded = self.guarded
        return in_house((most, most, most), guarded.rotation, guarded.settings.wired)

    def _last(self, at: float) -> list[Phases[float]]:
        """Return what was measured last before a time, unless that is too old."""
        for when, currents in reversed(self._draws):
            if when < at - STALE:
                break
            if when < at - NEAR:
                return [currents]
        return []

    def _pick(
        self, pick: Callable[[Iterable[float]], float], found: list[Phases[float]]
    ) -> Phases[float]:
        if not found:
            return (0.0, 0.0, 0.0)
        one, two, three = (pick(phase) for phase in zip(*found, strict=True))
        guarded = self.guarded
        return in_house((one, two, three), guarded.rotation, guarded.settings.wired)

    def idle(self, now: float) -> bool:
        """Return whether its car takes nothing, or there is none."""
        return now - self._drew > IDLE or self._drew > now

    def give(self, current: float, now: float) -> None:
        """Grant a current."""
        if current < self.grant:
            self._had.append((now + self.guarded.reaction, self.grant))
        if current != self.grant:
            self.changed = now
        self.grant = current

    def pause(self, now: float) -> None:
        """Pause for the fuse: the next start waits."""
        self.give(0.0, now)
        self.pauses += 1
        self.paused = True
        self.waits_until = now + self._wait

    def restart_in(self, now: float) -> float:
        """Return the time until it may start again, s."""
        return max(0.0, self.waits_until - now)

    def set_back(self, now: float) -> None:
        """Begin all times anew: the clock went back."""
        self.changed = now
        self.short_since = None
        self._had = [(now + self.guarded.reaction, one) for _, one in self._had]
        if self.paused:
            self.waits_until = now + self._wait

    def standing(self, now: float) -> float:
        """Return the most that the box may offer at this moment, A."""
        reported = self._reported
        if reported is not None and now - self.report.at <= STALE:
            return max(self.grant, reported)
        self._had = [one for one in self._had if now < one[0]]
        had = max((current for _, current in self._had), default=0.0)
        return max(self.grant, had, reported or 0.0)

    def ignored(self, now: float) -> float:
        """Return what it offers although it should offer less by now, A; else 0."""
        reported = self._reported or 0.0
        overdue = now - self.changed > self.guarded.reaction
        return reported if overdue and reported > self.grant + TINY else 0.0

    @property
    def _reported(self) -> float | None:
        offered = self.report.offered
        return offered if offered is not None and isfinite(offered) else None


def _measured(current: float | None) -> float:
    """Return a current that a car certainly draws, A."""
    if current is None or not 0 <= current <= PLAUSIBLE:
        return 0.0
    return current
