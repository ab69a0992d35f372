"""Clients of virtual buses in simulated time, for tests that are no coroutines.

A client runs the loop that the bus lives on while it waits; between its calls time
stands still.
"""

import asyncio
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
import socket
from typing import override

from tests.simulated_time import SimulatedLoop
from tests.virtual import VirtualBus
from tests.virtual.ports import DirectPort

type Address = tuple[str, int]


@contextmanager
def living[B: VirtualBus](bus: B) -> Iterator[B]:
    """Start a bus in simulated time; stop it, and raise what went wrong inside."""

    async def start() -> None:
        bus.start()

    async def stop() -> None:
        bus.stop()

    loop = SimulatedLoop()
    try:
        loop.run_until_complete(start())
        try:
            yield bus
        finally:
            loop.run_until_complete(stop())
    finally:
        loop.close()


def wait(bus: VirtualBus, seconds: float) -> None:
    """Let simulated time pass."""
    bus.loop.run_until_complete(asyncio.sleep(seconds))


class _Client:
    """One end of a line; the other lives on a loop that runs only when we wait."""

    def __init__(self, bus: VirtualBus) -> None:
        self._bus = bus

    def time(self) -> float:
        """Return the simulated time, s."""
        return self._bus.time()

    def _run[T](self, what: Coroutine[object, object, T]) -> T:
        result: T = self._bus.loop.run_until_complete(what)
        return result


class PortClient(_Client, asyncio.Protocol):
    """Opens the port of a bus, writes and reads bytes."""

    def __init__(self, bus: VirtualBus) -> None:
        super().__init__(bus)
        self.read_at: list[tuple[float, int]] = []
        """When bytes arrived, and how many."""
        self._data = bytearray()
        self._arrived = asyncio.Event()
        self._transport = self._run(self._open())

    async def _open(self):  # type: ignore[no-untyped-def] # noqa: ANN202 - of the port
        port = DirectPort.find(self._bus.url)
        assert port is not None
        return port.open(self)

    @override
    def data_received(self, data: bytes) -> None:
        self.read_at.append((self.time(), len(data)))
        self._data += data
        self._arrived.set()

    def close(self) -> None:
        self._transport.close()

    def write(self, data: bytes) -> None:
        """Write all."""
        self._transport.write(data)

    def read(self, count: int, timeout: float = 2.0) -> bytes:
        """Read so many bytes, or fewer up to the time-out."""
        self._run(self._wait(count, timeout))
        data = bytes(self._data[:count])
        del self._data[:count]
        return data

    def read_some(self, timeout: float) -> bytes:
        """Return the next bytes, none at the time-out."""
        self._run(self._wait(1, timeout))
        data = bytes(self._data)
        self._data.clear()
        return data

    def read_line(self, end: bytes = b"\n", timeout: float = 2.0) -> bytes:
        """Read up to that byte, or up to the time-out."""
        data = b""
        limit = self.time() + timeout
        while not data.endswith(end) and (byte := self.read(1, limit - self.time())):
            data += byte
        return data

    def ask(self, data: bytes, end: bytes = b"\n", timeout: float = 2.0) -> bytes:
        """Write, and read up to that byte."""
        self.write(data)
        return self.read_line(end, timeout)

    async def _wait(self, count: int, timeout: float) -> None:  # noqa: ASYNC109 - simulated
        try:
            async with asyncio.timeout(timeout):
                while len(self._data) < count:
                    self._arrived.clear()
                    await self._arrived.wait()
        except TimeoutError:
            return


class SocketClient(_Client):
    """The server's end of a connection that a virtual box has opened."""

    def __init__(self, bus: VirtualBus, server: socket.socket) -> None:
        super().__init__(bus)
        self.ended = False
        server.setblocking(False)  # noqa: FBT003 - the call takes no keyword
        self._socket, self.address = self._run(self._accept(server))

    async def _accept(self, server: socket.socket) -> tuple[socket.socket, Address]:
        async with asyncio.timeout(5):
            accepted: tuple[socket.socket, Address] = await self._bus.loop.sock_accept(
                server
            )
        return accepted

    def close(self) -> None:
        self._socket.close()

    def write(self, data: bytes) -> None:
        """Write all."""
        self._run(self._bus.loop.sock_sendall(self._socket, data))

    def read_some(self, timeout: float) -> bytes:
        """Return the next bytes, none at the time-out or the end (`ended`)."""

        async def read() -> bytes:
            async with asyncio.timeout(timeout):
                data: bytes = await self._bus.loop.sock_recv(self._socket, 4096)
            return data

        try:
            data = self._run(read())
        except TimeoutError:
            return b""
        self.ended = not data
        return data
