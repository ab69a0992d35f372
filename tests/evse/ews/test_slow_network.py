"""A box behind a slow network: a command gets its turn, or fails."""

import asyncio

import pytest

from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.ews.timing import TCP_TIMING
from custom_components.evse_bus.evse.model import OrderChange
from tests.simulated_time import simulate

from .scene import EwsScene

WORKS_UP_TO = 2.4
"""Longest round trip with which the box can be used, s."""


@pytest.mark.parametrize("delay", [0.1, 1.0, 2.0, WORKS_UP_TO, 3.0, 4.0])
def test_no_command_waits_for_ever(delay: float) -> None:
    async def scene() -> None:
        scene = EwsScene(timing=TCP_TIMING)
        # TCP checks the bytes: no reading is repeated.
        scene.line.opened_by_peer = True  # type: ignore[misc]
        async with scene:
            say = scene.line.say
            loop = asyncio.get_running_loop()

            def say_late(data: bytes) -> None:
                loop.call_later(delay, say, data)

            scene.line.say = say_late  # type: ignore[method-assign]
            await asyncio.sleep(200)
            for port in scene.ports:
                confirmed = True
                try:
                    async with asyncio.timeout(120):
                        change = OrderChange(current=10.0)
                        await scene.charger(port).change_orders(change)
                except EvseError:
                    confirmed = False
                assert confirmed or delay > WORKS_UP_TO
                assert (10 in scene.line.limits(port)) >= confirmed

    simulate(scene())
