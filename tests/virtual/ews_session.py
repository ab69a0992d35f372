"""Meter and times of the current charge, and of the last one."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .ews_rfid import Card


class Result:
    """The last charge's result (`rc`)."""

    NONE, STOPPED, PILOT_LOST, CABLE_LOST, RCD = 0, 1, 3, 4, 5
    METER, SERVER_TIMEOUT, NO_FAN, UNSTABLE = 6, 7, 8, 9


class Session:
    """Counts seconds and Wh; `card` is the one that is logged in.

    `total_wh` is the absolute meter, `cycles` the number of charges so far.
    """

    def __init__(self) -> None:
        """Begin at zero."""
        self.seconds = self.wh = 0.0
        self.last_seconds = self.last_wh = 0.0
        self.total_wh = 0.0
        self.cycles = 0
        self.result = Result.NONE
        self.card: Card | None = None
        self.last_card: Card | None = None
        self.last_end: tuple[int, ...] = (0,) * 6
        self._at: float | None = None

    def start(self, *, resumed: bool) -> None:
        """Begin at zero, or continue after a pause by the server."""
        self.result = Result.NONE
        if not resumed:
            self.seconds = self.wh = 0.0
            self.cycles += 1

    def end(self, result: int, at: tuple[int, ...]) -> None:
        """Keep the result; the current charge is the last one from now on."""
        self.result = result
        self.last_seconds, self.last_wh = self.seconds, self.wh
        self.last_card = self.card
        self.last_end = at

    def gone(self) -> None:
        """Drop the state of the car that left."""
        self.seconds = self.wh = 0.0
        self.card = None

    def live(self, now: float, wh: float, *, active: bool) -> None:
        """Count."""
        if self._at is not None and active:
            self.seconds += now - self._at
        self._at = now
        self.wh += wh
        self.total_wh += wh
