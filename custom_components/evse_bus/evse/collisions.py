"""Evidence that two boxes answer to one address: garbled replies, and no good one.

A disturbed line garbles some replies in a row now and then; two boxes that answer at
the same moment garble nearly all, for as long as both are there.
"""

from math import inf
from typing import Final

GARBLED: Final = 3
"""Garbled replies in a row, at least."""
NO_GOOD_ONE: Final = 30.0
"""Time without a good reply, s."""


class Collisions:
    """The replies of one address. All times are loop times, s."""

    def __init__(self) -> None:
        """Begin before the first reply."""
        self._garbled = 0
        self._good_at = -inf

    def good(self, now: float) -> None:
        """Take note of a good reply."""
        self._garbled = 0
        self._good_at = now

    def garbled(self, now: float) -> bool:
        """Take note of a garbled reply; return whether two boxes are likely."""
        self._garbled += 1
        return self._garbled >= GARBLED and now - self._good_at >= NO_GOOD_ONE
