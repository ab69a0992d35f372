"""The wires of the bus: one byte at a time, at the pace of the line.

Everything is scheduled by absolute time, so that errors of single timers do not add
up. Bytes that overlap in time garble each other, for any senders.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from .log import CLIENT, Entry

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable
    from random import Random

    from .faults import Faults
    from .loop import PreciseLoop

EPSILON = 1e-6
# Two drivers at once: no receiver gets either byte. The mask garbles also two equal
# bytes.
COLLISION_MASK = 0x55


@dataclass(slots=True)
class Transmission:
    """Bytes of one sender, back to back from `start` on."""

    source: str
    data: bytes
    start: float
    byte_time: float
    position: int = 0
    received: bytearray = field(default_factory=bytearray)
    collided: bool = False

    @property
    def next_start(self) -> float:
        """Return the time at which the next byte begins."""
        return self.start + self.position * self.byte_time

    @property
    def end(self) -> float:
        """Return the end of the last byte."""
        return self.start + len(self.data) * self.byte_time


@dataclass(slots=True)
class Segment:
    """Bytes received in a row, with the silence before them (s)."""

    start: float
    byte_time: float
    data: bytes
    sources: tuple[str, ...]
    silence_before: float
    lasts: float = 0.0
    """How long the wire was in use, s; 0: for the time of its bytes."""

    @property
    def end(self) -> float:
        """Return the end of the last byte."""
        return self.start + (self.lasts or len(self.data) * self.byte_time)


class Wire:
    """Carries transmissions to the client (chunk by chunk) and to the devices."""

    def __init__(
        self,
        byte_time: float,
        granularity: float,
        faults: Faults,
        rng: Random,
        *,
        duplex: bool = False,
    ) -> None:
        """Make a silent wire; `attach` connects it.

        With `duplex` (RS-232) each direction has its own wire: bytes of the client and
        of the devices do not collide.
        """
        self.byte_time = byte_time
        self.duplex = duplex
        self.faults = faults
        self.collisions = 0
        self.bytes_carried = 0
        self._chunk = max(1, int(granularity / byte_time))
        self._rng = rng
        self._active: list[Transmission] = []
        self._client_free = 0.0
        self._last_end = float("-inf")
        self._segments: list[Segment] = []
        self._to_client = bytearray()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = 0.0
        self._loop: PreciseLoop | None = None

    def attach(
        self,
        loop: PreciseLoop,
        to_client: Callable[[bytes], None],
        to_devices: Callable[[list[Segment]], None],
        on_entry: Callable[[Entry], None],
    ) -> None:
        """Connect the ends."""
        self._loop = loop
        self._deliver_client = to_client
        self._deliver_devices = to_devices
        self._on_entry = on_entry

    @property
    def idle_from(self) -> float:
        """Return the end of all transmissions, scheduled ones included."""
        return max([self._last_end, *(t.end for t in self._active)])

    def free_from(self, source: str) -> float:
        """Return the end of the last transmission of one sender."""
        ends = (t.end for t in self._active if t.source == source)
        return max(ends, default=float("-inf"))

    def audible_until(self, now: float) -> float:
        """Return the end of the transmissions that a listener can detect at `now`.

        A byte is received at its end: a sender that begins before that collides.
        """
        detected = [t.end for t in self._active if t.start + t.byte_time <= now]
        return max([self._last_end, *detected])

    @property
    def last_end(self) -> float:
        """Return the end of the last byte received."""
        return self._last_end

    def begun_before(self, at: float, listener: str) -> bool:
        """Return whether another transmission that still goes on had begun by then."""
        return any(t.start <= at and t.source != listener for t in self._active)

    def busy(self, now: float) -> bool:
        """Return whether there is a transmission now."""
        return any(t.start <= now < t.end for t in self._active)

    def send_client(self, data: bytes) -> None:
        """Take bytes that the client wrote: they leave its UART one by one."""
        if self._loop is None:
            return
        start = max(self._loop.time(), self._client_free)
        last = next((t for t in reversed(self._active) if t.source == CLIENT), None)
        if last is not None and start - last.end <= EPSILON:
            # Still sending: the new bytes follow without a gap.
            last.data += data
            self._client_free = last.end
            self._schedule()
            return
        self.send(CLIENT, data, start)
        self._client_free = start + len(data) * self.byte_time

    def send(self, source: str, data: bytes, start: float) -> None:
        """Put bytes on the wire from `start` on (not in the past)."""
        if not data:
            return
        self._active.append(Transmission(source, data, start, self.byte_time))
        self._schedule()

    def drop_pending(self) -> None:
        """Stop all senders at once; the bytes sent so far are logged."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        for transmission in self._active:
            self._log(transmission)
        self._active.clear()

    def _schedule(self) -> None:
        """Set the timer to the next delivery."""
        if not self._active or self._loop is None:
            return
        when = min(self._due(t) for t in self._active)
        if self._timer is not None:
            if self._timer_at <= when:
                return
            self._timer.cancel()
        self._timer_at = when
        self._timer = self._loop.call_at(when, self._pump)

    def _due(self, transmission: Transmission) -> float:
        if transmission.source == CLIENT and not self.faults.echo:
            # Without an echo only devices receive them: a whole run of bytes at its end.
            return transmission.end
        chunk_end = transmission.position + self._chunk
        return min(
            transmission.end, transmission.start + chunk_end * transmission.byte_time
        )

    def _pump(self) -> None:
        """Deliver everything that is due."""
        self._timer = None
        if self._loop is None:
            return
        now = self._loop.time() + EPSILON
        finished = False
        while self._active and self._step(now):
            done = [t for t in self._active if t.position >= len(t.data)]
            for transmission in done:
                self._active.remove(transmission)
                self._log(transmission)
                finished = True
        if self._to_client:
            data = bytes(self._to_client)
            self._to_client.clear()
            self._deliver_client(data)
        if finished:
            segments, self._segments = self._segments, []
            self._deliver_devices(segments)
        self._schedule()

    def _step(self, now: float) -> bool:
        """Carry the earliest bytes; return False if none is complete by now."""
        first = min(self._active, key=lambda t: t.next_start)
        others = [t for t in self._active if t is not first and self._meet(t, first)]
        bt = first.byte_time
        complete = int((now - first.start) / bt)
        complete = min(complete, len(first.data)) - first.position
        if complete <= 0:
            return False
        alone_until = min((t.next_start for t in others), default=float("inf"))
        if alone_until < first.end - EPSILON:
            alone = int((alone_until - first.start + EPSILON) / bt) - first.position
            complete = min(complete, alone)
        start = first.next_start
        if complete > 0:
            sent = first.data[first.position : first.position + complete]
            first.position += complete
            data = self.faults.disturb(sent, self._rng)
            first.received += data
            self._receive(start, data, (first.source,), complete * bt)
            return True
        self._collide(first, others, start)
        return True

    def _meet(self, one: Transmission, other: Transmission) -> bool:
        """Return whether two transmissions use the same wire."""
        return not self.duplex or (one.source == CLIENT) == (other.source == CLIENT)

    def _collide(
        self, first: Transmission, others: list[Transmission], start: float
    ) -> None:
        """Garble one byte with all that begin before its end."""
        value = first.data[first.position] ^ COLLISION_MASK
        together = [first]
        for other in others:
            if other.next_start < start + first.byte_time - EPSILON:
                value ^= other.data[other.position]
                together.append(other)
        for transmission in together:
            transmission.position += 1
            transmission.received.append(value)
            if not transmission.collided:
                transmission.collided = True
                self.collisions += 1
        sources = tuple(sorted({t.source for t in together}))
        self._receive(start, bytes((value,)), sources, first.byte_time)

    def _receive(
        self, start: float, data: bytes, sources: tuple[str, ...], lasts: float
    ) -> None:
        """Receive bytes for which the wire was in use so long, s.

        A byte error may have removed bytes, or added some.
        """
        silence = start - self._last_end
        # On two wires the other direction may already be further.
        self._last_end = max(self._last_end, start + lasts)
        self.bytes_carried += len(data)
        if sources != (CLIENT,) or self.faults.echo:
            self._to_client += data
        last = self._segments[-1] if self._segments else None
        if last is not None and last.sources == sources and silence < EPSILON:
            last.data += data
            last.lasts += lasts
        elif data:
            self._segments.append(
                Segment(start, self.byte_time, data, sources, silence, lasts)
            )

    def _log(self, transmission: Transmission) -> None:
        self._on_entry(
            Entry(
                transmission.start,
                transmission.end,
                transmission.source,
                transmission.data,
                bytes(transmission.received),
                transmission.collided,
            )
        )
