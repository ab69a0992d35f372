"""Conversations that wait for the bus: their queue, and one turn of each."""

import asyncio
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
import logging
from typing import Protocol

from .conversation import Conversation, RunningConversation
from .errors import (
    EvseError,
    ExchangeRefusedError,
    LineBusyError,
    NotAvailableError,
    ReplyTimeoutError,
    SupersededError,
)
from .exchange import Turn, Wire
from .model import OrderChange, Orders, Persistence
from .schedule import Slot
from .statistics import ChargerStatistics

_LOGGER = logging.getLogger(__name__)


class JobOwner(Protocol):
    """The charger of a job."""

    statistics: ChargerStatistics

    @property
    def orders(self) -> Orders:
        """Return the orders that stand."""

    @property
    def bursts(self) -> bool:
        """Return whether its conversations rest only where they must wait."""


@dataclass(slots=True, eq=False, kw_only=True)
class Job(Slot):
    """A conversation waiting for the bus."""

    owner: JobOwner | None
    conversation: Conversation[object]
    running: RunningConversation[object] | None = None
    """The conversation, once it has begun."""
    persistence: Persistence = Persistence.ONCE
    merge_key: str | None = None
    """A newer waiting job of this owner with the same key is merged into it."""
    change: OrderChange | None = None
    """The order change it carries; merged jobs carry both."""
    raises: bool = False
    """It asked for more than stood at the time."""
    is_poll: bool = False
    """It is the rest of a poll that has rested."""
    begun: bool = False
    """Its first turn is over; the rest must be finished even when the bus stops."""
    under_way: bool = False
    """It has the bus right now."""
    tries: int = 0
    future: asyncio.Future[object] = field(
        default_factory=lambda: asyncio.get_running_loop().create_future()
    )

    @property
    def waits(self) -> bool:
        """Return whether it waits for its first turn."""
        return not (self.begun or self.under_way or self.future.done())

    @property
    def outcome(self) -> object:
        """Return the result of its conversation, or its error, once it has ended."""
        future = self.future
        if not future.done() or future.cancelled():
            return None
        return future.exception() or future.result()


class JobQueue:
    """All that waits for the bus besides the regular polls."""

    def __init__(self) -> None:
        """Start empty."""
        self._jobs: list[Job] = []

    def __iter__(self) -> Iterator[Job]:
        """Return the waiting jobs; the queue may change meanwhile."""
        return iter(tuple(self._jobs))

    def __contains__(self, job: object) -> bool:
        """Return whether a job still waits."""
        return job in self._jobs

    def eligible(self) -> Iterator[Job]:
        """Return the jobs that may have a turn now, as far as the queue is concerned.

        A lowering or a pause goes at any time. A raise or a start waits for the
        changes before it: half done or to be repeated, their end would undo it.
        """
        changing: set[JobOwner | None] = set()
        for job in self._jobs:
            if job.owner not in changing or not job.raises:
                yield job
            if job.change is not None:
                changing.add(job.owner)

    def add(self, job: Job) -> None:
        """Add a job."""
        job.raises |= _raises(job)
        self._jobs.append(job)

    def merge(self, job: Job) -> Job | None:
        """Merge a job into a waiting one of its kind, and return that, if any.

        Only order changes merge, and only before they are under way: where both set a
        value the newer one counts. A pause merges with nothing but a pause.
        """
        if job.merge_key is None or job.change is None:
            return None
        for waiting in reversed(self._jobs):
            if (waiting.owner, waiting.merge_key) != (job.owner, job.merge_key):
                continue
            if waiting.change is None or not waiting.waits:
                # Nor into an older one: this one's end would undo it.
                return None
            waiting.change = waiting.change.merged_with(job.change)
            waiting.raises = _raises(waiting)
            return waiting
        return None

    def supersede(self, owner: JobOwner, which: Callable[[OrderChange], bool]) -> None:
        """Drop waiting order changes that a newer command makes wrong."""
        for job in self:
            if (
                job.owner is owner
                and job.change is not None
                and job.waits
                and which(job.change)
            ):
                self.fail(job, SupersededError("a newer command came first"))

    def done(self, job: Job, result: object) -> None:
        """End a job with a result."""
        self._remove(job)
        if not job.future.done():
            job.future.set_result(result)

    def fail(self, job: Job, error: Exception) -> None:
        """End a job with an error, which its caller gets."""
        self._remove(job)
        if job.running is not None and not job.under_way:
            job.running.close()
        if not job.future.done():
            job.future.set_exception(error)
            # A follow-up has no caller that would retrieve it: no warning.
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

    async def serve(
        self, job: Job, wire: Wire, *, connected: Callable[[], bool]
    ) -> None:
        """Give a job a turn; then it is done, waits for its next turn, or fails."""
        if job.future.cancelled():
            self.fail(job, NotAvailableError("its caller has given up"))
            return
        job.tries += 1
        job.under_way = True
        statistics = job.owner.statistics if job.owner else ChargerStatistics()
        if job.running is None:
            job.running = RunningConversation(
                job.conversation(Turn(wire, statistics)),
                bursts=job.owner is not None and job.owner.bursts,
            )
        try:
            pause = await job.running.go_on()
        except (ReplyTimeoutError, LineBusyError) as error:
            if _may_repeat(job, wire) and connected():
                job.running = None
                wire.statistics.retries += 1
                now = asyncio.get_running_loop().time()
                job.ready = now + wire.timing.retry_pauses[0]
            else:
                self.fail(job, error)
        except EvseError as error:
            statistics.refused += isinstance(error, ExchangeRefusedError)
            self.fail(job, error)
        except Exception as error:
            # A mistake of ours must not end the bus for all other chargers.
            _LOGGER.exception("%s: a command failed unexpectedly", wire.line.url)
            self.fail(job, EvseError(f"{type(error).__name__}: {error}"))
        else:
            if pause is None:
                self.done(job, job.running.result)
            else:
                job.ready = asyncio.get_running_loop().time() + pause.pause
                if pause.worst_case is not None:
                    job.worst_case = pause.worst_case
                job.begun = True
                job.tries = 0
        finally:
            job.under_way = False


def merge_key(change: OrderChange) -> str | None:
    """Merge limits with limits and pauses with pauses, and nothing with a start."""
    return {None: "limits", False: "pause", True: None}[change.allowed]


def _may_repeat(job: Job, wire: Wire) -> bool:
    return job.persistence is not Persistence.ONCE and job.tries < wire.timing.attempts


def _raises(job: Job) -> bool:
    """Return whether a change asks for more than stands; a pause never does."""
    if job.owner is None or job.change is None or job.change.allowed is False:
        return False
    # A lowering is in the orders already.
    orders = job.owner.orders
    return job.change.allowed is True or job.change.apply(orders) != orders
