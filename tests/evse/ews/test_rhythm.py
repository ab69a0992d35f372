"""What a search has learnt of a box is used by the bus that is set up next."""

import asyncio

import pytest

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.ews import PROTOCOL
from custom_components.evse_bus.evse.ews.port import BoxPorts
from tests.simulated_time import now, simulate

from .scene import EwsScene


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
