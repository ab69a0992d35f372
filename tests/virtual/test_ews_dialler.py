"""The virtual EWS-Box that dials in: connections, time-outs, unusual frames."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import json
from pathlib import Path
import signal
import socket
import subprocess
import sys

import pytest

from tests.simulated_client import PortClient, SocketClient, living, wait

from .bus import VirtualBus
from .car import Car
from .ews_box import EwsBox
from .ews_cli import EwsFleet
from .ews_client import EwsClient
from .ews_dialler import EwsDialler
from .ews_frames import command, ews_commands_in
from .ews_records import InfoMix
from .log import CLIENT
from .raw_client import RawSocket
from .test_ews_box import SIZES

pytestmark = pytest.mark.usefixtures("socket_enabled")

SCRIPT = Path(__file__).parents[2] / "scripts" / "virtual-chargers"
RETRY = 0.02


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening


@contextmanager
def dialling(
    server: socket.socket, box: EwsBox, **options: float
) -> Iterator[EwsDialler]:
    options.setdefault("retry", RETRY)
    dialler = EwsDialler(box, *server.getsockname(), own_thread=False, **options)  # type: ignore[arg-type]
    with living(dialler):
        yield dialler


def accept(dialler: EwsDialler, server: socket.socket) -> EwsClient:
    return EwsClient(SocketClient(dialler, server))


def gone(client: EwsClient) -> bool:
    """Return whether the other end has closed (not: is silent)."""
    try:
        client.read(2)
    except ConnectionResetError:
        return True
    line = client.line
    assert isinstance(line, SocketClient | RawSocket)
    return line.ended


def test_the_box_dials_and_answers(server: socket.socket) -> None:
    box = EwsBox()
    with dialling(server, box) as dialler, accept(dialler, server) as client:
        for name, size in SIZES.items():
            assert len(client.ask(name)) == size
        assert client.ask("rs")[57] == 1
        assert box.server_connected
        assert dialler.connected
        assert dialler.opened == dialler.attempts == 1
        received = ews_commands_in(dialler.log.of(CLIENT))
        assert [m.name for m in received] == [*SIZES, "rs"]
        assert client.ask("rp")[13] == 0b00001
        assert not dialler.dropped


def test_it_waits_for_a_server() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        address = listening.getsockname()
    with living(
        EwsDialler(EwsBox(), *address, retry=RETRY, own_thread=False)
    ) as dialler:
        dialler.wait_for(lambda: dialler.attempts > 5)
        assert not dialler.connected
        with socket.create_server(address) as again, accept(dialler, again) as client:
            assert len(client.ask("id")) == 11


def test_thirty_seconds_without_a_command(server: socket.socket) -> None:
    box = EwsBox()
    with dialling(server, box) as dialler:
        with accept(dialler, server) as client:
            dialler.advance(25)
            client.ask("rc")
            dialler.advance(25)
            assert dialler.connected
            # Bytes that are no command do not count.
            client.write(b"UUUU")
            dialler.advance(6)
            assert gone(client)
        assert dialler.dropped == ["30 s without a command"]
        with accept(dialler, server) as client:
            assert len(client.ask("id")) == 11


def test_ten_minutes_without_a_server(server: socket.socket) -> None:
    car = Car()
    box = EwsBox(cars=(car,))
    with dialling(server, box) as dialler:
        with accept(dialler, server) as client:
            car.plug_in()
            dialler.advance(1)
            assert client.order(1, 3) == 0
            dialler.advance(1)
            assert box.ports[0].contactor
        server.close()
        dialler.advance(590)
        assert box.ports[0].contactor
        dialler.advance(12)
        assert not box.ports[0].contactor
        assert not box.ports[0].locked
        assert box.ports[0].session.result == 7
        assert box.ports[0].status == 0x60


def test_ten_source_ports_in_turn(server: socket.socket) -> None:
    box = EwsBox(serial="000000000077")
    seen = []
    with dialling(server, box) as dialler:
        for _ in range(12):
            line = SocketClient(dialler, server)
            seen.append(line.address[1])
            line.close()
            dialler.wait_for(lambda: len(dialler.dropped) == len(seen))
    assert len(set(seen)) >= 9
    assert {port - 20770 for port in seen} <= set(range(10))
    assert dialler.dropped == ["by the server"] * 12


def test_half_open(server: socket.socket) -> None:
    box = EwsBox()
    with dialling(server, box) as dialler, accept(dialler, server) as old:
        assert len(old.ask("id")) == 11
        dialler.vanish()
        with accept(dialler, server) as new:
            assert len(new.ask("id")) == 11
            assert old.ask("id", timeout=0.1) == b"?"
            dialler.reset_half_open()
            with pytest.raises(OSError, match="reset"):
                old.read()


def test_a_power_failure_is_silent(server: socket.socket) -> None:
    box = EwsBox()
    with dialling(server, box) as dialler, accept(dialler, server) as old:
        dialler.wait_for(lambda: dialler.connected)
        box.power_off()
        assert old.ask("id", timeout=0.1) == b"?"
        assert not dialler.connected
        box.power_on()
        with accept(dialler, server) as new:
            assert new.ports()[0]["status"] == 0xF0
        assert dialler.dropped[0] == "power"


def test_a_reset_dials_again(server: socket.socket) -> None:
    box = EwsBox()
    with dialling(server, box) as dialler, accept(dialler, server) as old:
        assert old.ask("zz") == b""
        with accept(dialler, server) as new:
            assert new.ask("rs")[11] & 1
    assert box.restarts == 1


def test_a_pulled_network_cable(server: socket.socket) -> None:
    with dialling(server, EwsBox()) as dialler, accept(dialler, server) as old:
        dialler.unplug()
        assert old.ask("id", timeout=0.1) == b"?"
        dialler.replug()
        with accept(dialler, server) as new:
            assert len(new.ask("id")) == 11


def test_hanging_up(server: socket.socket) -> None:
    with dialling(server, EwsBox()) as dialler, accept(dialler, server) as client:
        dialler.hang_up(redial=False)
        assert gone(client)
        assert dialler.attempts == 1
        dialler.dial()
        with accept(dialler, server) as again:
            assert len(again.ask("id")) == 11


def test_half_of_the_lease(server: socket.socket) -> None:
    box = EwsBox()
    box.user.own_ip = bytes(4)
    box.lease = 40
    with dialling(server, box) as dialler, accept(dialler, server) as client:
        assert client.ask("rg")[20:24] == bytes((0, 0, 0, 40))
        dialler.advance(21)
        assert gone(client)
        assert dialler.dropped == ["half of the lease"]


def test_a_slow_sender(server: socket.socket) -> None:
    with dialling(server, EwsBox()) as dialler, accept(dialler, server) as client:
        dialler.pace = (1, 0.01)
        started = dialler.time()
        assert client.ask("id", timeout=2) == b"M165300103\x00"
        assert 0.15 < dialler.time() - started < 0.5


def test_characters_may_be_two_seconds_apart(server: socket.socket) -> None:
    box = EwsBox()
    with dialling(server, box) as dialler, accept(dialler, server) as client:
        client.write(command("id")[:3])
        wait(dialler, 0.2)
        client.write(command("id")[3:])
        message = client.next()
        assert message
        assert message.name == "id"
        assert box.frames.timeout == 2


def test_an_unfinished_command_ends_with_its_connection(server: socket.socket) -> None:
    box = EwsBox()
    with dialling(server, box) as dialler:
        with accept(dialler, server) as client:
            client.write(command("id")[:4])
            wait(dialler, 0.05)
        with accept(dialler, server) as client:
            assert len(client.ask("id")) == 11
    assert not box.frames.counters.bad_bcc


def test_garbage(server: socket.socket) -> None:
    box = EwsBox()
    with dialling(server, box) as dialler, accept(dialler, server) as client:
        box.send_raw(b"\x02\xff\xff" + bytes(64))
        assert client.read().startswith(b"\x02\xff\xff")


def test_events_wait_for_a_server() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        address = listening.getsockname()
    box = EwsBox(manual_io=True)
    with living(EwsDialler(box, *address, retry=RETRY, own_thread=False)) as dialler:
        box.press_key(1, 1, seconds=0.5)
        dialler.advance(1)
        box.key_down(1, 1)
        box.press_key(2, 2, seconds=0.5)
        dialler.advance(1)
        assert not box.infos
        with socket.create_server(address) as again, accept(dialler, again) as client:
            message = client.next(2)
            assert message
            # Pressed again: 255 in place of the old value; the other key was released.
            assert message.parameters == b"if\x00" + bytes((255, 0, 0, 0, 0, 5, 0, 0))
    assert len(box.infos) == 1


def test_an_info_record_at_any_cut(server: socket.socket) -> None:
    box = EwsBox(turn_round=0.0, jitter=0.0)
    with dialling(server, box) as dialler, accept(dialler, server) as client:
        for cut in range(1, 34, 3):
            box.mix_info(InfoMix("before", cut=cut, pause=0.002))
            assert client.ask("id") == b"M165300103\x00"
        assert len(client.unasked) == 11


def test_over_the_network_the_mode_stays(server: socket.socket) -> None:
    box = EwsBox()
    with dialling(server, box) as dialler, accept(dialler, server) as client:
        block = bytearray(client.ask("rp"))
        block[13] = 0b01110
        assert client.ask("sp", bytes(block)) == b"\x00"
        dialler.advance(2)
        assert client.ask("rp")[13] == 0b01011


def test_a_card_counts_as_valid_over_the_network(server: socket.socket) -> None:
    box = EwsBox(rfid=True)
    with dialling(server, box) as dialler, accept(dialler, server) as client:
        box.present_card()
        assert client.ask("rs")[91] == 1
        assert client.unasked[0].parameters[2] == 1


def test_a_standalone_box_does_not_dial() -> None:
    with pytest.raises(ValueError, match="does not dial"):
        EwsDialler(EwsBox(mode="standalone"), "127.0.0.1", 1)


def test_an_ethernet_box_sends_its_events_to_the_network_only() -> None:
    box = EwsBox(manual_io=True)
    box.system.mode &= ~0b100
    with living(VirtualBus.in_loop(box)) as bus:
        client = EwsClient(PortClient(bus))
        box.key_down(1, 1)
        assert len(client.ask("id")) == 11
        assert not client.unasked


def test_many_boxes_on_one_thread(server: socket.socket) -> None:
    boxes = [EwsBox(serial=f"{n:012d}") for n in range(400, 412)]
    with EwsFleet(boxes, *server.getsockname(), retry=RETRY) as fleet:
        clients = [EwsClient(RawSocket(server.accept()[0])) for _ in boxes]
        serials = sorted(client.ask("rs")[12:24] for client in clients)
        assert serials == [box.serial.encode() for box in boxes]
        fleet.advance(31)
        assert all(gone(client) for client in clients)
    assert len(fleet.devices) == 12


def test_the_script(server: socket.socket, tmp_path: Path) -> None:
    stats = tmp_path / "stats.json"
    address = f"127.0.0.1:{server.getsockname()[1]}"
    arguments = ["ews", "--dial", address, "--serials", "000000000501", "000000000502"]
    arguments += ["--control", "--manual-io", "--stats", str(stats)]
    process = subprocess.Popen(  # noqa: S603 - our own script
        [sys.executable, str(SCRIPT), *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin
    assert process.stdout
    try:
        assert process.stdout.readline() == f"ready ews dial://{address}\n"
        clients = {}
        for _ in range(2):
            client = EwsClient(RawSocket(server.accept()[0]))
            clients[client.ask("rs")[12:24]] = client
        for text in ("plug 501.2", "press 501.2 1 0.1", "rcd 502 on", "nothing 501"):
            process.stdin.write(text + "\n")
        process.stdin.flush()
        answers = [process.stdout.readline() for _ in range(4)]
        assert answers[:3] == ["ok\n"] * 3
        assert answers[3].startswith("error nothing 501")
        pressed = clients[b"000000000501"].next()
        assert pressed
        assert pressed.parameters == b"if\x00\x00\x00\x00\x00\xff\x00\x00\x00"
        assert clients[b"000000000502"].ports()[0]["status"] == 0xA8
        process.send_signal(signal.SIGTERM)
        assert process.wait(5) == 0
    finally:
        process.kill()
        process.communicate()
    assert json.loads(stats.read_text())["connected"] == 2
