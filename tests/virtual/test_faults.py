"""Faults, once and by rate."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

import pytest

from tests.simulated_client import PortClient, living

from .abl import AblBox
from .bus import VirtualBus
from .faults import Damage, Faults

READ_FULL = b":0103002E0005C9\r\n"
ANSWER = b">01030A2EA1110A03E803E803E847\r\n"
Line = tuple[VirtualBus, AblBox, PortClient]


@pytest.fixture
def line() -> Iterator[Line]:
    box = AblBox(1)
    with living(VirtualBus.in_loop(box)) as bus:
        yield bus, box, PortClient(bus)


@pytest.mark.parametrize("where", ["bus", "device"])
def test_lost_once(line: Line, where: str) -> None:
    bus, box, client = line
    (bus if where == "bus" else box).faults.once("lose")
    assert client.ask(READ_FULL, timeout=0.05) == b""
    assert client.ask(READ_FULL) == ANSWER


def test_late_once(line: Line) -> None:
    _, box, client = line
    box.faults.once("late", 0.1)
    begin = client.time()
    assert client.ask(READ_FULL) == ANSWER
    assert client.time() - begin > 0.11


def test_twice(line: Line) -> None:
    bus, box, client = line
    box.faults.once("duplicate")
    client.write(READ_FULL)
    assert client.read(62) == ANSWER * 2
    assert bus.wire.collisions == 0


def test_cut(line: Line) -> None:
    _, box, client = line
    box.faults.once("truncate", 10)
    client.write(READ_FULL)
    assert client.read(31, 0.05) == ANSWER[:10]


def test_corrupt_replaced_and_noisy_in_turn(line: Line) -> None:
    _, box, client = line
    box.faults.once("corrupt", 3)
    box.faults.once("replace", b"hello\n")
    box.faults.once("noise", b"\x00\xff")
    bad = client.ask(READ_FULL)
    assert [a == b for a, b in zip(bad, ANSWER, strict=True)].count(False) == 1
    assert client.ask(READ_FULL) == b"hello\n"
    assert client.ask(READ_FULL) == b"\x00\xff" + ANSWER
    assert box.faults.happened == {"corrupt": 1, "replace": 1, "noise": 1}


@pytest.mark.parametrize(
    ("damage", "lengths"),
    [("flip", {50}), ("replace", {50}), ("drop", {47, 48, 49}), ("insert", {51, 52})],
)
def test_kinds_of_byte_errors(damage: Damage, lengths: set[int]) -> None:
    faults = Faults(byte_error_rate=0.01, damage=(damage,))
    rng = Random(3)  # noqa: S311 - repeatable on purpose
    results = [faults.disturb(bytes(50), rng) for _ in range(100)]
    damaged = [data for data in results if data != bytes(50)]
    assert 20 < len(damaged) < 60
    assert {len(data) for data in damaged} & lengths
    assert all(len(data) <= 50 for data in damaged) == (damage != "insert")
    assert all(len(data) >= 50 for data in damaged) == (damage != "drop")


def test_a_lost_byte_leaves_a_gap(line: Line) -> None:
    """The bytes after it come when they would have come: the frame is only shorter."""
    bus, box, client = line
    client.write(READ_FULL)
    bus.wait_for(lambda: len(bus.log) == 1)
    bus.faults.damage = ("drop",)
    bus.faults.byte_error_rate = 0.1
    begin = bus.log.entries[0].end
    received = client.read_line()
    assert 20 < len(received) < 31
    whole = len(ANSWER) * bus.byte_time + box.turn_round
    assert client.time() - begin == pytest.approx(whole, abs=0.001)


def test_dead_box_and_cut_cable(line: Line) -> None:
    bus, box, client = line
    for faults in (box.faults, bus.faults):
        faults.dead = True
        assert client.ask(READ_FULL, timeout=0.05) == b""
        faults.dead = False
        assert client.ask(READ_FULL) == ANSWER
    assert box.requests == 2


def test_byte_errors_hit_requests_and_replies(line: Line) -> None:
    bus, box, client = line
    bus.faults.byte_error_rate = 0.5
    client.write(READ_FULL)
    bus.wait_for(lambda: len(bus.log) == 1)
    bus.faults.clear()
    request = bus.log.entries[0]
    assert request.data == READ_FULL
    assert request.wire != READ_FULL
    assert box.requests == 0
    box.faults.byte_error_rate = 0.5
    client.write(READ_FULL)
    assert client.read(31) != ANSWER


@pytest.mark.parametrize(
    "kind", ["lose_rate", "late_rate", "duplicate_rate", "truncate_rate"]
)
def test_rates(kind: str) -> None:
    faults = Faults()
    setattr(faults, kind, 0.25)
    rng = Random(1)  # noqa: S311 - repeatable on purpose
    hit = sum(
        faults.apply([(0.0, b"abcd")], rng) != [(0.0, b"abcd")] for _ in range(400)
    )
    assert 60 < hit < 140
    assert faults.happened == {kind.removesuffix("_rate"): hit}


def test_byte_error_rate_is_per_byte() -> None:
    faults = Faults(byte_error_rate=0.01)
    rng = Random(2)  # noqa: S311 - repeatable on purpose
    clean = bytes(50)
    wrong = sum(
        sum(byte != 0 for byte in faults.disturb(clean, rng)) for _ in range(1000)
    )
    assert 350 < wrong < 650
