"""The plug lock and the contactor of a charging port, with their defects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

TRAVEL = 0.4
TOGGLES = 5
TOGGLE_WINDOW = 30.0


@dataclass(frozen=True, slots=True)
class Unlocking:
    """An unlocking: device time, reason, and whether the car was still requesting."""

    at: float
    reason: str
    car_wanted: bool


class LockMotor:
    """A bolt that needs `travel` seconds, and a switch that detects it locked.

    `jammed`: "lock" never reaches locked, "unlock" never opens.
    """

    def __init__(self, travel: float = TRAVEL) -> None:
        """Begin open."""
        self.travel = travel
        self.jammed: Literal["", "lock", "unlock"] = ""
        self.locked = False
        self.target: bool | None = None
        self.moves = 0
        self.reason = ""
        self._done_at = 0.0

    @property
    def moving(self) -> bool:
        """Return whether it is moving."""
        return self.target is not None

    def drive(self, *, locked: bool, now: float, reason: str) -> None:
        """Start to move; no effect if it already moves there."""
        if self.target is locked:
            return
        self.target = locked
        self.reason = reason
        self.moves += 1
        self._done_at = now + self.travel

    def step(self, now: float) -> Literal["", "locked", "unlocked", "failed"]:
        """Return the result of a movement that has ended, once."""
        if self.target is None or now < self._done_at:
            return ""
        target, self.target = self.target, None
        if target == self.locked:
            # Reversed on its way: it never arrived.
            return "locked" if target else ""
        if self.jammed == ("lock" if target else "unlock"):
            return "failed"
        self.locked = target
        return "locked" if target else "unlocked"

    def spring_open(self) -> None:
        """Open at once, by the stored energy when the mains has failed."""
        self.target = None
        if self.jammed != "unlock":
            self.locked = False


class Contactor:
    """Switches the car's voltage; `closed` is its feedback contact.

    `broken`: "open" never closes, "closed" is welded once it has closed.
    """

    def __init__(self) -> None:
        """Begin open."""
        self.broken: Literal["", "open", "closed"] = ""
        self.closed = False
        self.closings: list[float] = []
        self._recent: list[float] = []

    def forget_toggles(self) -> None:
        """Restart the count: a start was released."""
        self._recent.clear()

    def close(self, now: float) -> bool:
        """Close; return whether the feedback confirms it."""
        if not self.closed and self.broken != "open":
            self.closed = True
            self.closings.append(now)
            self._recent.append(now)
        return self.closed

    def open(self) -> bool:
        """Open; return whether the feedback confirms it."""
        if self.broken != "closed":
            self.closed = False
        return not self.closed

    def toggled_too_often(self, now: float) -> bool:
        """Return whether it closed five times in 30 s (result 9 of `rc`)."""
        self._recent = [at for at in self._recent if now - at <= TOGGLE_WINDOW]
        return len(self._recent) >= TOGGLES
