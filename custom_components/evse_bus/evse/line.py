"""One serial line or socket: bytes out, bytes in, silence, echo.

The line knows no frames. It opens and closes one serialx connection, raises typed
errors where it cannot, and strips the echo of our own bytes where the adapter receives
its own transmission (common on two-wire RS-485).
"""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
import errno
from ipaddress import ip_address
import socket
from typing import ClassVar, Final, override
from urllib.parse import urlsplit

from serialx import (
    BaseSerialTransport,
    Parity,
    SerialException,
    StopBits,
    create_serial_connection,
)

from .errors import (
    LineError,
    LineLostError,
    PortBusyError,
    PortMissingError,
    PortPermissionError,
    PortSettingsError,
)
from .framing import LineSettings
from .memory import LineMemory

OPEN_TIMEOUT = 4.0
"""Longest wait for a port to open (a network port may not answer), s."""
CLOSE_TIMEOUT = 1.0
"""Longest wait for a port to close, s; then it is closed without its last bytes."""

_NETWORK: Final = frozenset({"socket", "rfc2217"})
"""Schemes that can name one TCP port of an adapter."""

_PARITIES = {"N": Parity.NONE, "E": Parity.EVEN, "O": Parity.ODD}
_STOP_BITS = {1: StopBits.ONE, 2: StopBits.TWO}

_ERRORS: dict[int, type[LineError]] = {
    errno.ENOENT: PortMissingError,
    errno.ENODEV: PortMissingError,
    errno.ENXIO: PortMissingError,
    errno.EIO: PortMissingError,
    errno.ENOTDIR: PortMissingError,
    errno.EHOSTUNREACH: PortMissingError,
    errno.ENETUNREACH: PortMissingError,
    errno.EBUSY: PortBusyError,
    errno.EACCES: PortPermissionError,
    errno.EPERM: PortPermissionError,
    errno.EINVAL: PortSettingsError,
    errno.ENOTTY: PortSettingsError,
}


def line_error(error: Exception) -> LineError:
    """Return the typed error for an exception of the port."""
    # Order matters: a name that does not resolve and a time-out are OSErrors too.
    if isinstance(error, (TimeoutError, ConnectionError, socket.gaierror)):
        return PortMissingError(str(error) or type(error).__name__)
    if isinstance(error, OSError):
        kind = _ERRORS.get(error.errno or 0, LineError)
        return kind(str(error))
    if isinstance(error, (ValueError, SerialException)):
        return PortSettingsError(str(error))
    return LineError(str(error) or type(error).__name__)


def canonical_url(url: str) -> str:
    """Return the one spelling of a URL; anything else as it is."""
    if "://" not in url:
        return url
    try:
        parts = urlsplit(url.strip())
        host, port = parts.hostname or "", parts.port
    except ValueError:
        return url
    name = host.removesuffix(".").removesuffix(".local")
    with suppress(ValueError):
        name = str(ip_address(host))
    if parts.scheme in _NETWORK:
        return f"//{name}:{port}"
    # Several ports of one device may differ only in what follows the address.
    return f"{parts.scheme}://{name}:{port}{parts.path.rstrip('/')}?{parts.query}"


@dataclass(slots=True)
class LineStatistics:
    """Traffic of a line since it was created; survives reopening."""

    bytes_out: int = 0
    bytes_in: int = 0
    echo_bytes: int = 0
    opened: int = 0
    lost: int = 0


