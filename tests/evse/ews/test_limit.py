"""The limit: never above the least of all, and believed when it is read back."""

import asyncio
from dataclasses import replace
from zoneinfo import ZoneInfo

import pytest

from custom_components.evse_bus.evse.errors import (
    NotConfirmedError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.ews.wire.answers import EwsRefusedError
from custom_components.evse_bus.evse.model import (
    Command,
    Fault,
    OrderChange,
)
from tests.virtual.ews_box import EwsBox as VirtualBox
from tests.virtual.ews_commands import COMMANDS

from .scene import EwsScene, now, play, simulate

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)


def amperes(current: float) -> OrderChange:
    return OrderChange(current=current)


@pytest.mark.parametrize(
    ("options", "installation", "highest"),
    [
        ({"jumper": 32}, 63.0, 32),
        ({"jumper": 32, "max_current": 20}, 63.0, 20),
        ({"jumper": 13}, 63.0, 13),
        ({"jumper": 32}, 25.0, 25),
        ({"jumper": 63}, 40.5, 40),
    ],
)
def test_no_limit_is_above_the_least_of_all(
    options: dict[str, object], installation: float, highest: int
) -> None:
    async def acts(scene: EwsScene) -> None:
        assert scene.line.limits()[-1] == highest
        assert max(scene.line.limits()) <= highest

    play(
        EwsScene(current=installation, installation=installation, options=options), acts
    )


def test_a_cable_weaker_than_the_limit() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.ports[0].cable = 13
        assert scene.box.ports[0].limit == 32
        await scene.charge()
        await scene.until(lambda: scene.box.ports[0].limit == 13)
        with pytest.raises(RefusedOrderError):
            await scene.charger().change_orders(amperes(40.0))
        await scene.charger().change_orders(amperes(20.0))
        assert scene.box.ports[0].limit == 13
        assert all(one.accepted for one in scene.box.currents_set)
        # The next cable is a better one.
        await scene.charger().command(Command.STOP_AND_UNLOCK)
        scene.cars[0].leave()
        await scene.until(lambda: scene.box.ports[0].limit == 20)

    play(EwsScene(current=32.0), acts)


def test_a_limit_of_port_2_of_its_own() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.extra.max_current_2 = 10
        scene.box.take_parameters()
        scene.charger().box.parameters_due = 0.0
        await scene.until(lambda: scene.box.ports[1].limit == 10)
        assert scene.box.ports[0].limit == 16

    play(EwsScene(), acts)


def test_a_limit_is_believed_when_it_is_read_back() -> None:
    async def acts(scene: EwsScene) -> None:
        scene.box.ignores_limits = True
        with pytest.raises(NotConfirmedError):
            await scene.charger().change_orders(amperes(10.0))
        assert Fault.LIMIT_NOT_TAKEN in scene.charger().faults
        scene.box.ignores_limits = False
        await scene.until(lambda: scene.box.ports[0].limit == 10)
        await asyncio.sleep(5)
        assert not scene.charger().faults

    play(EwsScene(), acts)


def test_a_limit_that_is_never_followed_is_not_sent_all_the_time() -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        await asyncio.sleep(100)
        assert Fault.LIMIT_NOT_TAKEN in scene.charger().faults
        assert len(scene.line.limits(1, since=begin)) <= 30

    async def run() -> None:
        scene = EwsScene(ports=(1,))
        scene.box.ignores_limits = True
        async with scene:
            await scene.until(lambda: scene.charger().reading is not None)
            await acts(scene)

    simulate(run())


def test_a_box_that_takes_less_is_left_in_peace() -> None:
    async def acts(scene: EwsScene) -> None:
        begin = now()
        await asyncio.sleep(60)
        assert not scene.line.limits(1, since=begin)
        assert scene.box.ports[0].limit == 20
        assert not scene.charger().faults

    async def run() -> None:
        scene = EwsScene(current=32.0, ports=(1,))
        scene.box.clamps_limits = True
        # An unreported limit keeps the box at 20 A.
        scene.box.ports[0].installation.limit = 20
        async with scene:
            await scene.until(lambda: scene.box.ports[0].limit)
            await asyncio.sleep(5)
            await acts(scene)

    simulate(run())


