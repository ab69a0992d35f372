"""A line that is opened by the box: it is the client and dials us (manual, 3.1.4.2).

The protocol has no authentication: any device may connect. So its time and bytes are
limited, and no data are logged.
"""

import asyncio
from collections.abc import Callable
from ipaddress import IPv4Address, IPv6Address, ip_address
import logging
from typing import ClassVar, Final, override

from ...errors import LineLostError, PortMissingError
from ...line import Line
from ...memory import LineMemory
from ..timing import SETTINGS
from ..wire.frames import LONGEST_FRAME

_LOGGER = logging.getLogger(__name__)

type Address = IPv4Address | IPv6Address

ANSWER_PATIENCE: Final = 15.0
"""A connection ends when commands are left unanswered for so long, s."""
MOST_NOISE: Final = LONGEST_FRAME
"""Most bytes of no message between two replies; more end a connection."""
MOST_BYTES: Final = 8 * LONGEST_FRAME
"""Most bytes of any kind between two replies; more end a connection."""
_PIECE: Final = 256
"""So many bytes are searched for messages before they are counted."""


class Connection(asyncio.Protocol):
    """One accepted connection; its bytes go to a line, or are kept for one."""

    def __init__(
        self,
        on_made: Callable[[Connection], None],
        on_gone: Callable[[Connection], None],
        may_receive: Callable[[Connection, int], bool],
    ) -> None:
        """Call ``on_made`` once it is open, and ``on_gone`` once it has ended.

        ``may_receive`` is called with the number of bytes that have arrived at once;
        it returns whether they may be looked at. If not, the connection ends.
        """
        self._on_made = on_made
        self._on_gone = on_gone
        self._may_receive = may_receive
        self._transport: asyncio.Transport | None = None
        self._waiting = b""
        self.line: AcceptedLine | None = None
        self.memory = LineMemory()
        """What its identification has learnt of the box."""
        self.peer: Address | None = None

    @property
    def is_open(self) -> bool:
        """Return whether it is open."""
        return self._transport is not None

    @override
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        if not isinstance(transport, asyncio.Transport):
            raise TypeError(type(transport).__name__)
        self._transport = transport
        self.peer = _address(transport.get_extra_info("peername"))
        self._on_made(self)

    @override
    def data_received(self, data: bytes) -> None:
        if not self._may_receive(self, len(data)):
            self.abort()
        elif self.line is not None:
            self.line.received(data)
        elif len(self._waiting) + len(data) > MOST_BYTES:
            self.abort()
        else:
            self._waiting += data

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        self._ended(exc)

    def keep(self, data: bytes) -> None:
        """Keep bytes for the next line."""
        self._waiting = (self._waiting + data)[-MOST_BYTES:]

    def hand_over(self) -> None:
        """Give the line the bytes that were kept."""
        waiting, self._waiting = self._waiting, b""
        if self.line is not None and waiting:
            self.line.received(waiting)

    def write(self, data: bytes) -> None:
        """Send bytes; raises LineLostError when it has ended."""
        if self._transport is None or self._transport.is_closing():
            raise LineLostError("the connection was closed")
        self._transport.write(data)

    def close(self) -> None:
        """End it, without waiting for bytes not sent yet."""
        transport = self._transport
        if transport is None:
            return
        self._ended(None)
        if transport.get_write_buffer_size():
            transport.abort()
        else:
            transport.close()

    def abort(self) -> None:
        """End it at once."""
        transport = self._transport
        if transport is not None:
            self._ended(None)
            transport.abort()

    def _ended(self, error: Exception | None) -> None:
        if self._transport is None:
            return
        self._transport = None
        self._waiting = b""
        line, self.line = self.line, None
        if line is not None:
            line.lost(error)
        self._on_gone(self)


def _address(peer: object) -> Address | None:
    if not isinstance(peer, tuple) or not peer:
        return None
    address = ip_address(str(peer[0]).partition("%")[0])
    return getattr(address, "ipv4_mapped", None) or address


