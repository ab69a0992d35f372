"""Visits of cars: from plug to unplug, as far as a box reports that.

A start counts for its visit: each further one needs more sun. The phases of a car are
those on which it has taken current in this visit.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any, Final, Self

from .readings import ChargerReport, ChargerSettings, Mode

WITHOUT_CURRENT: Final = 12 * 3600.0
"""A visit of which no end is reported ends after so long without current, s."""
SEEN: Final = 30.0
"""So long a number of phases must be seen, s."""


class Visit:
    """The present visit at a charger."""

    def __init__(self, settings: ChargerSettings) -> None:
        """Begin with a car of which nothing is known."""
        self.starts = 0
        self.session: str | None = None
        self._settings = settings
        self._plugged: bool | None = None
        self._current_at: float | None = None
        self._seen = 0
        self._candidate = 0
        self._candidate_since = 0.0

    def configure(self, settings: ChargerSettings) -> None:
        """Apply changed settings."""
        self._settings = settings

    @property
    def phases(self) -> int:
        """Return the phases that the car uses: seen, else set, else all wired ones."""
        settings = self._settings
        return min(self._seen or settings.phases or settings.wired, settings.wired)

    @property
    def absent(self) -> bool:
        """Return whether it is certain that there is no car."""
        return self._plugged is False and self._settings.unplug_is_reported_in_a_pause

    def look(self, report: ChargerReport, now: float, *, paused: bool) -> bool:
        """Take what is known of the charger now; return whether a visit has begun.

        ``paused``: by us, so that some boxes report "unplugged" with a car at it.
        """
        settings = self._settings
        begun = False
        if report.session is not None and report.session != self.session:
            begun = self.session is not None
            self.session = report.session
        if not paused or settings.unplug_is_reported_in_a_pause:
            begun = begun or (self._plugged is False and report.plugged is True)
            if report.plugged is not None:
                self._plugged = report.plugged
        if self._current_at is None or report.phases:
            self._current_at = now
        elif now - self._current_at > WITHOUT_CURRENT and report.plugged is None:
            begun = True
        if begun:
            self.starts = 0
            self._seen = self._candidate = 0
            self._current_at = now
        self._look_at_phases(report, now)
        return begun

    def _look_at_phases(self, report: ChargerReport, now: float) -> None:
        phases = min(report.phases, self._settings.wired)
        if phases <= self._seen:
            self._candidate = 0
        elif phases != self._candidate:
            self._candidate, self._candidate_since = phases, now
        elif now - self._candidate_since >= SEEN:
            self._seen, self._candidate = phases, 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """What of a charger must survive a restart; plain values."""

    mode: Mode
    serial: str | None = None
    session: str | None = None
    starts: int = 0
    charging: bool = False
    """Its last phase; a charger that was paused is paused after a restart."""

    def as_dict(self) -> dict[str, Any]:
        """Return it for a file."""
        return {**asdict(self), "mode": self.mode.value}

    @classmethod
    def from_dict(cls, values: object) -> Self | None:
        """Return what a file has; ``None`` for anything that it cannot be."""
        if not isinstance(values, Mapping):
            return None
        try:
            kept = cls(**{**values, "mode": Mode(values["mode"])})
        except KeyError, TypeError, ValueError:
            return None
        texts = (kept.serial, kept.session)
        if (
            all(one is None or isinstance(one, str) for one in texts)
            and isinstance(values.get("charging", False), bool)
            and type(kept.starts) is int
            and isfinite(kept.starts)
            and kept.starts >= 0
        ):
            return kept
        return None
