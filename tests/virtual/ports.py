"""The client's end of the bus: a pseudo-terminal or a TCP socket."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import itertools
import os
from pathlib import Path
import select
import shutil
import socket
import tempfile
import termios
from typing import TYPE_CHECKING, ClassVar, Literal, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable

READ_SIZE = 4096
# More connections than wait in the shortest queue of any system.
QUEUE = 4
# How an adapter on the network answers a connection that is made to it: "ignores" is a
# black hole, as one without power or behind a firewall.
Answer = Literal["accepts", "refuses", "ignores"]
# A connection without an answer is tried again after these times, s (RFC 6298: 1 s,
# doubled).
SYN_REPEATS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
# With a client, and without one: shorter, so that its first bytes are read soon.
CHORE_INTERVAL = 0.02
AWAIT_INTERVAL = 0.005


class Port(Protocol):
    """The client's end, as the bus uses it. All calls are on the bus thread."""

    overruns: int
    opened: int

    @property
    def url(self) -> str:
        """Return the path or URL that a client opens."""

    @property
    def connected(self) -> bool:
        """Return whether a client has it open."""

    def plug(self) -> None:
        """Make the port appear."""

    def unplug(self) -> None:
        """Make the port disappear, as a pulled adapter does."""

    def write(self, data: bytes) -> None:
        """Send bytes to the client; they are lost if there is none."""

    def after_reply(self) -> None:
        """Prepare the port for the next open; called after each reply."""

    def drop_client(self) -> None:
        """End the connection; the next one is possible at once."""

    def answer(self, how: Answer) -> None:
        """Answer connections in this way from now on."""

    def close(self) -> None:
        """Remove the port for good."""


class PtyPort:
    """A pseudo-terminal behind a stable symbolic link."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        on_bytes: Callable[[bytes], None],
        link: str | None,
    ) -> None:
        """Choose the path of the link; `plug` makes the terminal."""
        self._loop = loop
        self._on_bytes = on_bytes
        self._own_folder = tempfile.mkdtemp(prefix="evse-bus-") if not link else None
        self._link = Path(link) if link else Path(str(self._own_folder), "ttyEVSE")
        self._slave_path = ""
        self._master = -1
        self._reading = False
        self._timer: asyncio.TimerHandle | None = None
        self.overruns = 0
        self.opened = 0

    @property
    def url(self) -> str:
        """Return the path of the link."""
        return str(self._link)

    @property
    def connected(self) -> bool:
        """Return whether a client has the terminal open."""
        return self._reading

    def plug(self) -> None:
        """Make a terminal and point the link at it."""
        if self._master >= 0:
            return
        master, slave = os.openpty()
        _make_raw(slave)
        self._slave_path = os.ttyname(slave)
        # From now on a terminal without a client reports a hang-up, which shows when
        # it is opened and closed.
        os.close(slave)
        os.set_blocking(master, False)
        self._master = master
        if self._link.is_symlink() or self._link.exists():
            self._link.unlink()
        self._link.symlink_to(self._slave_path)
        self._chore()

    def unplug(self) -> None:
        """Remove the terminal and the link: the client gets a hang-up."""
        if self._master < 0:
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._stop_reading()
        with contextlib.suppress(FileNotFoundError):
            self._link.unlink()
        os.close(self._master)
        self._master = -1

    def write(self, data: bytes) -> None:
        """Send bytes to the client."""
        if not self._reading:
            return
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            written = 0
        except OSError:
            self._hung_up()
            return
        # A client that does not read loses bytes, as with a real UART.
        self.overruns += len(data) - written

    def after_reply(self) -> None:
        """Keep the next open possible."""
        self._forget_speed()

    def drop_client(self) -> None:
        """Do nothing: a serial port ends no connection."""

    def answer(self, how: Answer) -> None:
        """Fail: a serial port is there or not."""
        msg = f"a pty cannot be one that {how} connections"
        raise ValueError(msg)

    def close(self) -> None:
        """Remove the port and its files."""
        self.unplug()
        if self._own_folder is not None:
            shutil.rmtree(self._own_folder, ignore_errors=True)

    def _chore(self) -> None:
        """Detect a client, and keep the next open possible."""
        # A client may also have opened, written and closed since the last time.
        if not self._reading and self._client_was_here():
            self._reading = True
            self.opened += 1
            self._loop.add_reader(self._master, self._readable)
        self._forget_speed()
        interval = CHORE_INTERVAL if self._reading else AWAIT_INTERVAL
        self._timer = self._loop.call_later(interval, self._chore)

    def _forget_speed(self) -> None:
        """Set the terminal's speed to one that no client sets.

        The driver drops the parity flag, and the C library refuses an open (EINVAL) in
        which nothing but the dropped flag would change. With another speed before it,
        something always changes.
        """
        if self._master < 0:
            return
        with contextlib.suppress(OSError, termios.error):
            attributes = termios.tcgetattr(self._master)
            if attributes[4] != termios.B50:
                attributes[4] = attributes[5] = termios.B50
                termios.tcsetattr(self._master, termios.TCSANOW, attributes)

    def _client_was_here(self) -> bool:
        poll = select.poll()
        poll.register(self._master, select.POLLIN)
        events = poll.poll(0)
        if not events:
            return True
        return bool(events[0][1] & select.POLLIN) or not events[0][1] & select.POLLHUP

    def _readable(self) -> None:
        try:
            data = os.read(self._master, READ_SIZE)
        except BlockingIOError:
            return
        except OSError:
            self._hung_up()
            return
        if data:
            self._on_bytes(data)

    def _hung_up(self) -> None:
        """Drop bytes that the client has not read before it closed."""
        self._stop_reading()
        self._forget_speed()
        # Only the slave's end can drop bytes that wait to be read there.
        with contextlib.suppress(OSError, termios.error):
            slave = os.open(self._slave_path, os.O_RDWR | os.O_NOCTTY)
            try:
                termios.tcflush(slave, termios.TCIFLUSH)
            finally:
                os.close(slave)

    def _stop_reading(self) -> None:
        if self._reading:
            self._reading = False
            self._loop.remove_reader(self._master)


class DirectTransport:
    """The client's end of an open `DirectPort`."""

    def __init__(self, port: DirectPort, protocol: asyncio.Protocol) -> None:
        """Take the protocol of the client."""
        self.protocol = protocol
        self._port = port
        self._loop = asyncio.get_running_loop()
        self._closed = self._loop.create_future()

    def write(self, data: bytes) -> None:
        """Send bytes; they are taken at once, as by a driver."""
        if self._port.client is self:
            self._port.on_bytes(bytes(data))

    def close(self) -> None:
        """Close; `connection_lost` is called soon."""
        self.end(None)

    async def wait_closed(self) -> None:
        """Wait until it is closed."""
        await self._closed

    def end(self, error: Exception | None) -> None:
        """End the connection; `connection_lost` is called soon."""
        if self._port.client is self:
            self._port.client = None
            self._loop.call_soon(self._lost, error)

    def _lost(self, error: Exception | None) -> None:
        self.protocol.connection_lost(error)
        self._closed.set_result(None)


