"""The sun of the house among several chargers, by rank.

The first charger has all the sun; the next has what the first cannot take, and starts
on that. The last one pauses first. No surplus is given twice: what follows the sun is
taken from one pool.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite
from typing import Final

from .account import PRESETS, Decision, Need, SunAccount, Waiting
from .meter import Silence
from .readings import ChargerReport, ChargerSettings, plausible
from .visits import Kept, Visit

IDLE: Final = 90.0
"""A car that takes nothing for so long keeps its minimum, and its sun goes on, s."""
NOTHING: Final = 100.0
"""W; less is nothing."""
SHY: Final = 60.0
"""A car that takes less than it is offered for so long cannot take more, s."""
_TAKES: Final = 0.85
"""It takes what is offered, if it takes this share of it."""
SOON: Final = 60.0
"""The sun waits so long for a charger of a higher rank that may start then, s."""


class Contender:
    """One charger that charges from the sun: its account, its visit, its car."""

    def __init__(
        self, settings: ChargerSettings, kept: Kept | None, now: float
    ) -> None:
        """Begin with what survived a restart; ``None``: a charger that is new."""
        self.settings = settings
        self.visit = Visit(settings)
        self.account = SunAccount(PRESETS[settings.mode])
        self.decision = Decision(current=0.0, waiting=Waiting.METER)
        self.cap = inf
        """W that the car can take, as it seems."""
        self.permitted = inf
        """W that the main fuse leaves."""
        self.refused = False
        """The main fuse left less than the minimum when it last wanted to charge."""
        self._report = ChargerReport(at=-inf)
        self._idle_since: float | None = None
        self._shy_since: float | None = None
        if kept is not None:
            self.account.charging = kept.charging
            self.account.hold_back(now)
            self.visit.starts = kept.starts
            self.visit.session = kept.session

    @property
    def kept(self) -> Kept:
        """Return what must survive a restart."""
        return Kept(
            mode=self.settings.mode,
            serial=self.settings.serial,
            session=self.visit.session,
            starts=self.visit.starts,
            charging=self.account.charging,
        )

    def configure(self, settings: ChargerSettings) -> None:
        """Apply changed settings; the account goes on."""
        self.settings = settings
        self.visit.configure(settings)
        self.account.preset = PRESETS[settings.mode]

    @property
    def need(self) -> Need:
        """Return what car and charger can take."""
        settings = self.settings
        volts = self._report.volts
        if volts is None or not 0.7 * settings.volts < volts < 1.3 * settings.volts:
            volts = settings.volts
        return Need(
            minimum=settings.minimum,
            maximum=settings.maximum,
            step=settings.step,
            volts=volts,
            phases=self.visit.phases,
        )

    @property
    def most(self) -> float:
        """Return the most that the car can take, as far as that is known, W."""
        return min(self.need.most, self.cap, self.permitted)

    @property
    def power(self) -> float | None:
        """Return what the car takes, W; ``None``: not known."""
        report = self._report
        if report.power is not None:
            return report.power if plausible(report.power) else None
        known = [one for one in report.currents if one is not None and isfinite(one)]
        return sum(known) * self.need.volts if known else None

    def idle(self, now: float) -> bool:
        """Return whether the car takes nothing of what it is offered."""
        since = self._idle_since
        return since is not None and now - since >= IDLE

    def permit(self, current: float, now: float, *, began: bool) -> Decision:
        """Apply what the main fuse leaves, A; ``began``: it was charging before."""
        self.refused = current < self.need.minimum
        self.permitted = inf
        if not self.refused:
            if current < self.need.maximum:
                self.permitted = current * self.need.per_ampere
        elif began:
            self.decision = self.account.park(now, Waiting.FUSE)
        else:
            self.visit.starts -= 1
            self.decision = self.account.refuse()
        return self.decision

    def take(self, report: ChargerReport, now: float) -> bool:
        """Take what is known of the charger now; return whether a visit has begun."""
        self._report = report
        begun = self.visit.look(report, now, paused=not self.account.charging)
        power = self.power
        charging = self.account.charging
        if power is None or not charging or power >= NOTHING:
            self._idle_since = None
        elif self._idle_since is None:
            self._idle_since = now
        self._look_at_cap(power if charging else None, now)
        return begun

    def _look_at_cap(self, power: float | None, now: float) -> None:
        ampere = self.need.per_ampere
        if power is None:
            self.cap = inf
            self._shy_since = None
        elif power > self.cap - 0.5 * ampere:
            # It takes the ampere more that it was left: it may want all.
            self.cap = inf
            self._shy_since = None
        elif power >= _TAKES * self.account.current * ampere or power < NOTHING:
            self._shy_since = None
        elif self._shy_since is None:
            self._shy_since = now
        elif now - self._shy_since >= SHY:
            self.cap = max(power + ampere, self.need.least)


@dataclass(frozen=True, slots=True, kw_only=True)
class Take:
    """What one charger that charges takes of the sun, W."""

    least: float
    most: float
    held: float = 0.0
    """What it goes on taking for a moment, since its current was changed just now."""


def share(power: float, takes: Sequence[Take]) -> Sequence[float]:
    """Return the sun of each by rank, W; together never more than there is.

    Each leaves to those behind it the least that they take until they pause. What one
    still holds beyond its part is missing for the others, the last one first.
    """
    pool = max(power, 0.0)
    behind = sum(one.least for one in takes)
    parts = []
    for one in takes:
        behind -= one.least
        part = min(one.most, max(pool - behind, min(one.least, pool)))
        parts.append(part)
        pool -= part
    excess = sum(
        max(0.0, one.held - part) for one, part in zip(takes, parts, strict=True)
    )
    excess = max(0.0, excess - pool)
    for at in reversed(range(len(takes))):
        if not takes[at].held:
            less = min(parts[at], excess)
            parts[at] -= less
            excess -= less
    return parts


class Allotment:
    """All chargers that charge from the sun, in the order of their rank."""

    def __init__(self) -> None:
        """Begin with none."""
        self.contenders: dict[str, Contender] = {}

    def configure(
        self,
        settings: Iterable[ChargerSettings],
        kept: Mapping[str, Kept],
        now: float,
    ) -> None:
        """Apply settings, the first charger first; those that left are forgotten.

        Raises ValueError if two have one name.
        """
        found: dict[str, Contender] = {}
        for one in settings:
            if one.charger in found:
                raise ValueError(f"two chargers are called {one.charger}")
            before = self.contenders.get(one.charger)
            if before is None:
                before = Contender(one, kept.get(one.charger), now)
            else:
                before.configure(one)
            found[one.charger] = before
        self.contenders = found

    @property
    def power(self) -> float:
        """Return what all of them take, W; one that is not known counts as nothing."""
        return sum(one.power or 0.0 for one in self.contenders.values())

    def look(
        self, now: float, power: float | None, elapsed: float, silence: Silence
    ) -> Mapping[str, Decision]:
        """Decide for each; ``power`` is the sun, W, for the time ``elapsed``, s."""
        if power is None or silence is not Silence.NONE:
            severity = Silence.NEW if silence is Silence.NONE else silence
            for one in self.contenders.values():
                one.decision = self._without(one, now) or one.account.blind(
                    now, one.need, severity
                )
        else:
            self._share(now, power, elapsed)
        return {name: one.decision for name, one in self.contenders.items()}

    def _share(self, now: float, power: float, elapsed: float) -> None:
        ready = []
        for one in self.contenders.values():
            without = self._without(one, now)
            if without is not None:
                one.decision = without
            elif one.account.charging and one.idle(now):
                one.decision = one.account.rest(one.need)
            else:
                ready.append(one)
        self._decide(ready, now, power, elapsed)
        charging = [one for one in ready if one.account.charging]
        takes = [
            Take(
                least=one.need.least,
                most=one.most,
                held=one.account.current * one.need.per_ampere
                if one.account.held(now)
                else 0.0,
            )
            for one in charging
        ]
        for one, part in zip(charging, share(power, takes), strict=True):
            current = one.account.follow(now, part, one.need, fresh=elapsed > 0)
            one.decision = replace(one.decision, current=current)

    def _decide(
        self, ready: Iterable[Contender], now: float, power: float, elapsed: float
    ) -> None:
        """Let each start, go on or pause on what those before it cannot take."""
        left = power
        awaited = 0.0
        for one in ready:
            account, need = one.account, one.need
            began = account.charging
            sun = left if began else left - awaited
            one.decision = account.decide(now, sun, elapsed, need, one.visit.starts)
            if account.charging:
                one.visit.starts += not began
                left -= min(max(left, 0.0), one.most)
            elif account.enough(sun, need) and account.wait_left(now) <= SOON:
                awaited += need.least

    @staticmethod
    def _without(one: Contender, now: float) -> Decision | None:
        """Return the decision for a charger with which nothing can be charged now."""
        if not one.need.possible:
            return one.account.park(now, Waiting.CHARGER)
        if one.visit.absent:
            return one.account.park(now, Waiting.CAR)
        return None
