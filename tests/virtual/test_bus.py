"""The wire: its pace, collisions, echo, noise, waiters."""

from __future__ import annotations

import ast
import asyncio
from pathlib import Path
import sys
import threading
import time

import pytest

from tests.simulated_client import PortClient, living

from .abl import AblBox
from .bus import VirtualBus
from .device import Device
from .evbox import EvboxChargePoint
from .log import CLIENT
from .raw_client import RawClient
from .wire import Segment

READ_FULL = b":0103002E0005C9\r\n"
ANSWER = b">01030A2EA1110A03E803E803E847\r\n"
E1_BYTE = 11 / 38400


def test_nothing_is_faster_than_the_wire() -> None:
    box = AblBox(1, turn_round=0.002, jitter=0)
    with living(VirtualBus.in_loop(box)) as bus:
        client = PortClient(bus)
        client.ask(READ_FULL)
        begin = bus.time()
        assert client.ask(READ_FULL) == ANSWER
        wire = (len(READ_FULL) + len(ANSWER)) * E1_BYTE + 0.002
        assert wire <= bus.time() - begin < wire + 0.002
        request, reply = bus.log.entries[-2:]
        assert request.end - request.t == pytest.approx(17 * E1_BYTE)
        assert reply.t - request.end >= 0.002
        assert reply.end - reply.t == pytest.approx(31 * E1_BYTE)


def test_a_reply_comes_in_pieces_at_the_wires_pace() -> None:
    box = EvboxChargePoint(1, 20)
    with living(VirtualBus.in_loop(box)) as bus:
        client = PortClient(bus)
        client.write(b"\x0280A06900E6008C0154003C002800500046F703\x03")
        answer = client.read(742)
        assert len(answer) == 742
        times = [t for t, _ in client.read_at]
        assert len(times) > 20
        # 742 bytes of 10 bits; the first piece has some of them already.
        assert times[-1] - times[0] > 730 * 10 / 38400 - 0.01
        for seen, (at, _) in enumerate(client.read_at[:-1]):
            done = sum(n for _, n in client.read_at[: seen + 1])
            assert at >= bus.log.entries[1].t + done * bus.byte_time


def test_a_request_during_a_reply_garbles_both() -> None:
    box = AblBox(1)
    with living(VirtualBus.in_loop(box)) as bus:
        client = PortClient(bus)
        client.write(READ_FULL)
        first = client.read(8)
        client.write(READ_FULL)
        bus.wait_for(lambda: len(bus.log) == 3)
        rest = client.read(40, 0.1)
        assert first + rest != ANSWER
        assert box.requests == 1
        reply, second = bus.log.entries[1:]
        assert {reply.source, second.source} == {"abl-1", CLIENT}
        assert reply.collided
        assert second.collided
        assert second.data != second.wire
        assert client.ask(READ_FULL) == ANSWER


def test_echo() -> None:
    with living(VirtualBus.in_loop(AblBox(1))) as bus:
        client = PortClient(bus)
        bus.faults.echo = True
        begin = bus.time()
        client.write(READ_FULL)
        assert client.read(17) == READ_FULL
        assert bus.time() - begin == pytest.approx(17 * E1_BYTE)
        assert client.read(31) == ANSWER
        bus.faults.echo = False
        assert client.ask(READ_FULL) == ANSWER


def test_injected_frames_reach_client_and_devices() -> None:
    box = AblBox(1)
    with living(VirtualBus.in_loop(box)) as bus:
        client = PortClient(bus)
        client.ask(READ_FULL)
        bus.inject(b":0110001400010200A632\r\n")
        assert client.read_line() == b":0110001400010200A632\r\n"
        assert client.read_line() == b">011000140001DA\r\n"
        assert box.limits_written == [166]


def test_another_master() -> None:
    with living(VirtualBus.in_loop(AblBox(1))) as bus:
        client = PortClient(bus)
        client.ask(READ_FULL)
        bus.foreign_traffic(b"XYZ\n", every=0.02)
        for _ in range(3):
            assert client.read_line() == b"XYZ\n"
        bus.quiet()
        bus.wait_for(lambda: not bus.wire.busy(bus.time()))
        client.read(100, 0.03)
        assert client.ask(READ_FULL) == ANSWER


def test_noise() -> None:
    with living(VirtualBus.in_loop(AblBox(1), seed=3)) as bus:
        client = PortClient(bus)
        client.ask(READ_FULL)
        bus.faults.noise_rate = 1000
        assert len(client.read(3)) == 3


