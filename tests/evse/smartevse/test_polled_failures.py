"""A polled SmartEVSE: failures at the worst moment."""

import asyncio
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import pytest

from custom_components.evse_bus.evse.errors import EvseError, NotConfirmedError
from custom_components.evse_bus.evse.model import (
    Fault,
    OrderChange,
    PauseReason,
    Setting,
)
from custom_components.evse_bus.evse.smartevse import POLLED
from custom_components.evse_bus.evse.smartevse.dialects import MAPS, Dialect
from custom_components.evse_bus.evse.smartevse.registers import read_request
from tests.simulated_time import now, simulate

from .polled_scene import ALL, HEAD, LATER, OLDER, V2_17, V2_20, PolledScene, play

each = pytest.mark.parametrize("dialect", ALL)
older = pytest.mark.parametrize("dialect", OLDER)


async def chatter(scene: PolledScene, seconds: float) -> None:
    """Keep the line busy."""
    until = now() + seconds
    while now() < until:
        scene.line.noise(b"\xff")
        await asyncio.sleep(0.004)


@older
def test_a_line_too_busy_to_read_back_confirms_nothing(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(2)
        since = now()
        order = asyncio.create_task(
            scene.charger.change_orders(OrderChange(current=14))
        )
        await scene.until(lambda: scene.currents(since))
        await asyncio.sleep(0.1)
        scene.outlet.override_works = False
        await chatter(scene, 2.0)
        with pytest.raises(EvseError):
            await order
        assert scene.charger.orders.limit.current == 10

    play(PolledScene(dialect), acts)


@each
def test_expired_orders_stay_so_while_the_fail_safe_changes(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.until(lambda: scene.charger.orders_expired)
        await scene.until(lambda: scene.box.offers == 6)
        since = now()
        await scene.charger.change_orders(OrderChange(fail_safe_current=8))
        await scene.polled(3)
        assert max(scene.currents(since)) <= 80
        assert scene.box.offers == 8

    play(PolledScene(dialect, lifetime=40.0), acts)


@each
@pytest.mark.parametrize("away", [1.0, 600.0])
def test_access_opened_by_a_power_failure_is_soon_closed(
    dialect: Dialect, away: float
) -> None:
    async def acts(scene: PolledScene) -> None:
        scene.car.plug_in()
        await scene.polled(2)
        scene.box.deaf = True
        await asyncio.sleep(away)
        scene.box.controller.power_cycle()
        scene.box.deaf = False
        await asyncio.sleep(0.1)
        assert scene.outlet.access
        took = await scene.until(lambda: not scene.outlet.access, 100)
        assert took < 8

    play(PolledScene(dialect, allowed=False), acts)


@each
@pytest.mark.parametrize("how", ["answers", "line"])
def test_access_opened_by_a_setting_is_closed_after_a_failure(
    dialect: Dialect, how: str
) -> None:
    async def acts(scene: PolledScene) -> None:
        scene.outlet.set_access(False)
        scene.car.plug_in()
        await scene.polled(2)
        register = 0x0103 if dialect in LATER else 0xE0 if dialect is V2_17 else 0xC3
        request = asyncio.create_task(
            scene.charger.configure(Setting.MAXIMUM_CURRENT, 13)
        )
        await scene.until(lambda: scene.writes(register))
        await asyncio.sleep(0.015)
        scene.box.deaf = True
        if how == "line":
            await asyncio.sleep(0.03)
            scene.line.unplug()
        with pytest.raises(EvseError):
            await request
        if how == "answers":
            await asyncio.sleep(20)
        scene.box.deaf = False
        assert scene.outlet.access
        await asyncio.sleep(45)
        assert not scene.outlet.access
        # A start by the user turns it on.
        await scene.charger.change_orders(OrderChange(allowed=True))
        await scene.polled(3)
        assert scene.outlet.access

    play(PolledScene(dialect), acts)


def test_a_firmware_without_the_override_is_stopped() -> None:
    """2.17 as released refuses the override, and does not follow it either."""

    async def acts(scene: PolledScene) -> None:
        scene.car.plug_in()
        await scene.until(lambda: scene.box.offers > 0)
        assert await scene.until(lambda: scene.box.offers == 0) < 12
        await scene.polled(2)
        assert Fault.LIMIT_NOT_TAKEN in scene.charger.faults
        assert scene.charger.waits_for_current
        assert scene.charger.pause_reason is PauseReason.LIMIT_NOT_FOLLOWED
        # A limit that it would exceed again starts nothing.
        await scene.charger.change_orders(OrderChange(current=9))
        await scene.polled(3)
        assert scene.accesses() == [0]
        # A limit that it cannot exceed does.
        await scene.charger.change_orders(OrderChange(current=16))
        await scene.polled(4)
        assert scene.box.offers == 16
        assert Fault.LIMIT_NOT_TAKEN not in scene.charger.faults
        with pytest.raises(NotConfirmedError, match="set MAX in its menu"):
            await scene.charger.change_orders(OrderChange(current=8))
        assert scene.box.offers == 0
        # A start by the user is tried once.
        await scene.charger.change_orders(OrderChange(allowed=True))
        await scene.until(lambda: scene.box.offers > 0)
        assert await scene.until(lambda: scene.box.offers == 0) < 12
        await scene.polled(5)
        assert Fault.LIMIT_NOT_TAKEN in scene.charger.faults
        assert scene.accesses() == [0, 1, 0, 1, 0]
        await scene.charger.change_orders(OrderChange(allowed=False))
        assert Fault.LIMIT_NOT_TAKEN not in scene.charger.faults
        await scene.charger.change_orders(OrderChange(current=16))
        assert not scene.outlet.access

    play(PolledScene(V2_17, override_works=False), acts)


@pytest.mark.parametrize("reload", [True, False])
@pytest.mark.parametrize("after", [0.2, 2.0, 3.9, 6.0])
def test_a_reload_does_not_stop_a_later_box(
    after: float,
    reload: bool,  # noqa: FBT001
) -> None:
    async def run() -> None:
        scene = PolledScene(HEAD)
        errors: list[int] = []
        scene.on_step.append(lambda: errors.append(scene.outlet.error))
        async with scene:
            await scene.settled()
            await scene.charge()
            await scene.polled(5)
            last = len(scene.line.sent)
            await scene.until(lambda: len(scene.line.sent) > last)
            await asyncio.sleep(after)
            await scene.restart(reload=reload)
            await asyncio.sleep(30)
            assert not any(errors)

    simulate(run())


@pytest.mark.parametrize("after", [0.2, 2.0, 3.9, 6.0])
def test_a_scan_does_not_stop_a_later_box(after: float) -> None:
    async def acts(scene: PolledScene) -> None:
        errors: list[int] = []
        scene.on_step.append(lambda: errors.append(scene.outlet.error))
        await scene.charge()
        await scene.polled(5)
        last = len(scene.line.sent)
        await scene.until(lambda: len(scene.line.sent) > last)
        await asyncio.sleep(after)
        await POLLED.scan(
            scene.bus, scene.charger.config, scene.charger.orders, lambda _: None
        )
        await asyncio.sleep(30)
        assert not any(errors)

    play(PolledScene(HEAD), acts)


def test_the_fault_of_a_shared_address_is_steady() -> None:
    async def acts(scene: PolledScene) -> None:
        scene.bus.add(PolledScene(V2_20).make_charger("other"))
        faults: list[bool] = []
        scene.charger.subscribe(
            lambda: faults.append(Fault.DUPLICATE_ADDRESS in scene.charger.faults)
        )
        scene.car.plug_in()
        await asyncio.sleep(60)
        assert Fault.DUPLICATE_ADDRESS in scene.charger.faults
        changes = sum(a != b for a, b in pairwise(faults))
        assert changes <= 1

    play(PolledScene(V2_17), acts)


def test_a_late_status_is_not_taken_for_settings() -> None:
    """In 2.17 both are nine words."""

    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(2)
        scene.charger.configuration_due = 0.0
        request = read_request(0, MAPS[V2_17].status.block)
        status = scene.box.controller.receive(request, now())
        assert status is not None
        write = scene.line.write

        def late(data: bytes, *, reply_may_equal: bool = False) -> float:
            end = write(data, reply_may_equal=reply_may_equal)
            if data[2:4] == b"\x00\xc0":
                asyncio.get_running_loop().call_at(
                    end + 0.003, scene.line.noise, status
                )
            return end

        scene.line.write = late  # type: ignore[method-assign]
        await scene.polled(2)
        scene.line.write = write  # type: ignore[method-assign]
        await scene.polled(2)
        assert scene.charger.configuration is not None
        assert scene.charger.configuration.settings[Setting.MINIMUM_CURRENT] == 6

    play(PolledScene(V2_17), acts)


def test_a_pause_while_a_later_box_wakes_its_car() -> None:
    """It goes on to B, and from there to C, whatever its access bit."""

    async def acts(scene: PolledScene) -> None:
        scene.car.plug_in(request=False)
        await scene.until(lambda: scene.box.state == "T", 90)
        pause = asyncio.create_task(
            scene.charger.change_orders(OrderChange(allowed=False))
        )
        await asyncio.sleep(1)
        scene.car.request()
        with suppress(NotConfirmedError):
            await pause
            assert scene.box.state in ("A", "B1", "C1")
        await asyncio.sleep(20)
        assert scene.box.state == "B1"
        assert scene.box.offers == 0

    play(PolledScene(HEAD), acts)


@each
def test_a_start_half_done_does_not_outlive_the_shutdown(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(4)
        start = asyncio.create_task(
            scene.charger.change_orders(OrderChange(allowed=True, current=12))
        )
        since = now()
        await scene.until(lambda: scene.currents(since))
        await asyncio.sleep(0.2)
        await scene.charger.on_shutdown()
        await scene.bus.stop()
        with suppress(EvseError):
            await start
        assert scene.accesses(since)[-1] == 0
        assert not scene.outlet.access

    play(PolledScene(dialect, stop_on_shutdown=True), acts)


@each
def test_a_pause_by_the_installation_limit_ends_with_it(dialect: Dialect) -> None:
    async def acts(scene: PolledScene) -> None:
        await scene.charge()
        await scene.polled(3)
        config = scene.charger.config
        scene.charger.reconfigure(replace(config, installation_limit=5.0))
        await scene.until(lambda: scene.box.offers == 0, 20)
        await scene.polled(2)
        scene.charger.reconfigure(config)
        await scene.until(lambda: scene.box.offers == 10, 40)
        # Access turned off at the box stays off.
        scene.box.controller.outlet.set_access(False)
        await scene.polled(3)
        assert not scene.outlet.access

    play(PolledScene(dialect), acts)
