"""The virtual SmartEVSE against bytes recorded from the maker's v2.17 firmware.

The trace does not have all times between the exchanges; the events meanwhile are listed
here by the names in the trace.
"""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
from typing import Any

import pytest

from tests.simulated_client import PortClient, living

from .bus import VirtualBus
from .smartevse import SmartEvse
from .smartevse_alone import SmartEvseAlone
from .smartevse_frames import write_several_frame

TRACE: dict[str, list[dict[str, Any]]] = json.loads(
    (Path(__file__).parents[1] / "traces" / "smartevse_v2_17.json").read_text()
)
EXCHANGE = 0.25

# Events before an exchange: voltage of the pilot (None: unchanged), wait in seconds of
# the box. Other exchanges followed at once.
BEFORE_NORMAL: dict[str, tuple[int | None, float]] = {
    "car plugged in (pilot 9 V): state B": (9, 1.0),
    "car asks for power (pilot 6 V): state C": (6, 1.0),
    "read back 2.6 s later": (None, 2.6),
    "read back: back at the configured maximum, still charging": (None, 2.6),
    "3 s later": (None, 3.0),
    "car unplugged (pilot 12 V): state A": (12, 1.0),
}
# Duration of each recording without requests, s.
LISTENED = {
    "load balancing master (C1=1), nobody asks: what it sends by itself": 7.5,
    "load balancing slave (C1=2), nobody asks: what it sends by itself": 3.0,
    "car plugged in: what the slave sends": 4.0,
    "after the acknowledgement": 1.5,
    "car asks for power: what the slave sends": 3.5,
    # Until the last broadcast was more than 10 s ago: NO_COMM opened the contactor.
    "after": 1.5,
    "no broadcast for 12 s: what the slave sends": 12.0,
}
PILOT_SLAVE = {
    "car plugged in: what the slave sends": 9,
    "car asks for power: what the slave sends": 6,
}


class Recording(SmartEvseAlone):
    """A box in its own time, with hex as in the trace."""

    def __init__(self, load_balance: int) -> None:
        super().__init__("2.17", load_balance=load_balance)
        self.outlet.pilot_voltage = 12

    def receive_hex(self, request: str) -> str | None:
        answer = self.receive(bytes.fromhex(request))
        return answer.hex() if answer else None

    @property
    def sent_hex(self) -> list[tuple[float, str]]:
        return [(t, data.hex()) for t, data in self.sent]

    def sent_alone(self, seconds: float) -> list[tuple[float, str]]:
        """Return the frames sent within a time, with times from its beginning."""
        begin, before = self.now, len(self.sent)
        self.live(seconds)
        return [(t - begin, frame) for t, frame in self.sent_hex[before:]]


def frames_of(lumps: list[tuple[float, str]]) -> list[tuple[float, str]]:
    """Join frames that the recorder read in two pieces at one moment."""
    frames: list[tuple[float, str]] = []
    for t, data in lumps:
        if frames and frames[-1][0] == t:
            frames[-1] = (t, frames[-1][1] + data)
        else:
            frames.append((t, data))
    return frames


def assert_alike(
    got: list[tuple[float, str]], want: list[tuple[float, str]], within: float
) -> None:
    """Compare frames with the trace: the bytes, and the times between them."""
    assert [frame for _, frame in got] == [frame for _, frame in want]
    for index in range(1, len(want)):
        period = want[index][0] - want[index - 1][0]
        assert got[index][0] - got[index - 1][0] == pytest.approx(period, abs=within)


def replay(record: Recording, entries: list[dict[str, Any]]) -> Iterator[str]:
    """Replay the trace; yield each of its entries."""
    for entry in entries:
        what = entry["what"]
        if "unsolicited" in entry:
            record.outlet.pilot_voltage = PILOT_SLAVE.get(
                what, record.outlet.pilot_voltage
            )
            want = frames_of([(t, data) for t, data in entry["unsolicited"]])
            assert_alike(record.sent_alone(LISTENED[what]), want, 0.05)
        else:
            pilot, seconds = BEFORE_NORMAL.get(what, (None, 0.0))
            record.outlet.pilot_voltage = pilot or record.outlet.pilot_voltage
            record.live(seconds)
            assert record.receive_hex(entry["request"]) == entry["reply"], what
            record.live(EXCHANGE)
        yield what


def test_normal() -> None:
    record = Recording(0)
    assert len(list(replay(record, TRACE["normal"]))) == 27
    assert record.sent == []


def test_master() -> None:
    record = Recording(1)
    assert len(list(replay(record, TRACE["master"]))) == 2


