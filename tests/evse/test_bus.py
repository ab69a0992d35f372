"""The scheduler's promises, in simulated time."""

import asyncio
import contextlib
import itertools
from math import isclose

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.conversation import rest
from custom_components.evse_bus.evse.errors import (
    GarbledReplyError,
    LineBusyError,
    LineLostError,
    NotAvailableError,
    PortMissingError,
    ReplyTimeoutError,
    SupersededError,
)
from custom_components.evse_bus.evse.exchange import Turn
from custom_components.evse_bus.evse.model import OrderChange, Persistence
from custom_components.evse_bus.evse.recovery import SILENCES
from tests.simulated_time import now, simulate

from .telegram import TIMING, Device, Scene, TelegramLine


def test_polls_each_charger_at_its_interval() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2), interval=1.0) as bus:
            await asyncio.sleep(60)
            for address in (1, 2):
                times = bus.line.times(address)
                assert 58 <= len(times) <= 61
                assert bus.charger(address).available

    simulate(scene())


def test_a_reading_reaches_the_listeners_only_when_it_changed() -> None:
    async def scene() -> None:
        calls: list[float | None] = []
        bus = Scene()
        charger = bus.charger(1)

        def listen() -> None:
            reading = charger.reading
            calls.append(reading.offered_current if reading else None)

        stop = charger.subscribe(listen)
        async with bus:
            await asyncio.sleep(10)
            bus.line.devices[1].value = 7
            await asyncio.sleep(10)
            stop()
            bus.line.devices[1].value = 8
            await asyncio.sleep(10)
        assert calls == [0.0, 7.0]

    simulate(scene())


def test_a_charger_is_gone_after_three_misses_and_found_again() -> None:
    async def scene() -> None:
        async with Scene() as bus:
            await asyncio.sleep(5)
            device, charger = bus.line.devices[1], bus.charger(1)
            device.lose_next = 2
            await asyncio.sleep(5)
            assert charger.available
            device.alive = False
            start = len(bus.line.sent)
            gone = asyncio.Event()
            charger.subscribe(gone.set)
            await gone.wait()
            assert not charger.available
            assert len(bus.line.sent) - start == 3
            assert charger.reading is None
            await asyncio.sleep(600)
            pauses = bus.line.times(1)[-5:]
            gaps = [b - a for a, b in itertools.pairwise(pauses)]
            # The back-off, but for the probe right after a silent line was renewed.
            renewals = 600 / SILENCES[-1]
            assert all(gap < 31 for gap in gaps)
            assert sum(gap < 30 for gap in gaps) <= renewals
            device.alive = True
            await asyncio.sleep(31)
            assert charger.available

    simulate(scene())


@pytest.mark.parametrize("dead", [1, 5, 15])
def test_dead_chargers_cost_a_living_one_one_timeout_a_round(dead: int) -> None:
    """16 on the bus, polled as fast as it goes, some dead."""

    async def scene() -> float:
        bus = Scene(addresses=tuple(range(1, 17)), interval=0.0)
        for address in range(2, 2 + dead):
            bus.line.devices[address].alive = False
        async with bus:
            await asyncio.sleep(100)
            times = bus.line.times(1)
            gaps = [b - a for a, b in itertools.pairwise(times)]
            for address in range(2, 2 + dead):
                # Nobody is forgotten: each dead one is still asked for.
                assert len(bus.line.times(address)) >= 6
            return max(gaps)

    worst = simulate(scene())
    exchange = 0.002 + 8 * 10 / 38400
    living = (16 - dead) * exchange
    assert worst <= living + TIMING.reply_timeout + 0.01


