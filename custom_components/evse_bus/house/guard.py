"""The guard of the main fuse: how much the chargers may offer together, per phase.

It lowers at once by all of the excess, and raises only to what every reading of the
last minute left. It beats every mode. It does not survive a dead Home Assistant: what
a box does then is its own fail-safe's part.
"""

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from math import inf
from typing import Final

from .fuse import PLAUSIBLE, Fuse, Grant, Guarded, KeptPauses, PhaseReport, Reason
from .guarded import TINY, GuardedCharger
from .meter import AHEAD, Rhythm, Silence
from .phases import Order
from .readings import ChargerReport, Phases

MARGIN: Final = 1.0
"""A of the fuse that are never used."""
SILENCE: Final = 30.0
"""A meter of phase currents that has reported nothing for so long is silent, s."""
SLOWEST: Final = 60.0
"""A meter with a longer period is refused, s."""
SLOW: Final = 15.0
"""A meter with a longer period is warned about, s."""
LONGEST_REACTION: Final = 30.0
"""If meter, box and car take longer together, nothing above the minimum is granted, s."""
CONFIRM: Final = 60.0
"""Up only to what all readings of so long left, s."""
SHORT: Final = 15.0
"""So long a charger goes on with its minimum although it does not fit, s."""
TOLERATED: Final = 6.0
"""A; if more is missing it pauses at once."""
JITTER: Final = 1.05
"""A period may be so many times what it should be."""


