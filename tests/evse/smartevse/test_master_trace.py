"""Our master against the bytes recorded from the maker's firmware, as a slave.

The slave here is the recording, and our frames must be those of its master in the same
situation, byte for byte.
"""

import asyncio
from itertools import groupby
import json
from pathlib import Path
from typing import Any, override

from custom_components.evse_bus.evse.model import OrderChange
from tests.evse.smartevse.scene import Box, MasterScene, SmartEvseLine
from tests.simulated_time import now, simulate
from tests.virtual.smartevse_frames import values_frame

TRACE: dict[str, list[dict[str, Any]]] = json.loads(
    (Path(__file__).parents[2] / "traces" / "smartevse_v2_17.json").read_text()
)
READ = "020400a00009301d"
SETTINGS = {
    # As delivered (section "normal"), as slave 1.
    "020400c00009": values_frame(2, 4, [0, 2, 6, 16, 0, 4, 0, 0, 0]),
    "020400e00003": values_frame(2, 4, [13, 0, 25]),
}


class Recording(SmartEvseLine):
    """A line with the recorded slave."""

    def __init__(self) -> None:
        super().__init__()
        self.status = ""
        self.answers: dict[str, str] = {}

    @override
    def _arrive(self, data: bytes, speaker: Box | None) -> None:
        answer = self.answers.get(data.hex())
        if data.hex() == READ:
            answer = self.status
        elif data[:6].hex() in SETTINGS:
            answer = SETTINGS[data[:6].hex()].hex()
        if speaker is None and answer:
            asyncio.get_running_loop().call_later(0.008, self.reply, answer)

    def reply(self, answer: str) -> None:
        self.send(bytes.fromhex(answer))


def scene_with(status: str, current: float) -> tuple[MasterScene, Recording]:
    scene = MasterScene(units=(), current=current)
    line = Recording()
    line.status = status
    scene.line = line
    scene.new_bus()
    scene.add(2)
    return scene, line


def sent(scene: MasterScene, since: float) -> list[str]:
    """Return our frames, repeated ones once, without reads of settings."""
    frames = [sent.data.hex() for sent in scene.line.sent if sent.when >= since]
    spoken = [one for one in frames if one != READ and one[:12] not in SETTINGS]
    return [frame for frame, _ in groupby(spoken)]


def recorded(section: str, begin: float, end: float) -> list[str]:
    """Return the frames of the recorded master, repeated ones once."""
    frames = [
        entry["hex"]
        for entry in TRACE[section]
        if entry.get("dir") == "master" and begin <= entry["t"] < end
    ]
    return [frame for frame, _ in groupby(one for one in frames if one != READ)]


def play(section: str, begin: float, end: float, current: float) -> list[str]:
    """Let the recorded slave meet our master; return the frames of ours."""
    entries = [one for one in TRACE[section] if begin <= one["t"] < end]
    statuses = [one for one in entries if one.get("hex", "").startswith("020412")]

    async def scene() -> list[str]:
        scene, line = scene_with(statuses[0]["hex"], current)
        async with scene:
            await scene.until(scene.broadcasts)
            origin = scene.broadcasts()[0].when - begin
            for entry in entries:
                await asyncio.sleep(max(0.0, origin + entry["t"] - now()))
                if entry in statuses:
                    line.status = entry["hex"]
                elif entry.get("dir") == "slave":
                    line.send(bytes.fromhex(entry["hex"]))
                elif entry.get("event", "").startswith("limit"):
                    limit = int(entry["event"].split()[1]) / 10
                    # The read-back is part of the recording, later.
                    change = OrderChange(current=limit)
                    order = asyncio.create_task(scene.slave(2).change_orders(change))
                    order.add_done_callback(lambda done: done.exception())
            await asyncio.sleep(max(0.0, origin + end - now()))
            return sent(scene, origin)

    return simulate(scene())


def test_broadcasts_and_acknowledgements_are_those_of_the_recording() -> None:
    """6.0 A; plugged; power asked for; then 10.0 A."""
    ours = play("slave_with_master", 0.0, 20.0, 6.0)
    assert ours == recorded("slave_with_master", 0.0, 20.0)
    assert ours == [
        "001000010004080000003c00000000dabc",
        "02060082003c29c0",
        "001000010004080000003c00000000dabc",
        "02060083003c7800",
        "001000010004080000003c00000000dabc",
        "001000010004080000006400000000fb71",
    ]


def test_a_lower_current_and_a_resumed_master() -> None:
    """8.0 A while it charges, and again after a silence that has stopped the box."""
    for begin, end in ((26.15, 32.0), (46.0, 55.0)):
        ours = play("slave_with_master", begin, end, 8.0)
        assert ours == recorded("slave_with_master", begin, end)


def test_stop_and_resume_are_those_of_the_recording() -> None:
    entries = TRACE["slave_stop_and_resume"]
    by_what: dict[str, list[dict[str, Any]]] = {}
    for entry in entries:
        by_what.setdefault(entry["what"], []).append(entry)

    def status(what: str) -> str:
        return next(one["reply"] for one in by_what[what] if one.get("request") == READ)

    (stop,) = by_what["FC10 A7=0 to the charging slave (unit 2)"]
    (start,) = by_what["FC10 A7=1 to the slave"]

    async def scene() -> None:
        scene, line = scene_with(status("state A"), 6.0)
        slave = scene.slave(2)
        async with scene:
            await scene.until(scene.broadcasts)

            async def asks(what: str, then: str) -> None:
                request, answer = by_what[what]
                begin = now()
                line.send(bytes.fromhex(request["slave_sent"]))
                line.status = status(then)
                await asyncio.sleep(3)
                answers = [f for f in sent(scene, begin) if f.startswith("0206")]
                assert answers == [answer["master_ack"]], what

            await asks("plugged", "state B")
            await asks("power asked", "state C at 6.0 A")
            line.status = status("10 A")
            await slave.change_orders(OrderChange(current=10.0))
            await asyncio.sleep(3)

            begin = now()

            def stopped() -> None:
                line.status = status("right after")

            line.answers = {stop["request"]: stop["reply"]}
            stopping = asyncio.create_task(
                slave.change_orders(OrderChange(allowed=False))
            )
            await scene.until(lambda: stop["request"] in sent(scene, begin))
            stopped()
            await stopping
            writes = [f for f in sent(scene, begin) if f.startswith("0210")]
            assert writes == [stop["request"]]
            line.status = status("4 s later")
            await asyncio.sleep(4)
            assert slave.reading is not None
            assert slave.reading.allowed is False

            begin = now()
            line.answers = {start["request"]: start["reply"]}
            line.status = status("3 s later, pilot still 6 V")
            await slave.change_orders(OrderChange(allowed=True))
            writes = [f for f in sent(scene, begin) if f.startswith("0210")]
            assert writes == [start["request"]]
            await asyncio.sleep(3)
            await asks("pilot 9 V", "pilot back to 9 V")
            await asks("pilot 6 V", "pilot 6 V again")

    simulate(scene())
