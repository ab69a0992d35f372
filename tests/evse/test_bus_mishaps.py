"""What must not bring a bus down, in simulated time."""

import asyncio
import logging
import sys
from typing import override

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse import bus as bus_module
from custom_components.evse_bus.evse.bus import FAILURES_LOGGED
from custom_components.evse_bus.evse.conversation import FollowUp, rest
from custom_components.evse_bus.evse.errors import (
    LineLostError,
    NotAvailableError,
)
from custom_components.evse_bus.evse.exchange import Turn
from custom_components.evse_bus.evse.model import OrderChange, Orders
from custom_components.evse_bus.evse.readings import ChargerReading
from custom_components.evse_bus.evse.safety import clamp
from custom_components.evse_bus.evse.statistics import (
    KEPT_BYTES,
    KEPT_FRAMES,
    KEPT_OF_FRAME,
    Direction,
    FrameLog,
)
from tests.evse.simulated_line import until
from tests.simulated_time import now, simulate

from .telegram import Scene, SimulatedCharger, TelegramLine
from .test_master import PERIOD, BeatScene


class SlowCharger(SimulatedCharger):
    """Is sure of an order only in a second turn, as a box that takes its time."""

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        orders = self.standing_orders.confirmed_target(change)
        await self.say(turn, "W", int(clamp(orders, self.limits).current))
        await rest(1.0)
        await self.say(turn, "V")


class ThoroughCharger(SimulatedCharger):
    """Reads in two turns, and writes when it has read both."""

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        await self.say(turn, "R")
        await rest(0.2)
        await self.say(turn, "S")
        self.polls += 1
        self.reading = ChargerReading()
        return FollowUp(self.note) if self.polls == 1 else None

    async def note(self, turn: Turn) -> None:
        await self.say(turn, "N")


def thorough(scene: Scene) -> ThoroughCharger:
    plain = scene.make(1)
    charger = ThoroughCharger(plain.config, plain.orders)
    scene.bus.add(charger)
    return charger


def slow(scene: Scene) -> SlowCharger:
    plain = scene.make(1)
    charger = SlowCharger(plain.config, plain.orders)
    scene.bus.add(charger)
    return charger


def writes(scene: Scene) -> list[int]:
    return [sent.value for sent in scene.line.sent if sent.command == "W"]


def test_a_plan_that_fails_does_not_end_the_bus(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2), interval=1.0) as bus:
            await asyncio.sleep(2)

            def broken(_now: float) -> None:
                raise ZeroDivisionError

            monkeypatch.setattr(bus.charger(1), "plan", broken)
            count = len(bus.line.times(2))
            await asyncio.sleep(20)
            assert len(bus.line.times(2)) - count >= 18
            # The other one is not asked in a frenzy either.
            assert len(bus.line.times(1)) <= 10

    simulate(scene())


def test_a_lowering_that_cannot_be_stored_is_sent_all_the_same() -> None:
    async def scene() -> None:
        async with Scene(interval=60.0) as bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)

            async def full(_orders: Orders) -> None:
                raise OSError("disk full")

            charger.standing_orders.commit = full
            await charger.change_orders(OrderChange(allowed=False))
            assert writes(bus) == [0]
            await charger.change_orders(OrderChange(allowed=True))
            assert writes(bus) == [0, 10]
            assert charger.orders.allowed is True

    simulate(scene())


def test_a_second_start_changes_nothing() -> None:
    async def scene() -> None:
        async with Scene(interval=1.0) as bus:
            await bus.bus.start()
            assert len(asyncio.all_tasks()) == 2
            await asyncio.sleep(10)
            assert len(bus.line.times(1)) <= 11
        assert len(asyncio.all_tasks()) == 1

    simulate(scene())


def test_a_stop_ends_a_start_that_has_not_ended() -> None:
    async def scene() -> None:
        bus = Scene()
        opened = asyncio.Event()

        class SlowLine(TelegramLine):
            @override
            async def open(self) -> None:
                await opened.wait()
                await super().open()

        bus.line.__class__ = SlowLine
        starting = asyncio.create_task(bus.bus.start())
        await asyncio.sleep(0)
        await bus.bus.stop()
        opened.set()
        with pytest.raises(NotAvailableError):
            await starting
        assert not bus.line.is_open
        assert len(asyncio.all_tasks()) == 1

    simulate(scene())


def test_an_answer_in_the_last_breath_of_a_port_is_no_reading() -> None:
    async def scene() -> None:
        async with Scene(interval=1.0) as bus:
            await asyncio.sleep(0.5)
            charger = bus.charger(1)
            assert charger.available
            hear = bus.line.hear

            def hear_and_lose(data: bytes) -> None:
                hear(data)
                bus.line.refuse_open = LineLostError("gone")
                bus.line.unplug()

            bus.line.hear = hear_and_lose  # type: ignore[method-assign]
            await asyncio.sleep(2)
            assert not charger.available
            assert charger.reading is None

    simulate(scene())


