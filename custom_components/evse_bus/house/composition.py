"""The ceilings of all chargers of a house: the least of sun and main fuse, and why.

    ceiling = min(sun account, grant of the guard)

In mode *fast* the sun does not count, and without a fuse its guard does not. What a
charger's order, cable or bus allow is not composed here: it comes in as the maximum of
its settings, and applies to the ceiling at the charger.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from math import inf
from typing import Any, Final

from .account import Decision, Waiting
from .allotment import Allotment
from .fuse import Fuse, Grant, Guarded, KeptPauses, PhaseReport, Reason
from .guard import Guard
from .meter import Silence
from .readings import BatteryReport, ChargerReport, GridReport, Mode
from .surplus import Surplus
from .visits import Kept, Visit


class Limit(StrEnum):
    """What determines a ceiling."""

    NOTHING = "nothing"
    """It is what the charger can take."""
    SUN = "sun"
    METER_SILENT = "meter_silent"
    """A meter is silent, or has not reported twice yet; it is the safe value."""
    MAIN_FUSE = "main_fuse"
    CHARGER = "charger"
    """Order, charger or cable allow less than the minimum."""
    CAR = "car"
    """There is no car, or it takes nothing."""


_BY_WAITING: Final[Mapping[Waiting, Limit]] = {
    Waiting.METER: Limit.METER_SILENT,
    Waiting.METER_DEAD: Limit.METER_SILENT,
    Waiting.CHARGER: Limit.CHARGER,
    Waiting.CAR: Limit.CAR,
    Waiting.FUSE: Limit.MAIN_FUSE,
}
"""All else is the sun."""

_BY_REASON: Final[Mapping[Reason, Limit]] = {
    Reason.NOTHING: Limit.NOTHING,
    Reason.METER: Limit.METER_SILENT,
    Reason.NOT_WANTED: Limit.CHARGER,
}
"""All else is the main fuse."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ceiling:
    """What a charger may offer now, and why."""

    current: float
    """A; 0: pause."""
    guard: float
    """A that the main fuse leaves, whatever the mode; inf: there is no guard."""
    limit: Limit
    sun: Decision | None = None
    """What the sun account waits for, with its numbers; ``None``: mode *fast*."""
    fuse: Grant | None = None
    """What the guard grants, with its numbers; ``None``: there is no guard."""


