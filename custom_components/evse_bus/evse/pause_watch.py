"""Finding a car that charges although its charger is paused."""

from math import inf
from typing import Final

NO_CURRENT: Final = 0.5
"""A pause lets no more than this flow, A: box and sleeping car draw some tenths."""
FOLLOW_TIME: Final = 10.0
"""Time for a car to end a charge after its charger has paused it, s."""
UNCONFIRMED: Final = 30.0
"""The same for a pause that is ordered, and that the charger does not show, s."""


class PauseWatch:
    """Time for which a car has been charging against a pause."""

    def __init__(self) -> None:
        """Start without a reading."""
        self._ordered_at = inf
        """Loop time of the first reading in a row of a car that charges although a
        pause is ordered or shown, s."""
        self._shown_at = inf
        """The same, with the pause shown in any of these readings."""

    def charges(
        self, now: float, *, ordered: bool, shown: bool, patience: float | None
    ) -> bool:
        """Return whether a car charges against a pause, by a reading at this time (s).

        ``ordered``: our orders come to a pause. ``shown``: the charger reports a
        pause, ours or not, or has confirmed ours. ``patience``: time after which this
        is a fault, s; ``None``: the reading shows no car that charges.
        """
        if patience is None or not (ordered or shown):
            self._ordered_at = self._shown_at = inf
            return False
        self._ordered_at = min(self._ordered_at, now)
        if shown:
            self._shown_at = min(self._shown_at, now)
        return now >= self._shown_at + patience or now >= self._ordered_at + max(
            patience, UNCONFIRMED
        )
