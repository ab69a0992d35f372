"""Time that single callbacks hold an event loop.

asyncio runs every callback through `Handle._run`, which is timed for a while. It costs
some microseconds for each callback, so nothing else is measured meanwhile.
"""

from asyncio import Handle
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
import gc
import heapq
import threading
import time
from typing import Any, Final

KEPT: Final = 5
_LISTED: Final = 1e-3
"""Shortest garbage collection that is listed, s."""


@dataclass(slots=True)
class Blocks:
    """The callbacks within a time."""

    seconds: list[float] = field(default_factory=list)
    """Wall time of each, s, including time that other threads and processes took."""
    longest: list[tuple[float, float, str]] = field(default_factory=list)
    """Of the longest ones: wall time and processor time of this thread, s; name."""
    busiest: tuple[float, str] = (0.0, "")
    """Most processor time of one, s, without garbage collection; its name."""

    def as_dict(self) -> dict[str, Any]:
        """Return it for another process."""
        return {
            "seconds": [one for one in self.seconds if one > 1e-3],  # noqa: PLR2004
            "callbacks": len(self.seconds),
            "longest": sorted(self.longest, reverse=True),
            "busiest": self.busiest,
        }


class _Collections:
    """Processor time of garbage collections in this thread, s."""

    def __init__(self) -> None:
        self.taken = 0.0
        self._thread = threading.get_ident()
        self._begun = 0.0

    def __call__(self, phase: str, _info: dict[str, int]) -> None:
        if threading.get_ident() != self._thread:
            return
        if phase == "start":
            self._begun = time.thread_time()
        else:
            self.taken += time.thread_time() - self._begun


@contextmanager
def watch() -> Iterator[Blocks]:
    """Time all callbacks of all loops of this process."""
    blocks = Blocks()
    collections = _Collections()
    run = Handle._run  # noqa: SLF001 - every callback passes it

    def timed(handle: Handle) -> None:
        callback: object = getattr(handle, "_callback", None)
        collected = collections.taken
        wall, own = time.perf_counter(), time.thread_time()
        run(handle)
        took, used = time.perf_counter() - wall, time.thread_time() - own
        collected = collections.taken - collected
        blocks.seconds.append(took)
        if used - collected > blocks.busiest[0]:
            blocks.busiest = (used - collected, _name(callback))
        if len(blocks.longest) < KEPT or took > blocks.longest[0][0]:
            name = _name(callback)
            if collected > _LISTED:
                name += f", {collected * 1000:.0f} ms of it garbage collection"
            entry = (took, used, name)
            if len(blocks.longest) < KEPT:
                heapq.heappush(blocks.longest, entry)
            else:
                heapq.heapreplace(blocks.longest, entry)

    Handle._run = timed  # type: ignore[method-assign, assignment] # noqa: SLF001
    gc.callbacks.append(collections)
    try:
        yield blocks
    finally:
        gc.callbacks.remove(collections)
        Handle._run = run  # type: ignore[method-assign] # noqa: SLF001


def _name(callback: object) -> str:
    """Return the name of a callback: that of its task, or of its function."""
    owner = getattr(callback, "__self__", None)
    if owner is not None and hasattr(owner, "get_coro"):
        coro = owner.get_coro()
        return f"task {owner.get_name()} {getattr(coro, '__qualname__', coro)}"
    return str(getattr(callback, "__qualname__", callback))
