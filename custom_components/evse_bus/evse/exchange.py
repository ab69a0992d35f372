"""One exchange on a line: silence, request, answer, time-out.

Frames that answer nothing are handed on, or counted as other people's.
"""

import asyncio
from collections.abc import Callable
from math import inf
from typing import Final

from .errors import (
    EvseError,
    GarbledReplyError,
    LineBusyError,
    LineLostError,
    ReplyTimeoutError,
)
from .framing import Frame, Framer, Timing
from .line import Line
from .statistics import BusStatistics, ChargerStatistics, Direction, FrameLog

_BASE_REQUEST: Final = 64
"""Longest request of a conversation that belongs to no charger, bytes."""


type Request = bytes | Callable[[], bytes]
"""What to send; a function is asked when the line is quiet, right before it goes."""


class Wire:
    """A line with frames on it; one exchange at a time."""

    def __init__(self, line: Line, framer: Framer[Frame], timing: Timing) -> None:
        """Listen to a line; `Line.open` is the caller's."""
        self.line = line
        self.timing = timing
        self.statistics = BusStatistics()
        self.frames = FrameLog()
        self.on_unsolicited: Callable[[Frame], bool] = lambda _frame: False
        """Called with a good frame that is no answer; returns whether it was ours."""
        self.sent_at: float | None = None
        """Loop time at which the last request had left; ``None``: it did not."""
        self._framer = framer
        self._heard_at = -inf
        self._pending: _PendingReply | None = None
        line.on_data = self._on_data

    def exchange_time(self, request_bytes: int = _BASE_REQUEST) -> float:
        """Return the longest time an exchange can take, time-out included, s."""
        timing = self.timing
        # Where silence is asked for, others may keep us waiting for it.
        silence = timing.silence_patience if timing.silence else 0.0
        wire = (request_bytes + timing.longest_reply) * self.line.settings.byte_time
        return silence + wire + timing.reply_timeout + timing.gap

    def send_time(self, request_bytes: int) -> float:
        """Return the longest time it can take to send what nobody answers, s."""
        silence = self.timing.silence_patience if self.timing.silence else 0.0
        return silence + request_bytes * self.line.settings.byte_time

    def reset(self) -> None:
        """Forget a frame begun: the line was opened anew."""
        self._framer.reset()

    def fail(self, error: LineLostError) -> None:
        """End the exchange under way: the line is gone."""
        if self._pending is not None:
            self._pending.fail(error)

    async def exchange[F: Frame, T](
        self,
        request: Request,
        accept: Callable[[F], T | None],
        counted: ChargerStatistics,
        *,
        reply_may_equal: bool = False,
        patience: float = 0.0,
    ) -> T:
        """Send a request and wait for its answer (see `Turn.exchange`)."""
        self.sent_at = None
        await self._silence()
        data = request() if callable(request) else request
        loop = asyncio.get_running_loop()
        self._forget_what_has_begun()
        bad, noise = self._framer.bad, self._framer.noise
        started = loop.time()
        sent = self.line.write(data, reply_may_equal=reply_may_equal)
        self.sent_at = sent
        pending = _PendingReply(
            accept,
            first_byte_by=sent + self.timing.reply_timeout + patience,
            longest=self.timing.longest_reply * self.line.settings.byte_time,
            gap=self.timing.gap,
        )
        self._pending = pending
        self.frames.add(Direction.OUT, self._framer.shown(data))
        self.statistics.requests += 1
        counted.requests += 1
        try:
            result = await pending.future
        except ReplyTimeoutError as error:
            self.statistics.timeouts += 1
            counted.timeouts += 1
            self._framer.reset()
            unreadable = self._framer.bad - bad
            if unreadable or self._framer.noise > noise:
                counted.bad_frames += max(unreadable, 1)
                message = "an answer came, but it could not be read"
                raise GarbledReplyError(message) from error
            raise
        finally:
            pending.close()
            self._pending = None
            if pending.answered_at is not None:
                self.line.answered()
                self.statistics.replies += 1
                counted.reply(pending.answered_at - started)
        if not self.line.is_open:
            # Lost in the same breath: nothing may go on from here.
            message = f"{self.line.url} was lost"
            raise LineLostError(message)
        return result  # type: ignore[return-value] # accept's own type

    async def send(self, request: Request) -> float:
        """Send what nobody answers (see `Turn.send`)."""
        self.sent_at = None
        await self._silence()
        data = request() if callable(request) else request
        self._forget_what_has_begun()
        sent = self.line.write(data)
        self.sent_at = sent
        self.frames.add(Direction.OUT, self._framer.shown(data))
        self.statistics.sent_only += 1
        # The line is ours until the last byte has left.
        await asyncio.sleep(sent - asyncio.get_running_loop().time())
        return sent

    async def _silence(self) -> None:
        """Wait until the line has been quiet for as long as the protocol asks."""
        loop = asyncio.get_running_loop()
        patience = loop.time() + self.timing.silence_patience
        while True:
            now = loop.time()
            wait = self.line.last_activity + self.timing.silence - now
            if wait <= 0:
                return
            if now + wait > patience:
                message = "others keep talking, there is no silence to speak in"
                raise LineBusyError(message)
            await asyncio.sleep(wait)

    def _forget_what_has_begun(self) -> None:
        """Forget a frame begun before we speak, but for one that may be unasked.

        A serial port gives it in lumps, and what it tells is told once.
        """
        now = asyncio.get_running_loop().time()
        if not self._framer.unasked or now - self._heard_at > self.timing.gap:
            self._framer.reset()

    def _on_data(self, data: bytes) -> None:
        self._heard_at = asyncio.get_running_loop().time()
        framer = self._framer
        bad, noise = framer.bad, framer.noise
        frames = framer.feed(data)
        if framer.bad > bad or framer.noise > noise:
            self.statistics.bad_frames += framer.bad - bad
            self.statistics.noise_bytes += framer.noise - noise
            self.frames.add(Direction.UNREADABLE, framer.shown(data))
        for frame in frames:
            self.statistics.frames += 1
            self.frames.add(Direction.IN, framer.shown(frame.raw))
            self._on_frame(frame)
        if self._pending is not None and framer.pending:
            self._pending.goes_on()

    def _on_frame(self, frame: Frame) -> None:
        if self._pending is not None and self._pending.offer(frame):
            return
        if self.on_unsolicited(frame):
            self.statistics.unsolicited += 1
        else:
            self.statistics.foreign_frames += 1


