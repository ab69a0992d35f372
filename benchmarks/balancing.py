"""What a wire tells of load balancing: broadcasts, requests, answers, sums. Pure.

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
from .witness import Heard

PERIOD: Final = 2.0
"""From broadcast to broadcast."""
EARLY: Final = 0.001
"""A broadcast so little before its time is the one that was due."""
REPEATS: Final = 1.0
"""An unanswered request is repeated after this."""
ANSWERING: Final = 0.012
"""So soon after a request another box may still say the answer that it owes us."""
SAME_MOMENT: Final = 0.005
"""Boxes that hear one frame do not follow it in the same microsecond."""
IN_FLIGHT: Final = 0.05
"""A frame that was on its way when the supply was lowered still counts for it."""
ROUNDING: Final = 0.01


def _packet(heard: Heard) -> Packet | None:
    return decode(heard.data, (*READS, WRITE_ONE, WRITE_SEVERAL))


# -- Broadcasts ------------------------------------------------------------------


def broadcasts(log: Iterable[Heard]) -> list[float]:
    """Return when our broadcasts of currents began."""
    return [
        heard.start
        for heard in log
        if heard.from_client
        and (packet := _packet(heard)) is not None
        and (packet.unit, packet.function) == (0, WRITE_SEVERAL)
        and packet.register == 1
    ]


def on_plan(times: Iterable[float], begin: float) -> list[tuple[float, float]]:
    """Return the broadcasts that were due, each with its deviation from the plan.

    The plan is a grid of exactly 2 s from ``begin`` on. What is due is the first one
    from a point of it on, however late; those between, sent because something had
    changed, stand for none.
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
class Asked:
    """A request of a box to its master."""

    unit: int
    register: int
    end: float
    idle: float
    """When nobody spoke any more."""
    answered: float | None
    """When our answer began; ``None``: not before the box had given up."""
    garbled: bool
    """Somebody else spoke at the same time: nobody can have heard it."""


def requests(log: Sequence[Heard]) -> list[Asked]:
    """Return all requests of boxes (01 to 04) and what became of them."""
    asked: list[Asked] = []
    for index, heard in enumerate(log):
        packet = None if heard.from_client else _packet(heard)
        if packet is None or packet.function != WRITE_ONE or packet.register > 4:  # noqa: PLR2004 - the last of them
            continue
        behind = log[index + 1 :]
        answer = _answer(behind, packet, heard)
        asked.append(
            Asked(
                packet.unit,
                packet.register,
                heard.end,
                _idle(behind, heard.end),
                answer,
                heard.collided,
            )
        )
    return asked


def _idle(behind: Iterable[Heard], idle: float) -> float:
    for heard in behind:
        if heard.start > idle + ANSWERING or heard.from_client:
            break
        idle = max(idle, heard.end)
    return idle


def _answer(behind: Iterable[Heard], asked: Packet, request: Heard) -> float | None:
    for heard in behind:
        if heard.start > request.start + REPEATS:
            break
        packet = _packet(heard) if heard.from_client else None
        if packet is None or (packet.unit, packet.function) != (asked.unit, WRITE_ONE):
            continue
        if packet.register == 0x80 | asked.register:
            return heard.start
    return None


# -- What all boxes together offer -----------------------------------------------


@dataclass(frozen=True, slots=True)
class Shared:
    """What the boxes may share from a moment on."""

    at: float
    amps: float


@dataclass(frozen=True, slots=True)
class Sums:
    """The sum of what boxes with a closed contactor offer, beside what they share."""

    most: float
    """The highest sum."""
    violations: int
    """How often it has risen above what they share."""
    longest: float
    """Longest time that it stood above a supply which had been lowered."""


def sums(offers: Iterable[Offer], shared: Iterable[Shared], end: float) -> Sums:
    """Look at each change of an offer and of the supply, in their order."""
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
