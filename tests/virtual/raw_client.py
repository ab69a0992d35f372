"""Clients of bare system calls, for the tests of the virtual chargers."""

from __future__ import annotations

import os
import select
import socket
import termios
import time
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from types import TracebackType

PATIENCE = 20.0
"""Longest wait for an answer that is expected, s: a busy machine is slow."""
_PREFIX = "socket://"


class RawClient:
    """Opens a path (8N1 or 8E1) or a `socket://` URL, writes and reads bytes."""

    def __init__(self, url: str, parity: str = "N", baud: int = termios.B38400) -> None:
        """Open."""
        self._socket: socket.socket | None = None
        if url.startswith(_PREFIX):
            host, port = url.removeprefix(_PREFIX).split(":")
            self._socket = socket.create_connection((host, int(port)), timeout=PATIENCE)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.fd = self._socket.fileno()
        else:
            self.fd = os.open(url, os.O_RDWR | os.O_NOCTTY)
            self._set_line(parity, baud)
        self.read_at: list[tuple[float, int]] = []

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """Close; no effect if already closed."""
        if self._socket is not None:
            self._socket.close()
        elif self.fd >= 0:
            os.close(self.fd)
        self.fd = -1

    def write(self, data: bytes) -> None:
        """Write all."""
        if os.write(self.fd, data) != len(data):
            raise OSError("a short write")

    def read(self, count: int, timeout: float = PATIENCE) -> bytes:
        """Read `count` bytes, or fewer up to the time-out or the hang-up."""
        data = b""
        end = time.monotonic() + timeout
        while len(data) < count:
            left = end - time.monotonic()
            if left <= 0 or not select.select([self.fd], [], [], left)[0]:
                break
            piece = os.read(self.fd, count - len(data))
            if not piece:
                break
            self.read_at.append((time.monotonic(), len(piece)))
            data += piece
        return data

    def time(self) -> float:
        """Return the real time, s."""
        return time.monotonic()

    def read_some(self, timeout: float) -> bytes:
        """Return the next byte, none at the time-out or the hang-up."""
        return self.read(1, timeout)

    def read_line(self, end: bytes = b"\n", timeout: float = PATIENCE) -> bytes:
        """Read up to that byte, or up to the time-out."""
        data = b""
        limit = time.monotonic() + timeout
        while not data.endswith(end):
            byte = self.read(1, limit - time.monotonic())
            if not byte:
                break
            data += byte
        return data

    def ask(self, data: bytes, end: bytes = b"\n", timeout: float = PATIENCE) -> bytes:
        """Write, and read up to that byte."""
        self.write(data)
        return self.read_line(end, timeout)

    def _set_line(self, parity: str, baud: int) -> None:
        attributes = termios.tcgetattr(self.fd)
        attributes[0] = attributes[1] = attributes[3] = 0
        attributes[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
        if parity != "N":
            attributes[2] |= termios.PARENB
        if parity == "O":
            attributes[2] |= termios.PARODD
        attributes[4] = attributes[5] = baud
        attributes[6][termios.VMIN] = 1
        attributes[6][termios.VTIME] = 0
        termios.tcsetattr(self.fd, termios.TCSANOW, attributes)


class RawSocket:
    """The server's end of a connection, to read from and write to."""

    def __init__(self, connection: socket.socket) -> None:
        """Take an open connection."""
        self.ended = False
        self._socket = connection

    def time(self) -> float:
        """Return the real time, s."""
        return time.monotonic()

    def close(self) -> None:
        """Close."""
        self._socket.close()

    def write(self, data: bytes) -> None:
        """Write all."""
        self._socket.sendall(data)

    def read_some(self, timeout: float) -> bytes:
        """Return the next bytes, none at the time-out or the end (`ended`)."""
        self._socket.settimeout(timeout)
        try:
            data = self._socket.recv(4096)
        except TimeoutError:
            return b""
        self.ended = not data
        return data
