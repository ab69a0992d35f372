"""The client end of a TCP connection, as a small LAN chip implements it."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable

    from .ports import Answer

READ_SIZE = 4096
CONNECT_TIMEOUT = 5.0
# Linger on, for 0 s: the connection is reset.
RESET = struct.pack("ii", 1, 0)


class DialPort:
    """Dials an address until it is connected; all calls are on the bus thread.

    `half_open`: sockets of connections that were left half-open.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        on_bytes: Callable[[bytes], None],
        address: tuple[str, int],
        *,
        source_ports: Callable[[], list[int]],
        source_host: Callable[[], str],
        on_change: Callable[[bool], None],
        retry: float,
    ) -> None:
        """Prepare; `plug` begins to dial."""
        self._loop = loop
        self._on_bytes = on_bytes
        self._address = address
        self._source_ports = source_ports
        self._source_host = source_host
        self._on_change = on_change
        self.retry = retry
        self.pace: tuple[int, float] | None = None
        self.overruns = 0
        self.opened = 0
        self.attempts = 0
        self.source_port = 0
        self.half_open: list[socket.socket] = []
        self._socket: socket.socket | None = None
        self._connected = False
        self._out = bytearray()
        self._turn = 0
        self._timer: asyncio.TimerHandle | None = None
        self._send_timer: asyncio.TimerHandle | None = None

    @property
    def url(self) -> str:
        """Return the address it dials."""
        return f"dial://{self._address[0]}:{self._address[1]}"

    @property
    def connected(self) -> bool:
        """Return whether it is connected."""
        return self._connected

    def plug(self) -> None:
        """Begin to dial."""
        self.dial()

    def unplug(self) -> None:
        """Pull the network cable: the connection is half-open, no dialling."""
        if self._connected:
            self._on_change(False)  # noqa: FBT003 - a callback
        self.hang_up(silent=True, redial=False)

    def write(self, data: bytes) -> None:
        """Send bytes, at the pace set."""
        if self._connected:
            self._out += data
            self._send()

    def after_reply(self) -> None:
        """Do nothing."""

    def drop_client(self) -> None:
        """End the connection, and dial again."""
        self._on_change(False)  # noqa: FBT003 - a callback
        self.hang_up()

    def answer(self, how: Answer) -> None:
        """Fail: the box dials, nothing connects to it."""
        msg = f"a box that dials is none that {how} connections"
        raise ValueError(msg)

    def close(self) -> None:
        """Hang up for good."""
        self.hang_up(redial=False)
        self.reset_half_open()

    def hang_up(self, *, silent: bool = False, redial: bool = True) -> None:
        """End the connection; `silent`: leave it half-open."""
        for timer in (self._timer, self._send_timer):
            if timer is not None:
                timer.cancel()
        self._timer = self._send_timer = None
        self._out.clear()
        line, self._socket = self._socket, None
        self._connected = False
        self.source_port = 0
        if line is not None:
            self._loop.remove_reader(line.fileno())
            self._loop.remove_writer(line.fileno())
            if silent:
                self.half_open.append(line)
            else:
                line.close()
        if redial:
            self.dial_later()

    def reset_half_open(self) -> None:
        """Reset the connections that were left half-open."""
        for line in self.half_open:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, RESET)
            line.close()
        self.half_open.clear()

    def dial_later(self) -> None:
        """Dial after the pause between two attempts."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_later(self.retry, self.dial)

    def dial(self) -> None:
        """Dial once, from the next source port."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._socket is not None:
            return
        self.attempts += 1
        ports = self._source_ports()
        source = ports[self._turn % len(ports)]
        self._turn += 1
        line = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        line.setblocking(False)  # noqa: FBT003 - the call takes no keyword
        line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            if source or self._source_host():
                line.bind((self._source_host(), source))
            result = line.connect_ex(self._address)
        except OSError as error:
            result = error.errno or errno.EIO
        if result not in (0, errno.EINPROGRESS):
            line.close()
            self.dial_later()
            return
        self._socket = line
        self._timer = self._loop.call_later(CONNECT_TIMEOUT, self.hang_up)
        self._loop.add_writer(line.fileno(), self._answered)

    def _answered(self) -> None:
        line = self._socket
        if line is None:
            return
        self._loop.remove_writer(line.fileno())
        if line.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            self.hang_up()
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._connected = True
        self.opened += 1
        self.source_port = line.getsockname()[1]
        self._loop.add_reader(line.fileno(), self._readable)
        self._on_change(True)  # noqa: FBT003 - a callback

    def _readable(self) -> None:
        if self._socket is None:
            return
        try:
            data = os.read(self._socket.fileno(), READ_SIZE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._on_bytes(data)
        else:
            self._lost()

    def _lost(self) -> None:
        self._on_change(False)  # noqa: FBT003 - a callback
        self.hang_up()

    def _send(self) -> None:
        if self._send_timer is not None or self._socket is None or not self._out:
            return
        size, pause = self.pace or (len(self._out), 0.0)
        try:
            sent = self._socket.send(self._out[:size])
        except BlockingIOError:
            sent, pause = 0, 0.01
        except OSError:
            self._lost()
            return
        del self._out[:sent]
        if self._out:
            self._send_timer = self._loop.call_later(pause, self._send_again)

    def _send_again(self) -> None:
        self._send_timer = None
        with contextlib.suppress(OSError):
            self._send()
