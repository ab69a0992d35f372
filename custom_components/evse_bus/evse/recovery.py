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
LASTED: Final = 1.0
"""An adapter that closes a connection of which nothing was asked has not refused it if
it has lasted so long, s."""


class LineRecovery:
    """Evidence that a line is dead or works. All times are loop times, s."""

    def __init__(self) -> None:
        """Start with a line that was never open."""
        self._answered = False
        self._owed = True
        """The last request was not answered, or there was none."""
        self._opened_at = -inf
        self._attempts = 0
        self._renewals = 0
        self._unanswered_since: float | None = None

    def works(self, now: float) -> bool:
        """Return whether its requests are answered, as far as any were sent on it.

        Bytes alone prove nothing: an adapter may send a greeting, and close the
        connection at the first request.
        """
        lasted = now - self._opened_at >= LASTED
        return self._answered or (lasted and not self._owed)

    def opened(self, now: float) -> None:
        """Take note of an opened line."""
        self._answered = False
        self._opened_at = now
        self._unanswered_since = None

    def asked(self) -> None:
        """Take note of a request."""
        self._owed = True

    def received(self) -> None:
        """Take note of a received byte: this line is not silent."""
        self._attempts = self._renewals = 0
        self._unanswered_since = None

    def answered(self) -> None:
        """Take note of its reply."""
        self._answered = True
        self._owed = False

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
