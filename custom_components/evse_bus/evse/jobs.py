"""Conversations that wait for the bus, and the queue they wait in."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
import logging
from typing import TYPE_CHECKING

from .errors import EvseError, SupersededError
from .exchange import Talk
from .model import OrderChange, Persistence
from .schedule import Slot

if TYPE_CHECKING:
    from .charger import Charger

_LOGGER = logging.getLogger(__name__)

type Step[T] = Callable[[Talk], Awaitable[T | Later[T]]]
"""One turn of a conversation: returns its result, or what is to come later."""


@dataclass(frozen=True, slots=True)
class Later[T]:
    """The rest of a conversation, after a pause in which others may speak."""

    pause: float
    """s"""
    step: Step[T]
    worst_case: float | None = None
    """Longest time its next turn can take, s; ``None``: as the turn before it, or as any
    turn of its charger."""


@dataclass(slots=True, eq=False, kw_only=True)
class Job(Slot):
    """A command waiting for the bus."""

    charger: Charger | None
    step: Step[object]
    persistence: Persistence = Persistence.ONCE
    merge_key: str | None = None
    """A newer waiting job of this charger with the same key is merged into it."""
    change: OrderChange | None = None
    """The order change it carries; merged jobs carry both."""
    raises: bool = False
    """It asks for more than stood when it was said."""
    begun: bool = False
    """Its first turn is over; the rest must be finished even when we stop."""
    under_way: bool = False
    """It has the bus right now."""
    tries: int = 0
    future: asyncio.Future[object] = field(
        default_factory=lambda: asyncio.get_running_loop().create_future()
    )


class JobQueue:
    """What waits for the bus besides the regular polls."""

    def __init__(self) -> None:
        """Start empty."""
        self._jobs: list[Job] = []

    def __iter__(self) -> Iterator[Job]:
        """Return what waits now; the queue may change meanwhile."""
        return iter(tuple(self._jobs))

    def __contains__(self, job: object) -> bool:
        """Return whether a job still waits."""
        return job in self._jobs

    def eligible(self) -> Iterator[Job]:
        """Return what may have a turn now, as far as the queue is concerned.

        A lowering or a pause goes at any time. A raise or a start waits for the
        changes before it: half done or to be repeated, their end would undo it.
        """
        changing: set[Charger | None] = set()
        for job in self._jobs:
            if job.charger not in changing or not job.raises:
                yield job
            if job.change is not None:
                changing.add(job.charger)

    def add(self, job: Job) -> None:
        """Let a job wait."""
        job.raises = _raises(job)
        self._jobs.append(job)

    def merge(self, job: Job) -> Job | None:
        """Merge a job into a waiting one of its kind, and return that, if any.

        Only order changes merge, and only before they are under way: the newer
        wish wins where both speak. A pause merges with nothing but a pause.
        """
        if job.merge_key is None or job.change is None:
            return None
        for waiting in reversed(self._jobs):
            if (waiting.charger, waiting.merge_key) != (job.charger, job.merge_key):
                continue
            if waiting.change is None or waiting.begun or waiting.under_way:
                # Nor into an older one: this one's end would undo it.
                return None
            waiting.change = waiting.change.merged_with(job.change)
            waiting.raises = _raises(waiting)
            return waiting
        return None

    def supersede(self, charger: Charger, which: Callable[[OrderChange], bool]) -> None:
        """Drop waiting order changes that a newer command makes wrong."""
        for job in self:
            if (
                job.charger is charger
                and job.change is not None
                and not (job.begun or job.under_way)
                and which(job.change)
            ):
                self.fail(job, SupersededError("a newer command came first"))

    def done(self, job: Job, result: object) -> None:
        """End a job well."""
        self._remove(job)
        if not job.future.done():
            job.future.set_result(result)

    def fail(self, job: Job, error: Exception) -> None:
        """End a job badly; whoever waits for it is told."""
        self._remove(job)
        if not job.future.done():
            job.future.set_exception(error)
            # Nobody may be waiting any more (a follow-up of a poll): no warning.
            job.future.exception()
        _LOGGER.debug("A command failed: %s", error)

    def fail_all(self, error: EvseError, *, begun: bool = True) -> None:
        """End every waiting job; ``begun``: also those half done."""
        for job in self:
            if not job.under_way and (begun or not job.begun):
                self.fail(job, error)

    def _remove(self, job: Job) -> None:
        if job in self._jobs:
            self._jobs.remove(job)


def merge_key(change: OrderChange) -> str | None:
    """Merge limits with limits and pauses with pauses, and nothing with a start."""
    return {None: "limits", False: "pause", True: None}[change.allowed]


def _raises(job: Job) -> bool:
    """Return whether a change asks for more than stands; a pause never does."""
    if job.charger is None or job.change is None or job.change.allowed is False:
        return False
    # What it lowers has been lowered in the orders already.
    orders = job.charger.orders
    return job.change.allowed is True or job.change.apply(orders) != orders
