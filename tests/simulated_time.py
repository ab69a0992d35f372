"""Simulated time: an event loop whose clock jumps to the next timer.

The clock stands still while anything is done, in the loop or in a thread of its
executors, and moves only when nothing is left but to wait. An hour takes milliseconds,
and the load of the machine changes nothing.
"""

import asyncio
from collections.abc import Coroutine
import selectors
from time import process_time
from typing import Any, override

NOW = 1000.0
"""Time at which a loop begins, s."""
_REAL_WAIT = 0.0001
"""Wait for sockets of this process before time goes on, real s."""
_LONGEST = 120.0
"""Processor time after which a loop hangs, s.

What pytest-timeout raises ends a task or a callback, and the loop goes on.
"""
_CHECK_EVERY = 256
"""Waits between two looks at the processor time."""


class _JumpingSelector(selectors.SelectSelector):
    """Waits only for what happens outside the loop; else lets the time pass."""

    def __init__(self, loop: SimulatedLoop) -> None:
        super().__init__()
        self._loop = loop
        self._waits = 0

    @override
    def select(self, timeout: float | None = None) -> Any:
        loop = self._loop
        if loop.jobs and (timeout is None or timeout > 0):
            # A job in a thread takes no time.
            loop.woken = False
            return super().select()
        if loop.woken or len(self.get_map()) > 1:
            # One is the loop's own: other threads wake it through that.
            loop.woken = False
            wait = 0 if timeout is not None and timeout <= 0 else _REAL_WAIT
            if events := super().select(wait):
                return events
        if timeout is None:
            message = "everything waits for nothing"
            raise RuntimeError(message)
        self._waits += 1
        # Asking for the processor time may take longer than all else here.
        if self._waits % _CHECK_EVERY == 0 and process_time() > loop.ends_at:
            message = f"no end after {_LONGEST:g} s of processor time"
            raise RuntimeError(message)
        if timeout > 0:
            # A little more than asked for, as with a real clock: a timer may fire
            # within the clock's resolution before its time, for ever if time stood.
            loop.now += timeout + 1e-9
        return []


class SimulatedLoop(asyncio.SelectorEventLoop):
    """An event loop with a clock of its own."""

    def __init__(self) -> None:
        self.now = NOW
        self.ends_at = process_time() + _LONGEST
        self.jobs = 0
        """Jobs under way in threads."""
        self.woken = False
        """A thread has called something in the loop."""
        super().__init__(_JumpingSelector(self))

    @override
    def time(self) -> float:
        return self.now

    @override
    def get_debug(self) -> bool:
        """Return False: a traceback for each timer doubles the time of a test.

        The debug mode still checks callbacks, and threads that call into the loop.
        """
        return False

    @override
    def run_in_executor(self, executor: Any, func: Any, *args: Any) -> Any:
        future = super().run_in_executor(executor, func, *args)
        self.jobs += 1
        future.add_done_callback(self._job_done)
        return future

    @override
    def _write_to_self(self) -> None:
        self.woken = True
        super()._write_to_self()  # type: ignore[misc] # of a base class

    @override
    async def shutdown_default_executor(self, timeout: float | None = None) -> None:
        self.jobs += 1
        try:
            await super().shutdown_default_executor(timeout)
        finally:
            self.jobs -= 1

    def _job_done(self, _job: object) -> None:
        self.jobs -= 1


def simulate[T](scene: Coroutine[Any, Any, T]) -> T:
    """Run a scene in simulated time and return its result."""
    with asyncio.Runner(loop_factory=SimulatedLoop) as runner:
        return runner.run(scene)


def now() -> float:
    return asyncio.get_running_loop().time()