def test_a_command_waits_for_the_exchange_in_progress_at_most() -> None:
    async def scene() -> None:
        addresses = tuple(range(1, 17))
        async with Scene(addresses=addresses, interval=0.0) as bus:
            exchange = 0.002 + 8 * 10 / 38400
            for step in range(100):
                await asyncio.sleep(0.37 + step / 1000)
                asked = now()
                task = asyncio.create_task(
                    bus.charger(5).change_orders(OrderChange(current=6.0 + step % 20))
                )
                await task
                written = bus.line.times(5, "W")[-1]
                assert written - asked <= exchange + 1e-6

    simulate(scene())


def test_a_pause_goes_before_any_raise() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2, 3), interval=0.0) as bus:
            await asyncio.sleep(1)
            tasks = [
                asyncio.create_task(bus.charger(1).change_orders(change))
                for change in (OrderChange(current=20.0), OrderChange(allowed=False))
            ]
            tasks.append(
                asyncio.create_task(
                    bus.charger(2).change_orders(OrderChange(current=16.0))
                )
            )
            await asyncio.gather(*tasks)
            writes = [(s.address, s.value) for s in bus.line.sent if s.command == "W"]
            assert writes == [(1, 0), (1, 0), (2, 16)]
            assert bus.charger(1).orders.limit.current == 20.0
            assert bus.charger(1).orders.allowed is False

    simulate(scene())


def test_waiting_limits_merge_into_the_newest() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2), interval=0.0) as bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)
            await asyncio.gather(
                *(
                    charger.change_orders(OrderChange(current=value))
                    for value in (6.0, 12.0, 9.0, 16.0)
                )
            )
            assert [s.value for s in bus.line.sent if s.command == "W"] == [16]
            assert charger.orders.limit.current == 16.0
            assert bus.bus.wire.statistics.merged == 3

    simulate(scene())


def test_a_pause_is_never_merged_away() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2), interval=0.0) as bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)
            await asyncio.gather(
                charger.change_orders(OrderChange(allowed=False)),
                charger.change_orders(OrderChange(current=16.0)),
                charger.change_orders(OrderChange(allowed=True)),
            )
            values = [s.value for s in bus.line.sent if s.command == "W"]
            assert values[0] == 0
            assert values[-1] == 16
            assert charger.orders.allowed is True

    simulate(scene())


def test_the_same_pause_asked_for_twice_is_sent_once() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2), interval=0.0, minimum_interval=5.0) as bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)
            asked = now()
            await asyncio.gather(
                *(charger.change_orders(OrderChange(allowed=False)) for _ in range(5))
            )
            assert now() - asked <= 5.1
            assert [s.value for s in bus.line.sent if s.command == "W"] == [0]

    simulate(scene())


def test_a_pause_supersedes_a_start_that_still_waits() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2), interval=0.0) as bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)
            start = asyncio.create_task(
                charger.change_orders(OrderChange(allowed=True))
            )
            await asyncio.sleep(0)
            await charger.change_orders(OrderChange(allowed=False))
            with pytest.raises(SupersededError):
                await start
            await asyncio.sleep(5)
            assert {s.value for s in bus.line.sent if s.command == "W"} == {0}

    simulate(scene())


def test_a_limit_is_repeated_and_a_once_command_is_not() -> None:
    async def scene() -> None:
        async with Scene(interval=60.0) as bus:
            await asyncio.sleep(1)
            device, charger = bus.line.devices[1], bus.charger(1)
            device.lose_next = 2
            await charger.change_orders(OrderChange(current=8.0))
            assert len(bus.line.times(1, "W")) == 3

            async def once(turn: Turn) -> int:
                return await charger.say(turn, "X")

            device.lose_next = 1
            with pytest.raises(ReplyTimeoutError):
                await charger.run(once)
            assert len(bus.line.times(1, "X")) == 1
            assert await charger.run(once, persistence=Persistence.REPEATABLE) == 8

    simulate(scene())


