"""A polled SmartEVSE end to end: the library's bus and a virtual box."""

import asyncio
from collections.abc import Callable

import pytest

from custom_components.evse_bus.evse.model import CurrentLimit, OrderChange, Orders
from custom_components.evse_bus.evse.smartevse import POLLED
from custom_components.evse_bus.evse.smartevse.config import PolledConfig
from custom_components.evse_bus.evse.smartevse.dialects import Dialect
from tests.evse.wires import MakeBus, each_wire
from tests.virtual import Car, SmartEvse

from .polled_scene import V2_17

SCALE = 10.0


async def until(holds: Callable[[], object]) -> None:
    async with asyncio.timeout(10):
        while not holds():  # noqa: ASYNC110 - the virtual box has no event for it
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("dialect", [V2_17])
@each_wire
async def test_a_charge(make_bus: MakeBus, dialect: Dialect) -> None:
    car = Car(max_current=32.0)
    box = SmartEvse(dialect.value, car=car, max_current=16)
    with make_bus(box, baud=9600, parity="N", time_scale=SCALE) as virtual:
        bus = POLLED.bus(virtual.url)
        charger = POLLED.charger(
            PolledConfig(
                key="box",
                name="the box",
                address=box.unit,
                installation_limit=20.0,
                poll_interval=0.2,
            ),
            Orders(limit=CurrentLimit(current=10.0)),
        )
        bus.add(charger)
        async with bus:
            await charger.wait_available(5)
            car.plug_in()
            await until(lambda: box.contactor and box.pilot_current == 10)
            await charger.change_orders(OrderChange(current=13.0))
            assert box.pilot_current == 13
            await charger.change_orders(OrderChange(allowed=False))
            assert not box.contactor
            assert not box.access
            await charger.change_orders(OrderChange(allowed=True))
            assert box.access
        assert bus.wire.statistics.bad_frames == 0
