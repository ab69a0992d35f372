"""A configured port that the box does not have: the other one goes on."""

import asyncio

import pytest

from custom_components.evse_bus.evse.errors import NotAvailableError
from custom_components.evse_bus.evse.ews.timing import TCP_TIMING
from custom_components.evse_bus.evse.model import Command, Fault, OrderChange

from .scene import EwsScene, now, simulate
from .test_times import longest_silence


def one_port(**options: object) -> EwsScene:
    return EwsScene(options={"ports": 1}, **options)  # type: ignore[arg-type]


async def reinstall(scene: EwsScene, ports: int) -> None:
    """Let the box have so many ports from now on, as if by its web page."""
    scene.box.system.ports = ports
    scene.box.take_parameters()
    scene.charger().box.parameters_due = float("-inf")
    await asyncio.sleep(15)


def test_a_missing_port_is_a_fault_and_gets_no_order() -> None:
    async def run() -> None:
        async with one_port() as scene:
            await scene.until(lambda: scene.charger().reading is not None)
            await asyncio.sleep(30)
            missing = scene.charger(2)
            assert missing.faults == {Fault.NO_SUCH_PORT}
            assert not missing.available
            assert missing.reading is None
            for change in (OrderChange(current=10.0), OrderChange(allowed=True)):
                with pytest.raises(NotAvailableError, match="no port 2"):
                    await missing.change_orders(change)
            with pytest.raises(NotAvailableError, match="no port 2"):
                await missing.command(Command.STOP_AND_UNLOCK)
            with pytest.raises(NotAvailableError, match="no port 2"):
                await missing.services.set_meter(5)
            assert not scene.line.limits(2)
            assert not scene.line.named("sl", "cr")
            # The other one knows nothing of it.
            assert not scene.charger().faults
            await scene.charge()
            await scene.charger().change_orders(OrderChange(current=10.0))
            assert scene.box.ports[0].limit == 10

    simulate(run())


@pytest.mark.parametrize("order", [(1, 2), (2, 1)], ids=["last", "first"])
@pytest.mark.parametrize("interval", [2.0, 20.0, 300.0])
def test_the_other_one_keeps_its_times(order: tuple[int, ...], interval: float) -> None:
    async def run() -> None:
        scene = one_port(
            ports=order, timing=TCP_TIMING, config={"poll_interval": interval}
        )
        async with scene:
            await scene.until(lambda: scene.charger().reading is not None)
            begin = now()
            await asyncio.sleep(600)
            assert longest_silence(scene, begin) < 25
            assert scene.bus.wire.statistics.missed_deadlines == 0
            assert scene.charger().available
            assert Fault.NO_SUCH_PORT in scene.charger(2).faults
            asked = len(scene.line.named("rc", since=begin))
            assert asked <= 600 / min(interval, 12) + 10
            if interval == 2.0:
                assert asked >= 290
            # A record is followed by a reading at once, by either port.
            scene.cars[0].plug_in()
            await scene.until(lambda: scene.status() == 0x30)
            began = now()
            scene.box.press_key(1, 1)
            await scene.until(lambda: scene.connector().start_requested)
            assert now() - began < 0.2

    simulate(run())


def test_it_comes_and_goes() -> None:
    async def run() -> None:
        async with one_port() as scene:
            await scene.until(lambda: scene.charger().reading is not None)
            await asyncio.sleep(10)
            missing: list[bool] = []
            port = scene.charger(2)
            port.subscribe(lambda: missing.append(Fault.NO_SUCH_PORT in port.faults))
            await reinstall(scene, 2)
            await scene.until(lambda: port.available and port.reading, 400)
            assert not port.faults
            assert not missing[-1]
            await port.change_orders(OrderChange(current=10.0))
            assert scene.box.ports[1].limit == 10
            await reinstall(scene, 1)
            assert not port.available
            assert port.reading is None
            assert port.faults == {Fault.NO_SUCH_PORT}
            assert missing[-1]

    simulate(run())
