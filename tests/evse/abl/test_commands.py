"""Commands: written once, verified, and temporary states ended again."""

import asyncio
from contextlib import suppress

import pytest

from custom_components.evse_bus.evse.errors import (
    EvseError,
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
    ReplyTimeoutError,
)
from custom_components.evse_bus.evse.model import Command, Fault, OrderChange
from tests.virtual import Car, Request

from .scene import (
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

# -- Outlet ----------------------------------------------------------------------------


async def test_outlet_off_and_on() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await charger.command(Command.SET_OUTLET, value=False)
        assert box.state == "E0"
        assert charger.reading is not None
        assert charger.reading.outlet_enabled is False
        assert charger.reading.connectors[1].plugged is None
        await charger.command(Command.SET_OUTLET, value=False)
        await charger.command(Command.SET_OUTLET, value=True)
        assert box.state != "E0"
        await charger.command(Command.SET_OUTLET, value=True)
        # Once each: a state that is reached already is not written again.
        assert scene.writes() == [E0, A1]
        assert charger.reading.outlet_enabled is True


async def test_an_outlet_is_enabled_with_the_limit_that_stands() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(8))
        await charger.command(Command.SET_OUTLET, value=False)
        await charger.change_orders(OrderChange(current=12))
        await charger.command(Command.SET_OUTLET, value=True)
        assert scene.writes() == [133, E0, A1, 200]


async def test_a_paused_outlet_is_enabled_and_stays_paused() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(8, allowed=False))
        await charger.command(Command.SET_OUTLET, value=False)
        await charger.command(Command.SET_OUTLET, value=True)
        assert scene.writes() == [PAUSE, E0, A1]
        assert box.ic_amps == 0


async def test_after_a_lost_reply_the_state_decides() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.stop_polls(charger)
        # The status, and the reply to the write.
        answers(box, "good", "good", "lose")
        await charger.command(Command.SET_OUTLET, value=False)
        assert box.state == "E0"
        assert scene.writes() == [E0]


async def test_a_lost_request_is_repeated() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.stop_polls(charger)
        answer = box._answer
        lost = []

        def lose_one(request: Request) -> bytes | None:
            if request.register != STATE or lost:
                return answer(request)
            lost.append(request)
            return None

        box._answer = lose_one  # type: ignore[method-assign]
        await charger.command(Command.SET_OUTLET, value=False)
        assert box.state == "E0"
        assert scene.writes() == [E0, E0]


async def test_an_outlet_that_does_not_follow() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        box.fail(2)
        await scene.polled(charger)
        with pytest.raises(NotAvailableError, match="F2"):
            await charger.command(Command.SET_OUTLET, value=True)
        with pytest.raises(EvseError, match="exception 4"):
            await charger.command(Command.SET_OUTLET, value=False)
        assert Fault.INTERNAL in charger.faults


async def test_an_outlet_that_confirms_and_does_not_follow() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        box._modify_state = lambda _value: True  # type: ignore[method-assign]
        with pytest.raises(NotConfirmedError, match="does not change to E0"):
            await charger.command(Command.SET_OUTLET, value=False)
        # The box has confirmed it: no repeat.
        assert scene.writes() == [E0]


@pytest.mark.parametrize("value", [None, 1, "on"])
async def test_an_outlet_accepts_only_on_and_off(value: object) -> None:
    async with Scene(box_with()) as scene:
        charger = await scene.settled(config(), orders())
        with pytest.raises(RefusedOrderError):
            await charger.command(Command.SET_OUTLET, value=value)  # type: ignore[arg-type]
        assert scene.writes() == []


# -- Waking a car ------------------------------------------------------------------------


async def test_a_car_is_woken() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        await scene.polled(charger)
        await charger.command(Command.WAKE)
        assert scene.writes() == [E0, A1]
        disabled, enabled = (one.t for one in scene.requests() if one.register == STATE)
        assert 3.0 <= enabled - disabled <= 3.5
        # Polls went on meanwhile: the command did not hold the bus.
        assert len(scene.reads(1)) > 20
        assert box.state != "E0"
        assert charger.pending_cleanup is None


async def test_only_a_car_that_may_charge_is_woken() -> None:
    car = sleepy()
    box = box_with(car)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        await charger.change_orders(OrderChange(allowed=False))
        with pytest.raises(NotAvailableError, match="paused"):
            await charger.command(Command.WAKE)
        await charger.change_orders(OrderChange(allowed=True))
        car.leave()
        await until(lambda: box.state == "A1")
        with pytest.raises(NotAvailableError, match="A1"):
            await charger.command(Command.WAKE)
        box.stop_locally()
        with pytest.raises(NotAvailableError, match="E0"):
            await charger.command(Command.WAKE)
        assert scene.writes(STATE) == []


