"""The same conversation through a line, at the pace of the wire."""

from custom_components.evse_bus.evse.ews import PROTOCOL
from custom_components.evse_bus.evse.ews.config import EwsPortConfig
from custom_components.evse_bus.evse.model import (
    CurrentLimit,
    OrderChange,
    Orders,
    Status,
)
from tests.evse.simulated_line import until
from tests.evse.wires import MakeBus, each_wire
from tests.virtual import Car
from tests.virtual.ews_box import EwsBox as VirtualBox


@each_wire
async def test_both_ports(make_bus: MakeBus) -> None:
    cars = (Car(), Car())
    box = VirtualBox(cars=cars)
    with make_bus(box) as bus:
        async with PROTOCOL.bus(bus.url) as line:
            ports = [
                PROTOCOL.charger(
                    EwsPortConfig(
                        key=str(port),
                        name=str(port),
                        address=port,
                        serial=box.serial,
                        installation_limit=16.0,
                        poll_interval=0.3,
                    ),
                    Orders(limit=CurrentLimit(current=16.0)),
                )
                for port in (1, 2)
            ]
            for port in ports:
                line.add(port)
            await until(lambda: all(port.reading for port in ports))
            for at, port in enumerate(ports):
                cars[at].plug_in()
                await until(lambda at=at: box.ports[at].status == 0x30)
                await port.change_orders(OrderChange(allowed=True, current=10.0 + at))
            await until(lambda: all(port.contactor for port in box.ports))
            assert [port.offered for port in box.ports] == [10, 11]
            await ports[1].change_orders(OrderChange(allowed=False))
            assert [port.status for port in box.ports] == [0x40, 0x50]
            assert all(port.locked for port in box.ports)
            reading = ports[1].reading
            assert reading is not None
            assert reading.connectors[2].status is Status.SUSPENDED_EVSE
            bus.unplug()
            await until(lambda: not line.connected)
            bus.replug()
            await until(lambda: all(port.reading for port in ports))
            assert line.wire.statistics.bad_frames == 0
