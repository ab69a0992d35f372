"""One serial line: opening and its errors, echo, loss. Real ptys and sockets."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
import errno
import itertools
import os
from pathlib import Path
import socket
import tty
from unittest.mock import AsyncMock, Mock, patch

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse import line as module
from custom_components.evse_bus.evse.errors import (
    LineError,
    LineLostError,
    PortBusyError,
    PortMissingError,
    PortPermissionError,
    PortSettingsError,
)
from custom_components.evse_bus.evse.framing import LineSettings
from custom_components.evse_bus.evse.line import Line, line_error

pytestmark = pytest.mark.real_time

PATIENCE = 30.0

SETTINGS = LineSettings(baudrate=38400)


class Ear:
    """Hears what a line hands on, and waits for it."""

    def __init__(self, line: Line) -> None:
        self.data = b""
        self.lost: list[LineLostError] = []
        self._changed = asyncio.Event()
        line.on_data = self._on_data
        line.on_lost = self._on_lost

    def _on_data(self, data: bytes) -> None:
        self.data += data
        self._changed.set()

    def _on_lost(self, error: LineLostError) -> None:
        self.lost.append(error)
        self._changed.set()

    async def until(self, condition: Callable[[], bool]) -> None:
        async with asyncio.timeout(PATIENCE):
            while not condition():
                self._changed.clear()
                await self._changed.wait()


@contextmanager
def pty() -> Iterator[tuple[int, str]]:
    """Yield the master's descriptor and the path of the slave."""
    master, slave = os.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    os.close(slave)
    try:
        yield master, path
    finally:
        with suppress(OSError):
            os.close(master)


@asynccontextmanager
async def opened(url: str, settings: LineSettings = SETTINGS) -> AsyncIterator[Line]:
    line = Line(url, settings)
    await line.open()
    try:
        yield line
    finally:
        await line.close()


