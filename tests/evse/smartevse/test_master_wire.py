"""Our master and virtual slaves end to end: sharing, and falling silent."""

import asyncio
from itertools import pairwise
from typing import ClassVar, Literal, override

import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.model import (
    Circuit,
    CurrentLimit,
    OrderChange,
    Orders,
)
from custom_components.evse_bus.evse.scan import ScanResult
from custom_components.evse_bus.evse.smartevse import MASTER, SlaveConfig, master
from tests.evse.wires import MakeBus, each_wire
from tests.virtual import Car, SmartEvse, VirtualBus, smartevse_requests_in
from tests.virtual.device import Device

PATIENCE = 20.0


class OfferMeter(Device):
    """Adds up at each step the offers of all boxes with closed contactors."""

    baud: ClassVar[int] = 9600
    parity: ClassVar[str] = "N"
    protocol: ClassVar[str] = "smartevse"

    def __init__(self, *boxes: SmartEvse) -> None:
        super().__init__("meter")
        self.boxes = boxes
        self.most = 0.0
        self.opened_at: float | None = None

    @override
    def step(self) -> None:
        offers = [box.pilot_current for box in self.boxes if box.contactor]
        self.most = max(self.most, sum(offers))
        if offers:
            self.opened_at = None
        elif self.opened_at is None:
            self.opened_at = self.now()

    @override
    def receive(self, segment: object) -> None:
        pass


def make_box(unit: Literal[2, 3, 4]) -> SmartEvse:
    return SmartEvse("2.17", load_balance=unit, cable=32, max_current=32, car=Car())


def config(unit: int) -> SlaveConfig:
    return SlaveConfig(
        key=str(unit), name=f"slave {unit}", address=unit, installation_limit=16.0
    )


def put_on(bus: Bus, *units: int) -> None:
    for unit in units:
        orders = Orders(limit=CurrentLimit(current=16.0), allowed=True)
        bus.add(MASTER.charger(config(unit), orders))


def car_of(box: SmartEvse) -> Car:
    assert box.car is not None
    return box.car


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the time to listen for another master: there is none."""
    monkeypatch.setattr(master, "LISTENING", 0.3)


@pytest.mark.usefixtures("impatient")
@each_wire
async def test_two_cars_share_16_a(make_bus: MakeBus) -> None:
    """One after the other, up and down; the contactors and pilots are the oracle."""
    boxes = make_box(2), make_box(3)
    meter = OfferMeter(*boxes)
    async with make_bus(*boxes, meter) as virtual:
        bus = MASTER.bus(virtual.url, circuit=Circuit(limit=16.0))
        put_on(bus, 2, 3)
        async with bus:
            for charger in bus.chargers.values():
                await charger.wait_available()
            car_of(boxes[0]).plug_in()
            await virtual.wait_for_async(
                lambda: boxes[0].contactor and boxes[0].pilot_current == 16,
                timeout=PATIENCE,
            )
            car_of(boxes[1]).plug_in()
            await virtual.wait_for_async(
                lambda: (
                    [box.pilot_current for box in boxes] == [8, 8]
                    and boxes[1].contactor
                ),
                timeout=PATIENCE,
            )
            await bus.chargers["2"].change_orders(OrderChange(current=6.0))
            await virtual.wait_for_async(
                lambda: [box.pilot_current for box in boxes] == [6, 10],
                timeout=PATIENCE,
            )
            await bus.chargers["3"].change_orders(OrderChange(allowed=False))
            assert not boxes[1].contactor
            await bus.chargers["2"].change_orders(OrderChange(current=16.0))
            await virtual.wait_for_async(
                lambda: boxes[0].pilot_current == 16, timeout=PATIENCE
            )
        assert meter.most == 16
        assert max(box.controller.dropped for box in boxes) == 0
        beats = [r.t for r in smartevse_requests_in(virtual) if r.unit == 0]
        if make_bus == VirtualBus.in_loop:
            assert max(b - a for a, b in pairwise(beats)) < 2.2


@pytest.mark.usefixtures("impatient")
async def test_without_a_shutdown_the_slaves_stop_by_themselves() -> None:
    box = make_box(2)
    meter = OfferMeter(box)
    async with VirtualBus.in_loop(box, meter) as virtual:
        bus = MASTER.bus(virtual.url, circuit=Circuit(limit=16.0))
        put_on(bus, 2)
        await bus.start()
        await bus.chargers["2"].wait_available()
        car_of(box).plug_in()
        await virtual.wait_for_async(lambda: box.contactor, timeout=PATIENCE)
        # Nothing is awaited or closed: the task is just gone.
        task = bus._task
        assert task is not None
        task.cancel()
        await asyncio.wait({task})
        last = box.broadcasts[-1].t
        virtual.time_scale = 20
        await virtual.wait_for_async(lambda: not box.contactor, timeout=PATIENCE)
        assert meter.opened_at is not None
        assert 9 <= meter.opened_at - last <= 11.5
        assert box.error & 2
        virtual.time_scale = 1
        await bus.stop()


@pytest.mark.usefixtures("impatient")
async def test_a_restarted_bus_does_not_disturb_a_charge() -> None:
    box = make_box(2)
    meter = OfferMeter(box)
    async with VirtualBus.in_loop(box, meter) as virtual:
        bus = MASTER.bus(virtual.url, circuit=Circuit(limit=16.0))
        put_on(bus, 2)
        async with bus:
            await bus.chargers["2"].wait_available()
            car_of(box).plug_in()
            await virtual.wait_for_async(
                lambda: box.contactor and box.pilot_current == 16, timeout=PATIENCE
            )
        before, requests = len(box.broadcasts), len(box.requests_sent)
        bus = MASTER.bus(virtual.url, circuit=Circuit(limit=16.0))
        put_on(bus, 2)
        async with bus:
            await virtual.wait_for_async(
                lambda: len(box.broadcasts) >= before + 2, timeout=PATIENCE
            )
            assert {sent.currents[1] for sent in box.broadcasts[before:]} == {160}
            assert box.contactor
            assert meter.opened_at is None
            assert len(box.requests_sent) == requests


@pytest.mark.usefixtures("impatient")
async def test_a_scan_finds_slaves_and_only_reads() -> None:
    boxes = make_box(2), make_box(4)
    async with (
        VirtualBus.in_loop(*boxes) as virtual,
        MASTER.bus(virtual.url, circuit=Circuit()) as bus,
    ):
        report: ScanResult = await MASTER.scan(
            bus, config(2), Orders(limit=CurrentLimit(current=6.0)), lambda _share: None
        )
        assert [found.address for found in report.found] == [2, 4]
        assert not boxes[0].writes
        assert not boxes[0].broadcasts


async def test_a_box_that_is_a_master_silences_us() -> None:
    boxes = SmartEvse("2.17", load_balance=1), make_box(2)
    async with VirtualBus.in_loop(*boxes) as virtual:
        bus = MASTER.bus(virtual.url, circuit=Circuit(limit=16.0))
        put_on(bus, 2)
        async with bus:
            assert bus.master is not None
            duty = bus.master
            await virtual.wait_for_async(lambda: duty.noticed, timeout=PATIENCE)
            await asyncio.sleep(1.5)
            assert smartevse_requests_in(virtual) == []
