"""Limits below the minimum: a pause where a car charges, no start where one waits."""

import asyncio

from hypothesis import example, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.model import Command, OrderChange, PauseReason

from .scene import EwsScene, play

ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)
START, PAUSE = 3, 6


def amperes(current: float) -> OrderChange:
    return OrderChange(current=current)


@pytest.mark.parametrize("low", [0.0, 5.0, 5.9])
def test_a_start_is_withheld_until_the_limit_is_high_enough(low: float) -> None:
    """In 0x30 a pause would unlock the plug: nothing is sent but the start, later."""

    async def acts(scene: EwsScene) -> None:
        charger = scene.charger()
        await charger.change_orders(amperes(low))
        await scene.plug()
        await charger.change_orders(ON)
        await asyncio.sleep(60)
        assert scene.status() == 0x30
        assert not scene.line.orders()
        assert 0 not in scene.line.limits()
        assert charger.orders.allowed is True
        assert charger.orders.limit.current == int(low)
        assert charger.waits_for_current
        assert charger.pause_reason is PauseReason.LIMIT_TOO_LOW
        # Still too low.
        await charger.change_orders(amperes(3.0))
        await asyncio.sleep(30)
        assert not scene.line.orders()
        await charger.change_orders(amperes(9.0))
        await scene.until(lambda: scene.status() == 0x40)
        assert scene.box.ports[0].limit == 9
        assert charger.pause_reason is None
        assert [one.parameters[1] for one in scene.line.orders()] == [START]

    play(EwsScene(), acts)


def test_a_withheld_start_ends_with_the_word_of_the_user() -> None:
    async def acts(scene: EwsScene) -> None:
        charger = scene.charger()
        await charger.change_orders(amperes(0.0))
        await scene.plug()
        await charger.change_orders(ON)
        await charger.change_orders(OFF)
        assert charger.pause_reason is PauseReason.NOT_ALLOWED
        await charger.change_orders(amperes(16.0))
        await asyncio.sleep(60)
        assert not scene.line.orders()

    play(EwsScene(), acts)


@pytest.mark.parametrize("command", [Command.STOP_AND_UNLOCK, Command.UNLOCK])
def test_a_withheld_start_ends_with_a_command_that_unlocks(command: Command) -> None:
    """The car stays in 0x30: a higher limit alone must not start it."""

    async def acts(scene: EwsScene) -> None:
        charger = scene.charger()
        await charger.change_orders(amperes(0.0))
        await scene.plug()
        if command is Command.UNLOCK:
            await charger.command(Command.LOCK)
        await charger.change_orders(ON)
        assert charger.waits_for_current
        await charger.command(command)
        await asyncio.sleep(5)
        assert scene.status() == 0x30
        assert not charger.waits_for_current
        await charger.change_orders(amperes(16.0))
        await asyncio.sleep(60)
        assert not scene.line.orders(START)

    play(EwsScene(), acts)


def test_a_withheld_start_ends_with_a_restart_too_short_to_be_seen() -> None:
    """Another car may be plugged in: the restart flag alone shows it."""

    async def acts(scene: EwsScene) -> None:
        charger = scene.charger()
        await charger.change_orders(amperes(0.0))
        await scene.plug()
        await charger.change_orders(ON)
        assert charger.waits_for_current
        scene.box.power_cycle(0.0)
        await asyncio.sleep(20)
        assert scene.status() == 0x30
        assert not charger.waits_for_current
        await charger.change_orders(amperes(16.0))
        await asyncio.sleep(60)
        assert not scene.line.orders()

    play(EwsScene(options={"init_time": 0.0}), acts)


@pytest.mark.parametrize("how", ["leaves", "line", "power"])
def test_a_withheld_start_is_for_the_car_that_waits(how: str) -> None:
    """The next car asks anew, and so does one that was out of sight."""

    async def acts(scene: EwsScene) -> None:
        charger = scene.charger()
        await charger.change_orders(amperes(0.0))
        await scene.plug()
        await charger.change_orders(ON)
        assert charger.waits_for_current
        if how == "leaves":
            scene.cars[0].leave()
            await scene.until(lambda: scene.status() == 0x00)
            await asyncio.sleep(5)
            await scene.plug()
        elif how == "line":
            statistics = scene.bus.line.statistics
            opened = statistics.opened
            scene.line.unplug()
            await scene.until(lambda: statistics.opened > opened)
            await asyncio.sleep(10)
        else:
            scene.box.power_cycle(2.0)
            await asyncio.sleep(10)
        await asyncio.sleep(20)
        assert scene.status() == 0x30
        assert not charger.waits_for_current
        await charger.change_orders(amperes(16.0))
        await asyncio.sleep(60)
        assert not scene.line.orders()
        assert charger.pause_reason is PauseReason.NOT_ALLOWED
        await charger.change_orders(ON)
        await scene.until(lambda: scene.status() == 0x40)

    play(EwsScene(), acts)


