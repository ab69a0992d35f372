"""A server of bare sockets, for the tests of the virtual EWS-Box."""

from __future__ import annotations

import struct
import termios
from typing import TYPE_CHECKING, Protocol, Self

from .ews_frames import FrameReader, Message, command
from .raw_client import RawClient
from .wire import Segment

if TYPE_CHECKING:
    from types import TracebackType

    from .ews_frames import Bcc

PORT_STATUS = struct.Struct(">7B6I3BhhHB?HH8s")
PORT_FIELDS = (
    *("status", "cable", "offered", "fan", "start_mode", "optimised", "result"),
    *("seconds", "wh", "last_seconds", "last_wh", "total_wh", "cycles"),
    *("locked", "contactor", "rcd", "low", "high", "proximity", "keys"),
    *("logged_in", "group", "card", "name"),
)


class Line(Protocol):
    """What a client needs of its end of a line."""

    def time(self) -> float:
        """Return the time, s."""

    def write(self, data: bytes) -> None:
        """Send bytes."""

    def read_some(self, timeout: float) -> bytes:
        """Return the next bytes, none at the time-out or the end."""

    def close(self) -> None:
        """Close."""


class EwsClient:
    """Sends commands to a box, on its serial line or the connection it opened."""

    def __init__(self, line: Line, bcc: Bcc = "all") -> None:
        """Take an open line; it is closed with this client."""
        self.line = line
        self._bcc: Bcc = bcc
        self._reader = FrameReader(10.0, bcc)
        self._waiting: list[Message] = []
        self.unasked: list[Message] = []

    @classmethod
    def serial(cls, url: str, bcc: Bcc = "all") -> EwsClient:
        """Open a pseudo-terminal or a `socket://` URL."""
        return cls(RawClient(url, baud=termios.B115200), bcc)

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
        self.line.close()

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self.line.write(data)

    def read(self, timeout: float = 1.0) -> bytes:
        """Return the next bytes, b"" at the time-out or the end."""
        return self.line.read_some(timeout)

    def next(self, timeout: float = 1.0) -> Message | None:
        """Return the next message of any kind."""
        end = self.line.time() + timeout
        while not self._waiting:
            left = end - self.line.time()
            data = self.read(left) if left > 0 else b""
            if not data:
                return None
            segment = Segment(self.line.time(), 0.0, data, ("box",), 0.0)
            self._waiting += self._reader.feed(segment)
        return self._waiting.pop(0)

    def ask(self, name: str, parameters: bytes = b"", timeout: float = 1.0) -> bytes:
        """Send a command and return the data of its answer; b"?" without one."""
        self.write(command(name, parameters, self._bcc))
        while True:
            message = self.next(timeout)
            if message is None:
                return b"?"
            if message.msgid == b"A" and message.name == name:
                return message.data
            self.unasked.append(message)

    def order(self, port: int, order: int) -> int:
        """Send `sl`; return the code."""
        return self.ask("sl", bytes((port, order)))[0]

    def limit(self, port: int, amps: int) -> int:
        """Send `st`; return the code."""
        return self.ask("st", bytes((port, amps)))[0]

    def ports(self) -> list[dict[str, int]]:
        """Return the fields of `rc` for each port."""
        data = self.ask("rc")
        size = PORT_STATUS.size
        return [
            dict(
                zip(PORT_FIELDS, PORT_STATUS.unpack(data[at : at + size]), strict=True)
            )
            for at in (0, size)
        ]
