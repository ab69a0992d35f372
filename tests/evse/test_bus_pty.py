"""The scheduler and a line, with virtual ABL boxes at the wire's pace."""

import asyncio
from itertools import pairwise

import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.errors import LineLostError
from custom_components.evse_bus.evse.model import CurrentLimit, OrderChange, Orders
from custom_components.evse_bus.evse.protocols import PROTOCOLS
from tests.virtual import AblBox, Request, VirtualBus, requests_in

from .wires import MakeBus, each_wire

ABL = PROTOCOLS["abl"]
LIMIT = 0x14
CURRENT = 0x2E


def put_on(bus: Bus, address: int, interval: float = 0.0) -> Charger:
    config = ABL.config(
        key=str(address),
        name=f"box {address}",
        address=address,
        installation_limit=16.0,
        poll_interval=interval,
    )
    charger = ABL.charger(config, Orders(limit=CurrentLimit(current=16.0)))
    bus.add(charger)
    return charger


def reads_of(virtual: VirtualBus, address: int) -> list[Request]:
    return [
        request
        for request in requests_in(virtual.log.bursts())
        if request.device_id == address and request.register == CURRENT
    ]


async def asked(virtual: VirtualBus, charger: Charger, times: int) -> None:
    """Wait until a charger has been asked so many times more."""
    goal = charger.statistics.requests + times
    await virtual.wait_for_async(
        lambda: charger.statistics.requests >= goal, timeout=40
    )


async def test_fifteen_dead_boxes_cost_the_living_one_a_timeout_at_most() -> None:
    boxes = [AblBox(number) for number in range(1, 17)]
    for box in boxes[1:]:
        box.faults.dead = True
    async with VirtualBus.in_loop(*boxes) as virtual, ABL.bus(virtual.url) as bus:
        living = put_on(bus, 1)
        for number in range(2, 17):
            put_on(bus, number)
        await living.wait_available()
        await asked(virtual, living, 40)
        # The first turns also look, once, for a register that not every box has.
        starts = [request.t for request in reads_of(virtual, 1)][2:]
        gaps = [later - earlier for earlier, later in pairwise(starts)]
        # One time-out, and the living box's own exchange.
        assert max(gaps) < ABL.timing.reply_timeout + 0.05, gaps
        heard = {request.device_id for request in requests_in(virtual.log.bursts())}
        assert heard == set(range(1, 17))


@each_wire
async def test_a_command_goes_out_between_two_polls(make_bus: MakeBus) -> None:
    boxes = [AblBox(number, default_current=16) for number in (1, 2, 3)]
    async with make_bus(*boxes) as virtual, ABL.bus(virtual.url) as bus:
        chargers = [put_on(bus, number) for number in (1, 2, 3)]
        for charger in chargers:
            await charger.wait_available()
        for current in (6.0, 12.0, 8.0, 16.0):
            await chargers[1].change_orders(OrderChange(current=current))
            assert boxes[1].ic_amps <= current
        assert [duty / 10 * 0.6 for duty in boxes[1].limits_written] == pytest.approx(
            [6.0, 12.0, 7.98, 15.96]
        )
        assert not boxes[0].limits_written
        assert not boxes[2].limits_written


@each_wire
async def test_an_adapter_unplugged_in_mid_frame_and_back(make_bus: MakeBus) -> None:
    boxes = [AblBox(number) for number in (1, 2)]
    async with make_bus(*boxes) as virtual, ABL.bus(virtual.url) as bus:
        first, second = put_on(bus, 1), put_on(bus, 2)
        await first.wait_available()
        await second.wait_available()
        told = asyncio.Event()
        bus.subscribe(told.set)
        # Ten bytes of an answer, and nothing more.
        boxes[0].faults.once("truncate", 10)
        happened = boxes[0].faults.happened
        await virtual.wait_for_async(lambda: bool(happened), timeout=10)
        virtual.unplug()
        await asyncio.wait_for(told.wait(), 10)
        assert not bus.connected
        assert first.reading is None
        assert not second.available
        with pytest.raises(LineLostError):
            await first.change_orders(OrderChange(current=6.0))
        virtual.replug()
        await first.wait_available()
        await second.wait_available()
        # The lowering that nobody could hear then stands, and is followed now.
        await virtual.wait_for_async(lambda: boxes[0].ic_amps <= 6.0, timeout=10)
        assert bus.wire.statistics.reopened == 1


async def test_damaged_bytes_show_nothing_wrong() -> None:
    box = AblBox(1)
    async with VirtualBus.in_loop(box) as virtual, ABL.bus(virtual.url) as bus:
        charger = put_on(bus, 1)
        reading = await charger.wait_available()
        virtual.faults.byte_error_rate = 0.003
        seen = {reading.connectors[1].raw_state}

        def look() -> None:
            if charger.reading is not None:
                seen.add(charger.reading.connectors[1].raw_state)

        charger.subscribe(look)
        await asked(virtual, charger, 30)
        await virtual.wait_for_async(
            lambda: charger.statistics.timeouts > 1, timeout=40
        )
        assert seen == {"A1"}
        virtual.faults.clear()
        await charger.wait_available()
