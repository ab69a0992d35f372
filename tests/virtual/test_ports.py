"""The client's end: reopening, unplugging the adapter, one client at a time."""

from __future__ import annotations

import os
from pathlib import Path
import termios

import pytest

from .abl import AblBox
from .bus import VirtualBus
from .raw_client import RawClient

READ_FULL = b":0103002E0005C9\r\n"
ANSWER = b">01030A2EA1110A03E803E803E847\r\n"


@pytest.mark.parametrize("parity", ["N", "E", "O"])
def test_pty_opens_again_and_again(parity: str) -> None:
    with VirtualBus.pty(AblBox(1)) as bus:
        for _ in range(4):
            with RawClient(bus.url, parity) as client:
                assert client.ask(READ_FULL) == ANSWER
        bus.wait_for(lambda: not bus.connected)
        assert bus.opened >= 1


def test_unread_bytes_are_dropped_on_close() -> None:
    box = AblBox(1)
    with VirtualBus.pty(box) as bus:
        with RawClient(bus.url, "E") as client:
            client.write(READ_FULL)
            bus.wait_for(lambda: len(bus.log) == 2)
        bus.wait_for(lambda: not bus.connected)
        with RawClient(bus.url, "E") as client:
            assert client.read(1, 0.05) == b""


def test_bytes_of_a_client_that_closes_at_once_are_not_lost() -> None:
    box = AblBox(1)
    with VirtualBus.pty(box) as bus:
        with RawClient(bus.url, "E") as client:
            client.write(READ_FULL)
        bus.wait_for(lambda: box.requests == 1)


def test_pty_unplug_and_replug() -> None:
    with VirtualBus.pty(AblBox(1)) as bus:
        url = bus.url
        with RawClient(url, "E") as client:
            assert client.ask(READ_FULL) == ANSWER
            bus.unplug()
            assert not Path(url).exists()
            with pytest.raises(OSError, match="Input/output error"):
                client.write(READ_FULL)
            with pytest.raises(FileNotFoundError):
                RawClient(url)
            bus.replug()
        assert bus.url == url
        with RawClient(url, "E") as client:
            assert client.ask(READ_FULL) == ANSWER


def test_tcp_unplug_and_replug() -> None:
    with VirtualBus.tcp(AblBox(1)) as bus:
        url = bus.url
        with RawClient(url) as client:
            assert client.ask(READ_FULL) == ANSWER
            bus.unplug()
            assert client.read(1) == b""
            with pytest.raises(ConnectionRefusedError):
                RawClient(url)
            bus.replug()
        with RawClient(url) as client:
            assert client.ask(READ_FULL) == ANSWER


def test_tcp_has_one_client_at_a_time() -> None:
    with VirtualBus.tcp(AblBox(1)) as bus, RawClient(bus.url) as first:
        assert first.ask(READ_FULL) == ANSWER
        with RawClient(bus.url) as second:
            assert second.read(1) == b""
        assert first.ask(READ_FULL) == ANSWER
        first.close()
        with RawClient(bus.url) as third:
            assert third.ask(READ_FULL) == ANSWER


def test_a_given_link(tmp_path: Path) -> None:
    link = tmp_path / "ttyABL"
    with VirtualBus.pty(AblBox(1), link=str(link)) as bus:
        assert bus.url == str(link)
        with RawClient(str(link), "E") as client:
            assert client.ask(READ_FULL) == ANSWER
    assert not link.exists()


def test_pty_passes_all_bytes_as_they_are() -> None:
    everything = bytes(range(256))
    with VirtualBus.pty(baud=1_000_000, parity="N") as bus:
        client = os.open(bus.url, os.O_RDWR | os.O_NOCTTY)
        try:
            assert not termios.tcgetattr(client)[3] & termios.ECHO
            os.write(client, everything)
            bus.wait_for(lambda: bus.log.sent_by_client() == everything)
            bus.inject(everything)
            seen = b""
            while len(seen) < 256:
                seen += os.read(client, 256)
            assert seen == everything
        finally:
            os.close(client)


@pytest.fixture(autouse=True)
def _sockets(request: pytest.FixtureRequest) -> None:
    """Allow TCP on this machine where the test plugin forbids it."""
    if "tcp" in request.node.name:
        request.getfixturevalue("socket_enabled")
