"""Crowds of connections that never say which box they are, and boxes among them."""

import asyncio
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from ipaddress import ip_address
from itertools import pairwise
import logging
import socket
from types import SimpleNamespace

import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.ews.network import admission
from custom_components.evse_bus.evse.ews.network.listener import (
    ACCEPTED_AT_ONCE,
    Listener,
)
from custom_components.evse_bus.evse.ews.wire.frames import EwsFrame, EwsFramer
from tests.simulated_time import now
from tests.virtual.ews_box import EwsBox as VirtualBox
from tests.virtual.ews_dialler import EwsDialler

from .dialling import HOST, SERIAL, expected, has_reading, run, server, until

pytestmark = pytest.mark.usefixtures("socket_enabled")

PER_SECOND = 100
MOST_CLIENTS = 300
LONGEST = 10.0
"""Longest time that a known box is kept out, s."""
RETRIES = (0.5, 1.0, 3.0)
"""Pauses of a box between two attempts, s: the manual names none."""
ONE = ("127.0.1.1",)
MANY = tuple(f"127.0.1.{number}" for number in range(1, 201))
"""Addresses of crowds; all of 127.0.0.0/8 are this machine."""
GARBAGE = b"\x02\x00\x0bIif\x00" * 100


@pytest.fixture
def few_places(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have fewer places than the crowd needs."""
    monkeypatch.setattr(admission, "PLACES", 16)


@asynccontextmanager
async def crowd(
    made: Listener,
    sources: Sequence[str],
    says: bytes = b"",
) -> AsyncIterator[None]:
    """Let connections come and wait."""
    clients: list[socket.socket] = []

    async def come() -> None:
        loop = asyncio.get_running_loop()
        number = 0
        while True:
            client = socket.socket()
            client.setblocking(False)  # noqa: FBT003 - the call takes no keyword
            client.bind((sources[number % len(sources)], 0))
            clients.append(client)
            with suppress(OSError):
                await loop.sock_connect(client, (HOST, made.port))
                await loop.sock_sendall(client, says)
            number += 1
            if len(clients) > MOST_CLIENTS:
                clients.pop(0).close()
            await asyncio.sleep(1 / PER_SECOND)

    task = asyncio.create_task(come())
    counted = made.statistics
    await until(lambda: counted.accepted + counted.crowded_out > PER_SECOND)
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        for client in clients:
            client.close()


def dialler(made: Listener, source: str, retry: float) -> EwsDialler:
    return EwsDialler(
        VirtualBox(serial=SERIAL),
        HOST,
        made.port,
        retry=retry,
        source_ports=0,
        source_host=source,
        own_thread=False,
    )


async def is_back(bus: Bus) -> float:
    """Wait until a box is connected; return how long it took, s."""
    begun = now()
    await until(lambda: bus.connected and has_reading(bus), 60.0)
    return now() - begun


@pytest.mark.usefixtures("few_places")
@pytest.mark.parametrize("retry", RETRIES)
@pytest.mark.parametrize("sources", [ONE, MANY], ids=["one address", "many"])
def test_a_known_box_is_back_in_time(sources: Sequence[str], retry: float) -> None:
    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with dialler(made, "127.0.0.9", retry) as box:
                await is_back(bus)
                async with crowd(made, sources):
                    for _ in range(5):
                        box.hang_up()
                        await until(lambda: not bus.connected)
                        assert await is_back(bus) < LONGEST

    run(scene)


@pytest.mark.usefixtures("few_places")
@pytest.mark.parametrize("retry", RETRIES)
def test_a_known_box_is_back_in_time_after_a_restart(retry: float) -> None:
    """The crowd is there first; its addresses are stored."""

    async def scene() -> None:
        async with server() as made:
            known = [ip_address("127.0.0.9")]
            made.register(SERIAL, addresses=known)
            async with crowd(made, MANY), expected(made) as bus:
                with dialler(made, "127.0.0.9", retry):
                    assert await is_back(bus) < LONGEST

    run(scene)


@pytest.mark.parametrize("retry", RETRIES)
@pytest.mark.parametrize("sources", [ONE, MANY], ids=["one address", "many"])
def test_a_box_with_a_new_address_finds_a_place(
    sources: Sequence[str], retry: float
) -> None:
    """DHCP has given it a new one."""

    async def scene() -> None:
        async with server() as made, expected(made) as bus, crowd(made, sources):
            with dialler(made, "127.0.0.9", retry) as box:
                assert await is_back(bus) < LONGEST
                box.source_host = "127.0.0.10"
                box.hang_up()
                await until(lambda: not bus.connected)
                assert await is_back(bus) < LONGEST
                assert list(map(str, made._registered[SERIAL].addresses)) == [
                    "127.0.0.10",
                    "127.0.0.9",
                ]

    run(scene)


@pytest.mark.parametrize("retry", RETRIES[:2])
def test_a_box_that_shares_its_address_with_the_crowd(retry: float) -> None:
    """Behind a router that translates addresses."""

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with dialler(made, ONE[0], retry) as box:
                await is_back(bus)
                async with crowd(made, ONE):
                    for _ in range(5):
                        box.hang_up()
                        await until(lambda: not bus.connected)
                        assert await is_back(bus) < LONGEST

    run(scene)


@pytest.mark.usefixtures("few_places")
def test_a_crowd_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    async def scene() -> None:
        async with server() as made, crowd(made, MANY, GARBAGE):
            async with crowd(made, MANY):
                await asyncio.sleep(10.0)
            assert made.statistics.crowded_out > 0
            assert made.statistics.over_budget > 0

    run(scene)
    warnings = [one for one in caplog.records if one.levelno >= logging.WARNING]
    assert len(warnings) == 1
    assert "connections of devices that are no known box" in warnings[0].getMessage()


@pytest.mark.parametrize("sources", [ONE, MANY], ids=["one address", "many"])
def test_the_bytes_of_strangers_are_limited(
    sources: Sequence[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Work is counted in bytes that are searched for messages."""
    searched = SimpleNamespace(bytes=0)
    feed = EwsFramer.feed

    def counted(self: EwsFramer, data: bytes) -> list[EwsFrame]:
        searched.bytes += len(data)
        return feed(self, data)

    monkeypatch.setattr(EwsFramer, "feed", counted)

    async def scene() -> None:
        async with server() as made, crowd(made, sources, GARBAGE):
            seconds = 30.0
            await asyncio.sleep(seconds)
            most = admission.ALL_BYTES * (2 + seconds / admission.RECOVERY)
            assert 0 < searched.bytes < most
            if len(sources) == 1:
                assert searched.bytes < most * (
                    admission.ADDRESS_BYTES / admission.ALL_BYTES
                )

    run(scene)


def test_few_connections_are_accepted_at_once() -> None:
    """One round of the event loop is short, however many wait."""
    rounds: list[int] = []

    async def scene() -> None:
        loop = asyncio.get_running_loop()

        def count() -> None:
            rounds.append(made.statistics.accepted)
            if rounds[-1] < len(clients):
                loop.call_soon(count)

        async with server() as made:
            clients = [socket.create_connection((HOST, made.port)) for _ in range(100)]
            loop.call_soon(count)
            await until(lambda: made.statistics.accepted == len(clients))
            for client in clients:
                client.close()

    run(scene)
    most = max(after - before for before, after in pairwise(rounds))
    assert most <= ACCEPTED_AT_ONCE + 1


def test_a_box_that_dials_anew_from_its_address_is_back_soon() -> None:
    """Its cable was out: only the old connection is silent, not the box."""

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with dialler(made, "127.0.0.9", 0.5) as box:
                await is_back(bus)
                begun = now()
                box.vanish()
                await until(lambda: made.statistics.replaced, 20.0)
                assert now() - begun < 4.0
                assert await is_back(bus) < 2.0
                # Any other device has to wait longer for the place.
                box.source_host = "127.0.0.10"
                begun = now()
                box.vanish()
                await until(lambda: made.statistics.replaced == 2, 20.0)
                assert now() - begun > 8.0
                await is_back(bus)

    run(scene)


@pytest.mark.real_time
def test_a_known_box_in_a_crowd_in_real_time() -> None:
    async def scene() -> None:
        loop = asyncio.get_running_loop()
        async with server() as made, expected(made) as bus:
            with dialler(made, "127.0.0.9", 0.5) as box:
                await until(lambda: has_reading(bus))
                async with crowd(made, MANY):
                    box.hang_up()
                    await until(lambda: not bus.connected)
                    begun = loop.time()
                    await until(lambda: bus.connected, LONGEST)
                    assert loop.time() - begun < LONGEST

    asyncio.run(scene())
