"""A virtual EWS-Box on the network: the box is the TCP client and dials its server.

It retries for ever, from ten source ports in turn; after 30 s without a command it
closes the connection and dials again (manual, 3.1.4.2).
"""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

from .bus import VirtualBus
from .ews_box import COMMAND_TIMEOUT
from .ews_frames import TCP_TIMEOUT
from .ews_parameters import SystemMode
from .ews_socket import DialPort

if TYPE_CHECKING:
    from .ews_box import EwsBox
    from .ports import Port

# The byte time of a network is negligible, but the wire needs one.
NETWORK_BAUD = 1_000_000
SOURCE_PORTS = 10
FIRST_SOURCE_PORT = 20_000
LAST_SOURCE_PORT = 32_000


class EwsDialler(VirtualBus):
    """A box that dials `host:port`; otherwise a virtual bus: `log`, `faults`, ...

    - `retry`: real seconds between two attempts; `source_ports`: the first of ten, 0 =
      any (default: from the box's serial number)
    - `dropped`: reasons why connections ended, oldest first
    - `source_host`: the address to dial from, where the machine has several ("": any)
    - `on`: another dialler, to run on its thread
    - `pace`: (bytes, real seconds) to send slowly
    """

    def __init__(
        self,
        box: EwsBox,
        host: str,
        port: int,
        *,
        retry: float = 0.5,
        source_ports: int | None = None,
        source_host: str = "",
        on: EwsDialler | None = None,
        **options: float | None,
    ) -> None:
        """Prepare; `start` or `with` begins to dial."""
        self._thread_of = on
        self._dial_port: DialPort | None = None
        self._connected_at = 0.0
        self.box = box
        self.source_host = source_host
        self.dropped: list[str] = []
        if source_ports is None:
            span = (LAST_SOURCE_PORT - FIRST_SOURCE_PORT) // SOURCE_PORTS
            number = int(box.serial) % span
            source_ports = FIRST_SOURCE_PORT + number * SOURCE_PORTS
        box.user.own_port = source_ports
        if not box.system.has(SystemMode.SERVER):
            msg = "a box in standalone mode does not dial"
            raise ValueError(msg)
        box.user.server_ip = socket.inet_aton(socket.gethostbyname(host))
        box.user.server_port = port
        box.system.mode &= ~SystemMode.RS232
        box.frames.timeout = TCP_TIMEOUT
        box.network = True
        box.on_power = self._power

        def make(_bus: VirtualBus) -> Port:
            dial_port = DialPort(
                self.loop,
                self.adapter.from_client,
                (host, port),
                source_ports=self._source_ports,
                source_host=lambda: self.source_host,
                on_change=self._link_changed,
                retry=retry,
            )
            self._dial_port = dial_port
            return dial_port

        options.setdefault("baud", NETWORK_BAUD)
        super().__init__((box,), make, **options)  # type: ignore[arg-type]

    # For tests

    @property
    def dial_port(self) -> DialPort:
        """Return the box's end of the connection."""
        if self._dial_port is None:
            msg = "the dialler was never started"
            raise RuntimeError(msg)
        return self._dial_port

    @property
    def attempts(self) -> int:
        """Return the number of times it has dialled."""
        return self._dial_port.attempts if self._dial_port else 0

    @property
    def source_port(self) -> int:
        """Return the source port of the connection, 0 without one."""
        return self._dial_port.source_port if self._dial_port else 0

    @property
    def pace(self) -> tuple[int, float] | None:
        """Return its pace: bytes at a time, seconds between; None: at once."""
        return self.dial_port.pace

    @pace.setter
    def pace(self, pace: tuple[int, float] | None) -> None:
        """Change the pace from now on."""
        self.dial_port.pace = pace

    def hang_up(self, *, redial: bool = True) -> None:
        """Close the connection properly; dial again after `retry`, or not."""
        self.call(lambda: self._drop("hung up", redial=redial))

    def vanish(self, *, redial: bool = True) -> None:
        """Leave the connection half-open: no byte ever comes again."""
        self.call(lambda: self._drop("vanished", silent=True, redial=redial))

    def dial(self) -> None:
        """Dial now."""
        self.call(self.dial_port.dial)

    def reset_half_open(self) -> None:
        """Reset the connections that were left half-open."""
        self.call(self.dial_port.reset_half_open)

    # One thread for many diallers

    def start_thread(self) -> None:
        """Start a thread, or use the other dialler's."""
        if self._thread_of is None:
            super().start_thread()
        else:
            self.share_thread(self._thread_of)

    # Inside

    def _source_ports(self) -> list[int]:
        first = self.box.user.own_port
        return [first + n for n in range(SOURCE_PORTS)] if first else [0]

    def _link_changed(self, up: bool) -> None:  # noqa: FBT001 - a callback
        self._connected_at = self.now()
        if not up and self.box.link_up:
            self.dropped.append("by the server")
        self.box.link_changed(up=up)
        self.check_waiters()

    def _drop(self, why: str, *, silent: bool = False, redial: bool = True) -> None:
        if self.dial_port.connected:
            self.dropped.append(why)
            self.box.link_changed(up=False)
        self.dial_port.hang_up(silent=silent, redial=redial)

    def _power(self, on: bool) -> None:  # noqa: FBT001 - a callback
        """Lose the connection as a box without power does: silently."""
        if on:
            self.dial_port.dial_later()
        else:
            self._drop("power", silent=True, redial=False)

    def _step_devices(self) -> None:
        super()._step_devices()
        box, port = self.box, self._dial_port
        if port is None or not port.connected:
            return
        silent = min(box.silent_for, self.now() - self._connected_at)
        lease_half = box.lease / 2 if box.user.own_ip == bytes(4) else 0
        if silent >= COMMAND_TIMEOUT:
            self._drop("30 s without a command")
        elif lease_half and self.now() - self._connected_at >= lease_half:
            self._drop("half of the lease")
