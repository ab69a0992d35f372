"""One exchange on a line: silence, request, reply, time-out.

A frame that matches no request is passed on as unsolicited, or counted as foreign.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
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
from .gateway import PATIENCE, PROBE, GatewayWatch
from .line import Line
from .recovery import LineRecovery
from .round_trip import RoundTrip
from .statistics import BusStatistics, ChargerStatistics, Direction, FrameLog

_LATEST: Final = 10.0
"""Time after which no reply to a request comes, on any line, s."""
_LATER: Final = 1.25
"""Of two round trips of one line, the later one may take so much longer."""
_BASE_REQUEST: Final = 64
"""Longest request of a conversation that belongs to no charger, bytes."""


type Request = bytes | Callable[[], bytes]
"""Bytes to send, or a function that returns them, called right before they are sent."""


class AllReplies[F: Frame, T]:
    """Accepts a reply as another function does; none of them ends the exchange."""

    def __init__(self, accept: Callable[[F], T | None]) -> None:
        """``accept`` returns ``None`` for a frame that is no reply."""
        self._accept = accept
        self.replies: list[T] = []

    def __call__(self, frame: F) -> T | None:
        """Keep the reply and return it."""
        if (reply := self._accept(frame)) is not None:
            self.replies.append(reply)
        return reply


class Wire:
    """A line with frames on it; one exchange at a time."""

    def __init__(self, line: Line, framer: Framer[Frame], timing: Timing) -> None:
        """Receive from a line; its caller opens it."""
        self.line = line
        self.timing = timing
        self.statistics = BusStatistics()
        self.frames = FrameLog()
        self.recovery = LineRecovery()
        self.round_trip = RoundTrip(timing)
        self.gateway = GatewayWatch()
        self.on_times_changed: Callable[[], None] = lambda: None
        """Called when exchanges take another time than before, usually or at worst."""
        self.on_unsolicited: Callable[[Frame], bool] = lambda _frame: False
        """Called with a good frame that is no reply; returns whether it was used."""
        self.sent_at: float | None = None
        """Loop time at which the last request had been sent, s; ``None``: it was not."""
        self._framer = framer
        self._received_at = -inf
        self._pending: _PendingReply | None = None
        self._unanswered: list[_Unanswered] = []
        """Requests whose replies may still come, oldest first."""
        line.on_data = self._on_data

    def exchange_time(self, request_bytes: int = _BASE_REQUEST) -> float:
        """Return the longest time an exchange can take, time-out included, s."""
        timing = self.timing
        # Where silence is required, other masters may delay it.
        silence = timing.silence_patience if timing.silence else 0.0
        wire = (request_bytes + timing.longest_reply) * self.line.settings.byte_time
        trip = self.round_trip
        return silence + wire + trip.timeout + trip.drain + timing.gap

    def usual_time(self, request_bytes: int = _BASE_REQUEST) -> float | None:
        """Return the time an exchange usually takes, s; ``None``: no reply yet."""
        if (trip := self.round_trip.usual) is None:
            return None
        request = request_bytes * self.line.settings.byte_time
        return self.timing.silence + request + trip

    def lost_time(self, request_bytes: int = _BASE_REQUEST) -> float:
        """Return the time an exchange takes whose reply does not come, s."""
        request = request_bytes * self.line.settings.byte_time
        trip = self.round_trip
        return self.timing.silence + request + trip.timeout + trip.drain

    def send_time(self, request_bytes: int) -> float:
        """Return the longest time that sending without a reply can take, s."""
        silence = self.timing.silence_patience if self.timing.silence else 0.0
        return silence + request_bytes * self.line.settings.byte_time

    def reset(self) -> None:
        """Drop an incomplete frame: the line was opened anew."""
        self._framer.reset()
        self._unanswered.clear()
        self.recovery.opened(asyncio.get_running_loop().time())

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
        """Send a request and wait for its reply (see `Turn.exchange`)."""
        self.sent_at = None
        await self._drain()
        await self._silence()
        data = request() if callable(request) else request
        loop = asyncio.get_running_loop()
        self._drop_incomplete_frame()
        bad, noise = self._framer.bad, self._framer.noise
        started = loop.time()
        self.gateway.sent(data, started)
        sent = self.line.write(data, reply_may_equal=reply_may_equal)
        self.sent_at = self.line.memory.sent_at = sent
        pending = _PendingReply(
            accept,
            first_byte_by=sent + self.round_trip.timeout + patience,
            longest=self.timing.longest_reply * self.line.settings.byte_time,
            gap=self.timing.gap,
        )
        self._pending = pending
        self.frames.add(Direction.OUT, self._framer.redacted(data))
        self.statistics.requests += 1
        counted.requests += 1
        self.recovery.asked()
        try:
            await pending.future
            pending = await self._last_reply(pending, accept, sent)
            result = pending.future.result()
        except ReplyTimeoutError as error:
            self.statistics.timeouts += 1
            counted.timeouts += 1
            if self._received_at < started:
                self.recovery.unanswered(loop.time())
            self.gateway.unanswered()
            self._unanswered.append(_Unanswered(accept, sent, loop.time()))
            self._framer.reset()
            if self._is_disturbed(bad, noise, counted):
                message = "a reply came, but it could not be read"
                raise GarbledReplyError(message) from error
            raise
        finally:
            pending.close()
            self._pending = None
            if pending.answered_at is not None:
                self._note_reply()
                counted.reply(pending.answered_at - started)
                if not patience and self._late_request(pending.frame) is None:
                    self._measure(pending.answered_at - sent)
        if not self.line.is_open:
            # Lost together with the reply: the conversation must not go on.
            message = f"{self.line.url} was lost"
            raise LineLostError(message)
        if isinstance(accept, AllReplies):
            self._framer.reset()
            if self._is_disturbed(bad, noise, counted):
                raise GarbledReplyError("unreadable bytes came beside a reply")
        return result  # type: ignore[return-value] # accept's own type

    def _note_reply(self) -> None:
        self.line.answered()
        self.recovery.answered()
        self.statistics.replies += 1

    async def _last_reply(
        self,
        pending: _PendingReply,
        accept: Callable[..., object | None],
        sent: float,
    ) -> _PendingReply:
        """Return the reply to a request sent then; ``pending``: the first that came.

        On a line of which nothing is known, that may be the late reply to an earlier
        request. The one to this request takes as long, so another one must follow.
        """
        if isinstance(accept, AllReplies):
            return pending
        while (
            self.round_trip.mean is None
            and pending.answered_at is not None
            and (earlier := self._late_request(pending.frame)) is not None
        ):
            wait = _LATER * (pending.answered_at - earlier.sent_at)
            newer = _PendingReply(
                accept,
                first_byte_by=sent + min(wait, self.round_trip.longest),
                longest=self.timing.longest_reply * self.line.settings.byte_time,
                gap=self.timing.gap,
            )
            self._pending = newer
            self._unanswered.remove(earlier)
            try:
                await newer.future
            except ReplyTimeoutError:
                # The earlier request was lost: a box was asleep.
                break
            finally:
                newer.close()
            self.statistics.late += 1
            pending.close()
            pending = newer
        return pending

    def _is_disturbed(self, bad: int, noise: int, counted: ChargerStatistics) -> bool:
        """Return whether unreadable bytes came since these counts, and count them."""
        unreadable = self._framer.bad - bad
        if not unreadable and self._framer.noise == noise:
            return False
        counted.bad_frames += max(unreadable, 1)
        return True

    async def send(self, request: Request) -> float:
        """Send without waiting for a reply (see `Turn.send`)."""
        self.sent_at = None
        await self._silence()
        data = request() if callable(request) else request
        self._drop_incomplete_frame()
        sent = self.line.write(data)
        self.sent_at = self.line.memory.sent_at = sent
        self.frames.add(Direction.OUT, self._framer.redacted(data))
        self.statistics.sent_only += 1
        # The line is in use until the last byte has been sent.
        await asyncio.sleep(sent - asyncio.get_running_loop().time())
        return sent

    async def ask_gateway(self) -> None:
        """Ask an adapter behind which nothing answers whether it speaks Modbus TCP.

        To be called right after the connection was opened. Raises LineBusyError and
        LineLostError.
        """
        await self._silence()
        loop = asyncio.get_running_loop()
        self.gateway.sent(PROBE, loop.time())
        self.line.write(PROBE)
        self.frames.add(Direction.OUT, PROBE)
        await asyncio.sleep(PATIENCE)
        self.gateway.unanswered()
        self._framer.reset()

    async def _drain(self) -> None:
        """Wait for the late reply to a request that has timed out, on a slow line."""
        if not self._unanswered:
            return
        loop = asyncio.get_running_loop()
        last = self._unanswered[-1]
        wait = last.timed_out_at + self.round_trip.drain - loop.time()
        if wait > 0:
            await asyncio.sleep(wait)
        since = loop.time() - max(self.round_trip.longest, _LATEST)
        self._unanswered = [one for one in self._unanswered if one.sent_at >= since]

    def _late_request(self, frame: Frame | None) -> _Unanswered | None:
        """Return the oldest request that has timed out and has this reply, if any.

        So a reply that may be that of an earlier request is not measured.
        """
        return next((one for one in self._unanswered if one.accepts(frame)), None)

    def _measure(self, round_trip: float) -> None:
        if self.round_trip.measure(round_trip):
            self.on_times_changed()

    def _is_late(self, frame: Frame) -> bool:
        """Return whether a frame is a late reply; its contents are not used."""
        request = self._late_request(frame)
        if request is None:
            return False
        self._unanswered.remove(request)
        self.statistics.late += 1
        now = asyncio.get_running_loop().time()
        self._measure(now - request.sent_at)
        return True

    async def _silence(self) -> None:
        """Wait until the line has been quiet for as long as the protocol requires."""
        loop = asyncio.get_running_loop()
        patience = loop.time() + self.timing.silence_patience
        while True:
            now = loop.time()
            wait = self.line.last_activity + self.timing.silence - now
            if wait <= 0:
                return
            if now + wait > patience:
                message = "the line is never quiet for long enough to send"
                raise LineBusyError(message)
            await asyncio.sleep(wait)

    def _drop_incomplete_frame(self) -> None:
        """Drop a frame that has not ended before a request, unless it is unsolicited.

        Serial ports deliver such a frame in chunks, and it is sent only once.
        """
        now = asyncio.get_running_loop().time()
        if not self._framer.unsolicited or now - self._received_at > self.timing.gap:
            self._framer.reset()

    def _on_data(self, data: bytes) -> None:
        self._received_at = asyncio.get_running_loop().time()
        self.recovery.received()
        self.gateway.received(data)
        framer = self._framer
        bad, noise = framer.bad, framer.noise
        frames = framer.feed(data)
        if framer.bad > bad or framer.noise > noise:
            self.statistics.bad_frames += framer.bad - bad
            self.statistics.noise_bytes += framer.noise - noise
            self.frames.add(Direction.UNREADABLE, framer.redacted(data))
        if frames:
            self.gateway.understood()
        for frame in frames:
            self.statistics.frames += 1
            self.frames.add(Direction.IN, framer.redacted(frame.raw))
            self._on_frame(frame)
        if self._pending is not None and framer.pending:
            self._pending.extend()

    def _on_frame(self, frame: Frame) -> None:
        if self._pending is not None and self._pending.offer(frame):
            return
        if self._is_late(frame):
            return
        self.statistics.foreign_requests += frame.is_request
        if self.on_unsolicited(frame):
            self.statistics.unsolicited += 1
        else:
            self.statistics.foreign_frames += 1


class Turn:
    """The turn of a conversation: exchanges, one after the other."""

    def __init__(self, wire: Wire, counted: ChargerStatistics) -> None:
        """Count its exchanges in the statistics of one charger."""
        self._wire = wire
        self._counted = counted

    @property
    def now(self) -> float:
        """Return the loop time, s."""
        return asyncio.get_running_loop().time()

    @property
    def sent_at(self) -> float | None:
        """Return the loop time at which the last request had been sent, s.

        ``None``: it was not sent (the line was never quiet, or was lost).
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
        """Send a request and return the result of ``accept`` for its reply.

        A request that carries an order is a function: an order lowered while the line
        is not quiet must not be overtaken by the one before it.

        ``accept`` gets every good frame: it returns ``None`` for one that is not the
        reply, and raises for a refusal.

        ``patience`` is added to the reply time-out, s: the worst case of the turn must
        include it (see `rest`).

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

    async def collect[F: Frame, T](
        self, request: Request, accept: Callable[[F], T | None]
    ) -> list[T]:
        """Send a request and return all replies that come within the reply time-out.

        No reply ends the exchange: that of a second, slower charger is among them, and
        cannot fall into the next exchange. Raises GarbledReplyError also where
        unreadable bytes came beside a reply, else as `exchange`.
        """
        collector = AllReplies(accept)
        await self._wire.exchange(request, collector, self._counted)
        return collector.replies

    async def send(self, request: Request) -> float:
        """Send without waiting for a reply; return the loop time of the end, s.

        For a broadcast, and for the reply to a request of a charger. Raises
        LineBusyError and LineLostError.
        """
        return await self._wire.send(request)


@dataclass(frozen=True, slots=True)
class _Unanswered:
    """A request that has timed out, and whose reply may still come."""

    accept: Callable[..., object | None]
    sent_at: float
    timed_out_at: float

    def accepts(self, frame: Frame | None) -> bool:
        """Return whether a frame is its reply, a refusal included."""
        try:
            return self.accept(frame) is not None
        except EvseError:
            return True


class _PendingReply:
    """The wait for one reply: for its first byte, then for as long as bytes come."""

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
        self.frame: Frame | None = None
        """Its reply."""
        self._accept = accept
        self._gap = gap
        self._first_byte_by = first_byte_by
        self._received_at = -inf
        # Endless noise must not hold the bus: this is the worst case.
        self._last_chance = first_byte_by + longest + gap
        self._timer = self._loop.call_at(first_byte_by, self._time_is_up)

    def offer(self, frame: Frame) -> bool:
        """Return whether this frame was the reply."""
        if self.future.done():
            return False
        try:
            result = self._accept(frame)
        except Exception as error:  # noqa: BLE001 - it is for the caller
            self.future.set_exception(error)
        else:
            if result is None:
                return False
            if not isinstance(self._accept, AllReplies):
                self.future.set_result(result)
        if self.answered_at is None:
            self.answered_at = self._loop.time()
            self.frame = frame
        return True

    def extend(self) -> None:
        """Give an incomplete frame the time to end."""
        self._received_at = self._loop.time()

    def fail(self, error: EvseError) -> None:
        """End the wait without a reply."""
        if not self.future.done():
            self.future.set_exception(error)

    def _time_is_up(self) -> None:
        if self.future.done():
            return
        until = max(self._first_byte_by, self._received_at + self._gap)
        until = min(until, self._last_chance)
        if until > self._loop.time():
            self._timer = self._loop.call_at(until, self._time_is_up)
            return
        if isinstance(self._accept, AllReplies) and self._accept.replies:
            self.future.set_result(self._accept.replies[0])
        else:
            self.future.set_exception(ReplyTimeoutError("no reply in time"))

    def close(self) -> None:
        """Leave no timer behind."""
        self._timer.cancel()
