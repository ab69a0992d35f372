"""Settings of the box: written to an identified box only, and checked afterwards."""

import asyncio

import pytest

from custom_components.evse_bus.evse.errors import (
    DuplicateAddressError,
    EvseError,
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.model import Command, OrderChange
from tests.virtual import AblBox

from .scene import (
    LIMIT,
    SETUP,
    STATE,
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


async def test_a_new_device_id() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10))
        await charger.command(Command.SET_ADDRESS, 7)
        assert box.device_id == 7
        assert charger.config.address == 7
        assert scene.writes(STATE) == [E2, RESET]
        # Bits 15..12: no change.
        assert scene.writes(SETUP) == [0xF007]
        assert box.outlet.upstream_enabled is False
        await until(lambda: charger.available and box.ic_amps < 10)
        assert scene.reads(7, 0x50)


async def test_a_new_device_id_in_e0_leaves_the_outlet_disabled() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await charger.command(Command.SET_OUTLET, value=False)
        await charger.command(Command.SET_ADDRESS, 2)
        assert (box.device_id, box.state) == (2, "E0")


async def test_a_device_id_in_use() -> None:
    unknown = AblBox(3, serial="2W22xy00000003", sleep_after=5, wake_time=0.1)
    async with Scene(box_with(), AblBox(2, serial="2W22xy00000002"), unknown) as scene:
        charger = await scene.settled(config(), orders())
        scene.add(config(2), orders())
        for address in (2, 3):
            with pytest.raises(DuplicateAddressError, match=str(address)):
                await charger.command(Command.SET_ADDRESS, address)
        assert scene.writes() == []
        assert charger.config.address == 1


async def test_a_device_id_that_is_not_taken() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        # The box confirms the write and ignores it.
        box._configure = lambda _value: True  # type: ignore[method-assign]
        with pytest.raises(NotConfirmedError, match="not found at device-ID 2"):
            await charger.command(Command.SET_ADDRESS, 2)
        assert charger.config.address == 1
        await until(lambda: charger.available and charger.pending_cleanup is None)
        assert box.state == "A1"


@pytest.mark.parametrize("value", [0, 17, True, None, 2.0])
async def test_an_invalid_device_id_is_refused(value: object) -> None:
    async with Scene(box_with()) as scene:
        charger = await scene.settled(config(), orders())
        with pytest.raises(RefusedOrderError):
            await charger.command(Command.SET_ADDRESS, value=value)  # type: ignore[arg-type]
        await charger.command(Command.SET_ADDRESS, 1)
        assert scene.writes() == []


async def test_a_device_id_with_an_unreadable_reply_is_in_use() -> None:
    box = box_with()
    other = AblBox(2, serial="2W22xy00000002")
    async with Scene(box, other) as scene:
        charger = await scene.settled(config(), orders())
        # Two boxes whose replies collide.
        answers(other, *[b">02030401\xff\xff\r\n"] * 4)
        with pytest.raises(DuplicateAddressError):
            await charger.command(Command.SET_ADDRESS, 2)
        assert scene.writes() == []


async def test_no_settings_with_a_car_or_without_a_serial_number() -> None:
    car = sleepy()
    box = box_with(car)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        with pytest.raises(NotAvailableError, match="B2"):
            await charger.command(Command.SET_ADDRESS, 2)
        assert scene.writes() == []
    box = box_with(serial="")
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        with pytest.raises(NotAvailableError, match="serial number"):
            await charger.command(Command.SET_ADDRESS, 2)
        assert scene.writes() == []


async def test_refused_settings_leave_the_set_up_mode() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.stop_polls(charger)
        # The status and Icmax, E2, both again, and the settings.
        answers(box, *["good"] * 5, b">0190046B\r\n")
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
        await charger.command(Command.SET_ADDRESS, 5)
        await charger.command(Command.RESET)
        await charger.change_orders(OrderChange(current=8))
        assert {one.device_id for one in scene.requests()} <= {1, 5}
        assert scene.writes(LIMIT) == [133]


async def test_a_port_lost_in_the_set_up_mode() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        setting = asyncio.create_task(charger.command(Command.SET_ADDRESS, 2))
        await until(lambda: box.state == "E2")
        scene.virtual.unplug()
        with pytest.raises(EvseError):
            await setting
        scene.virtual.replug()
        await until(lambda: box.state == "A1")
        await until(lambda: charger.pending_cleanup is None)
        assert charger.config.address == box.device_id
