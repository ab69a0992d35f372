"""Load balancing as seen on the wire: broadcasts, requests, replies, sums. Pure.

All times are seconds of CLOCK_MONOTONIC, all currents amperes.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import inf
from typing import Final

from tests.virtual.smartevse_frames import (
    READS,
    WRITE_ONE,
    WRITE_SEVERAL,
    Packet,
    decode,
)

from .figures import gaps
from .offers import Offer
from .oracle import LoggedFrame

PERIOD: Final = 2.0
"""Between two broadcasts."""
BROADCASTS: Final = {(0, 0x0001), (9, 0x0001), (9, 0x0020)}
"""Unit and register of the broadcasts of currents: of 2.17, of 2.20, of 2.30 on."""
STATUS: Final = {0x00A0, 0x0000}
"""The first register of a status, which is the state."""
ASKS: Final = {4: "B", 6: "C"}
"""States of a node that waits for its master's answer, from 2.20 on."""
EARLY: Final = 0.001
"""A broadcast this early still counts as the one that is due."""
REPEATS: Final = 1.0
"""An unanswered request is repeated after this."""
SAME_REQUEST: Final = 1.4
"""After a longer time it is another request, not a repetition."""
PENDING_REPLY: Final = 0.012
"""Time after a request within which another box may still send a pending reply."""
SAME_MOMENT: Final = 0.005
"""Spread of the reactions of several boxes to one frame."""
IN_FLIGHT: Final = 0.05
"""Time after a lowering of the supply within which a frame may be on its way."""
ROUNDING: Final = 0.01


def _packet(frame: LoggedFrame) -> Packet | None:
    return decode(frame.data, (*READS, WRITE_ONE, WRITE_SEVERAL))


# -- Broadcasts ------------------------------------------------------------------


def broadcasts(log: Iterable[LoggedFrame]) -> list[float]:
    """Return the start times of our broadcasts of currents."""
    return [
        frame.start
        for frame in log
        if frame.from_client
        and (packet := _packet(frame)) is not None
        and packet.function == WRITE_SEVERAL
        and (packet.unit, packet.register) in BROADCASTS
    ]


def on_plan(times: Iterable[float], begin: float) -> list[tuple[float, float]]:
    """Return the times of the due broadcasts, each with its deviation from the plan.

    The plan is a grid of exactly 2 s from ``begin`` on. The first broadcast after each
    of its points is the due one, however late. The others, sent because of a change,
    are left out.
    """
    due: list[tuple[float, float]] = []
    for time in times:
        while time >= begin - EARLY:
            due.append((time, time - begin))
            begin += PERIOD
    return due


def longest_silence(times: Sequence[float], end: float) -> float:
    """Return the longest time without a broadcast, up to the end."""
    return max(gaps([*times, end]), default=0.0)


# -- Requests of the boxes -------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SlaveRequest:
    """A request of a box to its master."""

    unit: int
    register: int
    end: float
    idle: float
    """When the bus was idle."""
    replied: float | None
    """Start of our reply; ``None``: none before the box repeated its request."""
    garbled: bool
    """It collided with another frame: no station can have received it."""


def requests(log: Sequence[LoggedFrame]) -> list[SlaveRequest]:
    """Return all requests of boxes (01 to 04) and the replies to them."""
    found: list[SlaveRequest] = []
    for index, frame in enumerate(log):
        packet = None if frame.from_client else _packet(frame)
        if packet is None or packet.function != WRITE_ONE or packet.register > 4:  # noqa: PLR2004 - the last of them
            continue
        behind = log[index + 1 :]
        reply = _reply(behind, packet, frame)
        found.append(
            SlaveRequest(
                packet.unit,
                packet.register,
                frame.end,
                _idle(behind, frame.end),
                reply,
                frame.collided,
            )
        )
    return found


def _idle(behind: Iterable[LoggedFrame], idle: float) -> float:
    for frame in behind:
        if frame.start > idle + PENDING_REPLY or frame.from_client:
            break
        idle = max(idle, frame.end)
    return idle


def _reply(
    behind: Iterable[LoggedFrame], packet: Packet, request: LoggedFrame
) -> float | None:
    for frame in behind:
        if frame.start > request.start + REPEATS:
            break
        reply = _packet(frame) if frame.from_client else None
        if reply is None or (reply.unit, reply.function) != (packet.unit, WRITE_ONE):
            continue
        if reply.register == 0x80 | packet.register:
            return frame.start
    return None


# -- What a box asks for, in any dialect -----------------------------------------


@dataclass(frozen=True, slots=True)
class Ask:
    """A box that waits for its master, from the first time it said so."""

    unit: int
    kind: str
    since: float
    answered: float | None
    """Start of the answer; ``None``: none before it gave up, or the log ended."""
    until: float
    """When it was answered, gave up, or the log ended."""

    @property
    def waited(self) -> float:
        """Return how long it has waited, s."""
        return self.until - self.since


def repeated(made: Iterable[SlaveRequest], end: float) -> list[Ask]:
    """Return the requests of 2.17, each with its repetitions, up to ``end``."""
    found: list[Ask] = []
    waiting: dict[tuple[int, int], tuple[float, float]] = {}
    for one in made:
        key = (one.unit, one.register)
        first, last = waiting.pop(key, (one.end, one.end))
        if one.end - last > SAME_REQUEST:
            found.append(_ask(*key, first, None, last))
            first = one.end
        if one.replied is None:
            waiting[key] = (first, one.end)
        else:
            found.append(_ask(*key, first, one.replied, one.replied))
    for key, (first, last) in waiting.items():
        until = end if end - last < SAME_REQUEST else last
        found.append(_ask(*key, first, None, until))
    return found