def test_a_raise_counts_when_confirmed_a_lowering_at_once() -> None:
    async def scene() -> None:
        async with Scene(interval=60.0) as bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)
            stored: list[float] = []

            async def commit(orders: object) -> None:
                stored.append(orders.limit.current)  # type: ignore[attr-defined]
                sent.append(len(bus.line.times(1, "W")))

            sent: list[int] = []
            charger.standing_orders.commit = commit
            bus.line.devices[1].alive = False
            with pytest.raises(ReplyTimeoutError):
                await charger.change_orders(OrderChange(current=20.0))
            assert (charger.orders.limit.current, stored) == (10.0, [])
            with pytest.raises(ReplyTimeoutError):
                await charger.change_orders(OrderChange(current=7.0))
            assert (charger.orders.limit.current, stored) == (7.0, [7.0])
            assert sent == [3]  # stored before its own three tries
            bus.line.devices[1].alive = True
            await charger.change_orders(OrderChange(current=12.0))
            assert (charger.orders.limit.current, stored) == (12.0, [7.0, 12.0])

    simulate(scene())


@settings(max_examples=25)
@given(
    interval=st.floats(0.02, 2.0),
    keep_alive=st.floats(6.0, 20.0),
    commands=st.lists(
        st.tuples(st.floats(0.0, 30.0), st.integers(1, 6), st.integers(6, 32)),
        max_size=20,
    ),
    dead=st.sets(st.integers(1, 5), max_size=4),
)
def test_no_deadline_is_missed_whatever_else_the_bus_does(
    interval: float,
    keep_alive: float,
    commands: list[tuple[float, int, int]],
    dead: set[int],
) -> None:
    async def scene() -> None:
        bus = Scene(addresses=(1, 2, 3, 4, 5, 6), interval=interval)
        keeper = bus.make(7)
        keeper._config = type(keeper.config)(
            key="7",
            name="keeper",
            address=7,
            installation_limit=32.0,
            poll_interval=1000.0,
            keep_alive=keep_alive,
        )
        bus.line.devices[7] = Device(7)
        bus.bus.add(keeper)
        for address in dead:
            bus.line.devices[address].alive = False
        async with bus:
            tasks = []

            async def command(when: float, address: int, value: int) -> None:
                await asyncio.sleep(when)
                with contextlib.suppress(ReplyTimeoutError, NotAvailableError):
                    await bus.charger(address).change_orders(
                        OrderChange(current=float(value))
                    )

            tasks = [asyncio.create_task(command(*one)) for one in commands]
            await asyncio.sleep(45)
            await asyncio.gather(*tasks)
            times = bus.line.times(7)
            gaps = [b - a for a, b in itertools.pairwise(times)]
            assert len(times) >= 3
            assert max(gaps) <= keep_alive + 1e-6
            assert bus.bus.wire.statistics.missed_deadlines == 0

    simulate(scene())


def test_a_minimum_interval_holds_for_polls_and_commands() -> None:
    async def scene() -> None:
        async with Scene(interval=0.0, minimum_interval=5.0) as bus:
            for value in range(6, 20):
                await bus.charger(1).change_orders(OrderChange(current=float(value)))
                await asyncio.sleep(value / 7)
            times = [sent.when for sent in bus.line.sent]
            gaps = [b - a for a, b in itertools.pairwise(times)]
            assert min(gaps) >= 5.0 - 1e-6

    simulate(scene())


def test_an_unasked_frame_is_answered_at_once() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2, 3), interval=0.0) as bus:
            await asyncio.sleep(1)
            bus.line.hear(bytes((ord("@"), 2, ord("?"), 9)))
            heard = now()
            await asyncio.sleep(0.1)
            assert bus.charger(2).asked == [9]
            assert bus.line.times(2, "!")[0] - heard < 0.005
            assert bus.bus.wire.statistics.unsolicited == 1

    simulate(scene())


