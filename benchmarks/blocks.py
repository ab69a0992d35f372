"""How long single callbacks hold an event loop.

asyncio runs everything through `Handle._run`; for a while, that is timed. It costs
some microseconds a callback, so nothing else is measured meanwhile.
"""

from asyncio import Handle
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
import heapq
import time
from typing import Any, Final

KEPT: Final = 5


@dataclass(slots=True)
class Blocks:
    """The callbacks of a while."""

    seconds: list[float] = field(default_factory=list)
    """Wall time of each, s: also what other threads and processes took from it."""
    longest: list[tuple[float, float, str]] = field(default_factory=list)
    """Of the longest ones: wall time and this thread's own processor time, s; what."""

    def as_dict(self) -> dict[str, Any]:
        """Return what can be sent to another process."""
        return {
            "seconds": [one for one in self.seconds if one > 1e-3],  # noqa: PLR2004
            "callbacks": len(self.seconds),
            "longest": sorted(self.longest, reverse=True),
        }


@contextmanager
def watch() -> Iterator[Blocks]:
    """Time all callbacks of all loops of this process."""
    blocks = Blocks()
    run = Handle._run  # noqa: SLF001 - the one place that everything passes

    def timed(handle: Handle) -> None:
        what: object = getattr(handle, "_callback", None)
        wall, own = time.perf_counter(), time.thread_time()
        run(handle)
        took = time.perf_counter() - wall
        blocks.seconds.append(took)
        if len(blocks.longest) < KEPT or took > blocks.longest[0][0]:
            entry = (took, time.thread_time() - own, _name(what))
            if len(blocks.longest) < KEPT:
                heapq.heappush(blocks.longest, entry)
            else:
                heapq.heapreplace(blocks.longest, entry)

    Handle._run = timed  # type: ignore[method-assign, assignment] # noqa: SLF001
    try:
        yield blocks
    finally:
        Handle._run = run  # type: ignore[method-assign] # noqa: SLF001


def _name(callback: object) -> str:
    """Return whose callback it was: a task's name, or a function's."""
    owner = getattr(callback, "__self__", None)
    if owner is not None and hasattr(owner, "get_coro"):
        coro = owner.get_coro()
        return f"task {owner.get_name()} {getattr(coro, '__qualname__', coro)}"
    return str(getattr(callback, "__qualname__", callback))