def test_a_refused_limit_leaves_no_open_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """The box has no limit, and refuses ours: then the lowest there is."""
    takes = COMMANDS["st"]

    def picky(box: VirtualBox, parameters: bytes) -> bytes:
        return b"\1" if parameters[1] > 16 else takes(box, parameters)

    monkeypatch.setitem(COMMANDS, "st", picky)

    async def run() -> None:
        scene = EwsScene(current=20.0, ports=(1,))
        async with scene:
            await scene.until(lambda: scene.box.ports[0].limit == 6)
            assert Fault.LIMIT_NOT_TAKEN in scene.charger().faults
            with pytest.raises(EwsRefusedError):
                await scene.charger().change_orders(amperes(30.0))
            await scene.charger().change_orders(amperes(16.0))
            assert scene.box.ports[0].limit == 16
            await asyncio.sleep(3)
            assert not scene.charger().faults

    simulate(run())


def test_a_box_with_a_lower_maximum_than_it_reports() -> None:
    """It refuses, and offers less than that anyhow."""

    async def run() -> None:
        scene = EwsScene(current=32.0, ports=(1,))
        scene.box.ports[0].installation.limit = 20
        async with scene:
            await scene.until(scene.line.limits)
            await asyncio.sleep(60)
            assert len(scene.line.limits()) == 1
            assert not scene.charger().faults
            with pytest.raises(EwsRefusedError):
                await scene.charger().change_orders(amperes(30.0))
            await scene.charger().change_orders(amperes(18.0))
            assert scene.box.ports[0].limit == 18

    simulate(run())


@pytest.mark.parametrize("current", [10, 20])
@pytest.mark.parametrize("received", [True, False])
@pytest.mark.parametrize("name", ["st", "rd", "rc"])
def test_a_limit_with_a_lost_answer(name: str, current: int, *, received: bool) -> None:
    """A lower one that is read back then is the one before."""

    async def acts(scene: EwsScene) -> None:
        left = 1

        def lose(command: str) -> bool:
            nonlocal left
            if command != name or not left:
                return False
            left -= 1
            return True

        if received:
            scene.line.mute = lose
        else:
            scene.line.deaf = lose
        await scene.charger().change_orders(amperes(current))
        assert scene.box.ports[0].limit == current

    play(EwsScene(), acts)


def test_a_limit_that_is_switched_off_is_sent_again() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        scene.box.ports[0].limit = 0
        took = await scene.until(lambda: scene.box.ports[0].limit == 16)
        assert took < 3
        await asyncio.sleep(2)
        assert scene.charger().statistics.reasserted == 1

    play(EwsScene(), acts)


def test_a_restart_is_noticed_and_the_limit_is_back() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charger().command(Command.RESET)
        await scene.until(lambda: scene.box.restarts == 1)
        took = await scene.until(
            lambda: scene.box.ports[0].limit == scene.box.ports[1].limit == 16
        )
        assert took < 5
        await asyncio.sleep(12)
        assert scene.charger().box.restarts == 2

    play(EwsScene(), acts)


def test_expired_orders_fall_back_and_start_nothing() -> None:
    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        await scene.until(lambda: scene.box.ports[0].limit == 8, 80)
        await scene.charger().change_orders(amperes(16.0))
        assert scene.box.ports[0].limit == 16

    play(EwsScene(lifetime=60.0, fail_safe=8.0), acts)


def test_a_lower_installation_limit_is_sent_at_once_after_a_failure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Something else that failed just now, such as a clock that cannot be set."""
    monkeypatch.setitem(COMMANDS, "sc", lambda _box, _parameters: b"\1")

    async def acts(scene: EwsScene) -> None:
        await scene.charge()
        port = scene.charger()
        config = port.config
        port.reconfigure(replace(config, time_zone=ZoneInfo("Asia/Tokyo")))
        await scene.until(lambda: "sc" in [one.name for one in scene.line.sent])
        await asyncio.sleep(2)
        said_at = now()
        port.reconfigure(replace(port.config, installation_limit=8.0))
        await scene.until(lambda: scene.box.ports[0].limit == 8)
        assert now() - said_at < 4

    play(EwsScene(), acts)