class Line:
    """One serialx connection, half duplex."""

    opened_by_peer: ClassVar[bool] = False
    """The other end opens it: a line that is not open yet is no error."""

    def __init__(self, url: str, settings: LineSettings) -> None:
        """Set URL and line settings; nothing is opened yet."""
        self.url = url
        self.settings = settings
        self.memory = LineMemory()
        """What is known of it; replaced by that of an earlier bus, if there was one."""
        self.statistics = LineStatistics()
        self.on_data: Callable[[bytes], None] = lambda _data: None
        """Called with received bytes, without the echo."""
        self.on_lost: Callable[[LineLostError], None] = lambda _error: None
        """Called once when an open line is gone."""
        self.last_activity = 0.0
        """Loop time at which the last byte passed, in or out."""
        self.echoes: bool | None = None
        """Whether the adapter echoes our own bytes; ``None``: not known yet."""
        self._transport: BaseSerialTransport | None = None
        self._receiver: _Receiver | None = None
        """Of the connection that is open or being opened."""
        self._echo = b""
        self._held = 0

    @property
    def is_network(self) -> bool:
        """Return whether it is a TCP port that is to pass bytes as they are."""
        return self.url.startswith("socket://")

    @property
    def is_open(self) -> bool:
        """Return whether bytes can be sent."""
        return self._transport is not None

    async def open(self) -> None:
        """Open the port.

        Raises PortMissingError, PortBusyError, PortPermissionError,
        PortSettingsError or LineError.
        """
        loop = asyncio.get_running_loop()
        self._receiver = receiver = _Receiver(self)
        try:
            async with asyncio.timeout(OPEN_TIMEOUT):
                transport, _ = await create_serial_connection(
                    loop,
                    lambda: receiver,
                    self.url,
                    baudrate=self.settings.baudrate,
                    parity=_PARITIES[self.settings.parity],
                    stopbits=_STOP_BITS[self.settings.stop_bits],
                )
        except (OSError, ValueError, SerialException) as error:
            raise line_error(error) from error
        self._transport = transport
        self._echo = b""
        self._held = 0
        # Another adapter may have been plugged in meanwhile.
        self.echoes = None
        self.statistics.opened += 1
        self.last_activity = loop.time()

    async def close(self) -> None:
        """Close the port; no error if it is gone."""
        transport, self._transport = self._transport, None
        if transport is None:
            return
        transport.close()
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT):
                await transport.wait_closed()
        except TimeoutError:
            # Bytes that a dead connection never takes would keep it open.
            transport.abort()
        except OSError, SerialException:
            # A port that was unplugged reports so once more here.
            pass

    def write(self, data: bytes, *, reply_may_equal: bool = False) -> float:
        """Send bytes; return the loop time at which the last one has left.

        ``reply_may_equal``: the reply may be the same bytes (a Modbus RTU write), so
        an echo is stripped only if the adapter is known to make one. Raises
        LineLostError when the line is not open.
        """
        if self._transport is None:
            message = f"{self.url} is not open"
            raise LineLostError(message)
        try:
            self._transport.write(data)
        except (OSError, SerialException) as error:
            raise LineLostError(str(error)) from error
        self.statistics.bytes_out += len(data)
        now = asyncio.get_running_loop().time()
        self.last_activity = now + len(data) * self.settings.byte_time
        expect_echo = self.echoes if reply_may_equal else self.echoes is not False
        self._echo = data if expect_echo else b""
        self._held = 0
        return self.last_activity

    def _received(self, data: bytes) -> None:
        self.statistics.bytes_in += len(data)
        # A request still leaving the adapter keeps the line busy after this byte.
        self.last_activity = max(self.last_activity, asyncio.get_running_loop().time())
        if self._echo:
            data = self._strip_echo(data)
        if data:
            self.on_data(data)

    def _strip_echo(self, data: bytes) -> bytes:
        """Strip our own bytes from the front; return everything where they differ."""
        rest = self._echo[self._held :]
        length = min(len(rest), len(data))
        if rest[:length] != data[:length]:
            # Not an echo after all, or a damaged one: the framer gets all of it.
            held = self._echo[: self._held]
            self._echo = b""
            return held + data
        self._held += length
        if self._held < len(self._echo):
            return b""
        self.echoes = True
        self.statistics.echo_bytes += len(self._echo)
        self._echo = b""
        return data[length:]

    def answered(self) -> None:
        """Take note of a reply: an adapter that has not echoed by now does not."""
        if self.echoes is None:
            self.echoes = False
        self._echo = b""

    def _lost(self, error: Exception | None) -> None:
        if self._transport is None:
            return
        self._transport = None
        self.statistics.lost += 1
        self.on_lost(LineLostError(str(error) if error else "connection closed"))


class _Receiver(asyncio.Protocol):
    """Passes the events of one serialx connection to the line.

    One that was closed may deliver its last events when the next one is open: they are
    not of that one.
    """

    def __init__(self, line: Line) -> None:
        self._line = line

    @property
    def _is_current(self) -> bool:
        return self._line._receiver is self  # noqa: SLF001 - one object in two classes

    @override
    def data_received(self, data: bytes) -> None:
        if self._is_current:
            self._line._received(data)  # noqa: SLF001 - one object in two classes

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        if self._is_current:
            self._line._lost(exc)  # noqa: SLF001 - one object in two classes
