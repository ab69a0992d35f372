"""Whether a car is plugged in, where state ``A`` does not always mean that there is none.

A box reports ``A`` also for a car that came while access was off or an error stood, and
2.17 to 2.30 for one that they have stopped themselves. It stays in ``A`` until the pilot
has been at 9 V: a car that keeps its request is never seen again. PROTOCOLS.md, 3.
"""

from math import inf
from typing import Final

from .dialects import MAPS, Dialect, Status
from .states import CHARGING, UNPLUGGED, WAITING, shows_plug, state_of

HIDDEN_BY_ERROR: Final = 65.0
"""After an error or a refusal ``A`` may mean a plugged car for this long, s: a box
waits for 60 s before it asks again."""
HIDDEN_BY_STOP: Final = 20.0
"""Likewise after a stop at its button (15 s), its power-up or an absence (7 s), s."""


class PlugWatch:
    """What is known of the plug of one box."""

    def __init__(self) -> None:
        """Begin with an unknown box."""
        self._before: Status | None = None
        """Its last status, also from before lost replies."""
        self._known: bool | None = None
        """Whether a car was in when that was last known."""
        self._hidden_until = 0.0
        self._missed = False

    def missed(self) -> None:
        """Take note of a lost reply: it may have been switched off meanwhile."""
        self._missed = True

    def see(
        self, dialect: Dialect, status: Status, now: float, *, may_be_refused: bool
    ) -> bool | None:
        """Return whether a car is plugged in; ``None``: not known.

        ``may_be_refused``: it was out of sight for long, and a master or its meter may
        have let it have no current meanwhile.
        """
        if status.raw_state != UNPLUGGED:
            self._hidden_until = 0.0
        else:
            hidden = self._hidden_for(dialect, status, may_be_refused=may_be_refused)
            self._hidden_until = max(self._hidden_until, now + hidden)
        plugged = state_of(dialect, status.raw_state).plugged
        if status.raw_state == UNPLUGGED and now < self._hidden_until:
            plugged = None
        if plugged is not None:
            self._known = plugged
        self._before = status
        self._missed = False
        return plugged

    def _hidden_for(
        self, dialect: Dialect, status: Status, *, may_be_refused: bool
    ) -> float:
        """Return for how long this ``A`` may mean a plugged car, s."""
        before = self._before
        if self._known and before is not None and has_restarted(before, status):
            return inf
        # A car that it has stopped is not A, so one in A was never offered current.
        shows_stopped = MAPS[dialect].shows_plug
        if status.error:
            return inf if self._known and not shows_stopped else HIDDEN_BY_ERROR
        if not shows_plug(status):
            return HIDDEN_BY_STOP if shows_stopped else inf
        if may_be_refused:
            return HIDDEN_BY_ERROR
        if before is None or self._missed or has_restarted(before, status):
            return HIDDEN_BY_STOP
        return self._hidden_after(dialect, before.raw_state)

    @staticmethod
    def _hidden_after(dialect: Dialect, raw_state: str) -> float:
        """Return the same for an ``A`` right after another state."""
        if raw_state in WAITING:
            was_in = state_of(dialect, raw_state).plugged
            return HIDDEN_BY_ERROR if was_in else 0.0
        is_stopped = raw_state in CHARGING and not MAPS[dialect].shows_plug
        return HIDDEN_BY_STOP if is_stopped else 0.0


def has_restarted(before: Status, after: Status) -> bool:
    """Return whether two statuses show that a box was switched off and on between."""
    # Only a restart forgets the cable.
    return bool(before.maximum) and after.maximum is None