class DirectPort:
    """A port within this process: a client on the same loop opens it by its name."""

    ports: ClassVar[dict[str, DirectPort]] = {}
    """All ports, by their names."""

    _numbers = itertools.count()

    def __init__(
        self, on_bytes: Callable[[bytes], None], *, network: bool = False
    ) -> None:
        """Choose a unique name; ``network``: that of a TCP port."""
        self.on_bytes = on_bytes
        self.client: DirectTransport | None = None
        self.overruns = 0
        self.opened = 0
        prefix = "socket://virtual:" if network else "/dev/ttyVirtual"
        self._url = f"{prefix}{next(self._numbers)}"
        self._plugged = False
        self._answer: Answer = "accepts"
        self.ports[self._url] = self

    @property
    def url(self) -> str:
        """Return the name, like that of a serial port."""
        return self._url

    @property
    def connected(self) -> bool:
        """Return whether a client has it open."""
        return self.client is not None

    @classmethod
    def find(cls, url: str) -> DirectPort | None:
        """Return the port of a name or of a link to it, unplugged or not."""
        return cls.ports.get(url) or cls.ports.get(os.path.realpath(url))

    async def connect(self, protocol: asyncio.Protocol) -> DirectTransport:
        """Open it as a client; raises OSError as a serial port or a socket would."""
        for pause in SYN_REPEATS:
            if self._answer != "ignores":
                return self.open(protocol)
            await asyncio.sleep(pause)
        raise TimeoutError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))

    def open(self, protocol: asyncio.Protocol) -> DirectTransport:
        """Open it at once."""
        if self._answer == "refuses":
            raise ConnectionRefusedError(
                errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED)
            )
        if not self._plugged:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), self._url)
        if self.client is not None:
            raise BlockingIOError(errno.EBUSY, os.strerror(errno.EBUSY), self._url)
        self.client = DirectTransport(self, protocol)
        self.opened += 1
        protocol.connection_made(self.client)  # type: ignore[arg-type]
        return self.client

    def plug(self) -> None:
        """Let clients open it."""
        self._plugged = True

    def unplug(self) -> None:
        """Remove it from clients; the one that has it open loses it."""
        self._plugged = False
        if self.client is not None:
            self.client.end(OSError(errno.EIO, os.strerror(errno.EIO)))

    def write(self, data: bytes) -> None:
        """Send bytes to the client."""
        if self.client is not None:
            self.client.protocol.data_received(data)

    def after_reply(self) -> None:
        """Do nothing."""

    def drop_client(self) -> None:
        """End the connection."""
        if self.client is not None:
            self.client.end(None)

    def answer(self, how: Answer) -> None:
        """Answer connections in this way from now on."""
        self._answer = how

    def close(self) -> None:
        """Remove the port and its name."""
        self.unplug()
        del self.ports[self._url]


