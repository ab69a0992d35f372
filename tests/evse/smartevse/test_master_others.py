"""Another master, other dialects, and the scan, under our own master."""

import asyncio

import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.errors import NotAvailableError, RefusedOrderError
from custom_components.evse_bus.evse.model import Circuit, Fault, OrderChange
from custom_components.evse_bus.evse.scan import ScanResult
from custom_components.evse_bus.evse.smartevse import MASTER
from custom_components.evse_bus.evse.smartevse.dialects import Dialect
from custom_components.evse_bus.evse.smartevse.master import (
    LISTENING,
    STAY_SILENT,
    Master,
)
from tests.evse.simulated_line import until
from tests.evse.smartevse.frames import OTHER_BROADCAST, frame
from tests.evse.smartevse.scene import MasterScene
from tests.simulated_time import now, simulate


async def scan(bus: Bus, scene: MasterScene) -> ScanResult:
    config, orders = scene.make(2).config, scene.make(2).orders
    return await MASTER.scan(bus, config, orders, lambda _share: None)


def test_another_master_is_noticed_before_our_first_broadcast() -> None:
    async def scene() -> None:
        async with MasterScene() as scene:
            changes: list[frozenset[Fault]] = []
            scene.master.subscribe(lambda: changes.append(scene.master.noticed))
            await asyncio.sleep(2.3)
            scene.line.send(OTHER_BROADCAST)
            await asyncio.sleep(STAY_SILENT - 1)
            assert scene.line.sent == []
            assert changes == [frozenset({Fault.SECOND_MASTER})]
            await asyncio.sleep(5)
            assert scene.broadcasts()
            assert changes[-1] == frozenset()

    simulate(scene())


@pytest.mark.parametrize(
    "head",
    [
        "001000010004080064003c00000000",
        "0910000100081000640000000000000000000000000000",
        "0910002000081000640000000000000000000000000000",
        # Its polls of slaves that are not ours.
        "040400a0000b",
        "080400000008",
    ],
)
def test_another_master_silences_us_at_once_for_as_long_as_it_sends(head: str) -> None:
    async def scene() -> None:
        async with MasterScene() as scene:
            await asyncio.sleep(6)
            assert scene.slave(2).available
            data = frame(head)
            await scene.until(lambda: now() > scene.line.busy_until + 0.01)
            scene.line.send(data)
            await asyncio.sleep(0.005)
            waiting = asyncio.create_task(
                scene.slave(2).change_orders(OrderChange(current=9.0))
            )
            for _ in range(50):
                await asyncio.sleep(2)
                scene.line.send(data)
            first = now() - 100
            with pytest.raises(NotAvailableError, match="another master"):
                await waiting
            with pytest.raises(NotAvailableError, match="another master"):
                await scene.slave(2).change_orders(OrderChange(allowed=False))
            late = [s for s in scene.line.sent if s.when > first + 0.02]
            assert late == []
            assert scene.master.noticed == {Fault.SECOND_MASTER}
            assert not scene.slave(2).available
            # It answers the requests of the slaves, too.
            scene.line.send(bytes.fromhex("020600030082f998"))
            await asyncio.sleep(STAY_SILENT - 5)
            assert [s for s in scene.line.sent if s.when > first + 0.02] == []
            await asyncio.sleep(10)
            assert scene.master.noticed == frozenset()
            assert scene.slave(2).available
            # The lowering stands.
            assert scene.slave(2).orders.limit.current == 9

    simulate(scene())


@pytest.mark.parametrize("late", [0.02, 0.3])
def test_our_own_echo_is_not_taken_for_another_master(late: float) -> None:
    """An adapter with an echo, also one that passes it on late."""

    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            await asyncio.sleep(6)
            line = scene.line
            write = line.write
            loop = asyncio.get_running_loop()

            def echoing(data: bytes, *, reply_may_equal: bool = False) -> float:
                end = write(data, reply_may_equal=reply_may_equal)
                if data[0] == 0:
                    loop.call_at(end + late, line.noise, data)
                return end

            line.write = echoing  # type: ignore[method-assign]
            await asyncio.sleep(60)
            assert scene.master.noticed == frozenset()
            assert max(scene.gaps()) < 2.1

    simulate(scene())


@pytest.mark.parametrize(
    "head",
    [
        "001000010004",  # the answer to a broadcast, of a box without load balancing
        "040600030082",  # a slave that is not configured
        "020600830050",  # an acknowledgement
        "0a0400000028",
        "000600020001",
    ],
)
def test_other_frames_are_not_taken_for_a_master(head: str) -> None:
    async def scene() -> None:
        async with MasterScene() as scene:
            await asyncio.sleep(6)
            scene.line.noise(frame(head))
            await asyncio.sleep(6)
            assert scene.master.noticed == frozenset()
            assert max(scene.gaps()) < 2.1

    simulate(scene())


@pytest.mark.parametrize("dialect", ["2.20", "2.30", "2.30+"])
def test_nothing_is_written_to_boxes_of_two_families(dialect: str) -> None:
    """The broadcast for 2.20 would change error, mode and access of a later box."""

    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            scene.plug_box(3, dialect)
            slave = scene.add(3)
            await asyncio.sleep(100)
            assert scene.master.noticed == {Fault.MIXED_DIALECTS}
            # They are read all the same.
            assert slave.available
            assert scene.slave(2).available
            scene.box(2).car.plug_in()
            scene.box(3).car.plug_in()
            for one in (slave, scene.slave(2)):
                for change in (OrderChange(current=10.0), OrderChange(allowed=False)):
                    with pytest.raises(NotAvailableError, match="firmware"):
                        await one.change_orders(change)
            await asyncio.sleep(100)
            assert {s.data[1] for s in scene.line.sent} <= {3, 4}
            # Without the one, it listens first, then it is the master of the other.
            await scene.bus.remove(slave)
            begin = now()
            await scene.until(scene.broadcasts)
            assert now() - begin >= LISTENING
            assert scene.master.noticed == set()

    simulate(scene())