def test_other_peoples_and_late_frames_are_counted_and_not_misread() -> None:
    async def scene() -> None:
        async with Scene(interval=1.0) as bus:
            await asyncio.sleep(0.5)
            device, charger = bus.line.devices[1], bus.charger(1)
            bus.line.hear(bytes((ord("@"), 99, ord("R"), 31)))
            assert bus.bus.wire.statistics.foreign_frames == 1
            # No frame that only a master sends.
            assert bus.bus.wire.statistics.foreign_requests == 0
            device.delay = 0.3  # later than the time-out
            device.value = 5
            while device.delay > 0.1:
                await asyncio.sleep(0.01)
                if charger.misses:
                    device.delay = 0.002
            await asyncio.sleep(1.2)
            assert charger.reading is not None
            assert charger.reading.offered_current == 5.0
            assert charger.statistics.timeouts == 1
            assert bus.bus.wire.statistics.foreign_frames == 1
            assert bus.bus.wire.statistics.late == 1

    simulate(scene())


def test_noise_instead_of_an_answer_is_told_apart_from_silence() -> None:
    async def scene() -> None:
        async with Scene(interval=60.0) as bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)
            bus.line.devices[1].answer = lambda _request: b"#$%&"

            async def ask(turn: Turn) -> int:
                return await charger.say(turn, "R")

            with pytest.raises(GarbledReplyError):
                await charger.run(ask)
            bus.line.devices[1].alive = False
            bus.line.devices[1].answer = None
            with pytest.raises(ReplyTimeoutError) as caught:
                await charger.run(ask)
            assert not isinstance(caught.value, GarbledReplyError)
            assert charger.statistics.bad_frames == 1

    simulate(scene())


def test_a_long_conversation_lets_others_speak_and_is_finished_at_a_stop() -> None:
    async def scene() -> None:
        bus = Scene(addresses=(1, 2), interval=0.5)
        async with bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)

            async def in_two_turns(turn: Turn) -> int:
                await charger.say(turn, "A")
                await rest(3.0)
                return await charger.say(turn, "B")

            before = len(bus.line.times(2))
            await charger.run(in_two_turns)
            assert len(bus.line.times(2)) - before >= 5
            waiting = asyncio.create_task(charger.run(in_two_turns))
            await asyncio.sleep(0.1)
            stopping = now()
        assert len(bus.line.times(1, "B")) == 2
        assert isclose(bus.line.times(1, "B")[1], stopping + 3.0, abs_tol=0.2)
        assert await waiting == 0

    simulate(scene())


def test_a_lost_port_is_opened_again_and_commands_are_not_replayed() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2), interval=1.0) as bus:
            await asyncio.sleep(5)
            told: list[bool] = []
            bus.bus.subscribe(lambda: told.append(bus.bus.connected))
            bus.line.refuse_open = PortMissingError("gone")
            bus.line.unplug()
            await asyncio.sleep(0)
            assert not bus.charger(1).available
            with pytest.raises(LineLostError):
                await bus.charger(1).change_orders(OrderChange(current=20.0))
            await asyncio.sleep(100)
            bus.line.refuse_open = None
            count = len(bus.line.sent)
            await asyncio.sleep(10)
            assert bus.charger(1).available
            assert told == [False, True]
            assert "W" not in {sent.command for sent in bus.line.sent[count:]}
            assert bus.charger(1).orders.limit.current == 10.0

    simulate(scene())


def test_an_exchange_under_way_ends_when_the_port_is_lost() -> None:
    async def scene() -> None:
        async with Scene(interval=60.0) as bus:
            await asyncio.sleep(1)
            bus.line.devices[1].alive = False
            command = asyncio.create_task(
                bus.charger(1).change_orders(OrderChange(current=20.0))
            )
            await asyncio.sleep(0.1)
            lost = now()
            bus.line.unplug()
            with pytest.raises(LineLostError):
                await command
            assert isclose(now(), lost, abs_tol=1e-6)

    simulate(scene())


