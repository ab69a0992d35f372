"""Under every load a command is sent within a bound, and a deadline that can be kept is.

The bound: a round of the deadlines for each command that waits before it. Where the
command meets the deadline of its own charger, one round is enough for all. Where
deadlines are late already, it is a round of all chargers.
"""

import asyncio
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar, override

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.errors import (
    ReplyTimeoutError,
    SupersededError,
)
from custom_components.evse_bus.evse.exchange import Turn
from custom_components.evse_bus.evse.framing import Timing
from custom_components.evse_bus.evse.load import ENDS_AT, Recurring, find_overload
from custom_components.evse_bus.evse.model import OrderChange, Orders
from tests.evse.evbox.scene import EvboxLine, Scene as EvboxScene
from tests.simulated_time import now, simulate
from tests.virtual import EvboxChargePoint

from .telegram import (
    Device,
    Scene,
    SimulatedCharger,
    TelegramFramer,
    TelegramLine,
)

SLOW = Timing(reply_timeout=0.25, longest_reply=40, reply_timeout_limit=5.0)
KEEPERS_READY = 1 / 3
"""A keep-alive may be sent from this part of its time-out on."""


class Keeper(SimulatedCharger):
    """A charger with a keep-alive, as an EVBox: a third of its time-out is its period."""

    timing: ClassVar[Timing] = SLOW

    @override
    def plan(self, now: float) -> None:
        super().plan(now)
        if self.config.keep_alive is not None:
            ready = self.spoken + self.config.keep_alive * KEEPERS_READY
            self.slot.ready = self.slot.due = ready

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        await super().apply(turn, orders, change)
        self.on_reply(turn.now)
        self.plan(turn.now)


class RidingKeeper(Keeper):
    """Its commands meet its deadline."""

    orders_keep_alive: ClassVar[bool] = True


@dataclass(frozen=True)
class Load:
    keepers: int
    riding: bool
    others: int
    dead: int
    keep_alive: float
    trip: float
    commands: tuple[tuple[float, int], ...]
    """Delay after the one before, s, and the index of the charger."""


loads = st.builds(
    Load,
    keepers=st.integers(1, 8),
    riding=st.booleans(),
    others=st.integers(0, 4),
    dead=st.integers(0, 2),
    keep_alive=st.floats(6.0, 30.0),
    trip=st.floats(0.01, 3.0),
    commands=st.lists(
        st.tuples(st.floats(0.0, 5.0), st.integers(0, 20)), min_size=1, max_size=12
    ).map(tuple),
)


def build(load: Load) -> Bus:
    count = load.keepers + load.others + load.dead
    devices = [Device(address, delay=load.trip) for address in range(1, count + 1)]
    for device in devices[load.keepers + load.others :]:
        device.alive = False
    bus = Bus(TelegramLine(*devices), TelegramFramer(), SLOW, "load")
    kind = RidingKeeper if load.riding else Keeper
    scene = Scene(addresses=tuple(range(1, count + 1)), interval=1.0)
    for address in range(1, count + 1):
        model = scene.make(address)
        config = model.config
        if address <= load.keepers:
            config = replace(config, keep_alive=load.keep_alive)
        bus.add(kind(config, model.orders))
    return bus


@settings(max_examples=60)
@given(loads)
def test_a_command_is_sent_within_its_bound(load: Load) -> None:
    async def scene() -> None:
        bus = build(load)
        line = bus.line
        assert isinstance(line, TelegramLine)
        living = load.keepers + load.others
        async with bus:
            await asyncio.sleep(10 * load.keep_alive + 60)
            asked: list[tuple[float, int]] = []

            async def command(address: int) -> None:
                asked.append((now(), address))
                change = OrderChange(current=6.0 + len(asked) % 20)
                with suppress(ReplyTimeoutError, SupersededError):
                    await bus.chargers[str(address)].change_orders(change)

            tasks = []
            for delay, index in load.commands:
                await asyncio.sleep(delay)
                address = index % living + 1
                tasks.append(asyncio.create_task(command(address)))
            longest = max(one.slot.worst_case for one in bus.chargers.values())
            await asyncio.gather(*tasks)
            # Where deadlines are late already, the others have their turns as well.
            turns = count_all(load) + len(asked) + 2
            one_round = load.keep_alive + turns * longest
            for when, address in asked:
                sent = next(at for at in line.times(address, "W") if at >= when)
                waiting = sum(
                    when - len(asked) * one_round <= other <= sent for other, _ in asked
                )
                rides = load.riding and address <= load.keepers
                assert sent - when <= (1 if rides else waiting + 1) * one_round
            # No charger is forgotten over the commands.
            start = now()
            await asyncio.sleep((count_all(load) + 2) * one_round + 60)
            for address in range(1, living + 1):
                assert line.times(address)[-1] > start

    simulate(scene())