def test_slave() -> None:
    """The acknowledged slave also went to state A: no broadcast for 10 s."""
    record = Recording(2)
    out = record.outlet
    seen: dict[str, list[tuple[str, bool, int]]] = {}
    for what in replay(record, TRACE["slave"]):
        seen.setdefault(what, []).append((out.state, out.contactor, out.error))
    assert seen["master acknowledges state B with 6.0 A"] == [("B", False, 0)]
    assert seen["master acknowledges state C with 6.0 A"] == [("C", True, 0)]
    assert seen["after"] == [("A", False, 2)]
    assert seen["no broadcast for 12 s: what the slave sends"] == [("A", False, 2)]


def test_slave_with_master() -> None:
    """The whole minute by the clock, with all frames of the master."""
    record = Recording(2)
    pilots = {"plug ": 9, "power ": 6, "unplug ": 12}
    answers: list[tuple[float, str]] = []
    sections = TRACE["slave_with_master"]
    for entry in sections:
        record.live(max(0.0, entry["t"] - record.now))
        if entry.get("event") in pilots:
            record.outlet.pilot_voltage = pilots[entry["event"]]
        elif entry.get("dir") == "master":
            answer = record.receive_hex(entry["hex"])
            if answer:
                answers.append((record.now, answer))
    record.live(1.0)
    got = sorted(answers + record.sent_hex)
    want = [(e["t"], e["hex"]) for e in sections if e.get("dir") == "slave"]
    assert [frame for _, frame in got] == [frame for _, frame in want]
    for (t, _), (recorded, _) in zip(got, want, strict=True):
        # The recorder waited a quarter of a second for every reply.
        assert recorded - 0.32 <= t <= recorded + 0.05
    assert len(record.sent) == 2


# Pilot, broadcast of the master (0.1 A; None: as before), and duration.
BEFORE_RESUME: dict[str, tuple[int | None, int | None, float]] = {
    "state A": (None, None, 1.0),
    "plugged": (9, None, 0.3),
    "power asked": (6, None, 0.3),
    "after 5 s of broadcast 0 A": (None, 0, 5.0),
    "10 A": (None, 100, 4.0),
    "4 s later": (None, None, 4.0),
    "3 s later, pilot still 6 V": (None, None, 3.0),
    "pilot 9 V": (9, None, 0.3),
    "pilot 6 V": (6, None, 0.3),
    "2 s later": (None, None, 2.0),
    "unplugged": (12, None, 1.0),
}


def test_slave_stop_and_resume() -> None:
    record = Recording(2)
    limit, next_broadcast, done = 60, 0.0, set()

    def live(seconds: float) -> None:
        nonlocal next_broadcast
        end = record.now + seconds
        while next_broadcast <= end:
            record.live(max(0.0, next_broadcast - record.now))
            broadcast = write_several_frame(0, 1, 0, limit, 0, 0)
            assert record.receive_hex(broadcast.hex()) is None
            next_broadcast += 2.0
        record.live(max(0.0, end - record.now))

    for entry in TRACE["slave_stop_and_resume"]:
        what = entry["what"]
        if what not in done:
            done.add(what)
            pilot, current, seconds = BEFORE_RESUME.get(what, (None, None, 0.0))
            record.outlet.pilot_voltage = pilot or record.outlet.pilot_voltage
            limit = limit if current is None else current
            live(seconds)
        if "slave_sent" in entry:
            assert [frame for _, frame in record.sent_hex] == [entry["slave_sent"]]
            record.sent.clear()
        elif "master_ack" in entry:
            assert record.receive_hex(entry["master_ack"]) is None
        else:
            assert record.receive_hex(entry["request"]) == entry["reply"], what
            live(EXCHANGE)
    assert record.sent == []
    assert done >= set(BEFORE_RESUME)


def test_normal_on_the_wire() -> None:
    """The same bytes through the port, at the pace of the line."""
    box = SmartEvse()
    box.outlet.pilot_voltage = 12
    with living(VirtualBus.in_loop(box)) as bus:
        client = PortClient(bus)
        for entry in TRACE["normal"]:
            pilot, seconds = BEFORE_NORMAL.get(entry["what"], (None, 0.0))
            box.outlet.pilot_voltage = pilot or box.outlet.pilot_voltage
            if seconds:
                bus.advance(seconds)
            client.write(bytes.fromhex(entry["request"]))
            want = bytes.fromhex(entry["reply"] or "")
            assert client.read(len(want) or 1, 1.0 if want else 0.05) == want
    answered = [entry for entry in bus.log if entry.source == box.name]
    for reply in answered:
        request = [e for e in bus.log if e.end < reply.t][-1]
        assert 0.006 < reply.t - request.end < 0.03
