"""The script: ready line, commands, counters, clean end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import json
from pathlib import Path
import signal
import subprocess
import sys
import termios
import time

import pytest

from .ews_client import EwsClient
from .raw_client import RawClient
from .smartevse_frames import FRAME_GAP

SCRIPT = Path(__file__).parents[2] / "scripts" / "virtual-chargers"
READ_FULL = b":0103002E0005C9\r\n"
READ_ICMAX = b":0103000F0005E8\r\n"
PATIENCE = 30.0


@contextmanager
def running(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    process = subprocess.Popen(  # noqa: S603 - our own script
        [sys.executable, str(SCRIPT), *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout
        word, protocol, url = process.stdout.readline().split()
        assert (word, protocol) == ("ready", arguments[0])
        yield process, url
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE)


def test_abl(tmp_path: Path) -> None:
    stats, link = tmp_path / "stats.json", tmp_path / "ttyABL"
    arguments = ["--ids", "1", "2", "--dead", "2", "--control"]
    arguments += ["--stats", str(stats), "--pty", str(link)]
    with running("abl", *arguments) as (process, url):
        assert url == str(link)
        assert process.stdin
        assert process.stdout
        with RawClient(url, "E") as client:
            assert client.ask(READ_FULL).startswith(b">01030A2EA1")
            for text in ("plug 1", "others 1 0", "nonsense 1"):
                process.stdin.write(text + "\n")
                process.stdin.flush()
            answers = [process.stdout.readline() for _ in range(3)]
            assert answers[:2] == ["ok\n", "ok\n"]
            assert answers[2].startswith("error nonsense 1: no such command")
            asked = 2
            deadline = time.monotonic() + PATIENCE
            # The box follows the other master at its next step.
            while client.ask(READ_ICMAX)[19:23] != b"03E8":
                assert time.monotonic() < deadline
                asked += 1
            # Paused, it still reports its default: only 0x0F has the pause.
            assert client.ask(READ_FULL)[11:15] in (b"910A", b"110A")
            asked += 1
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 0
    counters = json.loads(stats.read_text())
    assert counters["devices"]["abl-1"]["requests"] == asked
    assert counters["devices"]["abl-2"]["requests"] == 0
    assert not link.exists()


def test_cars_that_come_and_go() -> None:
    """With `--away` cars come sooner than by default."""
    arguments = ["--cars", "auto", "--away", "0", "0"]
    with running("abl", *arguments) as (_, url), RawClient(url, "E") as client:
        deadline = time.monotonic() + PATIENCE
        while client.ask(READ_FULL)[9:11] not in (b"B1", b"B2", b"C2"):
            assert time.monotonic() < deadline


@pytest.mark.usefixtures("socket_enabled")
def test_evbox() -> None:
    arguments = ["--serials", "7", "--modules", "3", "--tcp", "0"]
    with running("evbox", *arguments) as (_, url), RawClient(url) as client:
        request = b"\x0280A06900E6008C0154003C002800500046F703\x03"
        assert client.ask(request, b"\x03")[15:17] == b"03"


def test_smartevse(tmp_path: Path) -> None:
    """A slave that sends requests, and commands for the box's menu and button."""
    stats = tmp_path / "stats.json"
    arguments = ["--load-balance", "0", "2", "--max-current", "20", "--cables", "32"]
    arguments += ["--control", "--stats", str(stats), "--time-scale", "4"]
    with running("smartevse", *arguments) as (process, url):
        assert process.stdin
        assert process.stdout
        with RawClient(url, "N", termios.B9600) as client:
            client.write(bytes.fromhex("000400a0000931ff"))
            assert client.read(23)[:5].hex() == "0004120041"
            for text in ("plug 2", "menu 2 min_current 8", "press 0", "fail 2 1"):
                process.stdin.write(text + "\n")
                process.stdin.flush()
            answers = [process.stdout.readline() for _ in range(4)]
            assert answers[:3] == ["ok\n"] * 3
            assert answers[3].startswith("error fail 2 1: no such command")
            assert client.read(6).hex() == "0206000200c8"
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE) == 0
    counters = json.loads(stats.read_text())["devices"]
    assert counters["smartevse-0"]["requests"] == 1
    assert counters["smartevse-2"]["unasked"] >= 1


def test_smartevse_dialects() -> None:
    arguments = ["--dialect", "2.30", "--serial", "77"]
    with (
        running("smartevse", *arguments) as (_, url),
        RawClient(url, "N", termios.B9600) as client,
    ):
        client.write(bytes.fromhex("0103000b0001f5c8"))
        assert client.read(7)[:5].hex() == "010302004d"


def test_smartevse_nodes_of_several_dialects() -> None:
    """A 3.x answers as a node only; each box has its own firmware."""
    arguments = ["--dialect", "2.30", "2.30+", "3", "--load-balance", "2", "3", "8"]
    arguments += ["--cars", "plugged", "--set", "circuit=20"]
    with (
        running("smartevse", *arguments) as (_, url),
        RawClient(url, "N", termios.B9600) as client,
    ):
        # The stored circuit limit of each.
        for request in ("0204020100016181", "0304020100016050", "080402010001612b"):
            # Without silence after the reply before it, a request is no frame.
            time.sleep(2 * FRAME_GAP)
            client.write(bytes.fromhex(request))
            assert client.read(7)[1:5].hex() == "04020014"


def test_drivers_at_an_ews_box() -> None:
    arguments = ["--cars", "plugged", "--drivers", "--time-scale", "8"]
    with running("ews", *arguments) as (_, url), EwsClient.serial(url) as client:
        deadline = time.monotonic() + PATIENCE
        while [port["start_mode"] for port in client.ports()] != [1, 1]:
            assert time.monotonic() < deadline