def test_bytes_written_in_pieces_are_one_frame() -> None:
    with living(VirtualBus.in_loop(AblBox(1))) as bus:
        client = PortClient(bus)
        for index in range(len(READ_FULL)):
            client.write(READ_FULL[index : index + 1])
        assert client.read_line() == ANSWER
        assert bus.log.bursts(gap=0.1)[0].data == READ_FULL
        assert bus.log.sent_by_client() == READ_FULL


def test_waiting_from_another_thread() -> None:
    box = AblBox(1)
    with VirtualBus.pty(box) as bus, RawClient(bus.url, "E") as client:
        threading.Timer(0.02, client.write, (READ_FULL,)).start()
        assert bus.wait_for(lambda: box.requests) == 1
        with pytest.raises(TimeoutError):
            bus.wait_for(lambda: box.requests > 1, timeout=0.02)
        with pytest.raises(ZeroDivisionError):
            bus.wait_for(lambda: 1 // (box.requests - 1))
        with pytest.raises(ZeroDivisionError):
            bus.call(lambda: 1 // 0)


@pytest.mark.real_time
async def test_waiting_without_blocking() -> None:
    box = AblBox(1)
    async with VirtualBus.pty(box) as bus:
        with RawClient(bus.url, "E") as client:
            waiting = asyncio.create_task(bus.wait_for_async(lambda: box.requests))
            await asyncio.sleep(0)
            client.write(READ_FULL)
            assert await waiting == 1
            assert await bus.call_async(lambda: box.requests) == 1
            with pytest.raises(TimeoutError):
                await bus.wait_for_async(lambda: False, timeout=0.01)


def test_time_can_be_scaled_and_skipped() -> None:
    with VirtualBus.pty(AblBox(1), time_scale=100) as bus:
        begin = bus.now()
        bus.wait_for(lambda: bus.now() - begin > 10)
        bus.time_scale = 1
        begin = bus.now()
        bus.advance(3600)
        assert 3600 <= bus.now() - begin < 3610


def test_devices_can_come_and_go() -> None:
    box = AblBox(1)
    with living(VirtualBus.in_loop(box)) as bus:
        client = PortClient(bus)
        client.ask(READ_FULL)
        bus.remove(box)
        assert client.ask(READ_FULL, timeout=0.05) == b""
        bus.add(box)
        assert client.ask(READ_FULL) == ANSWER


def test_an_error_inside_is_raised() -> None:
    class Broken(Device):
        def receive(self, segment: Segment) -> None:
            raise LookupError(segment.data.decode())

    bus = VirtualBus.pty(Broken("broken")).start()
    with RawClient(bus.url) as client:
        client.write(b"x")
        bus.wait_for(lambda: bus.errors)
    with pytest.raises(RuntimeError, match="inside the virtual bus"):
        bus.stop()


def test_line_settings_must_agree() -> None:
    with pytest.raises(ValueError, match="line settings"):
        VirtualBus.pty(AblBox(1), EvboxChargePoint(1))


def test_stats() -> None:
    with living(VirtualBus.in_loop(AblBox(1))) as bus:
        client = PortClient(bus)
        client.ask(READ_FULL)
        stats = bus.stats()
    assert stats["bytes"] == 48
    assert stats["devices"]["abl-1"]["requests"] == 1  # type: ignore[index]


def test_no_module_imports_the_integration() -> None:
    for path in Path(__file__).parent.glob("*.py"):
        if path.name.startswith("test_"):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            else:
                # Relative imports stay inside this folder.
                assert getattr(node, "level", 0) <= 1
            for name in names:
                assert name.split(".")[0] in sys.stdlib_module_names, path


def test_frozen_time_does_not_stop_the_bus(freezer: object) -> None:
    assert freezer
    with VirtualBus.pty(AblBox(1)) as bus, RawClient(bus.url, "E") as client:
        assert time.monotonic() == time.monotonic()
        assert client.ask(READ_FULL) == ANSWER
        with pytest.raises(TimeoutError):
            bus.wait_for(lambda: False, timeout=0.02)


@pytest.mark.real_time
async def test_a_cancelled_wait_leaves_no_waiter() -> None:
    async with VirtualBus.pty(AblBox(1)) as bus:
        waiting = asyncio.create_task(bus.wait_for_async(lambda: bus.opened))
        await asyncio.sleep(0.01)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        with RawClient(bus.url):
            await bus.wait_for_async(lambda: bus.opened)
