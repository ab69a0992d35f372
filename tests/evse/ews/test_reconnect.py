"""A box that was gone: how soon both of its ports are available again."""

import asyncio

import pytest

from custom_components.evse_bus.evse.ews.timing import TCP_TIMING

from .dialling import dialling, expected, has_reading, run, server, until
from .scene import EwsScene, play


@pytest.mark.parametrize("silence", [15.0, 40.0, 100.0, 200.0])
def test_both_ports_come_back_together(silence: float) -> None:
    async def acts(scene: EwsScene) -> None:
        scene.line.cut = True
        await asyncio.sleep(silence)
        assert not any(scene.charger(port).available for port in (1, 2))
        scene.line.cut = False
        one, other = scene.charger(1), scene.charger(2)
        await scene.until(lambda: one.available or other.available)
        took = await scene.until(lambda: one.reading and other.reading)
        assert took < 0.2

    play(EwsScene(), acts)


@pytest.mark.parametrize("silence", [5.0, 8.0, 20.0, 40.0, 80.0])
@pytest.mark.parametrize("counts", ["all", "without_msgid"])
def test_a_new_line_begins_with_the_reading_that_was_right(
    silence: float, counts: str
) -> None:
    async def acts(scene: EwsScene) -> None:
        scene.line.cut = True
        await asyncio.sleep(silence)
        lost = scene.bus.wire.statistics.timeouts
        assert lost > 0
        scene.unplug()
        scene.line.cut = False
        await scene.until(lambda: scene.bus.connected)
        await scene.until(lambda: scene.charger().reading and scene.charger(2).reading)
        assert scene.bus.wire.statistics.timeouts == lost

    play(EwsScene(timing=TCP_TIMING, options={"bcc": counts}), acts)


@pytest.mark.usefixtures("socket_enabled")
def test_a_box_that_dials_again_is_there_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    accepted = "custom_components.evse_bus.evse.ews.network.line.ANSWER_PATIENCE"
    monkeypatch.setattr(accepted, 5.0)

    async def scene() -> None:
        async with server() as made, expected(made) as bus:
            with dialling(made) as dialler:
                await until(lambda: has_reading(bus))
                dialler.unplug()
                # Two tries have been in vain, and the connection is given up.
                await until(lambda: not bus.connected, 12)
                assert bus.wire.statistics.timeouts > 1
                dialler.replug()
                await until(lambda: has_reading(bus), 1.5)

    run(scene)
