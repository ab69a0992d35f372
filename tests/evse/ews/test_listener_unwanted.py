"""Unwanted connections: little time, few bytes, no trust."""

import asyncio
from ipaddress import ip_network
import socket

import pytest

from custom_components.evse_bus.evse import recovery
from custom_components.evse_bus.evse.events import KEYS
from custom_components.evse_bus.evse.ews.box import MOST_KEYS
from custom_components.evse_bus.evse.ews.network import (
    admission,
    listener as listening,
)
from custom_components.evse_bus.evse.ews.network.line import AcceptedLine
from custom_components.evse_bus.evse.ews.wire import frames
from custom_components.evse_bus.evse.throttle import LOSSES
from tests.simulated_time import now
from tests.virtual.ews_box import EwsBox as VirtualBox

from .dialling import (
    HOST,
    SERIAL,
    dialling,
    expected,
    first,
    goes,
    has_reading,
    run,
    server,
    silent_client,
    until,
)

pytestmark = pytest.mark.usefixtures("socket_enabled")

RECORD = bytes.fromhex("02 000b 49 6966 00 0000000000000000 4d")


def test_addresses_that_may_not_connect() -> None:
    async def scene() -> None:
        async with server(allowed=(ip_network("192.0.2.0/24"),)) as made:
            with silent_client(made) as client:
                assert await goes(client)
            assert made.statistics.not_allowed == 1
        for allowed in ("127.0.0.0/8", "::ffff:127.0.0.0/104", "::ffff:127.0.0.1"):
            async with (
                server(allowed=(ip_network(allowed),)) as made,
                expected(made) as bus,
            ):
                with dialling(made):
                    await until(lambda known=bus: has_reading(known))

    run(scene)


def test_a_silent_connection_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listening, "IDENTIFY_TIME", 0.5)

    async def scene() -> None:
        async with server() as made:
            with silent_client(made) as client:
                assert await goes(client)
            assert made.statistics.unidentified == 1

    run(scene)


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\n\r\n" * 100,
        bytes(2000),
        b"\x02\x04\x11Cid" + bytes(1200),
        b"\x02\xff\xffAid" + b"\x02\x00" * 1000,
        RECORD * 1000,
    ],
    ids=["http", "zeros", "over-long", "longest", "records"],
)
def test_garbage_ends_a_connection(data: bytes) -> None:
    async def scene() -> None:
        async with server() as made:
            with silent_client(made) as client:
                await asyncio.get_running_loop().sock_sendall(client, data)
                assert await goes(client, 1.5)

    run(scene)


@pytest.mark.parametrize(
    "data",
    [
        b"\x02\x04\x00Aid" + RECORD,
        b"\x02\x04\x00Aid" * 10 + RECORD,
        b"\x02\x04\x00Aid" + RECORD[:-1] + b"\0",
        b"\x02",
    ],
    ids=["nested", "nested deeply", "broken", "beginnings"],
)
def test_much_garbage_at_once_does_not_block_the_loop(
    data: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Work is counted in looks at a possible message, on any machine."""
    looks = 0
    length = frames._length

    def counted(head: bytes) -> int | None:
        nonlocal looks
        looks += 1
        return length(head)

    monkeypatch.setattr(frames, "_length", counted)

    async def scene() -> None:
        async with server() as made:
            [listening_at] = made._server.sockets  # type: ignore[union-attr]
            listening_at.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            with silent_client(made) as client:
                client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
                # All of it is there before the first byte is processed.
                garbage = data * ((1 << 18) // len(data))
                client.send(garbage)
                assert await goes(client)
            assert looks < 4 * len(garbage)

    run(scene)


def test_a_slow_connection_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listening, "IDENTIFY_TIME", 0.5)

    async def scene() -> None:
        box = VirtualBox(serial=SERIAL)
        async with server() as made, expected(made) as bus:
            with dialling(made, box) as dialler:
                dialler.pace = (1, 0.05)
                await until(lambda: made.statistics.unidentified >= 2)
                assert not bus.connected

    run(scene)


def test_silent_connections_do_not_keep_boxes_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(admission, "GRACE", 0.1)
    monkeypatch.setattr(admission, "PLACES", 16)

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            silent = [socket.create_connection((HOST, made.port)) for _ in range(40)]
            await until(lambda: made.statistics.accepted + made.statistics.crowded_out)
            await asyncio.sleep(0.2)
            with dialling(made):
                await until(lambda: has_reading(bus))
            assert made.statistics.crowded_out > 0
            # One more for the registered box.
            assert len(made._unidentified) <= admission.PLACES + 1
            for one in silent:
                one.close()

    run(scene)


def test_many_connections_do_not_fill_the_log(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """With the number of a box that is away, any device is taken for it."""
    monkeypatch.setattr(recovery, "PAUSES", (0.01,))
    monkeypatch.setattr(listening, "PROOF_PAUSE", 0.0)
    monkeypatch.setattr(admission, "ADDRESS_BYTES", 1 << 20)
    cycles = LOSSES + 10

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with dialling(made) as first_one:
                await until(lambda: bus.connected)
                with dialling(made):
                    for cycle in range(1, cycles + 1):
                        await until(lambda: bus.connected)
                        dropped = made.statistics.duplicates
                        await until(lambda n=dropped: made.statistics.duplicates > n)
                        bus.line.end("it goes")
                        await until(lambda n=cycle: bus.line.statistics.lost >= n)
            assert first_one.attempts

    run(scene)
    warnings = [
        one.getMessage() for one in caplog.records if one.levelname == "WARNING"
    ]
    for text in ("was lost", "connected again", "connected and answers"):
        assert 0 < sum(text in one for one in warnings) <= LOSSES


def test_a_flood_of_key_events_is_limited() -> None:
    """Each would be an event: a flood of them would keep Home Assistant busy."""
    record = bytes.fromhex("02 000b 49 6966 00 ffffffffffffffff 4d")
    events: list[object] = []

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with dialling(made):
                await until(lambda: has_reading(bus))
                first(bus).subscribe_events(events.append)
                line, wire = bus.line, bus.wire.statistics
                assert isinstance(line, AcceptedLine)
                begun = now()
                for _ in range(5):
                    replies = wire.replies
                    line.received(record * 500)
                    assert line.is_open
                    await until(lambda n=replies: wire.replies > n)
                windows = now() - begun + 1
            assert KEYS <= len(events) <= MOST_KEYS * windows

    run(scene)


def test_a_box_is_rarely_polled_for_other_connections() -> None:
    box = VirtualBox(serial=SERIAL)

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with dialling(made, box):
                await until(lambda: has_reading(bus))
                with dialling(made):
                    await until(lambda: made.statistics.duplicates > 1)
                    before, refused = len(box.commands), made.statistics.duplicates
                    await asyncio.sleep(2.0)
                    assert made.statistics.duplicates > refused
                    asked = [one.name for one in box.commands[before:]]
            # A poll every 0.5 s, and one a second for the other connection.
            assert asked.count("rc") <= 8
            assert made.statistics.replaced == 0

    run(scene)