class TcpPort:
    """A TCP server for one client at a time, like a serial device server."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        on_bytes: Callable[[bytes], None],
        port: int,
    ) -> None:
        """Choose the port (0 = any free one, kept from then on)."""
        self._loop = loop
        self._on_bytes = on_bytes
        self._port = port
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        self._answer: Answer = "accepts"
        self._waiting: list[socket.socket] = []
        self.overruns = 0
        self.opened = 0

    @property
    def url(self) -> str:
        """Return the URL of the socket."""
        return f"socket://127.0.0.1:{self._port}"

    @property
    def connected(self) -> bool:
        """Return whether a client is connected."""
        return self._client is not None

    def plug(self) -> None:
        """Listen."""
        if self._server is not None or self._answer == "refuses":
            return
        server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server.bind(("127.0.0.1", self._port))
        server.listen(4)
        server.setblocking(False)  # noqa: FBT003 - the call takes no keyword
        self._port = server.getsockname()[1]
        self._server = server
        self._loop.add_reader(server.fileno(), self._accept)

    def unplug(self) -> None:
        """Close the connection and refuse new ones."""
        self.drop_client()
        for waiting in self._waiting:
            waiting.close()
        self._waiting.clear()
        if self._server is not None:
            self._loop.remove_reader(self._server.fileno())
            self._server.close()
            self._server = None

    def write(self, data: bytes) -> None:
        """Send bytes to the client."""
        if self._client is None:
            return
        try:
            written = self._client.send(data)
        except BlockingIOError:
            written = 0
        except OSError:
            self.drop_client()
            return
        self.overruns += len(data) - written

    def after_reply(self) -> None:
        """Do nothing: a socket needs no preparation."""

    def answer(self, how: Answer) -> None:
        """Answer new connections in this way; the one that is open stays."""
        self._answer = how
        server, self._server = self._server, None
        if server is not None:
            self._loop.remove_reader(server.fileno())
            server.close()
        for waiting in self._waiting:
            waiting.close()
        self._waiting.clear()
        self.plug()
        if how == "ignores" and self._server is not None:
            self._loop.remove_reader(self._server.fileno())
            self._fill()

    def _fill(self) -> None:
        """Fill the queue of connections: the system ignores all others then."""
        if self._server is None:
            return
        self._server.listen(0)
        for _ in range(QUEUE):
            waiting = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            waiting.setblocking(False)  # noqa: FBT003 - the call takes no keyword
            waiting.connect_ex(("127.0.0.1", self._port))
            self._waiting.append(waiting)

    def close(self) -> None:
        """Close the connection and the port."""
        self.unplug()

    def _accept(self) -> None:
        if self._server is None:
            return
        try:
            client, _ = self._server.accept()
        except BlockingIOError:
            return
        if self._client is not None and not self._client_gone():
            # One client at a time; the second one sees its connection closed.
            client.close()
            return
        self.drop_client()
        client.setblocking(False)  # noqa: FBT003 - the call takes no keyword
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client
        self.opened += 1
        self._loop.add_reader(client.fileno(), self._readable)

    def _client_gone(self) -> bool:
        """Return whether the client has closed, noticed here or not."""
        if self._client is None:
            return True
        try:
            return not self._client.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return False
        except OSError:
            return True

    def _readable(self) -> None:
        if self._client is None:
            return
        try:
            data = self._client.recv(READ_SIZE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._on_bytes(data)
        else:
            self.drop_client()

    def drop_client(self) -> None:
        """End the connection."""
        if self._client is not None:
            self._loop.remove_reader(self._client.fileno())
            self._client.close()
            self._client = None


def _make_raw(slave: int) -> None:
    """Set the terminal to pass bytes as they are: no echo, no line editing."""
    attributes = termios.tcgetattr(slave)
    attributes[0] = 0
    attributes[1] = 0
    attributes[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
    attributes[3] = 0
    attributes[4] = attributes[5] = termios.B38400
    attributes[6][termios.VMIN] = 1
    attributes[6][termios.VTIME] = 0
    termios.tcsetattr(slave, termios.TCSANOW, attributes)