def test_a_conversation_does_not_outlive_its_port() -> None:
    async def scene() -> None:
        async with Scene(interval=60.0) as bus:
            await asyncio.sleep(1)
            charger = slow(bus)
            await asyncio.sleep(1)
            hear = bus.line.hear

            def hear_and_lose(data: bytes) -> None:
                hear(data)
                bus.line.hear = hear  # type: ignore[method-assign]
                bus.line.unplug()

            bus.line.hear = hear_and_lose  # type: ignore[method-assign]
            with pytest.raises(LineLostError):
                await charger.change_orders(OrderChange(current=20.0))
            await asyncio.sleep(30)
            # Who answers behind a port that is back has to be asked first.
            assert bus.line.times(1, "V") == []

    simulate(scene())


def test_a_raise_is_not_undone_by_the_end_of_an_older_change() -> None:
    async def scene() -> None:
        async with Scene(interval=60.0) as bus:
            charger = slow(bus)
            await asyncio.sleep(1)
            changes = (
                OrderChange(current=8.0),
                OrderChange(allowed=False),
                OrderChange(current=20.0),
                OrderChange(current=25.0),
                OrderChange(allowed=True),
            )
            tasks = []
            for change in changes:
                tasks.append(asyncio.create_task(charger.change_orders(change)))
                await asyncio.sleep(0.3)
            await asyncio.gather(*tasks)
            assert writes(bus)[-1] == 25
            assert charger.orders.limit.current == 25.0
            assert charger.orders.allowed is True

    simulate(scene())


def test_a_pause_or_lowering_waits_for_no_change_under_way() -> None:
    async def scene() -> None:
        async with Scene(interval=60.0) as bus:
            charger = slow(bus)
            await asyncio.sleep(1)
            raising = asyncio.create_task(
                charger.change_orders(OrderChange(current=20.0))
            )
            await asyncio.sleep(0.1)
            tasks = [
                asyncio.create_task(charger.change_orders(OrderChange(current=25.0)))
            ]
            await asyncio.sleep(0.1)
            # Merged with the raise that waits, and no raise any more.
            tasks.append(
                asyncio.create_task(charger.change_orders(OrderChange(current=7.0)))
            )
            await asyncio.sleep(0.1)
            assert writes(bus) == [20, 7]
            # Whatever else a pause brings along.
            pause = OrderChange(allowed=False, current=30.0)
            tasks.append(asyncio.create_task(charger.change_orders(pause)))
            await asyncio.sleep(0.1)
            assert writes(bus) == [20, 7, 0]
            await asyncio.gather(raising, *tasks)
            assert charger.orders.allowed is False

    simulate(scene())


def test_a_lowering_does_not_undo_the_start_it_has_overtaken() -> None:
    async def scene() -> None:
        async with Scene(interval=60.0) as bus:
            charger = slow(bus)
            await asyncio.sleep(1)
            changes = (OrderChange(allowed=True), OrderChange(current=8.0))
            tasks = []
            for change in changes:
                tasks.append(asyncio.create_task(charger.change_orders(change)))
                await asyncio.sleep(0.3)
            await asyncio.gather(*tasks)
            assert writes(bus) == [10, 8]
            assert charger.orders.limit.current == 8.0
            assert charger.orders.allowed is True

    simulate(scene())


def test_a_limit_merges_into_the_newest_that_waits() -> None:
    async def scene() -> None:
        async with Scene(interval=60.0) as bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)
            bus.line.devices[1].lose_next = 1
            tasks = []
            for current in (20.0, 8.0, 16.0):
                change = OrderChange(current=current)
                tasks.append(asyncio.create_task(charger.change_orders(change)))
                # The first is on the wire when the second comes, and gets lost.
                bus.line.devices[1].lose_next += current == 8.0
                await asyncio.sleep(0.01 if current == 20.0 else 0.4)
            await asyncio.gather(*tasks)
            assert charger.orders.limit.current == 16.0
            assert writes(bus)[-1] == 16

    simulate(scene())


def test_a_pause_that_is_said_again_does_not_overtake_the_start_after_it() -> None:
    async def scene() -> None:
        async with Scene(interval=60.0) as bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)
            bus.line.devices[1].lose_next = 1
            pause = asyncio.create_task(
                charger.change_orders(OrderChange(allowed=False))
            )
            await asyncio.sleep(0.3)
            await charger.change_orders(OrderChange(allowed=True))
            await pause
            assert writes(bus) == [0, 0, 10]
            assert charger.orders.allowed is True

    simulate(scene())


