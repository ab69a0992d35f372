"""Clients that dial a listener for EWS-Boxes and are none: port scanners, other devices.

What they send is not from a manual: `hostile` is the bytes that cost a framer most in
the issue "Strangers, storage, ourselves", the others are anything that may dial.
"""

from __future__ import annotations

import contextlib
import errno
import random
import socket
from typing import TYPE_CHECKING

from .loop import LoopThread

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

KINDS = {
    "silent": "send nothing",
    "noise": "send random bytes",
    "hostile": "send beginnings of frames that overlap",
    "slow": "the same, byte by byte",
}
# Each 02 begins a frame of 11 bytes parameters, so all overlap.
HOSTILE = bytes.fromhex("02000b49696600")
PAUSE = 0.01
REPEATS = 50


class Strangers(LoopThread):
    """So many connections to one listener; a connection that ends is made anew.

    - `count`: connections at once; `rate`: new ones a second, the oldest end then
    - `dialled`, `closed`: connections made, and those that the listener has ended
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        count: int = 12,
        kind: str = "silent",
        rate: float | None = None,
        seed: int = 0,
        own_thread: bool = True,
    ) -> None:
        """Prepare; `start` or `with` begins to dial."""
        super().__init__("strangers", own_thread=own_thread)
        self.url = f"dial://{host}:{port}"
        self.count = count
        self.dialled = 0
        self.closed = 0
        self.sent = 0
        self._address = (host, port)
        self._kind = kind
        self._rate = rate
        self._rng = random.Random(seed)  # noqa: S311 - repeatable on purpose
        self._open: list[socket.socket] = []
        self._over = False

    def __enter__(self) -> Self:
        """Begin to dial."""
        self.start_thread()
        self.call(self._tick)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End all connections."""
        self.call(self._stop)
        self.stop_thread()

    def stats(self) -> dict[str, object]:
        """Return the counters."""
        return {
            "url": self.url,
            "open": len(self._open),
            "dialled": self.dialled,
            "closed": self.closed,
            "sent": self.sent,
        }

    def _stop(self) -> None:
        self._over = True
        for line in tuple(self._open):
            self._end(line)

    def _tick(self) -> None:
        if self._over:
            return
        if self._rate is None:
            while len(self._open) < self.count:
                if not self._dial():
                    break
            pause = PAUSE
        else:
            self._dial()
            while len(self._open) > self.count:
                self._end(self._open[0])
            pause = 1 / self._rate
        for line in tuple(self._open):
            self._look(line)
        self.loop.call_later(pause, self._tick)
        self.check_waiters()

    def _dial(self) -> bool:
        line = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        line.setblocking(False)  # noqa: FBT003 - the call takes no keyword
        result = line.connect_ex(self._address)
        if result not in (0, errno.EINPROGRESS):
            line.close()
            return False
        self.dialled += 1
        self._open.append(line)
        return True

    def _look(self, line: socket.socket) -> None:
        """Send to a connection, and notice its end."""
        try:
            if line.recv(4096) == b"":
                self.closed += 1
                self._end(line)
                return
        except BlockingIOError:
            pass
        except OSError:
            self.closed += 1
            self._end(line)
            return
        data = self._bytes()
        with contextlib.suppress(OSError):
            # Before it is connected, and while nothing is read there, nothing goes out.
            self.sent += line.send(data) if data else 0

    def _bytes(self) -> bytes:
        if self._kind == "noise":
            return self._rng.randbytes(64)
        if self._kind == "hostile":
            return HOSTILE * REPEATS
        if self._kind == "slow":
            at = self._rng.randrange(len(HOSTILE))
            return HOSTILE[at : at + 1]
        return b""

    def _end(self, line: socket.socket) -> None:
        self._open.remove(line)
        line.close()
