"""Cleanup after a command: cut off by a lost port, or overtaken by another command."""

import asyncio

import pytest

from custom_components.evse_bus.evse.abl.charger import AblCharger
from custom_components.evse_bus.evse.errors import (
    EvseError,
    NotConfirmedError,
    WrongChargerError,
)
from custom_components.evse_bus.evse.model import Command, Fault, OrderChange
from tests.virtual import AblBox, Car, Request

from .scene import (
    FOREVER,
    LIMIT,
    STATE,
    Scene,
    answers,
    box_with,
    config,
    orders,
    sleepy,
    until,
)

RESET, A1, E0 = 0x5A5A, 0xA1A1, 0xE0E0
PAUSE = 1000


async def cut_off_wake(scene: Scene, box: AblBox) -> AblCharger:
    """Lose the port while a car is woken: the outlet is still disabled."""
    charger = await scene.settled(config(), orders())
    await until(lambda: box.state == "B2")
    await scene.polled(charger)
    waking = asyncio.create_task(charger.command(Command.WAKE))
    await until(lambda: box.state == "E0")
    scene.virtual.unplug()
    with pytest.raises(EvseError):
        await waking
    return charger


async def test_a_pause_ordered_meanwhile_is_written_before_enabling() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await cut_off_wake(scene, box)
        with pytest.raises(EvseError):
            await charger.change_orders(OrderChange(allowed=False))
        scene.virtual.replug()
        await until(lambda: charger.pending_cleanup is None)
        await scene.polled(charger)
        assert scene.writes() == [E0, PAUSE, A1]
        assert box.state != "E0"


async def test_an_outlet_disabled_by_the_user_meanwhile_stays_so() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await cut_off_wake(scene, box)
        disabling = asyncio.Event()

        def disable() -> None:
            if scene.bus.connected and not disabling.is_set():
                disabling.set()
                # The command must come before the first poll.
                charger.slot.ready += 0.3
                tasks.append(
                    asyncio.create_task(
                        charger.command(Command.SET_OUTLET, value=False)
                    )
                )

        tasks: list[asyncio.Task[None]] = []
        scene.bus.subscribe(disable)
        scene.virtual.replug()
        await disabling.wait()
        await tasks[0]
        await scene.polled(charger, 5)
        assert box.state == "E0"
        assert scene.writes() == [E0]


async def test_an_outlet_that_cannot_be_enabled_again_is_enabled_later() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        await scene.polled(charger)
        box.outlet.e0_a1_enabled = False
        with pytest.raises(NotConfirmedError, match="does not leave its state"):
            await charger.command(Command.WAKE)
        assert box.state == "E0"
        box.outlet.e0_a1_enabled = True
        await until(lambda: box.state != "E0")
        await until(lambda: charger.pending_cleanup is None)


async def reset_when_disabled(
    scene: Scene, box: AblBox, charger: AblCharger, command: Command, value: object
) -> None:
    """Lose the port as soon as the box, its outlet disabled, has been reset."""
    await charger.command(Command.SET_OUTLET, value=False)
    resets = box.resets
    resetting = asyncio.create_task(charger.command(command, value))  # type: ignore[arg-type]
    await until(lambda: box.resets > resets)
    scene.virtual.unplug()
    with pytest.raises(EvseError):
        await resetting
    scene.virtual.replug()


@pytest.mark.parametrize(
    ("command", "value"),
    [(Command.RESET, None), (Command.SET_UPSTREAM_TIMEOUT, True)],
)
async def test_an_outlet_is_disabled_again_after_a_reset_that_was_cut_off(
    command: Command,
    value: bool | None,  # noqa: FBT001
) -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10, allowed=False))
        await reset_when_disabled(scene, box, charger, command, value)
        await until(lambda: box.state == "E0")
        await until(lambda: charger.pending_cleanup is None)
        await until(lambda: box.ic_amps == 0)


async def test_a_reset_starts_no_car_at_a_disabled_outlet() -> None:
    car = Car(ramp=0.0, reaction=0.0)
    car.plug_in()
    box = box_with(car)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10))
        await reset_when_disabled(scene, box, charger, Command.RESET, None)
        await until(lambda: box.state == "E0")
        assert scene.writes(STATE) == [E0, RESET, E0]


async def test_an_outlet_is_disabled_again_though_the_limit_is_refused_after_a_reset() -> (
    None
):
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10))
        await charger.command(Command.SET_OUTLET, value=False)
        answer = box._answer

        def refuse(request: Request) -> bytes | None:
            if request.register == LIMIT and request.value is not None:
                return b">0190046B\r\n"
            return answer(request)

        box._answer = refuse  # type: ignore[method-assign]
        with pytest.raises(EvseError):
            await charger.command(Command.RESET)
        await until(lambda: box.state == "E0")


async def test_an_outlet_enabled_by_the_user_after_a_reset_stays_so() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10))
        await reset_when_disabled(scene, box, charger, Command.RESET, None)
        await until(lambda: charger.pending_cleanup is None and charger.available)
        await charger.command(Command.SET_OUTLET, value=True)
        await scene.polled(charger, 5)
        assert box.state == "A1"


async def test_a_box_that_stays_in_set_up_mode_is_led_out_of_it() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10))
        answer = box._answer

        def deaf_to_resets(request: Request) -> bytes | None:
            if request.value == RESET:
                return None
            return answer(request)

        box._answer = deaf_to_resets  # type: ignore[method-assign]
        with pytest.raises(EvseError):
            await charger.command(Command.SET_UPSTREAM_TIMEOUT, value=True)
        await until(lambda: box.state == "A1")
        assert scene.writes(STATE)[-1] == A1


async def swapped(box: AblBox, charger: AblCharger) -> None:
    """Have a box that is being woken replaced by another, after a missed reply."""
    await until(lambda: box.state == "E0")
    if charger.slot.ready > FOREVER:
        # The read at the end of the rest is the one that is missed, and its repeat.
        answers(box, "good", "lose", "lose")
    else:
        box.faults.dead = True
        await until(lambda: charger.misses > 0)
        box.faults.dead = False
    box.serial = "2W22xy99999999"


@pytest.mark.parametrize("polls", [True, False])
async def test_a_box_swapped_in_a_rest_gets_no_write(
    polls: bool,  # noqa: FBT001
) -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(serial=box.serial), orders())
        await until(lambda: box.state == "B2")
        await scene.polled(charger)
        if not polls:
            await scene.stop_polls(charger)
        waking = asyncio.create_task(charger.command(Command.WAKE))
        await swapped(box, charger)
        with pytest.raises(WrongChargerError):
            await waking
        await asyncio.sleep(5)
        # The first box had E0; the other one is left as it is.
        assert scene.writes() == [E0]
        assert Fault.WRONG_CHARGER in charger.faults
        box.serial = "2W22xy01234567"
        charger.slot.ready = 0
        scene.bus.reschedule()
        await until(lambda: box.state != "E0", 60)