class Guard:
    """Grants of all chargers behind one fuse."""

    def __init__(self, fuse: Fuse) -> None:
        """Begin without a report of the meter."""
        self.fuse = fuse
        self._chargers: dict[str, GuardedCharger] = {}
        """In the order of their rank."""
        self._rhythm = Rhythm(SILENCE)
        self._report: PhaseReport | None = None
        self._others: list[Phases[float]] = []
        """Headroom of reports that can only lower."""
        self._readings: deque[tuple[float, Phases[float]]] = deque()
        """Headroom by the readings of the last time."""
        self._since: float | None = None
        """Time since when the meter reports without a break."""
        self._now = -inf

    @property
    def period(self) -> float | None:
        """Return the usual time between two reports of the meter, s."""
        return self._rhythm.period

    @property
    def refused(self) -> bool:
        """Return whether the meter is too slow to guard a fuse with it."""
        return (self.period or 0.0) > SLOWEST * JITTER

    @property
    def slow(self) -> bool:
        """Return whether the meter is slow enough for a warning."""
        return (self.period or 0.0) > SLOW * JITTER

    @property
    def headroom(self) -> Phases[float] | None:
        """Return what the last report leaves for all chargers, A; ``None``: no report."""
        return None if self._report is None else self._headroom(self._report)

    @property
    def kept(self) -> dict[str, KeptPauses]:
        """Return what must survive a restart, by charger."""
        return {name: one.kept for name, one in self._chargers.items()}

    def reaction(self, charger: str) -> float:
        """Return the worst time from an excess until the car draws less, s."""
        return (self.period or 0.0) + self._chargers[charger].guarded.reaction

    def silence(self, now: float) -> Silence:
        """Return whether the meter reports."""
        return self._rhythm.silence(now)

    def configure(
        self, chargers: Iterable[Guarded], kept: Mapping[str, KeptPauses], now: float
    ) -> None:
        """Apply chargers in the order of their rank; new ones begin with what was kept."""
        before = self._chargers
        self._chargers = {}
        for guarded in chargers:
            name = guarded.settings.charger
            one = before.get(name)
            if one is None:
                one = GuardedCharger(guarded, kept.get(name), self.fuse.safe, now)
            one.guarded = guarded
            self._chargers[name] = one

    def begin_visit(self, charger: str) -> None:
        """Count pauses anew for another car; a pause that lasts is not shortened."""
        self._chargers[charger].pauses = 0

    def charger(self, charger: str, report: ChargerReport, now: float) -> None:
        """Take what is known of a charger; one that is not measured counts as 0 A."""
        self._chargers[charger].draws(report, now)

    def meter(self, report: PhaseReport, now: float) -> None:
        """Take a report; one that is incomplete, late or of a wrong clock only lowers."""
        if report.restored:
            return
        headroom = self._headroom(report)
        if min(headroom) == inf:
            return
        whole = inf not in headroom
        elapsed = self._rhythm.take(report.at, now) if whole else None
        if elapsed == 0.0:
            self._since = None
        self._readings.append((now, headroom))
        last = self._report
        if elapsed is not None or (
            whole and last is not None and last.at <= report.at <= now + AHEAD
        ):
            self._report = report
        else:
            self._others.append(headroom)

    def look(self, now: float) -> dict[str, Grant]:
        """Decide, after each report and at least every 10 s."""
        if now < self._now:
            self._since = None
            self._readings.clear()
            for one in self._chargers.values():
                one.set_back(now)
        self._now = now
        silence = self._rhythm.silence(now)
        if silence is not Silence.NONE or self.refused or self._report is None:
            return self._blind(now)
        if self._since is None:
            self._since = now
        headroom, best = self._present(self._report, now)
        self._lower(headroom, best, now)
        if now - self._since >= CONFIRM and not self._overdue(now):
            self._share(self._confirmed(now, headroom), now)
        return {
            name: self._grant(one, headroom, now)
            for name, one in self._chargers.items()
        }

    def _overdue(self, now: float) -> bool:
        """Return whether a report should have come: nothing is raised without it."""
        return self._rhythm.age(now) > (self.period or 0.0) * JITTER + AHEAD

    def _blind(self, now: float) -> dict[str, Grant]:
        """Go down to the safe current; what is paused stays paused."""
        self._since = None
        self._readings.clear()
        self._others.clear()
        reason = Reason.METER_SLOW if self.refused else Reason.METER
        for one in self._chargers.values():
            most = min(one.grant, self.fuse.safe, one.guarded.settings.maximum)
            one.short_since = None
            current = one.whole(most)
            if one.grant and one.wanted and not current:
                one.pause(now)
            one.give(current, now)
        return {
            name: Grant(current=one.grant, reason=reason, seconds=one.restart_in(now))
            for name, one in self._chargers.items()
        }

    def _headroom(self, report: PhaseReport) -> Phases[float]:
        """Return what a report leaves for all chargers, A; inf: nothing is known."""
        own = [one.lowest(report.at) for one in self._chargers.values()]
        return self._left_by(report, own)

    def _left_by(
        self, report: PhaseReport, own: Sequence[Phases[float]]
    ) -> Phases[float]:
        """Return what is left where the cars draw this.

        What feeds in is not granted to cars beyond the rating: it can vanish faster
        than they follow.
        """
        most = self.fuse.rating - MARGIN

        def left(phase: int) -> float:
            current = report.currents[phase]
            if current is None or not abs(current) <= PLAUSIBLE:
                return inf
            return min(most, most - current + sum(one[phase] for one in own))

        return (left(0), left(1), left(2))

    def _present(
        self, report: PhaseReport, now: float
    ) -> tuple[Phases[float], Phases[float]]:
        """Return the headroom now, and what it is at best: cars may have risen."""
        headroom = self._headroom(report)
        if self._readings:
            # Cars measured since then may show that it left less.
            at, noted = self._readings[-1]
            self._readings[-1] = (at, _least((noted, headroom)))
        highest = [one.highest(report.at, now) for one in self._chargers.values()]
        best = self._left_by(report, highest)
        found = (_least((headroom, *self._others)), _least((best, *self._others)))
        self._others.clear()
        return found

    def _confirmed(self, now: float, headroom: Phases[float]) -> Phases[float]:
        """Return the least headroom of the time to confirm."""
        readings = self._readings
        while readings and readings[0][0] < now - CONFIRM:
            readings.popleft()
        return _least((headroom, *(one for _, one in readings)))

    def _lower(self, headroom: Phases[float], best: Phases[float], now: float) -> None:
        """Lower at once by all of the excess, the last in rank first."""
        used = [0.0, 0.0, 0.0]
        rest: list[GuardedCharger] = []
        for one in self._chargers.values():
            if not one.grant or not one.wanted:
                one.short_since = None
                one.give(0.0, now)
                _add(used, one, one.ignored(now))
                continue
            missing = one.minimum - _left(headroom, used, one.guarded.phases)
            if missing <= TINY:
                one.short_since = None
            elif one.short_since is None:
                one.short_since = now
            surely = one.minimum - _left(best, used, one.guarded.phases)
            if surely > TOLERATED or (
                one.short_since is not None and now - one.short_since >= SHORT
            ):
                one.short_since = None
                one.pause(now)
                continue
            _add(used, one, one.minimum)
            rest.append(one)
        for one in rest:
            left = max(0.0, _left(headroom, used, one.guarded.phases))
            most = min(one.grant, self._most(one), one.minimum + left)
            one.give(one.whole(most), now)
            _add(used, one, max(one.grant, one.ignored(now)) - one.minimum)

    def _share(self, least: Phases[float], now: float) -> None:
        """Share by rank what all readings of the time to confirm left.

        Each gets its minimum, then those that draw get more, then the others: they may
        draw at any time. What one loses the other gets when the first box has followed.
        """
        shares = self._shares(least, now)
        for name, one in self._chargers.items():
            if 0 < shares[name] < one.grant:
                one.give(shares[name], now)
        for name, one in self._chargers.items():
            if shares[name] <= one.grant:
                continue
            standing = [0.0, 0.0, 0.0]
            for other in self._chargers.values():
                if other is not one:
                    _add(standing, other, other.standing(now))
            left = _left(least, standing, one.guarded.phases)
            if left >= one.least:
                one.paused = False
                current = one.whole(min(shares[name], left))
                one.give(max(one.grant, current), now)

    def _shares(self, least: Phases[float], now: float) -> dict[str, float]:
        """Return what each should have, A, once all boxes have followed."""
        shares = dict.fromkeys(self._chargers, 0.0)
        used = [0.0, 0.0, 0.0]
        for name, one in self._chargers.items():
            if one.grant:
                shares[name] = one.minimum
            _add(used, one, max(shares[name], one.ignored(now)))
        for name, one in self._chargers.items():
            if (
                not one.grant
                and one.wanted
                and not (one.paused and one.restart_in(now))
                and _left(least, used, one.guarded.phases) >= one.least
            ):
                shares[name] = one.minimum
                _add(used, one, max(0.0, one.minimum - one.ignored(now)))
        for name in sorted(shares, key=lambda name: self._chargers[name].idle(now)):
            one = self._chargers[name]
            if shares[name]:
                ignored = one.ignored(now)
                _add(used, one, -max(one.minimum, ignored))
                left = max(one.minimum, _left(least, used, one.guarded.phases))
                shares[name] = one.whole(min(self._most(one), left))
                _add(used, one, max(shares[name], ignored))
        return shares

    def _most(self, one: GuardedCharger) -> float:
        """Return the most that it may be granted at all, A."""
        if self._too_slow(one):
            return one.minimum
        return one.guarded.settings.maximum

    def _too_slow(self, one: GuardedCharger) -> bool:
        period = (self.period or 0.0) / JITTER
        return period + one.guarded.reaction > LONGEST_REACTION

    def _grant(self, one: GuardedCharger, headroom: Phases[float], now: float) -> Grant:
        """Return the grant of a charger with its reason."""
        used = [0.0, 0.0, 0.0]
        for other in self._chargers.values():
            if other is not one:
                _add(used, other, other.grant)
        phases = one.guarded.phases
        worst = min(phases, key=lambda phase: headroom[phase] - used[phase])
        left = headroom[worst] - used[worst]
        seconds = one.restart_in(now) if one.paused else 0.0
        if not one.wanted:
            return Grant(current=0.0, reason=Reason.NOT_WANTED)
        if one.grant >= one.whole(one.guarded.settings.maximum):
            return Grant(current=one.grant, reason=Reason.NOTHING)
        if seconds:
            reason = Reason.RESTART
        elif one.grant and self._too_slow(one):
            reason = Reason.REACTION
        else:
            reason = Reason.MAIN_FUSE
        return Grant(
            current=one.grant,
            reason=reason,
            phase=worst,
            short=max(0.0, one.minimum - left),
            seconds=seconds,
        )


def _least(found: Iterable[Phases[float]]) -> Phases[float]:
    one, two, three = (min(phase) for phase in zip(*found, strict=True))
    return (one, two, three)


def _left(headroom: Phases[float], used: Sequence[float], phases: Order) -> float:
    return min(headroom[phase] - used[phase] for phase in phases)


def _add(used: list[float], one: GuardedCharger, current: float) -> None:
    for phase in one.guarded.phases:
        used[phase] += current