@pytest.mark.parametrize("again", [False, True])
def test_a_start_that_was_allowed_while_the_box_starts(again: bool) -> None:  # noqa: FBT001
    """The car that waits then is started, unless the box starts once more."""

    async def acts(scene: EwsScene) -> None:
        charger = scene.charger()
        await charger.change_orders(amperes(0.0))
        await scene.plug()
        scene.box.initialise()
        await charger.change_orders(ON)
        assert scene.status() == 0xF0
        assert charger.pause_reason is PauseReason.LIMIT_TOO_LOW
        await scene.until(lambda: scene.status() == 0x30)
        await asyncio.sleep(5)
        if again:
            scene.box.initialise()
            await asyncio.sleep(3)
            await scene.until(lambda: scene.status() == 0x30)
            await asyncio.sleep(5)
        assert charger.waits_for_current != again
        assert not scene.line.orders()
        await charger.change_orders(amperes(9.0))
        await asyncio.sleep(20)
        assert (scene.status() == 0x40) != again

    play(EwsScene(options={"init_time": 30.0}), acts)


def test_an_old_permission_starts_no_car_that_comes_later() -> None:
    """Allowed before there was a car, at 0 A: it is not asked for this one."""

    async def acts(scene: EwsScene) -> None:
        charger = scene.charger()
        await charger.change_orders(amperes(0.0))
        await charger.change_orders(ON)
        await scene.plug()
        await charger.change_orders(amperes(16.0))
        await asyncio.sleep(60)
        assert scene.status() == 0x30
        assert not scene.line.orders()

    play(EwsScene(), acts)


def test_what_was_allowed_below_the_minimum_goes_on_with_a_higher_limit() -> None:
    async def acts(scene: EwsScene) -> None:
        charger = scene.charger()
        await scene.charge()
        await charger.change_orders(OFF)
        await charger.change_orders(amperes(4.0))
        assert charger.pause_reason is PauseReason.NOT_ALLOWED
        await charger.change_orders(ON)
        assert charger.pause_reason is PauseReason.LIMIT_TOO_LOW
        await asyncio.sleep(30)
        assert len(scene.line.orders(PAUSE)) == 1
        await charger.change_orders(amperes(8.0))
        await scene.until(lambda: scene.status() == 0x40)
        assert not scene.unlocked()

    play(EwsScene(), acts)


CHANGES = st.lists(
    st.one_of(
        st.sampled_from([0.0, 3.0, 5.9, 6.0, 9.0, 16.0]).map(amperes),
        st.sampled_from([ON, OFF]),
    ),
    min_size=1,
    max_size=7,
)


@settings(max_examples=40)
@example(changes=[amperes(0.0), ON, amperes(16.0)], plugged=True, mode1=False)
@example(changes=[amperes(9.0), ON, OFF, amperes(16.0)], plugged=True, mode1=True)
@given(changes=CHANGES, plugged=st.booleans(), mode1=st.booleans())
def test_no_low_limit_starts_unlocks_or_takes_the_limit_away(
    *, changes: list[OrderChange], plugged: bool, mode1: bool
) -> None:
    """What is on the wire, whatever is ordered: the box is the oracle."""

    async def acts(scene: EwsScene) -> None:
        charger, port = scene.charger(), scene.box.ports[0]
        least = 16 if mode1 else 6
        if plugged:
            await scene.plug()
        allowed, limit = False, charger.orders.limit.current
        for change in changes:
            if change.allowed is not None:
                allowed = change.allowed and plugged
            if change.current is not None:
                limit = change.current
            await charger.change_orders(change)
            await asyncio.sleep(10)
            charges = allowed and limit >= least
            assert port.contactor == charges
            assert charger.orders.limit.current == int(limit)
        assert 0 not in scene.line.limits()
        assert not scene.unlocked()

    play(EwsScene(options={"mode1": (mode1, False)}), acts)
