"""What the log is told of a line that is lost and comes back."""

import logging
from typing import Final

from .errors import LineLostError
from .quota import Quota

_LOGGER = logging.getLogger(__name__)

MOST_LOST: Final = 20
LOST_WINDOW: Final = 3600.0
"""So many losses are told in so many seconds: who dials can come and go all day."""

_LOST: Final = {
    False: "%s: the port was lost (%s), trying again",
    True: "%s: the connection was lost (%s), waiting for another",
}
_BACK: Final = {False: "%s: the port is back", True: "%s: connected again"}
"""By whether the other end opens the line."""


class Losses:
    """The losses of one line: told once when it goes and once when it is back."""

    def __init__(self, *, opened_by_peer: bool) -> None:
        """Nothing was lost yet."""
        self._by_peer = opened_by_peer
        self._quota = Quota(MOST_LOST, LOST_WINDOW)
        self._level = logging.WARNING

    def lost(self, name: str, error: LineLostError, now: float) -> None:
        """Tell that it is gone; ``now``: loop time."""
        self._level = logging.WARNING if self._quota.take(now) else logging.DEBUG
        _LOGGER.log(self._level, _LOST[self._by_peer], name, error)

    def back(self, name: str) -> None:
        """Tell that it is back, as its loss was told."""
        _LOGGER.log(self._level, _BACK[self._by_peer], name)