def test_no_silence_no_speech() -> None:
    """A bus on which somebody else never stops talking."""

    async def scene() -> None:
        bus = Scene(interval=1.0)
        bus.bus.wire.timing = type(TIMING)(
            reply_timeout=0.25, longest_reply=40, silence=0.1, silence_patience=1.0
        )
        async with bus:
            await asyncio.sleep(5)
            assert bus.charger(1).available
            stop = asyncio.Event()

            async def chatter() -> None:
                while not stop.is_set():
                    bus.line.hear(b"@\x63R\x01")
                    await asyncio.sleep(0.05)

            talking = asyncio.create_task(chatter())
            await asyncio.sleep(0.2)
            count = len(bus.line.sent)

            async def ask(turn: Turn) -> int:
                return await bus.charger(1).say(turn, "R")

            with pytest.raises(LineBusyError):
                await bus.charger(1).run(ask)
            pause = asyncio.create_task(
                bus.charger(1).change_orders(OrderChange(allowed=False))
            )
            await asyncio.sleep(10)
            assert len(bus.line.sent) == count
            with pytest.raises(LineBusyError):
                await pause
            pause = asyncio.create_task(
                bus.charger(1).change_orders(OrderChange(allowed=False))
            )
            await asyncio.sleep(1.2)
            stop.set()
            await talking
            # Said while others talked, and sent as soon as they are quiet.
            await pause
            await asyncio.sleep(5)
            assert len(bus.line.sent) > count
            assert bus.bus.wire.statistics.line_busy > 0

    simulate(scene())


def test_a_reading_gets_no_older_on_a_line_that_is_never_quiet() -> None:
    """No reply is missed, since nothing can be sent; but nothing is known either."""

    async def scene() -> None:
        bus = Scene(interval=1.0)
        bus.bus.wire.timing = type(TIMING)(
            reply_timeout=0.25, longest_reply=40, silence=0.1, silence_patience=1.0
        )
        async with bus:
            await asyncio.sleep(5)
            charger = bus.charger(1)
            assert charger.available

            async def chatter() -> None:
                while True:
                    bus.line.hear(b"@\x63R\x01")
                    await asyncio.sleep(0.05)

            talking = asyncio.create_task(chatter())
            await asyncio.sleep(20)
            assert charger.available
            await asyncio.sleep(20)
            assert not charger.available
            assert charger.reading is None
            talking.cancel()
            await asyncio.sleep(5)
            assert charger.available
            # It is counted anew from here.
            talking = asyncio.create_task(chatter())
            await asyncio.sleep(20)
            assert charger.available
            talking.cancel()

    simulate(scene())


def test_chargers_come_and_go_without_disturbing_the_others() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2, 3), interval=1.0) as bus:
            await asyncio.sleep(10)
            gone = bus.charger(2)
            await bus.bus.remove(gone)
            bus.line.devices[4] = Device(4)
            bus.bus.add(bus.make(4))
            count = len(bus.line.times(2))
            await asyncio.sleep(10)
            assert len(bus.line.times(2)) == count
            assert bus.charger(4).available
            times = bus.line.times(1)
            gaps = [b - a for a, b in itertools.pairwise(times)]
            assert max(gaps) < 1.1
            with pytest.raises(NotAvailableError):
                await gone.change_orders(OrderChange(current=6.0))

    simulate(scene())


def test_a_charger_that_leaves_ends_what_it_has_begun() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2), interval=1.0) as bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)

            async def in_two_turns(turn: Turn) -> int:
                await charger.say(turn, "A")
                await rest(3.0)
                return await charger.say(turn, "B")

            waiting = asyncio.create_task(charger.run(in_two_turns))
            await asyncio.sleep(0.5)
            await bus.bus.remove(charger)
            assert await waiting == 0
            assert len(bus.line.times(1, "B")) == 1
            assert "1" not in bus.bus.chargers

    simulate(scene())