def _ask(
    unit: int, register: int, since: float, answered: float | None, until: float
) -> Ask:
    return Ask(unit, f"{register:02d}", since, answered, until)


def asked_by_state(log: Iterable[LoggedFrame], end: float) -> list[Ask]:
    """Return how long nodes were left in a state in which they wait, up to ``end``."""
    found: list[Ask] = []
    waiting: dict[int, tuple[int, float]] = {}
    for unit, packet, frame in _conversations(log):
        state, since = waiting.get(unit, (0, 0.0))
        if packet.kind != "answer":
            writes = packet.function in (WRITE_ONE, WRITE_SEVERAL)
            if writes and packet.register in STATUS and state:
                del waiting[unit]
                found.append(Ask(unit, ASKS[state], since, frame.start, frame.start))
            continue
        shown = int.from_bytes(frame.data[3:5], "big")
        if shown == state:
            continue
        if state:
            # The car has left, or an error has ended it.
            del waiting[unit]
            found.append(Ask(unit, ASKS[state], since, None, frame.end))
        if shown in ASKS:
            waiting[unit] = (shown, frame.end)
    found.extend(
        Ask(unit, ASKS[state], since, None, end)
        for unit, (state, since) in waiting.items()
    )
    return found


def _conversations(
    log: Iterable[LoggedFrame],
) -> Iterable[tuple[int, Packet, LoggedFrame]]:
    """Return our requests to single boxes, and the replies to reads of a status."""
    read = 0
    for frame in log:
        packet = None if frame.collided else _packet(frame)
        if packet is None:
            continue
        if frame.from_client:
            is_read = packet.function in READS and packet.register in STATUS
            read = packet.unit if is_read else 0
            yield packet.unit, packet, frame
        elif packet.unit == read and packet.function in READS:
            read = 0
            yield packet.unit, packet, frame


# -- Readings --------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Reading:
    """One reading of a status."""

    unit: int
    start: float
    end: float | None
    """End of the reply; ``None``: there was none."""


def readings(log: Iterable[LoggedFrame]) -> list[Reading]:
    """Return all readings of a status."""
    found: list[Reading] = []
    for unit, packet, frame in _conversations(log):
        if packet.kind == "answer":
            found[-1] = Reading(unit, found[-1].start, frame.end)
        elif packet.function in READS and packet.register in STATUS:
            found.append(Reading(unit, frame.start, None))
    return found


def rounds(
    due: Sequence[float], made: Sequence[Reading], units: Iterable[int]
) -> tuple[list[float], int]:
    """Return how long rounds took, and how often a box was left out of one.

    A round lasts from a due broadcast until each of the ``units`` was read.
    """
    lengths: list[float] = []
    left_out = 0
    units = set(units)
    at = 0
    for begin, next_one in pairwise(due):
        while at < len(made) and made[at].start < begin:
            at += 1
        missing = set(units)
        last = begin
        for poll in made[at:]:
            if poll.start >= next_one or not missing:
                break
            if poll.end is not None and poll.unit in missing:
                missing.discard(poll.unit)
                last = poll.end
        left_out += len(missing)
        if not missing:
            lengths.append(last - begin)
    return lengths, left_out


# -- The sum of all offers -------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Shared:
    """The supply that the boxes share from a time on."""

    at: float
    amps: float


@dataclass(frozen=True, slots=True)
class Sums:
    """The sum of the offers of boxes with a closed contactor, against the supply."""

    most: float
    """The highest sum."""
    violations: int
    """Number of rises above the supply."""
    seconds: float
    """Time above it after such a rise, s."""
    longest: float
    """Longest time above a supply that was lowered."""


def sums(offers: Iterable[Offer], shared: Iterable[Shared], end: float) -> Sums:
    """Evaluate the changes of offers and of the supply, in their order."""
    changes: list[Offer | Shared] = [*offers, *shared]
    changes.sort(key=lambda change: change.at)
    now: dict[str, float] = {}
    sum_ = _Sum()
    for index, change in enumerate(changes):
        if isinstance(change, Shared):
            sum_.share(change)
            continue
        now[change.name] = change.amps if change.closed else 0.0
        if index + 1 < len(changes) and (
            changes[index + 1].at - change.at < SAME_MOMENT
            and isinstance(changes[index + 1], Offer)
        ):
            continue
        sum_.change(sum(now.values()), change.at)
    sum_.end(end)
    return Sums(sum_.most, sum_.violations, sum_.seconds, sum_.longest)


class _Sum:
    """The sum of the offers against the supply, as time goes on."""

    def __init__(self) -> None:
        self.most = self.seconds = self.longest = 0.0
        self.violations = 0
        self._total = self._limit = 0.0
        self._lowered = -inf
        self._above: float | None = None
        """Since when it is above the supply, for whatever reason."""
        self._risen: float | None = None
        """Since when it is above because it rose."""

    def share(self, shared: Shared) -> None:
        """Follow another supply."""
        if shared.amps < self._limit:
            self._lowered = shared.at
        self._limit = shared.amps
        self._look(shared.at)

    def change(self, total: float, at: float) -> None:
        """Follow another sum."""
        before, self._total = self._total, total
        self.most = max(self.most, total)
        self._look(at)
        in_flight = at - self._lowered < IN_FLIGHT
        if self._above is not None and total > before + ROUNDING and not in_flight:
            self.violations += 1
            self._risen = at if self._risen is None else self._risen

    def end(self, at: float) -> None:
        """End the evaluation."""
        if self._above is not None:
            self.longest = max(self.longest, at - self._above)
        if self._risen is not None:
            self.seconds += at - self._risen
        self._above = self._risen = None

    def _look(self, at: float) -> None:
        if self._total <= self._limit + ROUNDING:
            self.end(at)
        elif self._above is None:
            self._above = at