@pytest.mark.parametrize("kept", [None, Dialect.V2_20])
def test_nothing_is_written_before_all_were_read(kept: Dialect | None) -> None:
    """Four boxes of 2.20 behind a slow adapter, and a last one with new firmware."""

    async def scene() -> None:
        async with MasterScene(
            units=(2, 3, 4, 5, 6), dialect="2.20", kept=kept
        ) as scene:
            scene.plug_box(6, "2.30")
            for unit in scene.units:
                scene.box(unit).delay = 0.08
            await scene.until(lambda: scene.master.noticed)
            assert scene.master.noticed == {Fault.MIXED_DIALECTS}
            await asyncio.sleep(20)
            assert {sent.data[1] for sent in scene.line.sent} <= {3, 4}

    simulate(scene())


@pytest.mark.parametrize("then", ["2.20", "2.30", "2.17"])
def test_another_family_than_before_is_broadcast_to_after_listening(then: str) -> None:
    """The firmware of the only box was changed."""

    async def scene() -> None:
        dialect = "2.17" if then != "2.17" else "2.30"
        async with MasterScene(units=(2,), dialect=dialect) as scene:
            await asyncio.sleep(6)
            assert scene.broadcasts()
            changed = now()
            scene.plug_box(2, then)
            await scene.until(lambda: scene.slave(2).expected_dialect == then)
            found = now()
            await asyncio.sleep(10)
            kinds = {bytes(sent.data[:4]) for sent in scene.broadcasts(found)}
            assert len(kinds) == 1
            assert kinds.isdisjoint(
                {bytes(s.data[:4]) for s in scene.broadcasts() if s.when < changed}
            )
            assert scene.broadcasts(found)[0].when - found >= LISTENING
            await scene.charge(2)

    simulate(scene())


def test_a_scan_only_reads_and_reports_all_dialects() -> None:
    async def scene() -> None:
        async with MasterScene(units=()) as scene:
            scene.plug_box(2)
            scene.plug_box(4, "2.30+")
            begin = now()
            report = await scan(scene.bus, scene)
            assert [one.address for one in report.found] == [2, 4]
            assert [one.facts["dialect"] for one in report.found] == ["2.17", "2.30+"]
            assert not report.other_master
            assert {sent.data[1] for sent in scene.line.sent} <= {3, 4}
            assert scene.line.sent[0].when - begin >= 2.5

    simulate(scene())


@pytest.mark.parametrize(
    ("noisy", "doubled"), [({1}, ()), ({3}, ()), ({2, 3}, ()), ({1, 2, 3}, (3,))]
)
def test_a_scan_tells_noise_from_two_boxes(
    noisy: set[int], doubled: tuple[int, ...]
) -> None:
    """Two boxes disturb each other in every round, noise in some of them."""

    async def scene() -> None:
        async with MasterScene(units=()) as scene:
            scene.plug_box(2)
            looking = asyncio.create_task(scan(scene.bus, scene))
            for count in (1, 2, 3):
                await until(
                    lambda: [one.data[0] for one in scene.line.sent].count(3) == count  # noqa: B023
                )
                if count in noisy:
                    scene.line.send(b"\x03\x04\x12\x00\x55\xaa")
            report = await looking
            assert [one.address for one in report.found] == [2]
            assert report.duplicates == doubled

    simulate(scene())


def test_a_scan_of_an_empty_line_is_short() -> None:
    async def scene() -> None:
        async with MasterScene(units=()) as scene:
            begin = now()
            report = await scan(scene.bus, scene)
            assert report == ScanResult()
            # Of which 2.5 s to listen for another master.
            assert now() - begin < 8
            asked = [one.data[0] for one in scene.line.sent]
            assert asked == [*range(2, 9), *range(2, 9), 2, 3, 4]

    simulate(scene())


def test_a_scan_beside_another_master_sends_nothing_and_reports_it() -> None:
    async def scene() -> None:
        async with MasterScene(units=()) as scene:
            scene.plug_box(2)
            looking = asyncio.create_task(scan(scene.bus, scene))
            await asyncio.sleep(1)
            scene.line.send(OTHER_BROADCAST)
            assert await looking == ScanResult(other_master=True)
            assert scene.line.sent == []
            assert await scan(scene.bus, scene) == ScanResult(other_master=True)

    simulate(scene())


def test_a_scan_of_a_running_bus_delays_no_broadcast() -> None:
    async def scene() -> None:
        async with MasterScene(units=(2,)) as scene:
            scene.plug_box(3)
            await asyncio.sleep(6)
            for _ in range(5):
                report = await scan(scene.bus, scene)
                assert [one.address for one in report.found] == [2, 3]
            assert max(scene.gaps()) <= 2.02

    simulate(scene())


@pytest.mark.parametrize(
    "circuit",
    [
        Circuit(limit=float("nan")),
        Circuit(limit=-1.0),
        Circuit(minimum=5.0),
        Circuit(minimum=81.0),
        Circuit(limit=16, minimum=float("inf")),
    ],
)
def test_an_impossible_circuit_is_refused(circuit: Circuit) -> None:
    with pytest.raises(RefusedOrderError):
        Master(circuit)
