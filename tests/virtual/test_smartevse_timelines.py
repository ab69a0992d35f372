"""The time-lines of the later recordings, replayed by the clock.

Every frame that a box sent is compared byte for byte, and what the recorder saw inside
with the virtual outlet. Excepted is what `about` names as faked; where that shows, it
stands beside the constant.
"""

from __future__ import annotations

from itertools import pairwise
import re
from typing import Any

import pytest

from .smartevse_alone import SmartEvseAlone
from .smartevse_recorded import (
    FIRMWARES,
    SECOND,
    STEP,
    Firmware,
    Line,
    Recorded,
)

every_firmware = pytest.mark.parametrize("firmware", FIRMWARES, ids=lambda f: f.trace)

# Nodes of each time-line; and from their power-up to its beginning, s: the trace does
# not have it, and the 60 s of a refusal run in the seconds of the box since then.
NODES = {
    "node_refused": (2,),
    "node_with_master": (2,),
    "two_nodes": (2, 3),
    "node_power_cycle": (2, 3),
    "makers_master": (3, 5, 7),
}
BEGIN = 3.9
BEGINS = {("20", "node_with_master"): 3.65, ("30", "node_with_master"): 3.65}


@every_firmware
@pytest.mark.parametrize("section", NODES)
def test_nodes(firmware: Firmware, section: str) -> None:
    """Nodes under a master, by the clock, with all left-out rounds."""
    line = Line(firmware, NODES[section], BEGINS.get((firmware.trace, section), BEGIN))
    line.replay(firmware.sections()[section])


# -- What the recorder saw inside, by the clock --------------------------------------

SEEN = re.compile(
    r"inside: state (\d+), error (\d+), pilot (steady|[\d.]+ A), contactor (\w+)"
)
# A change was seen within a tenth of a second, and seconds of the boxes are not quite
# those of the recorder's shared PC (`about`), s.
TOLERANCE = 0.3
# What lasted less was not always seen, s.
BRIEF = 0.2

type Inside = tuple[int, int, float, bool]


class Watched:
    """A box alone, and the changes inside it."""

    def __init__(self, box: Recorded) -> None:
        """Begin at the recorder's time 0."""
        self.box = box
        self.begin = box.now
        self.changes: list[tuple[float, Inside]] = []

    def look(self) -> None:
        """Note what is seen inside, if that has changed."""
        outlet = self.box.outlet
        state = self.box.box.dialect.states[outlet.state]
        seen = (state, outlet.error, outlet.pilot_current, outlet.contactor)
        if not self.changes or self.changes[-1][1] != seen:
            self.changes.append((self.box.now - self.begin, seen))

    def live_until(self, t: float) -> None:
        """Let it live until a time of the recorder."""
        while self.box.now - self.begin < t - 1e-6:
            self.box.live(min(STEP, self.begin + t - self.box.now))
            self.look()

    def replay(self, entries: list[dict[str, Any]]) -> None:
        """Replay a time-line, and compare all changes with those that were seen."""
        self.look()
        want: list[tuple[float, Inside]] = []
        answer: str | None = None
        for entry in entries:
            what, t = entry.get("event", ""), entry["t"]
            seen = SEEN.match(what)
            if seen:
                state, error, pilot, contactor = seen.groups()
                amps = 0.0 if pilot == "steady" else float(pilot.removesuffix(" A"))
                inside = (int(state), int(error), amps, contactor == "closed")
                if not want or want[-1][1] != inside:
                    want.append((t, inside))
            elif entry.get("dir") == "slave":
                assert answer == entry["hex"], entry
            else:
                self.live_until(t)
            if entry.get("dir") == "master":
                answer = self.box.exchange(entry["hex"])
                self.look()
            elif what.startswith(("car plugged in", "next car")):
                self.box.bring("wants")
            elif what.startswith("car leaves"):
                self.box.bring("away")
        self.live_until(entries[-1]["t"] + TOLERANCE)
        last = (self.box.now - self.begin, self.changes[-1][1])
        changes = [
            change
            for change, after in pairwise([*self.changes, last])
            if after[0] - change[0] >= BRIEF or change is self.changes[0]
        ]
        assert [one for _, one in changes] == [one for _, one in want]
        for (t, inside), (recorded, _) in zip(changes[1:], want[1:], strict=True):
            assert t == pytest.approx(recorded, abs=TOLERANCE), inside


