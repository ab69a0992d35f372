"""What a search has learnt of a box is used by the bus that is set up next."""

import asyncio

import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.dialling import UnknownBox
from custom_components.evse_bus.evse.ews import PROTOCOL
from custom_components.evse_bus.evse.ews.port import BoxPorts
from custom_components.evse_bus.evse.model import OrderChange
from tests.simulated_time import now, simulate
from tests.virtual.ews_box import EwsBox as VirtualBox

from .dialling import (
    SERIAL as DIALS,
    dialling,
    expected,
    has_reading,
    run as dialogue,
    server,
    until,
)
from .scene import EwsScene

INITIAL = 0xF0


async def new_bus(scene: EwsScene) -> None:
    await scene.bus.stop()
    scene.bus = Bus(
        scene.line, PROTOCOL.framer(), PROTOCOL.timing, "again", group=BoxPorts()
    )
    await scene.bus.start()


@pytest.mark.parametrize("bcc", ["all", "without_msgid"])
@pytest.mark.parametrize("searched", [True, False])
def test_its_checksum_is_used_at_once(
    bcc: str,
    searched: bool,  # noqa: FBT001
) -> None:
    """After a search, and after a reload: no command is lost on the way."""

    async def run() -> None:
        scene = EwsScene(ports=(1, 2) if not searched else (), options={"bcc": bcc})
        life = asyncio.create_task(scene.live())
        await scene.bus.start()
        if searched:
            config, orders = scene.make_charger(1).config, scene.make_charger(1).orders
            report = await PROTOCOL.scan(scene.bus, config, orders, lambda _share: None)
            assert len(report.found) == 1
        else:
            await asyncio.sleep(5)
        await new_bus(scene)
        began = now()
        for port in (1, 2):
            scene.bus.add(scene.make_charger(port))
        await scene.until(
            lambda: all(one.available for one in scene.bus.chargers.values()), 3
        )
        assert len(scene.line.named("id", since=began)) == 1
        assert scene.bus.wire.statistics.timeouts == 0
        await scene.bus.stop()
        life.cancel()

    simulate(run())


@pytest.mark.parametrize("bcc", ["all", "without_msgid"])
def test_a_box_with_the_other_checksum_in_its_place(bcc: str) -> None:
    """What is remembered of a line may be of another box."""

    async def run() -> None:
        scene = EwsScene(options={"bcc": bcc}, expected=None)
        async with scene:
            await scene.until(lambda: scene.charger().reading is not None)
            scene.options = {"bcc": "without_msgid" if bcc == "all" else "all"}
            scene.make_box()
            before = scene.charger().box.bcc
            took = await scene.until(lambda: scene.charger().box.bcc is not before)
            assert took < 10
            await scene.until(lambda: scene.charger().available, 1.0)

    simulate(run())


def test_after_a_long_absence_the_limit_is_back_within_ten_seconds() -> None:
    """After a power failure it may charge without a limit: it is looked for often."""

    async def run() -> None:
        scene = EwsScene()
        async with scene:
            await scene.until(lambda: scene.charger().available)
            for away in (3.0, 60.0, 600.0):
                scene.line.cut = True
                await asyncio.sleep(away)
                scene.box.power_cycle(0.5)
                await scene.until(lambda: scene.status() != INITIAL)
                scene.line.cut = False
                took = await scene.until(
                    lambda: scene.box.ports[0].limit == scene.box.ports[1].limit == 16
                )
                assert took < 10
                await asyncio.sleep(30)

    simulate(run())


@pytest.mark.parametrize(("idle", "poll_interval"), [(1.0, 2.0), (10.0, 15.0)])
def test_an_adapter_that_closes_idle_lines_costs_nothing(
    idle: float, poll_interval: float
) -> None:
    """Each time the box is identified anew; no order is sent again."""

    async def close_when_idle(scene: EwsScene) -> None:
        while True:
            await asyncio.sleep(0.1)
            if scene.line.is_open and now() - scene.line.last_activity > idle:
                scene.line.unplug()

    async def run() -> None:
        scene = EwsScene(config={"poll_interval": poll_interval})
        async with scene:
            await scene.until(
                lambda: all(one.reading for one in scene.bus.chargers.values())
            )
            await scene.charge()
            closing = asyncio.create_task(close_when_idle(scene))
            gone: list[bool] = []
            scene.watchers.append(lambda: gone.append(scene.charger().reading is None))
            began = now()
            await asyncio.sleep(20 * poll_interval)
            assert scene.line.statistics.opened > 15
            assert not scene.line.named("st", "sl", since=began)
            assert not any(gone)
            await scene.charger().change_orders(OrderChange(current=10.0))
            assert scene.box.ports[0].limit == 10
            closing.cancel()

    simulate(run())


@pytest.mark.usefixtures("socket_enabled")
@pytest.mark.parametrize("registered", [True, False])
def test_the_checksum_of_a_box_that_dialled_is_handed_on(
    registered: bool,  # noqa: FBT001
) -> None:
    """Its identification has found it: no command of its bus is lost."""

    async def scene() -> None:
        box = VirtualBox(serial=DIALS, bcc="without_msgid")
        unknown: list[UnknownBox] = []
        async with server(on_unknown_box=unknown.append) as made:
            if registered:
                async with expected(made) as bus:
                    with dialling(made, box):
                        await until(lambda: has_reading(bus), 30)
                        assert bus.wire.statistics.timeouts == 0
                return
            with dialling(made, box):
                await until(lambda: unknown, 30)
                async with expected(made) as bus:
                    await until(lambda: has_reading(bus), 30)
                    assert bus.wire.statistics.timeouts == 0

    dialogue(scene)
