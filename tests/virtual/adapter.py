"""The adapter between the client and the wire, as people have them.

A USB adapter passes bytes at once. One on the network is slow or jerky, hangs, closes
idle connections, or speaks Modbus TCP in place of passing bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable
    from random import Random

    from .loop import BorrowedLoop, PreciseLoop
    from .ports import Port

# Bytes keep their order, also those that would arrive in the same moment.
ORDER = 1e-6
# Header of Modbus TCP: transaction, protocol (0), length, unit (Modbus Messaging on
# TCP/IP Implementation Guide, 3.1.3).
MBAP = 7
LENGTH_AT = 4
NO_REPLY = 0x0B  # "gateway target device failed to respond" (application protocol, 7)
NOT_MODBUS = 1  # "illegal function"

GatewayKind = Literal["silent", "closes", "answers", "mute"]


class ModbusTcpGateway:
    """A gateway that expects Modbus TCP; nothing on its serial side answers.

    A request without the header of Modbus TCP is dropped, by the implementation guide
    (4.4.2.1). Not in it is what some do beside that: `closes` the connection, or
    `answers` with an exception. One that is `mute` drops it as well, and does not
    answer Modbus TCP either while no unit answers (an option of many gateways).
    """

    def __init__(self, kind: GatewayKind = "silent") -> None:
        """Make a gateway of this kind."""
        self.kind = kind
        self.dropped = 0
        self._received = bytearray()

    def reset(self) -> None:
        """Begin anew: another connection."""
        self._received.clear()

    def receive(self, data: bytes) -> bytes | None:
        """Take bytes of the client; return the reply (None: close the connection)."""
        self._received += data
        answer = b""
        while len(self._received) > MBAP:
            header = bytes(self._received[:MBAP])
            end = LENGTH_AT + 2 + int.from_bytes(header[LENGTH_AT:6], "big")
            if header[2:4] != bytes(2) or end <= MBAP:
                self.dropped += 1
                function = self._received[MBAP]
                self._received.clear()
                if self.kind == "closes":
                    return None
                if self.kind == "answers":
                    answer += exception(header, function, NOT_MODBUS)
                break
            if len(self._received) < end:
                break
            if self.kind != "mute":
                answer += exception(header, self._received[MBAP], NO_REPLY)
            del self._received[:end]
        return answer


def exception(header: bytes, function: int, code: int) -> bytes:
    """Return an exception of Modbus TCP as the answer to a request with this header."""
    start = header[:2] + bytes(2) + (3).to_bytes(2, "big")
    return start + header[6:7] + bytes((function | 0x80, code))


class Adapter:
    """Passes bytes between the port and the wire; attributes may be set at any time.

    - `delay_out`, `delay_in`: seconds to the wire, and back; `jitter`: up to so much
      more, at random; bytes keep their order
    - `hung`: passes nothing, on no connection; they stay open
    - `idle_timeout`: closes a connection without traffic after so many seconds
    - `gateway`: it speaks Modbus TCP
    """

    def __init__(
        self,
        rng: Random,
        to_wire: Callable[[bytes], None],
        port: Callable[[], Port | None],
        loop: Callable[[], PreciseLoop | BorrowedLoop],
    ) -> None:
        """Make one that passes all at once."""
        self.delay_out = 0.0
        self.delay_in = 0.0
        self.jitter = 0.0
        self.hung = False
        self.idle_timeout: float | None = None
        self.gateway: ModbusTcpGateway | None = None
        self.lost = 0
        self.closed_idle = 0
        self._rng = rng
        self._to_wire = to_wire
        self._port = port
        self._loop = loop
        self._free = [0.0, 0.0]
        self._stuck = 0
        self._gateway_for = 0
        self._idle: asyncio.TimerHandle | None = None

    def stick(self) -> None:
        """Leave the connection half-open: open, and nothing passes on it any more.

        The next one works.
        """
        self._stuck = self._connection

    def from_client(self, data: bytes) -> None:
        """Take bytes that the client has written."""
        self._traffic()
        if not self.delay_out and not self.jitter:
            self._out(self._connection, data)
            return
        self._later(0, self.delay_out, self._out, data)

    def to_client(self, data: bytes) -> None:
        """Take bytes from the wire."""
        if not self.delay_in and not self.jitter:
            self._in(self._connection, data)
            return
        self._later(1, self.delay_in, self._in, data)

    def stop(self) -> None:
        """Leave no timer behind."""
        if self._idle is not None:
            self._idle.cancel()

    @property
    def _connection(self) -> int:
        """Return the number of the connection; each has another one."""
        port = self._port()
        return port.opened if port is not None else 0

    def _later(
        self,
        way: int,
        delay: float,
        forward: Callable[[int, bytes], None],
        data: bytes,
    ) -> None:
        loop = self._loop()
        at = loop.time() + delay + self._rng.random() * self.jitter
        at = self._free[way] = max(at, self._free[way] + ORDER)
        loop.call_at(at, forward, self._connection, data)

    def _passes(self, connection: int, data: bytes) -> bool:
        """Return whether bytes of this connection still have an end to go to."""
        if self.hung or connection in (0, self._stuck):
            self.lost += len(data)
            return False
        return connection == self._connection

    def _out(self, connection: int, data: bytes) -> None:
        if not self._passes(connection, data):
            return
        if self.gateway is None:
            self._to_wire(data)
            return
        if self._gateway_for != connection:
            self._gateway_for = connection
            self.gateway.reset()
        answer = self.gateway.receive(data)
        if answer is None:
            self._close()
        elif answer:
            self._in(connection, answer)

    def _in(self, connection: int, data: bytes) -> None:
        port = self._port()
        if port is not None and self._passes(connection, data):
            self._traffic()
            port.write(data)

    def _close(self) -> None:
        port = self._port()
        if port is not None:
            port.drop_client()

    def _traffic(self) -> None:
        """Take note of traffic: the connection is not idle."""
        if self._idle is not None:
            self._idle.cancel()
            self._idle = None
        if self.idle_timeout is not None:
            self._idle = self._loop().call_later(
                self.idle_timeout, self._is_idle, self._connection
            )

    def _is_idle(self, connection: int) -> None:
        if connection == self._connection:
            self.closed_idle += 1
            self._close()
