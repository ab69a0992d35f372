"""When a line is opened again: decisions without a clock of their own. PROTOCOLS.md, 2.

A line that was lost is opened again at once, then with growing pauses, for ever. A
line that is open but silent is closed and opened anew: a network adapter that has hung
or restarted leaves our end of a dead connection open for hours.
"""

from math import inf
from typing import Final

PAUSES: Final = (1.0, 2.0, 4.0, 5.0)
"""Pauses before the attempts to open a lost line, s; the last one for ever. With an
attempt of at most `line.OPEN_TIMEOUT` it is back within 10 s of its adapter."""
SILENCES: Final = (30.0, 60.0, 120.0, 300.0)
"""Times without any received byte after which a silent line is opened anew, s; the last
one for ever: the chargers may simply be off."""


class LineRecovery:
    """Evidence that a line is dead or works. All times are loop times, s."""

    def __init__(self) -> None:
        """Start with a line that was never open."""
        self._delivered = False
        self._attempts = 0
        self._renewals = 0
        self._unanswered_since: float | None = None

    @property
    def worked(self) -> bool:
        """Return whether bytes were received since it was opened."""
        return self._delivered

    def opened(self) -> None:
        """Take note of an opened line."""
        self._delivered = False
        self._unanswered_since = None

    def received(self) -> None:
        """Take note of a received byte: this line works."""
        self._delivered = True
        self._attempts = self._renewals = 0
        self._unanswered_since = None

    def unanswered(self, now: float) -> None:
        """Take note of a request without any reply."""
        if self._unanswered_since is None:
            self._unanswered_since = now

    @property
    def renew_at(self) -> float:
        """Return when a line that stays silent is to be opened anew; inf: never."""
        if self._unanswered_since is None:
            return inf
        return self._unanswered_since + SILENCES[min(self._renewals, len(SILENCES) - 1)]

    def renewed(self) -> None:
        """Take note that a silent line was closed, to be opened anew."""
        self._renewals += 1
        self._unanswered_since = None

    def next_pause(self) -> float:
        """Return the pause before the next attempt to open a lost line, s.

        A connection on which no byte was ever received does not begin anew with short
        pauses.
        """
        pause = PAUSES[min(self._attempts, len(PAUSES) - 1)]
        self._attempts += 1
        return pause