# From the power-up to the beginning, s: the trace does not have it, and it decides when
# in the box's own cycle of 2 s something comes.
CYCLES = {"20": 0.55, "30": 0.65, "head": 1.65}


@every_firmware
def test_start_of_charging(firmware: Firmware) -> None:
    """Every start begins at MAX for a second; 2.30 and HEAD need quiet to begin."""
    box = Recorded(firmware)
    box.live(CYCLES[firmware.trace])
    Watched(box).replay(firmware.sections()["start_of_charging"])


def test_first_minutes() -> None:
    """HEAD searches for the smallest current of a new car for 82 s."""
    firmware = FIRMWARES[-1]
    box = Recorded(firmware)
    box.bring("wants")
    # After `limits_later`: at 13 A.
    box.live(119.9)
    Watched(box).replay(firmware.sections()["first_minutes"])


# -- The makers' masters ---------------------------------------------------------------

READ, WRITE_SEVERAL = "04", "10"


def rounds(entries: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """Return the frames of each whole round, which a broadcast ends."""
    result: list[list[dict[str, Any]]] = [[]]
    for entry in entries:
        if "hex" in entry:
            result[-1].append(entry)
            if entry["hex"].startswith("0910"):
                result.append([])
    return result[:-1]


class MasterAlone:
    """A virtual master, to whose polls the recorded replies come."""

    def __init__(self, firmware: Firmware) -> None:
        """Switch it on."""
        self.box = SmartEvseAlone(firmware.dialect, load_balance=1)
        self.box.outlet.second = SECOND

    def round(self, replies: dict[str, str]) -> list[str]:
        """Let one round pass; return its frames."""
        said: list[str] = []
        while not said or not said[-1].startswith("0910"):
            self.box.sent.clear()
            self.box.live(0.01)
            for _, data in self.box.sent:
                said.append(data.hex())
                answer = replies.get(data.hex())
                if answer is not None:
                    assert self.box.receive(bytes.fromhex(answer)) is None
        return said


@every_firmware
def test_makers_master(firmware: Firmware) -> None:
    """Grants, refusals and broadcasts of a virtual master are those recorded.

    Excepted, by `about`: the recorded master lost polls, by its faked UART; the virtual
    one polls all units, and those without a recorded reply do not answer it.
    """
    master = MasterAlone(firmware)
    for frames in rounds(firmware.sections()["makers_master"]):
        asked = [one["hex"] for one in frames if one["dir"] == "master"]
        replies = {
            before["hex"]: one["hex"]
            for before, one in pairwise(frames)
            if one["dir"] == "slave" and before["dir"] == "master"
        }
        said = master.round(replies)
        polls = [data for data in said if data[2:4] == READ]
        assert [data[:2] for data in polls] == [f"{unit:02x}" for unit in range(2, 9)]
        recorded = [data for data in asked if data[2:4] == READ]
        assert set(recorded) <= set(polls)
        writes = [data for data in asked if data[2:4] == WRITE_SEVERAL]
        assert [data for data in said if data[2:4] == WRITE_SEVERAL] == writes
        # All polls, all writes, one broadcast.
        assert said == [*polls, *writes]


@every_firmware
def test_every_section_is_replayed(firmware: Firmware) -> None:
    """Here, or frame by frame in `test_smartevse_traces`."""
    frames = {*firmware.polled, "limits_later", "node", "master"}
    timelines = {*NODES, "start_of_charging"}
    if firmware.dialect == "2.30+":
        timelines.add("first_minutes")
    assert firmware.sections().keys() == {"about", *frames, *timelines}
