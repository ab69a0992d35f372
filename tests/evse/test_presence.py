"""The log of chargers that go and return, in simulated time."""

import asyncio
import logging

import pytest

from custom_components.evse_bus.evse.errors import PortMissingError
from custom_components.evse_bus.evse.throttle import LOSSES
from tests.simulated_time import simulate

from .telegram import Scene


def presence(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the lines at info on the presence of chargers."""
    return [
        one.getMessage()
        for one in caplog.records
        if one.levelno == logging.INFO and "available: " in one.getMessage()
    ]


def test_charger_that_goes_and_returns_is_logged_once_each(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)

    async def scene() -> None:
        async with Scene(addresses=(1, 2), interval=1.0) as bus:
            await asyncio.sleep(5)
            assert presence(caplog) == []
            bus.line.devices[1].alive = False
            await asyncio.sleep(600)
            [gone] = presence(caplog)
            assert gone.startswith("charger 1 is unavailable: ")
            assert "no reply" in gone
            bus.line.devices[1].alive = True
            await asyncio.sleep(600)
            assert presence(caplog)[1:] == ["charger 1 is available: it answers"]

    simulate(scene())


def test_charger_that_never_answered_is_logged_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)

    async def scene() -> None:
        bus = Scene(addresses=(1, 2))
        bus.line.devices[1].alive = False
        async with bus:
            await asyncio.sleep(600)

    simulate(scene())
    assert len(presence(caplog)) == 1


def test_charger_that_comes_and_goes_for_ever_is_logged_at_most_20_times_an_hour(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)

    async def scene() -> None:
        async with Scene() as bus:
            for _ in range(40):
                for alive in (True, False):
                    bus.line.devices[1].alive = alive
                    await asyncio.sleep(40)

    simulate(scene())
    assert len(presence(caplog)) == 2 * LOSSES


def test_chargers_of_a_lost_port_are_logged_with_the_reason(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)

    async def scene() -> None:
        async with Scene(addresses=(1, 2)) as bus:
            await asyncio.sleep(5)
            bus.line.refuse_open = PortMissingError("no such port")
            bus.line.unplug()
            await asyncio.sleep(20)
            assert presence(caplog) == [
                "charger 1 is unavailable: unplugged",
                "charger 2 is unavailable: unplugged",
            ]
            bus.line.refuse_open = None
            await asyncio.sleep(20)
            assert len(presence(caplog)) == 4

    simulate(scene())