@pytest.mark.parametrize("part", ["choose", "_slots"])
def test_a_schedule_that_fails_does_not_block_the_loop(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, part: str
) -> None:
    calls = 0

    async def scene() -> None:
        async with Scene(interval=1.0) as bus:
            await asyncio.sleep(2)

            def broken(*_args: object) -> None:
                nonlocal calls
                calls += 1
                if calls > 10_000:
                    pytest.fail("the loop spins")
                raise ZeroDivisionError

            with monkeypatch.context() as patched:
                owner = bus_module if part == "choose" else bus.bus
                patched.setattr(owner, part, broken)
                await asyncio.sleep(3600)
            assert 10 <= calls <= 3700
            # The cause is fixed: the charger is polled again.
            count = len(bus.line.times(1))
            await asyncio.sleep(20)
            assert len(bus.line.times(1)) - count >= 17

    simulate(scene())
    errors = [one for one in caplog.records if one.levelno == logging.ERROR]
    assert len(errors) == FAILURES_LOGGED


def test_a_bus_whose_schedule_fails_can_be_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scene() -> None:
        async with Scene(interval=1.0):

            def broken(*_args: object) -> None:
                raise ZeroDivisionError

            monkeypatch.setattr(bus_module, "choose", broken)
            await asyncio.sleep(10)
        assert len(asyncio.all_tasks()) == 1

    simulate(scene())


@given(
    st.lists(
        st.tuples(st.sampled_from(Direction), st.integers(0, 300_000)), max_size=300
    )
)
def test_the_log_of_frames_is_bounded(added: list[tuple[Direction, int]]) -> None:
    log = FrameLog()
    chunk = memoryview(bytes(300_000))
    for direction, length in added:
        log.add(direction, bytes(chunk[:length]))
    kept = list(log)
    assert len(kept) <= KEPT_FRAMES
    assert sum(len(one.data) for one in kept) <= KEPT_BYTES
    # The newest are kept, with their length on the line.
    newest = added[len(added) - len(kept) :]
    assert [(one.direction, one.length) for one in kept] == newest
    assert all(len(one.data) == min(one.length, KEPT_OF_FRAME) for one in kept)
    if sum(min(length, KEPT_OF_FRAME) for _, length in added) <= KEPT_BYTES:
        assert len(kept) == min(len(added), KEPT_FRAMES)


def test_a_whole_read_of_noise_is_not_kept() -> None:
    """200 reads of 256 kB each stayed in memory as 50 MB."""
    log = FrameLog()
    for _ in range(200):
        log.add(Direction.UNREADABLE, bytes(256 * 1024))
    assert sum(sys.getsizeof(one.data) for one in log) < 80_000
    assert {one.length for one in log} == {256 * 1024}


def test_a_command_that_never_fits_is_let_in_after_a_broadcast() -> None:
    """Its worst case fits before no deadline: it waited for ever."""

    async def scene() -> None:
        scene = BeatScene(interval=1.0)
        async with scene:
            await asyncio.sleep(5)
            charger = scene.charger(1)
            charger.bus.worst_case = lambda _charger: 10.0  # type: ignore[method-assign, union-attr]
            start = now()
            await charger.change_orders(OrderChange(current=8.0))
            assert now() - start < 2 * PERIOD

    simulate(scene())


def test_a_poll_that_fails_after_its_first_turn_is_a_miss() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1,), interval=1.0) as bus:
            charger = thorough(bus)
            await asyncio.sleep(5)
            assert charger.available
            # The follow-up of a later turn is held too.
            assert len(bus.line.times(1, "N")) == 1
            device = bus.line.devices[1]
            device.answer = lambda request: None if request[2] == ord("S") else request
            begin = now()
            await until(lambda: charger.misses > 0)
            # It is polled again soon, not at the next interval.
            await until(lambda: charger.misses > 1)
            assert now() - begin < 3.0
            await until(lambda: not charger.available)
            assert charger.reading is None
            assert charger.statistics.timeouts >= charger.timing.misses
            device.answer = None
            await until(lambda: charger.available, 60)
            assert charger.misses == 0

    simulate(scene())


def test_a_charger_has_answered_when_its_poll_has_ended() -> None:
    async def scene() -> None:
        bus = Scene(addresses=(1,), interval=1.0)
        charger = thorough(bus)
        shown: list[bool] = []
        charger.subscribe(
            lambda: shown.append(charger.available and charger.reading is None)
        )
        async with bus:
            await until(lambda: charger.available)
            assert charger.reading is not None
            assert not any(shown)

    simulate(scene())