class Turn:
    """What a conversation may do in its turn: exchanges, one after the other."""

    def __init__(self, wire: Wire, counted: ChargerStatistics) -> None:
        """Count what is said under one charger's name."""
        self._wire = wire
        self._counted = counted

    @property
    def now(self) -> float:
        """Return the loop time, s."""
        return asyncio.get_running_loop().time()

    @property
    def sent_at(self) -> float | None:
        """Return the loop time at which our last request had left, s.

        ``None``: it was not sent (no silence to speak in, or the line was lost).
        """
        return self._wire.sent_at

    async def exchange[F: Frame, T](
        self,
        request: Request,
        accept: Callable[[F], T | None],
        *,
        reply_may_equal: bool = False,
        patience: float = 0.0,
    ) -> T:
        """Send a request and return what ``accept`` makes of its answer.

        A request that is an order is given as a function: an order lowered while
        we wait for silence must not be overtaken by the one before it.

        ``accept`` sees every good frame that comes: it returns ``None`` for one
        that is not the answer, and raises for an answer that says no.

        ``patience`` is added to the reply time-out, s: the turn must have been given
        the time for it (`FollowUp.worst_case`).

        Raises ReplyTimeoutError, GarbledReplyError, LineBusyError, LineLostError
        and what ``accept`` raises.
        """
        return await self._wire.exchange(
            request,
            accept,
            self._counted,
            reply_may_equal=reply_may_equal,
            patience=patience,
        )

    async def send(self, request: Request) -> float:
        """Send what nobody answers; return the loop time at which it had left.

        For a broadcast and for the answer to somebody's request. A function is asked
        for the bytes when the line is quiet, right before they go. Raises
        LineBusyError and LineLostError.
        """
        return await self._wire.send(request)


class _PendingReply:
    """The wait for one answer: until the first byte, then for as long as they come."""

    def __init__(
        self,
        accept: Callable[..., object | None],
        *,
        first_byte_by: float,
        longest: float,
        gap: float,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self.future: asyncio.Future[object] = self._loop.create_future()
        self.answered_at: float | None = None
        self._accept = accept
        self._gap = gap
        self._first_byte_by = first_byte_by
        self._heard_at = -inf
        # Noise that never ends must not hold the bus: this is the worst case.
        self._last_chance = first_byte_by + longest + gap
        self._timer = self._loop.call_at(first_byte_by, self._time_is_up)

    def offer(self, frame: Frame) -> bool:
        """Return whether this frame was the answer."""
        if self.future.done():
            return False
        try:
            result = self._accept(frame)
        except Exception as error:  # noqa: BLE001 - it must reach whoever asked
            self.future.set_exception(error)
        else:
            if result is None:
                return False
            self.future.set_result(result)
        self.answered_at = self._loop.time()
        return True

    def goes_on(self) -> None:
        """Give a frame that has begun the time to end."""
        self._heard_at = self._loop.time()

    def fail(self, error: EvseError) -> None:
        """End the wait without an answer."""
        if not self.future.done():
            self.future.set_exception(error)

    def _time_is_up(self) -> None:
        if self.future.done():
            return
        until = max(self._first_byte_by, self._heard_at + self._gap)
        until = min(until, self._last_chance)
        if until > self._loop.time():
            self._timer = self._loop.call_at(until, self._time_is_up)
            return
        self.future.set_exception(ReplyTimeoutError("no answer in time"))

    def close(self) -> None:
        """Leave no timer behind."""
        self._timer.cancel()
