"""Adapters that speak Modbus TCP in place of passing bytes on.

Such a gateway expects each request behind an MBAP header (transaction, protocol 0,
length) and makes a Modbus RTU request of it. None of our requests has that header, and
no charger is reached, whatever its protocol. What gateways do with our bytes differs:

- they close the connection, because the protocol in the header is not 0;
- they answer with a header of their own, mostly an exception;
- they drop them, or wait for as many bytes as the wrong header announces.

The last kind is recognised only when it is asked in its own words. Those bytes must
harm no charger if the adapter passes them on after all: `PROBE` and `NOT_MBAP` have no
byte that begins a message of EVBox, EWS (0x02) or ABL (0x3A), and no part of them is a
Modbus RTU frame with a valid CRC. A gateway makes a read at unit 247 of the probe, an
address that no charger of this library has.
"""

import asyncio
from collections.abc import Callable
from math import inf
from typing import Final

from .errors import LineError
from .framing import LineSettings
from .line import Line

PROBE: Final = bytes.fromhex("F5A0 0000 0006 F7 04 0000 0001")
"""A read of one input register at unit 247, with an MBAP header."""
NOT_MBAP: Final = bytes.fromhex("FFFF FFFF FFFF FFFF")
"""As long as a header, and none: its protocol is not 0."""
PATIENCE: Final = 3.5
"""Longest wait for an answer of a gateway, s: it waits for its unit first."""
AT_ONCE: Final = 0.25
"""A connection was closed because of a request if not later than this after it, s. No
adapter closes a connection that has been idle for so short a time."""
STEADY: Final = 1.0
"""One that has lasted so long without a byte was not refused as a whole, s."""
CLOSINGS: Final = 3
"""Connections in a row that a request has ended, from which it is a gateway."""

_HEADER: Final = 6
_SHORTEST: Final = _HEADER + 3
_KEPT: Final = 64


def is_reply(request: bytes, received: bytes) -> bool:
    """Return whether bytes are what a gateway answers to a request, MBAP or not.

    It repeats the transaction (our first two bytes), unit and function.
    """
    if len(received) < _SHORTEST or len(request) <= _HEADER + 1:
        return False
    length = int.from_bytes(received[4:6])
    return (
        received[:2] == request[:2]
        and received[2:4] == b"\0\0"
        and len(received) == _HEADER + length
        and received[6] == request[6]
        and received[7] & 0x7F == request[7] & 0x7F
    )


class GatewayWatch:
    """Evidence that an adapter speaks Modbus TCP; of one line, over all connections."""

    def __init__(self) -> None:
        """Start without evidence."""
        self.detected = False
        self.on_changed: Callable[[], None] = lambda: None
        """Called when `detected` has changed."""
        self.ever_understood = False
        """A good frame was received: it passes bytes on."""
        self._requests = (b"", b"")
        """The last two: a gateway may need more than one of ours for its header."""
        self._received = bytearray()
        self._any_received = False
        self._used_at = -inf
        """When the connection was opened, or the last request was sent on it."""
        self._idle = 0.0
        """How long it was idle before that request."""
        self._any_sent = False
        self._quick = 0
        self._certain = 0

    @property
    def suspected(self) -> bool:
        """Return whether a new connection should be left alone for `STEADY`.

        Requests seem to end the connections; only then it is seen that they do.
        """
        return self._quick > 1

    def opened(self, now: float) -> None:
        """Take note of a new connection; ``now``: loop time, s."""
        self._used_at = now
        self._any_sent = self._any_received = False
        self._requests = (b"", b"")
        self._received.clear()

    def sent(self, data: bytes, now: float) -> None:
        """Take note of a request."""
        self._requests = (self._requests[1], data)
        self._received.clear()
        self._idle, self._used_at = now - self._used_at, now
        self._any_sent = True

    def received(self, data: bytes) -> None:
        """Take note of received bytes; a good frame among them is `understood`."""
        self._quick = self._certain = 0
        self._any_received = True
        self._received += data[: _KEPT - len(self._received)]

    def understood(self) -> None:
        """Take note of a good frame: the adapter passes bytes on."""
        self.ever_understood = True
        self._received.clear()
        self._set(detected=False)

    def unanswered(self) -> None:
        """Take note that no good reply has come to the request."""
        last_two, received = b"".join(self._requests), bytes(self._received)
        if is_reply(self._requests[1], received) or is_reply(last_two, received):
            self._set(detected=True)

    def lost(self, now: float) -> None:
        """Take note that the other end has closed the connection."""
        at_once = self._any_sent and now - self._used_at <= AT_ONCE
        if self._any_received or not at_once:
            self._quick = self._certain = 0
            return
        self._quick += 1
        if self._idle >= STEADY:
            self._certain += 1
            if self._certain >= CLOSINGS:
                self._set(detected=True)

    def _set(self, *, detected: bool) -> None:
        if detected != self.detected:
            self.detected = detected
            self.on_changed()


async def speaks_modbus_tcp(url: str, settings: LineSettings, *, closes: bool) -> bool:
    """Return whether a network adapter speaks Modbus TCP.

    ``closes``: it has closed the connection. The port must not be open. Nothing is sent
    that a charger could take for a request.
    """
    if not Line(url, settings).is_network:
        return False
    try:
        return await _answers_probe(url, settings) or (
            closes and await _ends_at_request(url, settings)
        )
    except LineError:
        return False


async def _answers_probe(url: str, settings: LineSettings) -> bool:
    line, watch = Line(url, settings), GatewayWatch()
    line.on_data = watch.received
    await line.open()
    try:
        loop = asyncio.get_running_loop()
        watch.sent(PROBE, loop.time())
        line.write(PROBE)
        until = loop.time() + PATIENCE
        while line.is_open and not watch.detected and loop.time() < until:
            await asyncio.sleep(0.1)
            watch.unanswered()
    finally:
        await line.close()
    return watch.detected


async def _ends_at_request(url: str, settings: LineSettings) -> bool:
    line, watch = Line(url, settings), GatewayWatch()
    loop = asyncio.get_running_loop()
    line.on_data = watch.received
    line.on_lost = lambda _error: watch.lost(loop.time())
    for _ in range(CLOSINGS):
        await line.open()
        watch.opened(loop.time())
        await asyncio.sleep(STEADY)
        if line.is_open:
            watch.sent(NOT_MBAP, loop.time())
            line.write(NOT_MBAP)
            await asyncio.sleep(AT_ONCE)
        if line.is_open:
            await line.close()
            return False
    return watch.detected
