"""Load balancing as seen on the wire: broadcasts, requests, replies, sums. Pure.

All times are seconds of CLOCK_MONOTONIC, all currents amperes.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
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
EARLY: Final = 0.001
"""A broadcast this early still counts as the one that is due."""
REPEATS: Final = 1.0
"""An unanswered request is repeated after this."""
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
        and (packet.unit, packet.function) == (0, WRITE_SEVERAL)
        and packet.register == 1
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
    longest: float
    """Longest time above a supply that was lowered."""


def sums(offers: Iterable[Offer], shared: Iterable[Shared], end: float) -> Sums:
    """Evaluate the changes of offers and of the supply, in their order."""
    changes: list[Offer | Shared] = [*offers, *shared]
    changes.sort(key=lambda change: change.at)
    now: dict[str, float] = {}
    limit = most = total = longest = 0.0
    lowered = above = None
    violations = 0
    for index, change in enumerate(changes):
        before = total
        if isinstance(change, Shared):
            if change.amps < limit:
                lowered = change.at
            limit = change.amps
        else:
            now[change.name] = change.amps if change.closed else 0.0
            if index + 1 < len(changes) and (
                changes[index + 1].at - change.at < SAME_MOMENT
                and isinstance(changes[index + 1], Offer)
            ):
                continue
        total = sum(now.values())
        most = max(most, total)
        if total <= limit + ROUNDING:
            if above is not None:
                longest = max(longest, change.at - above)
            above = None
            continue
        if above is None:
            above = change.at
        in_flight = lowered is not None and change.at - lowered < IN_FLIGHT
        if isinstance(change, Offer) and total > before + ROUNDING and not in_flight:
            violations += 1
    if above is not None:
        longest = max(longest, end - above)
    return Sums(most, violations, longest)