class House:
    """All chargers of a house, in the order of their rank."""

    def __init__(self, priority: float | None = None, fuse: Fuse | None = None) -> None:
        """Begin without reports.

        ``priority`` is that of a home battery, %, ``None``: there is none.
        """
        self.surplus = Surplus(priority)
        self.guard = None if fuse is None else Guard(fuse)
        self._allotment = Allotment()
        self._chargers: dict[str, Guarded] = {}
        self._visits: dict[str, Visit] = {}
        """Of chargers in mode *fast*; the others have theirs with their account."""
        self._ceilings: dict[str, Ceiling] = {}
        self._pauses: dict[str, KeptPauses] = {}

    @property
    def kept(self) -> dict[str, dict[str, Any]]:
        """Return what must survive a restart, by charger: plain values for a file."""
        pauses = self.guard.kept if self.guard is not None else {}
        found: dict[str, dict[str, Any]] = {}
        for name, one in self._chargers.items():
            contender = self._allotment.contenders.get(name)
            settings = one.settings
            kept = (
                Kept(mode=settings.mode, serial=settings.serial, charging=True)
                if contender is None
                else contender.kept
            )
            found[name] = {"sun": kept.as_dict()}
            if name in pauses:
                found[name]["fuse"] = pauses[name].as_dict()
        return found

    def configure(
        self,
        chargers: Iterable[Guarded],
        kept: Mapping[str, Mapping[str, Any]],
        now: float,
    ) -> None:
        """Apply chargers, modes and limits; new chargers begin with what was kept.

        A charger of which nothing was kept begins paused, unless it was charging in
        mode *fast* until now: then its account decides. Raises ValueError for two of
        one name.
        """
        before = self._chargers
        found: dict[str, Guarded] = {}
        for one in chargers:
            if one.settings.charger in found:
                raise ValueError(f"two chargers are called {one.settings.charger}")
            found[one.settings.charger] = one
        self._chargers = found
        suns: dict[str, Kept] = {}
        for name, one in found.items():
            sun = Kept.from_dict(kept.get(name, {}).get("sun"))
            if name in before:
                ceiling = self._ceilings.get(name)
                charging = ceiling is not None and ceiling.current > 0
                sun = Kept(mode=one.settings.mode, charging=charging)
            if sun is not None:
                suns[name] = sun
            pauses = KeptPauses.from_dict(kept.get(name, {}).get("fuse"))
            if pauses is not None:
                self._pauses[name] = pauses
        self._allotment.configure(
            (one.settings for one in found.values() if one.settings.mode != Mode.FAST),
            suns,
            now,
        )
        self._visits = {
            name: self._visits.get(name, Visit(one.settings))
            for name, one in found.items()
            if one.settings.mode == Mode.FAST
        }

    def grid(self, report: GridReport, now: float) -> None:
        """Take a report of the grid meter."""
        self.surplus.grid(report, now)

    def battery(self, report: BatteryReport, now: float) -> None:
        """Take a report of the home battery."""
        self.surplus.battery(report, now)

    def phases(self, report: PhaseReport, now: float) -> None:
        """Take a report of the currents at the main fuse."""
        if self.guard is not None:
            self.guard.meter(report, now)

    def charger(self, name: str, report: ChargerReport, now: float) -> None:
        """Take what is known of a charger now; an unknown name is none of ours."""
        if name not in self._chargers:
            return
        contender = self._allotment.contenders.get(name)
        if contender is not None:
            begun = contender.take(report, now)
            self.surplus.cars(report.at, self._allotment.power)
        else:
            ceiling = self._ceilings.get(name)
            paused = ceiling is not None and not ceiling.current
            begun = self._visits[name].look(report, now, paused=paused)
        if self.guard is not None:
            self._configure_guard({}, now)
            self.guard.charger(name, report, now)
            if begun:
                self.guard.begin_visit(name)

    def look(self, now: float) -> Mapping[str, Ceiling]:
        """Return all ceilings; after each report, and at least every 10 s."""
        contenders = self._allotment.contenders
        charged = {name: one.account.charging for name, one in contenders.items()}
        offered = {name: one.account.current for name, one in contenders.items()}
        surplus = self.surplus
        decisions = dict(
            self._allotment.look(
                now, surplus.power, surplus.take_elapsed(now), surplus.silence(now)
            )
        )
        grants: Mapping[str, Grant] = {}
        if self.guard is not None:
            self._configure_guard(decisions, now)
            grants = self.guard.look(now)
            for name, one in contenders.items():
                if decisions[name].current:
                    current = grants[name].current
                    decisions[name] = one.permit(current, now, began=charged[name])
        self._ceilings = {
            name: _ceiling(one, decisions.get(name), grants.get(name))
            for name, one in self._chargers.items()
        }
        for name, one in contenders.items():
            if one.refused and not one.decision.short:
                found = self._ceilings[name]
                self._ceilings[name] = replace(found, limit=Limit.MAIN_FUSE)
        if any(offered[name] != self._ceilings[name].current for name in contenders):
            surplus.moved(now)
        return self._ceilings

    def silence(self, now: float) -> Silence:
        """Return whether grid meter and battery report."""
        return self.surplus.silence(now)

    def _configure_guard(self, decisions: Mapping[str, Decision], now: float) -> None:
        """Show the guard who wants to charge: one that the sun pauses does not."""
        if self.guard is None:
            return
        guarded = []
        for name, one in self._chargers.items():
            contender = self._allotment.contenders.get(name)
            decision = decisions.get(name)
            if decision is None and contender is not None:
                decision = contender.decision
            wants = decision is None or decision.current > 0
            maximum = one.settings.maximum if wants else 0.0
            settings = replace(one.settings, maximum=maximum)
            guarded.append(replace(one, settings=settings))
        self.guard.configure(guarded, self._pauses, now)


def _ceiling(one: Guarded, sun: Decision | None, fuse: Grant | None) -> Ceiling:
    """Return the least of all, and what it was."""
    settings = one.settings
    possible = settings.maximum >= settings.minimum
    wanted = sun.current if sun is not None else settings.maximum if possible else 0.0
    guard = inf if fuse is None else fuse.current
    if sun is not None and not sun.current:
        limit = _of_sun(sun)
    elif fuse is not None and guard <= wanted and guard < settings.maximum:
        limit = _BY_REASON.get(fuse.reason, Limit.MAIN_FUSE)
    elif sun is not None and sun.current < settings.maximum:
        limit = _of_sun(sun)
    else:
        limit = Limit.NOTHING if possible else Limit.CHARGER
    return Ceiling(
        current=min(wanted, guard), guard=guard, limit=limit, sun=sun, fuse=fuse
    )


def _of_sun(sun: Decision) -> Limit:
    return _BY_WAITING.get(sun.waiting, Limit.SUN)