class AcceptedLine(Line):
    """The line of one box, over all of its connections.

    It cannot be opened from here: the listener attaches a connection (`attach`), which
    the next `open` begins with.
    """

    opened_by_peer: ClassVar = True

    def __init__(self, name: str, noise: Callable[[], int]) -> None:
        """``noise`` returns the bytes received that belong to no message."""
        super().__init__(name, SETTINGS)
        self.echoes = False
        self.on_answered: Callable[[], None] = lambda: None
        """Called with each reply."""
        self._noise = noise
        self._noise_before = 0
        self._bytes_before = 0
        self._next: Connection | None = None
        self._connection: Connection | None = None
        self._watch: asyncio.TimerHandle | None = None
        self._proof: asyncio.Future[bool] | None = None

    @property
    @override
    def is_open(self) -> bool:
        return self._connection is not None

    def attach(self, connection: Connection) -> None:
        """Use this connection with the next `open`; one that still waits is ended."""
        if self._next is not None:
            self._next.abort()
        self._next = connection

    @override
    async def open(self) -> None:
        """Use the connection that waits; raises PortMissingError without one."""
        connection, self._next = self._next, None
        if connection is None or not connection.is_open:
            message = f"{self.url} has not connected"
            raise PortMissingError(message)
        self._connection = connection
        connection.line = self
        self.statistics.opened += 1
        self._note_progress()
        loop = asyncio.get_running_loop()
        self.last_activity = loop.time()
        # The caller gets ready first, then come the bytes received so far.
        loop.call_soon(connection.hand_over)

    @property
    def peer(self) -> Address | None:
        """Return the address of the other end; ``None``: it is not connected."""
        return None if self._connection is None else self._connection.peer

    def release(self) -> None:
        """Give the connection up, for another line."""
        self._connection = None
        self._stop_watch()

    @override
    async def close(self) -> None:
        connection, self._connection = self._connection, None
        waiting, self._next = self._next, None
        self._stop_watch()
        for one in (connection, waiting):
            if one is not None:
                one.line = None
                one.close()

    @override
    def write(self, data: bytes, *, reply_may_equal: bool = False) -> float:
        if self._connection is None:
            message = f"{self.url} is not connected"
            raise LineLostError(message)
        self._connection.write(data)
        self.statistics.bytes_out += len(data)
        loop = asyncio.get_running_loop()
        if self._watch is None:
            self._watch = loop.call_later(ANSWER_PATIENCE, self.end, "no answer")
        self.last_activity = loop.time()
        return self.last_activity

    def received(self, data: bytes) -> None:
        """Take bytes of the connection; too many without a reply end it."""
        # Garbage is searched for messages in pieces, up to the limit that ends the
        # connection.
        for at in range(0, len(data), _PIECE):
            if self._connection is None:
                return
            self._received(data[at : at + _PIECE])
            if self.statistics.bytes_in - self._bytes_before > MOST_BYTES:
                self.end("too many bytes")
            elif self._noise() - self._noise_before > MOST_NOISE:
                self.end("no message in so many bytes")

    @override
    def answered(self) -> None:
        self._note_progress()
        self.on_answered()
        if self._proof is not None and not self._proof.done():
            self._proof.set_result(True)

    def _note_progress(self) -> None:
        self._noise_before = self._noise()
        self._bytes_before = self.statistics.bytes_in
        self._stop_watch()

    def _stop_watch(self) -> None:
        if self._watch is not None:
            self._watch.cancel()
            self._watch = None

    async def answers(self, patience: float) -> bool:
        """Return whether the connection answers a command within this time, s.

        The command is the bus's, which has to be asked to poll at once.
        """
        if self._connection is None:
            return False
        self._proof = asyncio.get_running_loop().create_future()
        try:
            async with asyncio.timeout(patience):
                return await self._proof
        except TimeoutError:
            return False
        finally:
            self._proof = None

    def end(self, why: str) -> None:
        """End the connection; for the bus it is a port that was unplugged."""
        if self._connection is not None:
            _LOGGER.debug("%s: connection ended: %s", self.url, why)
            self._connection.abort()

    def lost(self, error: Exception | None) -> None:
        """Take note that the connection has ended; ``error``: why, if not by us."""
        if self._connection is None:
            return
        self._connection = None
        self._stop_watch()
        self.statistics.lost += 1
        if self._proof is not None and not self._proof.done():
            self._proof.set_result(False)
        self.on_lost(LineLostError(str(error) if error else "connection closed"))