def test_a_mistake_in_one_charger_does_not_end_the_bus() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1, 2), interval=1.0) as bus:
            await asyncio.sleep(5)

            async def broken(_turn: Turn) -> None:
                raise ZeroDivisionError

            bus.charger(1).poll = broken  # type: ignore[method-assign,assignment]
            await asyncio.sleep(20)
            assert not bus.charger(1).available
            assert bus.charger(2).available

    simulate(scene())


def test_an_order_nobody_renews_becomes_the_fail_safe() -> None:
    async def scene() -> None:
        async with Scene(interval=1.0, lifetime=600.0) as bus:
            await asyncio.sleep(1)
            charger = bus.charger(1)
            await charger.change_orders(OrderChange(current=16.0))
            await asyncio.sleep(500)
            await charger.change_orders(OrderChange(current=16.0))
            await asyncio.sleep(500)
            assert not charger.orders_expired
            await asyncio.sleep(102)
            assert charger.orders_expired
            assert charger.orders.limit.current == 16.0
            assert charger.setpoint.currents == (6.0, 6.0, 6.0)
            await charger.change_orders(OrderChange(fail_safe_current=7.0))
            assert charger.orders_expired
            assert charger.setpoint.currents == (7.0, 7.0, 7.0)
            await charger.change_orders(OrderChange(current=16.0))
            assert charger.setpoint.currents == (16.0, 16.0, 16.0)

    simulate(scene())


def test_statistics_count_what_passed() -> None:
    async def scene() -> None:
        async with Scene(interval=1.0) as bus:
            await asyncio.sleep(120)
            statistics = bus.charger(1).statistics
            assert statistics.requests == statistics.replies
            assert statistics.round_trip_mean is not None
            assert isclose(
                statistics.round_trip_mean, 0.002 + 8 * 10 / 38400, abs_tol=1e-6
            )
            share = bus.bus.wire.statistics.utilisation(now())
            assert share is not None
            assert isclose(share, statistics.round_trip_mean / 1.004, rel_tol=0.1)
            assert 180 <= len(bus.bus.wire.frames) <= 200

    simulate(scene())


def test_a_stopped_bus_takes_no_command_and_leaves_no_task() -> None:
    async def scene() -> None:
        bus = Scene()
        async with bus:
            await asyncio.sleep(1)
        assert len(asyncio.all_tasks()) == 1
        with pytest.raises(NotAvailableError):
            await bus.charger(1).change_orders(OrderChange(current=6.0))

    simulate(scene())


def test_a_port_that_cannot_be_opened_is_told_at_the_start() -> None:
    async def scene() -> None:
        bus = Scene()
        bus.line.refuse_open = PortMissingError("no such file")
        with pytest.raises(PortMissingError):
            await bus.bus.start()
        assert isinstance(bus.line, TelegramLine)
        await bus.bus.stop()

    simulate(scene())


def test_all_replies_to_one_request_are_collected() -> None:
    async def scene() -> None:
        async with Scene(addresses=(1,), interval=60.0) as bus:
            await asyncio.sleep(5)
            charger = bus.charger(1)

            async def conversation(turn: Turn) -> list[int]:
                return await turn.collect(b"@\x01R\x00", charger._accept("R"))

            begun = now()
            assert await charger.run(conversation) == [0]
            # No reply ends the exchange, and it is no time-out.
            assert now() - begun >= TIMING.reply_timeout
            assert bus.bus.wire.statistics.timeouts == 0
            reply = bytes((ord("@"), 1, ord("R"), 7))
            bus.line.on_sent = lambda _sent: bus.line.deliver(reply, now() + 0.1)
            assert await charger.run(conversation) == [0, 7]
            bus.line.on_sent = lambda _sent: bus.line.deliver(b"\xff", now() + 0.1)
            with pytest.raises(GarbledReplyError):
                await charger.run(conversation)
            bus.line.on_sent = lambda _sent: None
            bus.line.devices.pop(1)
            with pytest.raises(ReplyTimeoutError):
                await charger.run(conversation)

    simulate(scene())
