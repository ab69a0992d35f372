"""Settings of the box: written to an identified box only, and checked afterwards."""

import asyncio

import pytest

from custom_components.evse_bus.evse.errors import (
    EvseError,
    NotAvailableError,
    NotConfirmedError,
)
from custom_components.evse_bus.evse.model import Command, OrderChange

from .scene import (
    LIMIT,
    SETUP,
    Scene,
    answers,
    box_with,
    config,
    orders,
    sleepy,
    until,
)

RESET, A1, E0, E2 = 0x5A5A, 0xA1A1, 0xE0E0, 0xE2E2
PAUSE = 1000


async def test_no_settings_with_a_car_or_without_a_serial_number() -> None:
    car = sleepy()
    box = box_with(car)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        with pytest.raises(NotAvailableError, match="B2"):
            await charger.command(Command.SET_UPSTREAM_TIMEOUT, value=True)
        assert scene.writes() == []
    box = box_with(serial="")
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        with pytest.raises(NotAvailableError, match="serial number"):
            await charger.command(Command.SET_UPSTREAM_TIMEOUT, value=True)
        assert scene.writes() == []


async def test_refused_settings_leave_the_set_up_mode() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.stop_polls(charger)
        # Status and Icmax, E2, the changed status twice, Icmax, and the settings.
        answers(box, *["good"] * 6, b">0190046B\r\n")
        with pytest.raises(EvseError, match="exception 4"):
            await charger.command(Command.SET_UPSTREAM_TIMEOUT, value=True)
        assert scene.writes() == [E2, 0xB001, A1]
        assert box.state == "A1"


@pytest.mark.parametrize("on", [True, False])
async def test_upstream_timeout(on: bool) -> None:  # noqa: FBT001
    box = box_with(upstream_enabled=not on)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await charger.command(Command.SET_UPSTREAM_TIMEOUT, value=on)
        assert box.outlet.upstream_enabled is on
        assert scene.writes(SETUP) == [0xB001 if on else 0x7001]
        assert charger.info is not None
        assert charger.info.options["upstream_timeout"] is on


@pytest.mark.parametrize("on", [True, False])
async def test_enable_after_power_cycle(on: bool) -> None:  # noqa: FBT001
    box = box_with()
    box.outlet.b2_needs_enable_after_power = on
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await charger.command(Command.SET_ENABLE_AFTER_POWER_CYCLE, value=on)
        assert box.outlet.b2_needs_enable_after_power is not on
        assert scene.writes(SETUP) == [0xD001 if on else 0xE001]
        assert charger.info is not None
        assert charger.info.options["enable_after_power_cycle"] is on


async def test_a_setting_that_is_not_taken() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        # The box confirms the write and ignores it.
        box._configure = lambda _value: True  # type: ignore[method-assign]
        with pytest.raises(NotConfirmedError, match="upstream_timeout"):
            await charger.command(Command.SET_UPSTREAM_TIMEOUT, value=True)
        assert box.state == "A1"


async def test_nothing_is_broadcast() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await charger.command(Command.SET_UPSTREAM_TIMEOUT, value=False)
        await charger.command(Command.RESET)
        await charger.change_orders(OrderChange(current=8))
        assert {one.device_id for one in scene.requests()} == {1}
        assert scene.writes(LIMIT) == [133]


async def test_a_port_lost_in_the_set_up_mode() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        setting = asyncio.create_task(
            charger.command(Command.SET_UPSTREAM_TIMEOUT, value=True)
        )
        await until(lambda: box.state == "E2")
        scene.virtual.unplug()
        with pytest.raises(EvseError):
            await setting
        scene.virtual.replug()
        await until(lambda: box.state == "A1")
        await until(lambda: charger.pending_cleanup is None)
