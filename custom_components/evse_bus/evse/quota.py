"""How often something may be said: what comes and goes must not fill a log."""

from collections import deque


class Quota:
    """At most so many in any window of time."""

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
