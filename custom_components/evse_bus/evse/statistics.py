"""Counters of a bus and its chargers, and a log of the last frames."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from math import inf
from time import time
from typing import Final

WINDOW: Final = 60.0
"""Time over which utilisation is computed, s."""
KEPT_FRAMES: Final = 200
KEPT_OF_FRAME: Final = 1024
"""Bytes kept of one frame, or of one unreadable chunk."""
KEPT_BYTES: Final = 65536
"""Bytes kept of all frames together."""


@dataclass(slots=True)
class BusStatistics:
    """Counters since the bus was created; they survive a lost port."""

    requests: int = 0
    replies: int = 0
    sent_only: int = 0
    """Frames without a reply: broadcasts, acknowledgements."""
    timeouts: int = 0
    late: int = 0
    """Replies that came after their time-out; they lengthen it, and are not used."""
    retries: int = 0
    merged: int = 0
    """Limits that a newer one replaced before they were sent."""
    frames: int = 0
    bad_frames: int = 0
    foreign_frames: int = 0
    """Good frames that matched no request: late, or of other masters."""
    foreign_requests: int = 0
    """Good frames that only another master sends, also those that were of use."""
    unsolicited: int = 0
    noise_bytes: int = 0
    missed_deadlines: int = 0
    for_deadline: int = 0
    """Turns taken early because a deadline left room for nothing else."""
    line_busy: int = 0
    """Turns given up because the line was never quiet."""
    reopened: int = 0
    renewed: int = 0
    """Silent lines that were closed and opened anew."""
    busy_time: float = 0.0
    """Time in which an exchange was under way, s."""
    _marks: deque[tuple[float, float]] = field(default_factory=deque)

    def busy(self, start: float, end: float) -> None:
        """Count the time from start to end (loop times, s) as busy."""
        self.busy_time += end - start
        if not self._marks or end - self._marks[-1][0] >= WINDOW / 12:
            self._marks.append((end, self.busy_time))
            while len(self._marks) > 1 and end - self._marks[1][0] > WINDOW:
                self._marks.popleft()

    def utilisation(self, now: float) -> float | None:
        """Return the share of the last minute in which the bus was in use, 0..1."""
        if not self._marks:
            return None
        since, before = self._marks[0]
        if now <= since:
            return None
        return min((self.busy_time - before) / (now - since), 1.0)


@dataclass(slots=True)
class ChargerStatistics:
    """Counters of one charger."""

    requests: int = 0
    replies: int = 0
    timeouts: int = 0
    bad_frames: int = 0
    refused: int = 0
    reasserted: int = 0
    """Limits sent again because the box was above them."""
    implausible: int = 0
    missed_deadlines: int = 0
    round_trip_min: float = inf
    round_trip_max: float = 0.0
    round_trip_sum: float = 0.0

    def reply(self, took: float) -> None:
        """Count a reply; ``took``: from the first byte of the request, s."""
        self.replies += 1
        self.round_trip_sum += took
        self.round_trip_min = min(self.round_trip_min, took)
        self.round_trip_max = max(self.round_trip_max, took)

    @property
    def round_trip_mean(self) -> float | None:
        """Return the mean time from the first byte of a request to its reply, s."""
        return self.round_trip_sum / self.replies if self.replies else None


class Direction(StrEnum):
    """Direction of a frame."""

    OUT = "out"
    IN = "in"
    UNREADABLE = "unreadable"


@dataclass(frozen=True, slots=True)
class LoggedFrame:
    """One logged frame."""

    when: float
    """Seconds since the epoch."""
    direction: Direction
    data: bytes
    """The first `KEPT_OF_FRAME` bytes."""
    length: int
    """Number of bytes on the line."""


class FrameLog:
    """The last frames on a bus, for diagnostics; bounded, whatever a line delivers."""

    def __init__(self) -> None:
        """Start empty."""
        self._frames: deque[LoggedFrame] = deque()
        self._bytes = 0

    def add(self, direction: Direction, data: bytes) -> None:
        """Log a frame; the oldest ones are dropped."""
        kept = data[:KEPT_OF_FRAME]
        self._frames.append(LoggedFrame(time(), direction, kept, len(data)))
        self._bytes += len(kept)
        while len(self._frames) > KEPT_FRAMES or self._bytes > KEPT_BYTES:
            self._bytes -= len(self._frames.popleft().data)

    def __iter__(self) -> Iterator[LoggedFrame]:
        """Return the frames, oldest first."""
        return iter(tuple(self._frames))

    def __len__(self) -> int:
        """Return the number of frames in the log."""
        return len(self._frames)