@asynccontextmanager
async def server(
    behave: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]],
) -> AsyncIterator[str]:
    """Serve one TCP connection after the other; yield the URL."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(ConnectionError, asyncio.IncompleteReadError):
            await behave(reader, writer)
        writer.close()

    listener = await asyncio.start_server(serve, "127.0.0.1", 0)
    port = listener.sockets[0].getsockname()[1]
    try:
        yield f"socket://127.0.0.1:{port}"
    finally:
        listener.close()


async def test_bytes_go_out_and_come_in() -> None:
    with pty() as (master, path):
        async with opened(path) as line:
            ear = Ear(line)
            end = line.write(b"question")
            assert end > asyncio.get_running_loop().time()
            loop = asyncio.get_running_loop()
            asked = await loop.run_in_executor(None, os.read, master, 100)
            assert asked == b"question"
            os.write(master, b"answer")
            await ear.until(lambda: ear.data == b"answer")
            assert line.statistics.bytes_out == 8
            assert line.statistics.bytes_in == 6


async def test_a_missing_port() -> None:
    with pytest.raises(PortMissingError, match="No such file"):
        await Line("/dev/serial/by-id/usb-nothing", SETTINGS).open()


async def test_a_busy_port() -> None:
    with pty() as (_, path):
        async with opened(path):
            with pytest.raises(PortBusyError):
                await Line(path, SETTINGS).open()


@pytest.fixture
def locked_port(tmp_path: Path) -> Path:
    """Return a port that nobody may open, in folders that anybody may enter."""
    locked = tmp_path / "ttyUSB0"
    locked.touch(mode=0)
    for folder in (tmp_path, *tmp_path.parents):
        if "pytest-" in folder.as_posix():
            folder.chmod(0o755)
    return locked


async def test_a_port_without_permission(locked_port: Path) -> None:
    root = os.geteuid() == 0
    if root:
        # Root may open everything: be somebody else while the port is opened.
        os.seteuid(65534)
    try:
        with pytest.raises(PortPermissionError):
            await Line(str(locked_port), SETTINGS).open()
    finally:
        if root:
            os.seteuid(0)


async def test_something_that_is_no_serial_port(tmp_path: Path) -> None:
    plain = tmp_path / "notes.txt"
    plain.write_text("hello")
    with pytest.raises(PortSettingsError):
        await Line(str(plain), SETTINGS).open()


@pytest.mark.parametrize("url", ["nonsense://x", "socket://", "socket://127.0.0.1:x"])
async def test_a_url_that_cannot_be_understood(url: str) -> None:
    with pytest.raises(LineError):
        await Line(url, SETTINGS).open()


@pytest.mark.usefixtures("socket_enabled")
async def test_a_network_port_that_nobody_serves() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(PortMissingError):
        await Line(f"socket://127.0.0.1:{port}", SETTINGS).open()


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (OSError(errno.EBUSY, "busy"), PortBusyError),
        (PermissionError(errno.EACCES, "no"), PortPermissionError),
        (FileNotFoundError(errno.ENOENT, "no"), PortMissingError),
        (OSError(errno.EHOSTUNREACH, "no"), PortMissingError),
        (TimeoutError(), PortMissingError),
        (ConnectionRefusedError(), PortMissingError),
        (socket.gaierror(-2, "unknown name"), PortMissingError),
        (OSError(errno.EINVAL, "parity"), PortSettingsError),
        (ValueError("baud"), PortSettingsError),
        (OSError(errno.EMFILE, "too many"), LineError),
        (RuntimeError("odd"), LineError),
    ],
    ids=repr,
)
def test_errors_have_types(error: Exception, kind: type[LineError]) -> None:
    assert type(line_error(error)) is kind
    assert str(line_error(error))


async def test_an_unplugged_adapter_is_told_once_and_can_be_opened_again() -> None:
    with pty() as (master, path):
        line = Line(path, SETTINGS)
        ear = Ear(line)
        await line.open()
        os.close(master)
        await ear.until(lambda: bool(ear.lost))
        assert not line.is_open
        with pytest.raises(LineLostError):
            line.write(b"x")
        await line.close()
        assert len(ear.lost) == 1
        with pytest.raises(PortMissingError):
            await line.open()
    with pty() as (_, path):
        line.url = path
        await line.open()
        assert line.is_open
        assert line.statistics.opened == 2
        await line.close()


@pytest.mark.usefixtures("socket_enabled")
async def test_closing_is_no_loss() -> None:
    async def wait(reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
        await reader.read()

    async with server(wait) as url, opened(url) as line:
        ear = Ear(line)
        await line.close()
        await line.close()
        await asyncio.sleep(0)
        assert ear.lost == []


async def test_a_closed_connection_that_ends_late_is_not_the_next_one() -> None:
    """Where closing takes too long, its end comes when the next one is open."""
    receivers: list[asyncio.Protocol] = []

    async def connect(
        _loop: object, factory: Callable[[], asyncio.Protocol], _url: str, **_: object
    ) -> tuple[Mock, asyncio.Protocol]:
        receivers.append(factory())
        return Mock(wait_closed=AsyncMock()), receivers[-1]

    line = Line("port", SETTINGS)
    ear = Ear(line)
    with patch.object(module, "create_serial_connection", connect):
        await line.open()
        await line.close()
        await line.open()
    receivers[0].connection_lost(None)
    receivers[0].data_received(b"old")
    assert line.is_open
    assert ear.lost == []
    assert not ear.data
    receivers[1].connection_lost(None)
    assert not line.is_open


@pytest.mark.usefixtures("socket_enabled")
async def test_a_closed_connection_is_a_loss() -> None:
    async def hang_up(reader: asyncio.StreamReader, _: asyncio.StreamWriter) -> None:
        await reader.readexactly(1)

    async with server(hang_up) as url, opened(url) as line:
        ear = Ear(line)
        line.write(b"x")
        await ear.until(lambda: bool(ear.lost))


class EchoTest(Line):
    """A line whose bytes come from the test alone."""

    def __init__(self) -> None:
        super().__init__("test", SETTINGS)
        self.heard = b""
        self.on_data = self._hear
        self._transport = self  # type: ignore[assignment]

    def _hear(self, data: bytes) -> None:
        self.heard += data

    def write(self, data: bytes, *, reply_may_equal: bool = False) -> float:
        real, self._transport = self._transport, _Sink()  # type: ignore[assignment]
        try:
            return super().write(data, reply_may_equal=reply_may_equal)
        finally:
            self._transport = real

    def hear(self, data: bytes) -> None:
        self._received(data)


class _Sink:
    def write(self, data: bytes) -> None:
        pass


@given(
    request=st.binary(min_size=1, max_size=40),
    reply=st.binary(min_size=1, max_size=40),
    cuts=st.lists(st.integers(0, 80), max_size=6),
)
def test_an_echo_is_taken_out_however_it_is_cut(
    request: bytes, reply: bytes, cuts: list[int]
) -> None:
    async def scene() -> None:
        line = EchoTest()
        line.write(request)
        stream = request + reply
        edges = sorted({0, len(stream), *(cut for cut in cuts if cut < len(stream))})
        for start, end in itertools.pairwise(edges):
            line.hear(stream[start:end])
        assert line.heard == reply
        assert line.echoes is True

    asyncio.run(scene())


@given(request=st.binary(min_size=1, max_size=40), reply=st.binary(max_size=40))
def test_what_is_no_echo_is_handed_on_whole(request: bytes, reply: bytes) -> None:
    async def scene() -> None:
        line = EchoTest()
        line.write(request)
        for byte in reply:
            line.hear(bytes((byte,)))
        # What may still become an echo is held; a wrong byte lets go of all.
        if not request.startswith(reply):
            expected = reply
            if reply.startswith(request):
                expected = reply[len(request) :]
            assert line.heard == expected

    asyncio.run(scene())


def test_an_answer_that_equals_the_request_is_not_taken_for_an_echo() -> None:
    async def scene() -> None:
        line = EchoTest()
        line.write(b"write", reply_may_equal=True)
        line.hear(b"write")
        assert line.heard == b"write"
        line.answered()
        assert line.echoes is False

    asyncio.run(scene())


def test_an_adapter_known_to_echo_is_still_cleaned_then() -> None:
    async def scene() -> None:
        line = EchoTest()
        line.write(b"read")
        line.hear(b"readanswer")
        line.answered()
        line.write(b"write", reply_may_equal=True)
        line.hear(b"writewrite")
        assert line.heard == b"answerwrite"
        assert line.statistics.echo_bytes == 9

    asyncio.run(scene())
