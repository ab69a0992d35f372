"""Limits on how often something happens, or is logged."""

from collections import deque
import logging
from typing import Final

from .errors import LineLostError

_LOGGER = logging.getLogger(__name__)

LOSSES: Final = 20
LOSSES_WINDOW: Final = 3600.0
"""Losses of one line or charger logged at full level within this time, s."""

_LOST: Final = {
    False: "%s: the port was lost (%s), trying again",
    True: "%s: the connection was lost (%s), waiting for another",
}
_BACK: Final = {False: "%s: the port is back", True: "%s: connected again"}
"""By whether the other end opens the line."""


class RateLimiter:
    """At most so many events in any window of time."""

    def __init__(self, most: int, window: float) -> None:
        """Allow ``most`` in ``window`` seconds."""
        self._window = window
        self._taken: deque[float] = deque(maxlen=most)

    def take(self, now: float) -> bool:
        """Return whether one more is allowed at this time; it counts if it is."""
        taken = self._taken
        if len(taken) == taken.maxlen and now - taken[0] < self._window:
            return False
        taken.append(now)
        return True


class PresenceLog:
    """Logs when one charger goes and when it returns, once each.

    At info: that a charger is off may be quite in order.
    """

    def __init__(self) -> None:
        """Nothing is known of it yet."""
        self._limiter = RateLimiter(LOSSES, LOSSES_WINDOW)
        self._level = logging.INFO
        self._gone = False

    def gone(self, name: str, why: str, now: float) -> None:
        """Log that it is unavailable, unless it was; ``now``: loop time, s."""
        if self._gone:
            return
        self._gone = True
        self._level = logging.INFO if self._limiter.take(now) else logging.DEBUG
        _LOGGER.log(self._level, "%s is unavailable: %s", name, why)

    def back(self, name: str) -> None:
        """Log that it answers, at the level of its absence; the first time at debug."""
        level = self._level if self._gone else logging.DEBUG
        self._gone = False
        _LOGGER.log(level, "%s is available: it answers", name)


class LogThrottle:
    """Logs the losses of one line: once when it goes, once when it is back."""

    def __init__(self, *, opened_by_peer: bool) -> None:
        """``opened_by_peer``: the other end opens the line."""
        self._by_peer = opened_by_peer
        self._limiter = RateLimiter(LOSSES, LOSSES_WINDOW)
        self._level = logging.WARNING

    def lost(self, name: str, error: LineLostError, now: float) -> None:
        """Log a loss; ``now``: loop time, s."""
        self._level = logging.WARNING if self._limiter.take(now) else logging.DEBUG
        _LOGGER.log(self._level, _LOST[self._by_peer], name, error)

    def back(self, name: str) -> None:
        """Log the return, at the level of the loss."""
        _LOGGER.log(self._level, _BACK[self._by_peer], name)