async def test_a_stop_waits_until_the_outlet_is_enabled_again() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        await scene.polled(charger)
        waking = asyncio.create_task(charger.command(Command.WAKE))
        await until(lambda: E0 in scene.writes())
        await scene.bus.stop()
        await waking
        assert scene.writes() == [E0, A1]
        assert box.state != "E0"


async def test_after_a_lost_port_the_outlet_is_still_enabled_again() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        await scene.polled(charger)
        waking = asyncio.create_task(charger.command(Command.WAKE))
        await until(lambda: box.state == "E0")
        scene.virtual.unplug()
        with pytest.raises(EvseError):
            await waking
        scene.virtual.replug()
        await until(lambda: box.state not in ("E0", "A1"))
        assert scene.writes() == [E0, A1]


async def test_a_car_is_woken_though_replies_are_lost() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        await scene.stop_polls(charger)
        # The status, E0, the status (E0 was taken), the status again, A1.
        answers(box, "good", "good", "lose", *["good"] * 4, "lose")
        await charger.command(Command.WAKE)
        assert scene.writes() == [E0, A1]
        assert box.state != "E0"


@pytest.mark.parametrize("refusal", [None, b">0190046B\r\n"])
async def test_a_car_is_not_woken_by_a_box_that_stays_in_b2(
    refusal: bytes | None,
) -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        await scene.polled(charger)
        answer = box._answer

        def ignore(request: Request) -> bytes | None:
            return refusal if request.register == STATE else answer(request)

        box._answer = ignore  # type: ignore[method-assign]
        with pytest.raises(EvseError, match="exception 4" if refusal else "E0"):
            await charger.command(Command.WAKE)
        assert scene.writes() == [E0]
        assert charger.pending_cleanup is None


async def test_one_command_at_a_time() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        await scene.polled(charger)
        waking = asyncio.create_task(charger.command(Command.WAKE))
        await until(lambda: box.state == "E0")
        with pytest.raises(NotAvailableError, match="busy"):
            await charger.command(Command.RESET)
        # A pause goes between, and stands when the outlet is enabled again.
        await charger.change_orders(OrderChange(allowed=False))
        await waking
        assert scene.writes() == [E0, PAUSE, A1]
        assert box.ic_amps == 0


# -- Reset -------------------------------------------------------------------------------


async def test_a_reset_keeps_limit_and_identity() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10))
        await charger.command(Command.RESET)
        assert box.resets == 1
        assert scene.writes() == [166, RESET, 166]
        assert charger.misses == 0
        assert charger.reading is not None
        assert charger.reading.offered_current == 9.96


async def test_a_reset_starts_no_stopped_car() -> None:
    car = Car(ramp=0.0, reaction=0.0)
    car.plug_in()
    box = box_with(car)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10, allowed=False))
        await charger.command(Command.SET_OUTLET, value=False)
        await charger.command(Command.RESET)
        assert box.state == "E0"
        assert box.ic_amps == 0
        assert scene.writes() == [PAUSE, E0, RESET, PAUSE, E0]


async def test_a_reset_clears_a_failure() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        box.fail(3)
        await until(lambda: Fault.DC_RESIDUAL_CURRENT in charger.faults)
        await scene.stop_polls(charger)
        answers(box, "good", "good", "lose")
        # The reply is lost; the state shows that the reset happened.
        await charger.command(Command.RESET)
        assert box.resets == 1
        assert not charger.faults


async def test_a_reset_whose_reply_is_lost_is_not_repeated() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.stop_polls(charger)
        answers(box, "good", "good", "lose")
        with pytest.raises(NotConfirmedError, match="not repeated"):
            await charger.command(Command.RESET)
        assert box.resets == 1
        assert scene.writes() == [RESET]


async def test_a_command_for_a_sleeping_box() -> None:
    box = box_with(sleep_after=1.0, wake_time=0.1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.stop_polls(charger)
        await until(lambda: box.asleep)
        await charger.command(Command.RESET)
        assert box.resets == 1


async def test_a_command_for_a_dead_box() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.stop_polls(charger)
        box.faults.dead = True
        with pytest.raises((ReplyTimeoutError, NotConfirmedError)):
            await charger.command(Command.RESET)
        assert scene.writes() == []


async def test_a_reset_confirmed_late_says_nothing_of_the_line() -> None:
    box = box_with(sleepy())
    box.boot_time = 2.0
    box.reset_answer = "after"
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10))
        with suppress(NotConfirmedError):
            await charger.command(Command.RESET)
        assert box.resets == 1
        trip = scene.bus.wire.round_trip
        assert trip.timeout == scene.bus.wire.timing.reply_timeout
        assert trip.drain == 0
