"""One turn of a command: what becomes of it, and whether it comes again."""

import asyncio
from collections.abc import Callable
import logging
from typing import Final

from .errors import (
    EvseError,
    ExchangeRefusedError,
    LineBusyError,
    NotAvailableError,
    ReplyTimeoutError,
)
from .exchange import Talk, Wire
from .jobs import Job, JobQueue, Later
from .model import Persistence
from .statistics import ChargerStatistics

_LOGGER: Final = logging.getLogger(__name__)


async def serve(
    job: Job, wire: Wire, queue: JobQueue, *, connected: Callable[[], bool]
) -> None:
    """Let a command have its turn; it is done, waits for its next one, or fails."""
    if job.future.cancelled():
        queue.fail(job, NotAvailableError("nobody waits for it"))
        return
    job.tries += 1
    job.under_way = True
    counted = job.charger.statistics if job.charger else ChargerStatistics()
    try:
        result = await job.step(Talk(wire, counted))
    except (ReplyTimeoutError, LineBusyError) as error:
        if _may_come_again(job, wire) and connected():
            wire.statistics.retries += 1
            job.ready = asyncio.get_running_loop().time() + wire.timing.retry_pauses[0]
        else:
            queue.fail(job, error)
    except EvseError as error:
        counted.refused += isinstance(error, ExchangeRefusedError)
        queue.fail(job, error)
    except Exception as error:
        # A mistake of ours must not end the bus for everybody else.
        _LOGGER.exception("%s: a command failed unforeseen", wire.line.url)
        queue.fail(job, EvseError(f"{type(error).__name__}: {error}"))
    else:
        if isinstance(result, Later):
            _wait_for_the_rest(job, result)
        else:
            queue.done(job, result)
    finally:
        job.under_way = False


def _may_come_again(job: Job, wire: Wire) -> bool:
    return job.persistence is not Persistence.ONCE and job.tries < wire.timing.attempts


def _wait_for_the_rest(job: Job, later: Later[object]) -> None:
    job.step = later.step
    job.ready = asyncio.get_running_loop().time() + later.pause
    if later.worst_case is not None:
        job.worst_case = later.worst_case
    job.begun = True
    job.tries = 0
