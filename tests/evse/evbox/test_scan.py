"""Search for ChargePoints: a probe sends the confirmed orders, up to 6 A."""

import asyncio
from collections.abc import Callable
from dataclasses import replace

import pytest

from custom_components.evse_bus.evse.errors import LineBusyError, RefusedOrderError
from custom_components.evse_bus.evse.evbox import PROTOCOL, EvboxConfig
from custom_components.evse_bus.evse.evbox.memory import EvboxMemory
from custom_components.evse_bus.evse.evbox.scan import LONGEST_WAIT, PROBES
from custom_components.evse_bus.evse.model import CurrentLimit, Orders
from custom_components.evse_bus.evse.scan import ScanResult
from tests.simulated_time import now, simulate
from tests.virtual import EvboxChargePoint, Module
from tests.virtual.evbox_frames import frame

from .scene import ORDERS, Scene
from .test_damaged import Damage

ANY = EvboxConfig(key="scan", name="scan", address=0, installation_limit=32.0)
CONFIRMED = Orders(
    limit=CurrentLimit(current=32.0, phases=(None, 0.0, None)),
    fail_safe=CurrentLimit(current=4.0, phases=(None, None, 3.5)),
    fail_safe_timeout=120,
)


async def find(
    stage: Scene, config: EvboxConfig = ANY, orders: Orders = CONFIRMED
) -> tuple[ScanResult, list[float]]:
    progress: list[float] = []
    report = await PROTOCOL.scan(stage.bus, config, orders, progress.append)
    assert progress == sorted(progress)
    assert progress[-1] == 1.0
    assert all(0 <= share <= 1 for share in progress)
    return report, progress


def test_the_only_box_on_the_line() -> None:
    async def scene() -> None:
        point = EvboxChargePoint(1923054, 3, max_current=25.0)
        async with Scene.of(point) as stage:
            started = now()
            report, _ = await find(stage)
            (one,) = report.found
            assert (one.address, one.serial) == (1923054, "1923054")
            assert one.info.serial == "1923054"
            assert (one.maximum_current, one.connectors) == (25.0, 3)
            assert (report.duplicates, report.unreadable) == ((), False)
            # A second reply agrees, after a minimum interval of 1 s.
            assert now() - started < 3.5
            assert point.counters.too_soon == 0
            order, again = stage.line.orders
            assert again.limits == order.limits
            assert order.serial == "00000000"
            # One phase is ordered to be off: then all of them are.
            assert order.limits == (0.0, 0.0, 0.0)
            assert order.fallback == (4.0, 4.0, 3.5)
            assert order.timeout == 120

    simulate(scene())


SERIAL = slice(6, 14)
MAXIMUM = slice(18, 22)


@pytest.mark.parametrize(
    "changes",
    [
        [{SERIAL: "01923055"}],
        [{}, {SERIAL: "91923054"}],
        [{SERIAL: "01923055"}, {MAXIMUM: "0280"}],
        [{MAXIMUM: "0280"}],
        [{MAXIMUM: "0280"}, {MAXIMUM: "0140"}],
    ],
)
@pytest.mark.parametrize("address", [0, 1923054])
def test_a_damaged_reply_is_no_box(
    changes: list[dict[slice, str]], address: int
) -> None:
    """Its checksums match; the box is found with what two replies agree on."""

    async def scene() -> None:
        point = EvboxChargePoint(1923054, 1, max_current=25.0)
        async with Scene.of(point) as stage:
            Damage(stage.line).changes = list(changes)
            report, _ = await find(stage, replace(ANY, address=address))
            (one,) = report.found
            assert (one.address, one.serial) == (1923054, "1923054")
            assert one.maximum_current == 25.0
            assert point.counters.too_soon == 0

    simulate(scene())


def test_replies_that_never_agree_are_no_box() -> None:
    async def scene() -> None:
        async with Scene.of(EvboxChargePoint(1923054)) as stage:
            damage = Damage(stage.line)
            damage.changes = [{SERIAL: f"0192305{n}"} for n in range(9)]
            report, _ = await find(stage)
            assert (report.found, report.unreadable) == ((), True)
            assert len(stage.line.sent) == PROBES

    simulate(scene())


@pytest.mark.parametrize(("interval", "probes"), [(20, 2), (45, 2), (90, 1)])
def test_a_number_that_is_not_confirmed_is_not_bound(
    interval: int, probes: int
) -> None:
    async def scene() -> None:
        point = EvboxChargePoint(1923054, min_interval=interval)
        async with Scene.of(point) as stage:
            report, _ = await find(stage)
            (one,) = report.found
            assert len(stage.line.sent) == probes
            assert point.counters.too_soon == 0
            if probes == 1:
                assert (one.address, one.serial) == (0, None)
            else:
                assert (one.address, one.serial) == (1923054, "1923054")

    simulate(scene())


def test_one_damaged_interval_does_not_hold_up_the_next_search() -> None:
    async def scene() -> None:
        async with Scene.of(EvboxChargePoint(1923054)) as stage:
            await find(stage)
            interval = stage.line.memory.of(EvboxMemory).interval(0)
            interval.update(599)
            started = now()
            report, _ = await find(stage)
            assert [one.address for one in report.found] == [1923054]
            assert now() - started < LONGEST_WAIT + 5

    simulate(scene())


def test_a_pause_is_sent_as_a_pause() -> None:
    async def scene() -> None:
        async with Scene.of(EvboxChargePoint(5)) as stage:
            await find(stage, orders=replace(CONFIRMED, allowed=False))
            assert stage.line.orders[0].limits == (0.0, 0.0, 0.0)

    simulate(scene())


