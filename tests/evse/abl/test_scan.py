"""A scan finds boxes, results collisions, and writes nothing."""

import asyncio
from importlib import import_module

import pytest

from custom_components.evse_bus.evse.abl import PROTOCOL
from custom_components.evse_bus.evse.errors import LineLostError
from custom_components.evse_bus.evse.scan import ScanResult
from tests.virtual import AblBox

from .scene import READING, Scene, config, orders, until

# The package's own name `scan` is the function.
scanning = import_module("custom_components.evse_bus.evse.abl.scan")


@pytest.fixture
def few_ids(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scan fewer IDs: each time-out takes long."""
    monkeypatch.setattr(scanning, "ADDRESSES", range(1, 6))


async def scan(scene: Scene, progress: list[float] | None = None) -> ScanResult:
    shares = [] if progress is None else progress
    return await PROTOCOL.scan(scene.bus, config(), orders(), shares.append)


def box(address: int, **settings: object) -> AblBox:
    serial = f"2W22xy{address:08d}"
    return AblBox(address, serial=serial, **settings)  # type: ignore[arg-type]


async def test_boxes_awake_asleep_and_dead() -> None:
    asleep = box(9, sleep_after=5, wakes_on="own")
    dead = box(4)
    dead.faults.dead = True
    boxes = (box(1), dead, asleep, box(16, meter=False))
    async with Scene(*boxes) as scene:
        progress: list[float] = []
        result = await scan(scene, progress)
        assert [(one.address, one.serial) for one in result.found] == [
            (1, "2W22xy00000001"),
            (9, "2W22xy00000009"),
            (16, "2W22xy00000016"),
        ]
        assert result.found[0].info.options["meter"] is True
        assert result.found[2].info.options["meter"] is False
        assert result.found[0].maximum_current is None
        assert result.duplicates == ()
        assert not result.unreadable
        assert scene.writes() == []
        assert progress == sorted(progress)
        assert progress[-1] == 1.0
        # The sleeping box lost one request; the repeat came in time.
        first, second = [one.t for one in scene.reads(9, 0x01)]
        assert 0.5 <= second - first <= 1.0
        assert {len(scene.reads(address, 0x01)) for address in (2, 4, 15)} == {2}
        # No other address is ever used.
        assert {one.device_id for one in scene.requests()} == set(range(1, 17))


@pytest.mark.usefixtures("few_ids")
async def test_an_empty_bus_takes_two_time_outs_for_each_id() -> None:
    async with Scene() as scene:
        assert await scan(scene) == ScanResult()
        assert len(scene.requests()) == 2 * 5


@pytest.mark.usefixtures("few_ids")
@pytest.mark.parametrize("later", [0.003, 0.2], ids=["at once", "one by one"])
async def test_two_boxes_with_one_id(later: float) -> None:
    boxes = (
        AblBox(1, serial="2W22xy00000001", jitter=0.0, turn_round=0.002),
        AblBox(1, serial="2W22xy00000002", jitter=0.0, turn_round=0.002 + later),
        box(2),
    )
    async with Scene(*boxes) as scene:
        result = await scan(scene)
        assert [one.address for one in result.found] == [2]
        assert result.duplicates == (1,)
        assert not result.unreadable
        assert scene.writes() == []


@pytest.mark.usefixtures("few_ids")
async def test_two_new_boxes_alone() -> None:
    boxes = (
        AblBox(1, serial="2W22xy00000001", jitter=0.0, turn_round=0.002),
        AblBox(1, serial="2W22xy00000002", jitter=0.0, turn_round=0.0023),
    )
    async with Scene(*boxes) as scene:
        assert await scan(scene) == ScanResult(duplicates=(1,))


@pytest.mark.usefixtures("few_ids")
async def test_one_unreadable_reply_is_no_second_box() -> None:
    one = box(3)
    async with Scene(one) as scene:
        one.faults.once("truncate")
        result = await scan(scene)
        assert [found.address for found in result.found] == [3]
        assert result.duplicates == ()


@pytest.mark.usefixtures("few_ids")
async def test_garbage_from_all_ids_means_wrong_line_settings() -> None:
    boxes = [box(address) for address in range(1, 4)]
    for one in boxes:
        for _ in range(10):
            one.faults.once("replace", b"\x3e\xb0\xb1\xff\x00\x8d")
    async with Scene(*boxes) as scene:
        assert await scan(scene) == ScanResult(unreadable=True)


@pytest.mark.usefixtures("few_ids")
async def test_a_box_without_a_serial_number() -> None:
    async with Scene(AblBox(1, serial="")) as scene:
        result = await scan(scene)
        assert [(one.address, one.serial) for one in result.found] == [(1, None)]


@pytest.mark.usefixtures("few_ids")
async def test_other_chargers_are_polled_meanwhile() -> None:
    async with Scene(box(1), box(2)) as scene:
        charger = await scene.settled(config(1), orders())
        before = len(scene.reads(1, READING))
        result = await scan(scene)
        assert [one.address for one in result.found] == [1, 2]
        # At least once between any two requests to the three silent IDs.
        assert len(scene.reads(1, READING)) - before >= 3 * 2
        assert charger.available
        assert charger.statistics.timeouts == 0


async def test_a_port_lost_meanwhile() -> None:
    async with Scene(box(1)) as scene:
        scanned = asyncio.create_task(scan(scene))
        await until(lambda: len(scene.requests()) > 3)
        scene.virtual.unplug()
        with pytest.raises(LineLostError):
            await scanned


@pytest.mark.usefixtures("few_ids")
@pytest.mark.parametrize("later", [0.008, 0.015, 0.02, 0.03, 0.05, 0.1])
async def test_a_second_box_that_replies_later_is_a_duplicate(later: float) -> None:
    slower = AblBox(1, serial="2W22xy00000099", turn_round=later)
    async with Scene(box(1), slower) as scene:
        result = await scan(scene)
        assert result.duplicates == (1,)
        assert not result.found
