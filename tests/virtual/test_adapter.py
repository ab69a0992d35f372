"""Adapters between the client and the wire, of each kind."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import suppress
import socket

import pytest

from tests.simulated_client import PortClient, living, wait

from .abl import AblBox
from .adapter import ModbusTcpGateway
from .bus import VirtualBus
from .ports import DirectPort

READ_FULL = b":0103002E0005C9\r\n"
ANSWER = b">01030A2EA1110A03E803E803E847\r\n"
MODBUS_TCP = bytes.fromhex("000100000006010300000001")


@pytest.fixture
def bus() -> Iterator[VirtualBus]:
    with living(VirtualBus.in_loop(AblBox(1))) as bus:
        yield bus


def asked(client: PortClient) -> float:
    begin = client.time()
    assert client.ask(READ_FULL) == ANSWER
    return client.time() - begin


def test_delays_add_up(bus: VirtualBus) -> None:
    client = PortClient(bus)
    quick = asked(client)
    bus.adapter.delay_out, bus.adapter.delay_in = 0.05, 0.16
    # Beside the delays, the box takes up to 0.5 ms more or less.
    assert asked(client) == pytest.approx(quick + 0.21, abs=0.001)


def test_jitter_keeps_the_order(bus: VirtualBus) -> None:
    client = PortClient(bus)
    bus.adapter.jitter = 0.1
    took = [asked(client) for _ in range(20)]
    assert max(took) - min(took) > 0.05


def test_a_stuck_connection_is_dead_and_the_next_one_works(bus: VirtualBus) -> None:
    client = PortClient(bus)
    bus.adapter.stick()
    assert client.ask(READ_FULL, timeout=1) == b""
    assert bus.connected
    client.close()
    wait(bus, 0.1)
    assert asked(PortClient(bus))


def test_a_hung_adapter_passes_nothing(bus: VirtualBus) -> None:
    client = PortClient(bus)
    bus.adapter.hung = True
    assert client.ask(READ_FULL, timeout=1) == b""
    client.close()
    wait(bus, 0.1)
    client = PortClient(bus)
    assert client.ask(READ_FULL, timeout=1) == b""
    bus.adapter.hung = False
    assert asked(client)
    assert bus.adapter.lost == 2 * len(READ_FULL)


def test_an_idle_connection_is_closed(bus: VirtualBus) -> None:
    client = PortClient(bus)
    bus.adapter.idle_timeout = 10.0
    for _ in range(3):
        asked(client)
        wait(bus, 9)
    assert bus.connected
    wait(bus, 2)
    assert not bus.connected
    assert bus.adapter.closed_idle == 1
    assert asked(PortClient(bus))


def test_late_bytes_of_a_closed_connection_do_not_arrive(bus: VirtualBus) -> None:
    bus.adapter.delay_in = 1.0
    client = PortClient(bus)
    client.write(READ_FULL)
    wait(bus, 0.5)
    client.close()
    wait(bus, 0.1)
    client = PortClient(bus)
    assert client.read_some(3) == b""


@pytest.mark.parametrize("kind", ["silent", "closes", "answers"])
def test_a_gateway_for_modbus_tcp(bus: VirtualBus, kind: str) -> None:
    client = PortClient(bus)
    bus.adapter.gateway = ModbusTcpGateway(kind)  # type: ignore[arg-type]
    client.write(READ_FULL)
    # ":0", protocol "10", unit "2": an exception, if it answers at all.
    expected = b":0" + bytes.fromhex("0000000330") + bytes((ord("2") | 0x80, 1))
    assert client.read_some(1) == (expected if kind == "answers" else b"")
    assert bus.connected == (kind != "closes")
    assert len(bus.log) == 0


def test_a_gateway_answers_modbus_tcp() -> None:
    """Nothing answers behind it: exception 0x0B."""
    gateway = ModbusTcpGateway()
    assert gateway.receive(MODBUS_TCP[:9]) == b""
    assert gateway.receive(MODBUS_TCP[9:]) == bytes.fromhex("00010000000301830b")
    assert gateway.dropped == 0


def test_a_connection_that_is_ignored_or_refused(bus: VirtualBus) -> None:
    port = DirectPort.find(bus.url)
    assert port is not None

    async def connect() -> float:
        begin = bus.time()
        transport = await port.connect(asyncio.Protocol())
        transport.close()
        return bus.time() - begin

    run = bus.loop.run_until_complete
    bus.answer_calls("refuses")
    with pytest.raises(ConnectionRefusedError):
        run(connect())
    bus.answer_calls("ignores")
    with pytest.raises(TimeoutError):
        run(connect())
    bus.loop.call_later(2.0, bus.answer_calls, "accepts")
    assert run(connect()) == pytest.approx(3.0, abs=0.01)


@pytest.mark.real_time
@pytest.mark.slow
@pytest.mark.usefixtures("socket_enabled")
def test_a_socket_that_is_ignored_or_refused() -> None:
    def call() -> str:
        with socket.socket() as client:
            client.settimeout(0.3)
            with suppress(TimeoutError):
                return str(client.connect_ex(("127.0.0.1", port)))
        return "no answer"

    with VirtualBus.tcp(AblBox(1)) as bus:
        port = int(bus.url.rpartition(":")[2])
        assert call() == "0"
        bus.answer_calls("ignores")
        assert call() != "0"
        bus.answer_calls("refuses")
        assert call() not in ("0", "no answer")
        bus.answer_calls("accepts")
        assert call() == "0"
