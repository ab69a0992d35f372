"""Slow adapters: the reply time-out follows what the line shows."""

import asyncio
from collections.abc import Callable
from random import Random

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.framing import Timing
from custom_components.evse_bus.evse.model import OrderChange
from custom_components.evse_bus.evse.round_trip import RoundTrip
from tests.simulated_time import now, simulate

from .telegram import TIMING, Device, Scene


class Behind(Device):
    """A device behind an adapter that takes its time, more or less."""

    def __init__(self, address: int, each_way: float, jitter: float = 0.2) -> None:
        self.each_way = each_way
        self.jitter = jitter
        self.random = Random(address)  # noqa: S311 - jitter
        super().__init__(address)

    @property
    def delay(self) -> float:  # type: ignore[override]
        return 2 * self.each_way * self.random.uniform(1, 1 + self.jitter) + 0.002

    @delay.setter
    def delay(self, _value: float) -> None:
        pass


def behind(each_way: float, addresses: tuple[int, ...] = (1, 2)) -> Scene:
    scene = Scene(addresses=addresses, interval=1.0)
    for address in addresses:
        scene.line.devices[address] = Behind(address, each_way)
    return scene


@pytest.mark.parametrize("each_way", [0.0, 0.05, 0.16, 0.4, 1.0])
def test_a_box_behind_a_slow_adapter_is_available(each_way: float) -> None:
    async def scene() -> None:
        async with behind(each_way) as bus:
            await asyncio.sleep(60)
            losses = 0

            def count() -> None:
                nonlocal losses
                losses += not bus.charger(1).available

            bus.charger(1).subscribe(count)
            timeouts = bus.bus.wire.statistics.timeouts
            await asyncio.sleep(300)
            assert bus.charger(1).available
            assert bus.charger(2).available
            assert losses == 0
            assert bus.bus.wire.statistics.timeouts - timeouts <= 3
            assert bus.bus.wire.round_trip.timeout <= TIMING.reply_timeout_limit

    simulate(scene())


@pytest.mark.parametrize("each_way", [0.05, 0.16, 0.4])
def test_a_late_reply_is_never_taken_for_a_newer_one(each_way: float) -> None:
    """The device counts up: what was read must never be older than the request."""

    async def scene() -> None:
        bus = behind(each_way, (1,))
        sent: list[tuple[float, int]] = []
        device = bus.line.devices[1]

        def answer(request: bytes) -> bytes:
            device.value = (device.value + 1) % 256
            sent.append((now(), device.value))
            return bytes((ord("@"), 1, request[2], device.value))

        device.answer = answer
        async with bus:
            await asyncio.sleep(60)
            before = bus.charger(1).polls
            for _ in range(50):
                await asyncio.sleep(1)
                reading = bus.charger(1).reading
                assert reading is not None
                # At most the one under way is newer than the reading.
                newest = sent[-1][1]
                assert (newest - int(reading.offered_current or 0)) % 256 <= 1
            assert bus.charger(1).polls > before

    simulate(scene())


@pytest.mark.parametrize("each_way", [0.2, 0.43, 0.45])
def test_the_first_replies_of_a_slow_line_are_those_to_their_requests(
    each_way: float,
) -> None:
    """Nothing is known of the line yet: the first reply may be a late one."""

    async def scene() -> None:
        bus = behind(each_way, (1,))
        device = bus.line.devices[1]
        device.answer = lambda request: bytes(
            (ord("@"), 1, request[2], len(bus.line.sent))
        )
        seen: list[tuple[float, int]] = []

        def look() -> None:
            reading = bus.charger(1).reading
            if reading is not None:
                seen.append((len(bus.line.sent), int(reading.offered_current or 0)))

        bus.charger(1).subscribe(look)
        async with bus:
            await asyncio.sleep(20)
        # Each reading has the number of the last request.
        assert seen
        assert all(number == reported for number, reported in seen)

    simulate(scene())


def test_a_request_that_was_lost_costs_one_wait() -> None:
    """A sleeping box loses the first request; the reply is that to the second one."""

    async def scene() -> None:
        bus = Scene(addresses=(1,), interval=1.0)
        device = bus.line.devices[1]
        device.alive = False
        async with bus:
            await asyncio.sleep(TIMING.reply_timeout * 1.1)
            device.alive = True
            begin = now()
            await bus.charger(1).wait_available()
            # If the reply was late, another one would come as late.
            assert now() - begin < 2.5 * (TIMING.retry_pauses[0] + TIMING.reply_timeout)
            assert bus.bus.wire.round_trip.mean is not None
            assert bus.bus.wire.round_trip.mean < 0.1
            assert bus.bus.wire.statistics.late == 0

    simulate(scene())


def test_an_adapter_that_becomes_slow_is_followed() -> None:
    async def scene() -> None:
        bus = behind(0.005, (1,))
        device = bus.line.devices[1]
        assert isinstance(device, Behind)
        async with bus:
            await asyncio.sleep(30)
            assert bus.bus.wire.round_trip.timeout == TIMING.reply_timeout
            device.each_way = 0.4
            await asyncio.sleep(60)
            assert bus.charger(1).available
            assert bus.bus.wire.statistics.late
            device.each_way = 0.005
            await asyncio.sleep(120)
            assert bus.bus.wire.round_trip.timeout == TIMING.reply_timeout

    simulate(scene())


def test_worst_cases_follow() -> None:
    async def scene() -> None:
        async with behind(0.4, (1,)) as bus:
            await asyncio.sleep(60)
            slot = bus.charger(1).slot
            assert slot.worst_case == bus.bus.worst_case(bus.charger(1))
            assert slot.worst_case > 2 * TIMING.reply_timeout
            await bus.charger(1).change_orders(OrderChange(current=8.0))

    simulate(scene())


@pytest.mark.parametrize("trip", [0.5, 1.0, 2.0])
def test_a_slow_line_with_a_dead_charger_is_learnt(trip: float) -> None:
    """The reply came after the request to the other one, and counted as foreign."""

    async def scene() -> None:
        bus = Scene(addresses=(1, 2), interval=1.0)
        bus.line.devices[1].delay = trip
        bus.line.devices[2].alive = False
        async with bus:
            await asyncio.sleep(30)
            assert bus.charger(1).available
            assert bus.bus.wire.statistics.late

    simulate(scene())


TRIPS = Timing(reply_timeout=0.3, longest_reply=40)


@given(st.lists(st.floats(0.0, 20.0), max_size=50))
def test_the_timeout_is_bounded(trips: list[float]) -> None:
    line = RoundTrip(TRIPS)
    for trip in trips:
        line.measure(trip)
        assert TRIPS.reply_timeout <= line.timeout <= TRIPS.reply_timeout_limit
        assert 0.0 <= line.drain <= TRIPS.reply_timeout_limit


@given(st.floats(0.001, 1.9))
def test_a_steady_line_gets_a_margin_and_no_more(trip: float) -> None:
    line = RoundTrip(TRIPS)
    for _ in range(100):
        line.measure(trip)
    expected: Callable[[float], float] = lambda one: max(1.5 * one, 0.3)  # noqa: E731
    assert line.timeout == pytest.approx(expected(trip), rel=0.02)
