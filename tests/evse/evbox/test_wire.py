"""End to end: the library, a line paced at 38400 baud, a virtual ChargePoint."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib import import_module

import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.evbox import (
    PROTOCOL,
    EvboxCharger,
    EvboxConfig,
)
from custom_components.evse_bus.evse.model import CurrentLimit, OrderChange, Orders
from tests.evse.wires import MakeBus, each_wire
from tests.virtual import (
    Car,
    EvboxChargePoint,
    Module,
    Order,
    VirtualBus,
    orders_in,
)
from tests.virtual.evbox_frames import frame

ORDERS = Orders(limit=CurrentLimit(current=16.0))


def make(address: int, orders: Orders = ORDERS) -> EvboxCharger:
    config = EvboxConfig(
        key=str(address),
        name=f"box {address}",
        address=address,
        installation_limit=32.0,
        poll_interval=0.0,
    )
    return EvboxCharger(config, orders)


@asynccontextmanager
async def on_wire(
    *points: EvboxChargePoint,
    make_bus: MakeBus = VirtualBus.in_loop,
    echo: bool = False,
) -> AsyncIterator[tuple[VirtualBus, Bus]]:
    virtual = make_bus(*points)
    virtual.faults.echo = echo
    async with virtual:
        bus = PROTOCOL.bus(virtual.url)
        await bus.start()
        try:
            yield virtual, bus
        finally:
            await bus.stop()
        for point in points:
            assert point.silence_violations == 0
            assert point.over_limit_requests == 0
            assert point.counters.malformed == 0


def sent(virtual: VirtualBus) -> list[Order]:
    return orders_in(virtual.log.bursts())


async def orders_sent(virtual: VirtualBus, charger: EvboxCharger) -> None:
    """Wait until the maximum is known and the orders that stand have been sent."""
    await virtual.wait_for_async(
        lambda: (
            charger.limits.reported == 35.0
            and charger.reading is not None
            and charger.reading.details["sent_currents"] == "16 / 16 / 16"
        ),
        timeout=10.0,
    )


@pytest.mark.parametrize("echo", [False, True], ids=["quiet", "echoing"])
@each_wire
async def test_a_car_charges_and_is_paused(make_bus: MakeBus, *, echo: bool) -> None:
    car = Car(max_current=10.0, reaction=0.0, ramp=0.1)
    point = EvboxChargePoint(1923054, [Module(car)], min_interval=0)
    async with on_wire(point, make_bus=make_bus, echo=echo) as (virtual, bus):
        charger = make(1923054)
        bus.add(charger)
        car.plug_in()
        await orders_sent(virtual, charger)
        await virtual.wait_for_async(
            lambda: (
                charger.reading is not None
                and charger.reading.connectors[1].current == (10.0, 10.0, 10.0)
            )
        )
        await charger.change_orders(OrderChange(allowed=False))
        assert sent(virtual)[-1].limits == (0.0, 0.0, 0.0)
        await virtual.wait_for_async(lambda: car.current == 0.0)
        assert bus.line.echoes is echo
        assert [max(order.limits) for order in sent(virtual)[:2]] == [6.0, 6.0]


async def test_other_masters_and_half_frames() -> None:
    points = [EvboxChargePoint(11, min_interval=0), EvboxChargePoint(12)]
    async with on_wire(*points) as (virtual, bus):
        chargers = [make(11), make(12)]
        for charger in chargers:
            bus.add(charger)
        # A reply to another SmartGrid module, after a frame that ends half-way.
        others = frame("A08068000000770001015E00") + frame("BCA00142")
        virtual.foreign_traffic(others[:20] + others, 0.9, polite=0.02)
        await orders_sent(virtual, chargers[0])
        await orders_sent(virtual, chargers[1])
        virtual.quiet()
        for charger in chargers:
            assert charger.info is not None
            assert charger.info.serial == str(charger.config.address)
            assert charger.reading is not None
            assert len(charger.reading.connectors) == 1
        await chargers[1].change_orders(OrderChange(current=10.0))
        assert sent(virtual)[-1].limits == (10.0, 10.0, 10.0)
        assert points[1].counters.too_soon == 0
        assert bus.wire.statistics.foreign_frames >= 2
        assert bus.wire.statistics.noise_bytes >= 20


async def test_an_adapter_unplugged_in_mid_frame_and_back() -> None:
    point = EvboxChargePoint(1923054, 20, min_interval=0)
    async with on_wire(point) as (virtual, bus):
        charger = make(1923054)
        bus.add(charger)
        await orders_sent(virtual, charger)
        await virtual.wait_for_async(lambda: virtual.wire.busy(virtual.time()))
        virtual.unplug()
        await virtual.wait_for_async(lambda: not charger.available)
        assert charger.reading is None
        before = len(sent(virtual))
        virtual.replug()
        await virtual.wait_for_async(lambda: charger.available)
        await orders_sent(virtual, charger)
        assert max(sent(virtual)[before].limits) == 6.0
        assert len(charger.reading.connectors if charger.reading else ()) == 20


async def test_a_truncated_reply() -> None:
    module = Module(energy_wh=5000, currents=(11.0, 12.0, 13.0))
    point = EvboxChargePoint(1923054, [module], min_interval=0)
    async with on_wire(point) as (virtual, bus):
        charger = make(1923054)
        bus.add(charger)
        await orders_sent(virtual, charger)
        point.faults.once("truncate", 40)
        await virtual.wait_for_async(lambda: charger.statistics.bad_frames == 1)
        replies = charger.statistics.replies
        assert charger.reading is not None
        one = charger.reading.connectors[1]
        assert one.current == (11.0, 12.0, 13.0)
        assert one.energy == 5000
        await virtual.wait_for_async(lambda: charger.statistics.replies > replies)
        assert charger.available


async def test_boxes_that_reply_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    # In the package this name is the function, not the module.
    module = import_module("custom_components.evse_bus.evse.evbox.scan")
    monkeypatch.setattr(module, "RETRY_PAUSE", 0.2)
    points = [
        EvboxChargePoint(11, min_interval=0),
        EvboxChargePoint(12, min_interval=0),
    ]
    async with on_wire(*points) as (virtual, bus):
        any_box = make(0).config
        report = await PROTOCOL.scan(bus, any_box, ORDERS, lambda _share: None)
        assert report.found == ()
        assert report.unreadable
        assert virtual.wire.collisions
        one = make(12).config
        report = await PROTOCOL.scan(bus, one, ORDERS, lambda _share: None)
        assert [found.address for found in report.found] == [12]
        assert {max(order.limits) for order in sent(virtual)} == {6.0}


async def test_it_falls_back_after_the_bus_stopped() -> None:
    point = EvboxChargePoint(1923054, min_interval=0)
    async with on_wire(point) as (virtual, bus):
        charger = make(1923054)
        bus.add(charger)
        await orders_sent(virtual, charger)
        assert point.limits_in_force == (16.0, 16.0, 16.0)
        await asyncio.sleep(0)
        await bus.stop()
        assert not point.failed_back
        virtual.advance(61.0)
        assert point.failed_back
        assert point.limits_in_force == (6.0, 6.0, 6.0)