def count_all(load: Load) -> int:
    return load.keepers + load.others + load.dead


@settings(max_examples=60)
@given(loads)
def test_a_deadline_that_can_be_kept_is_kept(load: Load) -> None:
    """Room for a round, a command, a probe, and one reply that does not come."""

    async def scene() -> None:
        bus = build(load)
        line = bus.line
        assert isinstance(line, TelegramLine)
        async with bus:
            await asyncio.sleep(10 * load.keep_alive + 60)
            start = now()
            tasks = []
            for delay, index in load.commands:
                await asyncio.sleep(delay)
                charger = bus.chargers[str(index % (load.keepers + load.others) + 1)]
                tasks.append(
                    asyncio.create_task(charger.change_orders(OrderChange(current=7)))
                )
            await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.sleep(3 * load.keep_alive)
            longest = max(one.slot.worst_case for one in bus.chargers.values())
            usual = max(one.slot.usual or longest for one in bus.chargers.values())
            needed = load.keepers * usual + 3 * longest
            if needed > load.keep_alive * (1 - KEEPERS_READY):
                return
            for address in range(1, load.keepers + 1):
                times = sorted(line.times(address) + line.times(address, "W"))
                gaps = [b - a for a, b in pairwise(times) if a >= start]
                assert max(gaps) <= load.keep_alive + 1e-6

    simulate(scene())


class SlowEvboxLine(EvboxLine):
    """The line of an adapter that needs time each way."""

    each_way = 0.0

    @override
    def carry(self, data: bytes, end: float) -> None:
        loop = asyncio.get_running_loop()
        loop.call_later(self.each_way, super().carry, data, end)

    @override
    def hear(self, data: bytes) -> None:
        asyncio.get_running_loop().call_later(self.each_way, super().hear, data)


@pytest.mark.parametrize(
    ("each_way", "longest_wait"), [(0.0, 1.0), (0.5, 5.0), (1.0, 7.0), (1.5, 60.0)]
)
def test_sixteen_evbox_behind_a_slow_adapter(
    each_way: float, longest_wait: float
) -> None:
    """At 1.5 s each way a round takes 53 s of 60: a command rides on a keep-alive."""

    async def scene() -> None:
        serials = range(1000, 1016)
        points = [
            EvboxChargePoint(serial=f"{one:08d}", modules=1, min_interval=1)
            for one in serials
        ]
        made = EvboxScene.of(*points)
        line = SlowEvboxLine(*points)
        line.each_way = each_way
        made.line = made.bus.line = made.bus.wire.line = line
        line.on_data = made.bus.wire._on_data
        line.on_lost = made.bus.port.line_lost
        chargers = [made.add(one) for one in serials]
        async with made:
            await asyncio.sleep(600)
            assert all(one.available for one in chargers)
            before = [point.counters.fail_backs for point in points]
            for step in range(40):
                asked = now()
                charger = chargers[step * 7 % 16]
                await charger.change_orders(OrderChange(current=6.0 + step % 10))
                assert now() - asked <= longest_wait
                await asyncio.sleep(7.3)
            assert all(one.available for one in chargers)
            assert [point.counters.fail_backs for point in points] == before

    simulate(scene())


recurring = st.builds(
    Recurring, takes=st.floats(0.01, 5.0), within=st.sampled_from([2.0, 15.0, 60.0])
)


@given(st.lists(recurring, max_size=20), st.floats(0.0, 10.0))
def test_an_overload_is_a_deadline_that_a_round_exceeds(
    turns: list[Recurring], lost: float
) -> None:
    overload = find_overload(turns, lost)
    alike = {one.within for one in turns}
    if len(alike) == 1:
        [within] = alike
        needed = lost + sum(one.takes for one in turns)
        assert (overload is not None) == (needed > within)
    if overload is not None:
        assert overload.needed > overload.within
        # More turns never make it fit; and it is over only with a margin.
        assert find_overload([*turns, *turns], lost) is not None
        assert find_overload(turns, lost, share=ENDS_AT) is not None