def test_a_typed_serial_number_reaches_that_box_only() -> None:
    async def scene() -> None:
        points = [EvboxChargePoint(11), EvboxChargePoint(12)]
        async with Scene.of(*points) as stage:
            report, _ = await find(stage, replace(ANY, address=12))
            assert [one.address for one in report.found] == [12]
            assert [len(point.orders) for point in points] == [0, 2]

    simulate(scene())


def test_several_boxes_that_reply_one_after_the_other_are_all_found() -> None:
    async def scene() -> None:
        points = [
            EvboxChargePoint(serial, turn_round=0.11 * number)
            for number, serial in enumerate((11, 12, 13))
        ]
        async with Scene.of(*points) as stage:
            report, _ = await find(stage)
            assert [one.address for one in report.found] == [11, 12, 13]
            assert report.duplicates == ()

    simulate(scene())


def test_two_replies_69_are_duplicates() -> None:
    async def scene() -> None:
        points = [
            EvboxChargePoint(serial, serial, turn_round=0.11 * serial)
            for serial in (1, 2)
        ]
        async with Scene.of(*points) as stage:
            report, _ = await find(stage, replace(ANY, command=69))
            assert (report.found, report.duplicates) == ((), (0,))

    simulate(scene())


def test_a_box_without_command_68() -> None:
    async def scene() -> None:
        async with Scene.of(EvboxChargePoint(7, commands={69})) as stage:
            report, _ = await find(stage)
            assert report == ScanResult()
            report, _ = await find(stage, replace(ANY, command=69))
            (one,) = report.found
            assert (one.address, one.serial) == (0, None)

    simulate(scene())


@pytest.mark.parametrize(
    ("damage", "duplicates"),
    [(lambda _data: b"\x02A0\x7f\x80\x03", (0,)), (lambda _data: b"\x80\xfe\x11", ())],
)
def test_unreadable_replies(
    damage: Callable[[bytes], bytes], duplicates: tuple[int, ...]
) -> None:
    async def scene() -> None:
        async with Scene.of(EvboxChargePoint(11, min_interval=20)) as stage:
            stage.line.damage = damage
            report, _ = await find(stage)
            assert (report.found, report.duplicates) == ((), duplicates)
            assert report.unreadable
            # The box has received the first probe: the second is not too soon.
            assert len(stage.line.sent) == 2
            assert stage.line.pauses()[0] >= 20.0
            assert stage.line.points[0].counters.too_soon == 0
            # A typed number addresses one box, so the line must be bad.
            report, _ = await find(stage, replace(ANY, address=11))
            assert (report.duplicates, report.unreadable) == ((), True)

    simulate(scene())


def test_a_probe_without_a_reply_is_repeated_once() -> None:
    async def scene() -> None:
        point = EvboxChargePoint(11, min_interval=20)
        async with Scene.of(point) as stage:
            point.faults.once("lose")
            report, progress = await find(stage)
            assert [one.address for one in report.found] == [11]
            assert len(progress) > 20

    simulate(scene())


def test_no_box_on_the_line() -> None:
    async def scene() -> None:
        async with Scene.of() as stage:
            started = now()
            report, _ = await find(stage)
            assert report == ScanResult()
            assert now() - started < 24.0

    simulate(scene())


def test_an_implausible_reply_is_not_a_box() -> None:
    async def scene() -> None:
        point = EvboxChargePoint(11, [Module(voltages=(4000.0, 0.0, 0.0))])
        async with Scene.of(point) as stage:
            report, _ = await find(stage)
            assert report.found == ()
            assert report.unreadable

    simulate(scene())


def test_the_same_reply_twice_is_one_box() -> None:
    async def scene() -> None:
        point = EvboxChargePoint(11)
        async with Scene.of(point) as stage:
            point.faults.once("duplicate")
            report, _ = await find(stage)
            assert [one.address for one in report.found] == [11]
            assert report.duplicates == ()

    simulate(scene())


def test_replies_of_other_boxes_are_ignored() -> None:
    async def scene() -> None:
        async with Scene.of(EvboxChargePoint(11)) as stage:
            other_replies = frame("A080690001015E00") + frame(
                "A08068000000770001015E00"
            )
            stage.line.damage = lambda data: other_replies + data
            report, _ = await find(stage, replace(ANY, address=11))
            assert [one.address for one in report.found] == [11]

    simulate(scene())


def test_a_search_does_not_set_the_limits_of_boxes_in_use() -> None:
    async def scene() -> None:
        points = [EvboxChargePoint(11), EvboxChargePoint(12)]
        async with Scene.of(*points) as stage:
            stage.add(11)
            with pytest.raises(RefusedOrderError, match="serial number"):
                await find(stage)
            with pytest.raises(RefusedOrderError):
                await find(stage, replace(ANY, address=12, command=69))
            report, _ = await find(stage, replace(ANY, address=12))
            assert [one.address for one in report.found] == [12]
        assert {order.serial for order in stage.line.orders} == {
            "00000011",
            "00000012",
        }

    simulate(scene())


def test_orders_that_cannot_be_sent_are_refused() -> None:
    async def scene() -> None:
        async with Scene.of(EvboxChargePoint(11)) as stage:
            orders = replace(ORDERS, limit=CurrentLimit(current=float("nan")))
            with pytest.raises(RefusedOrderError):
                await find(stage, orders=orders)
            assert stage.line.sent == []

    simulate(scene())


def test_a_line_that_is_always_busy_raises() -> None:
    async def scene() -> None:
        async with Scene.of(EvboxChargePoint(11)) as stage:

            async def send_forever() -> None:
                while True:
                    stage.line.foreign(b"\x55")
                    await asyncio.sleep(0.05)

            sending = asyncio.create_task(send_forever())
            await asyncio.sleep(0.1)
            with pytest.raises(LineBusyError):
                await find(stage)
            sending.cancel()
            assert stage.line.sent == []

    simulate(scene())
