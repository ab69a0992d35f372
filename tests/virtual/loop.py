"""The bus thread: an event loop of its own, exact to some tens of microseconds.

A test may block, or fake the time of Home Assistant's loop, without effect on the
virtual bus. So it runs in its own thread, on a clock that is never patched.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import selectors
import threading
import time
from typing import TYPE_CHECKING, Any, TypeVar
import weakref

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

CALL_TIMEOUT = 10.0


class PreciseLoop(asyncio.SelectorEventLoop):
    """An event loop whose timers are not rounded up to whole milliseconds.

    epoll and poll take milliseconds, and asyncio rounds up: a reply of five chunks
    would come milliseconds late. select() takes microseconds.
    """

    # Taken when the module is imported and kept in the class: libraries that freeze
    # time replace the names in modules, and a frozen bus would stand still.
    _clock = staticmethod(time.monotonic)

    def __init__(self) -> None:
        """Make the loop on select()."""
        super().__init__(selectors.SelectSelector())

    def time(self) -> float:
        """Return the real monotonic time."""
        return self._clock()


class BorrowedLoop:
    """The loop of another owner that a bus runs on: its timers end with the bus."""

    def __init__(self, loop: asyncio.AbstractEventLoop | BorrowedLoop) -> None:
        """Borrow a loop."""
        self._loop = loop
        self._timers: weakref.WeakSet[asyncio.TimerHandle] = weakref.WeakSet()

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - of the loop
        """Return anything else of the loop."""
        return getattr(self._loop, name)

    def call_at(
        self,
        when: float,
        callback: Callable[..., object],
        *args: Any,  # noqa: ANN401 - as of a loop
    ) -> asyncio.TimerHandle:
        """Call a function at a time, unless the loop is given back before."""
        timer = self._loop.call_at(when, callback, *args)
        self._timers.add(timer)
        return timer

    def call_later(
        self,
        delay: float,
        callback: Callable[..., object],
        *args: Any,  # noqa: ANN401 - as of a loop
    ) -> asyncio.TimerHandle:
        """Call a function after a time, unless the loop is given back before."""
        return self.call_at(self._loop.time() + delay, callback, *args)

    def give_back(self) -> None:
        """End all timers."""
        for timer in tuple(self._timers):
            timer.cancel()


class _Waiter:
    """A caller that waits until a condition holds."""

    def __init__(self, predicate: Callable[[], object]) -> None:
        """Remember the condition."""
        self.predicate = predicate
        self.future: concurrent.futures.Future[object] = concurrent.futures.Future()
        self.timer: asyncio.TimerHandle | None = None


class LoopThread:
    """A thread with a loop, calls into it, and waiters on its state."""

    def __init__(self, name: str, *, own_thread: bool = True) -> None:
        """Prepare; nothing runs before `start_thread`.

        Without `own_thread` it runs on the loop of its caller, in the time of that loop.
        """
        self._thread_name = name
        self._thread: threading.Thread | None = None
        self._loop: PreciseLoop | BorrowedLoop | None = None
        self._own_thread = own_thread
        self._waiters: list[_Waiter] = []
        self.errors: list[BaseException] = []

    @property
    def loop(self) -> PreciseLoop | BorrowedLoop:
        """Return the running loop."""
        if self._loop is None:
            msg = "the virtual bus is not running"
            raise RuntimeError(msg)
        return self._loop

    @property
    def running(self) -> bool:
        """Return whether the thread runs."""
        return self._loop is not None

    def start_thread(self) -> None:
        """Start the thread and wait until its loop runs."""
        if not self._own_thread:
            self._loop = BorrowedLoop(asyncio.get_running_loop())
            self._thread = threading.current_thread()
            return
        loop = PreciseLoop()
        loop.set_exception_handler(self._on_error)
        ready = threading.Event()

        def run() -> None:
            asyncio.set_event_loop(loop)
            loop.call_soon(ready.set)
            try:
                loop.run_forever()
            finally:
                asyncio.set_event_loop(None)
                loop.close()

        self._thread = threading.Thread(target=run, name=self._thread_name, daemon=True)
        self._thread.start()
        ready.wait()
        self._loop = loop

    def share_thread(self, other: LoopThread) -> None:
        """Run on the thread of another bus."""
        self._loop = BorrowedLoop(other.loop)
        self._thread = other._thread

    def stop_thread(self) -> None:
        """Stop the loop, end the waiters, join the thread."""
        loop, thread = self._loop, self._thread
        if loop is None or thread is None:
            return
        if isinstance(loop, BorrowedLoop):
            self.call(loop.give_back)
        else:
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(loop.stop)
            # Until it has ended, callbacks that are due may still need the loop.
            thread.join(CALL_TIMEOUT)
        self._loop = None
        self._thread = None
        for waiter in self._waiters:
            if not waiter.future.done():
                waiter.future.set_exception(RuntimeError("the virtual bus stopped"))
        self._waiters.clear()

    def call(self, function: Callable[[], T]) -> T:
        """Run a function on the bus thread and return its result."""
        if self._loop is None or threading.current_thread() is self._thread:
            return function()
        return self._submit(function).result(CALL_TIMEOUT)

    async def call_async(self, function: Callable[[], T]) -> T:
        """Run a function on the bus thread without blocking the caller's loop."""
        if self._loop is None:
            return function()
        return await asyncio.wrap_future(self._submit(function))

    def wait_for(self, predicate: Callable[[], T], timeout: float = 5.0) -> T:
        """Block until the predicate is true; return its value.

        It is evaluated on the bus thread after everything that happens there, and at
        every tick. The time-out is real time, counted by the bus; without a thread of
        its own, it is the loop's time, and the loop runs until then.
        """
        future = self._wait(predicate, timeout)
        if not self._own_thread:
            self.loop.run_until_complete(self._ended(future))
        return future.result()  # type: ignore[return-value]

    async def _ended(self, future: concurrent.futures.Future[object]) -> None:
        with contextlib.suppress(Exception):
            await asyncio.wrap_future(future)

    async def wait_for_async(
        self,
        predicate: Callable[[], T],
        timeout: float = 5.0,  # noqa: ASYNC109 - counted by the bus, whose clock is real
    ) -> T:
        """Wait until the predicate is true without blocking the caller's loop."""
        future = self._wait(predicate, timeout)
        return await asyncio.wrap_future(future)  # type: ignore[arg-type]

    def check_waiters(self) -> None:
        """Evaluate the predicates again (on the bus thread)."""
        for waiter in tuple(self._waiters):
            try:
                value = waiter.predicate()
            except Exception as error:  # noqa: BLE001 - raised to the waiting caller
                self._finish(waiter, None, error)
            else:
                if value:
                    self._finish(waiter, value, None)

    def _submit(self, function: Callable[[], T]) -> concurrent.futures.Future[T]:
        future: concurrent.futures.Future[T] = concurrent.futures.Future()

        def run() -> None:
            # The caller may have been cancelled meanwhile.
            if not future.set_running_or_notify_cancel():
                return
            try:
                value = function()
            except BaseException as error:  # noqa: BLE001 - raised to the caller
                future.set_exception(error)
            else:
                future.set_result(value)
            self.check_waiters()

        self.loop.call_soon_threadsafe(run)
        return future

    def _wait(
        self, predicate: Callable[[], object], timeout: float
    ) -> concurrent.futures.Future[object]:
        waiter = _Waiter(predicate)

        def expire() -> None:
            msg = f"not within {timeout} s"
            self._finish(waiter, None, TimeoutError(msg))

        def begin() -> None:
            waiter.timer = self.loop.call_later(timeout, expire)
            self._waiters.append(waiter)
            self.check_waiters()

        if not self._own_thread:
            begin()
            return waiter.future
        if threading.current_thread() is self._thread:
            msg = "the bus thread cannot wait for itself"
            raise RuntimeError(msg)
        self.loop.call_soon_threadsafe(begin)
        return waiter.future

    def _finish(
        self, waiter: _Waiter, value: object, error: BaseException | None
    ) -> None:
        if waiter in self._waiters:
            self._waiters.remove(waiter)
        if waiter.timer is not None:
            waiter.timer.cancel()
        # A cancelled async waiter leaves a cancelled future behind.
        if not waiter.future.set_running_or_notify_cancel():
            return
        if error is not None:
            waiter.future.set_exception(error)
        else:
            waiter.future.set_result(value)

    def _on_error(
        self, loop: asyncio.AbstractEventLoop, context: dict[str, object]
    ) -> None:
        """Keep an error in the virtual chargers: `stop` raises it."""
        error = context.get("exception")
        if isinstance(error, BaseException):
            self.errors.append(error)
        loop.default_exception_handler(context)
