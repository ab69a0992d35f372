"""Commands: said once, verified, and what they change on the way changed back."""

import asyncio

import pytest

from custom_components.evse_bus.evse.abl.dialogue import Dialogue, Pauses
from custom_components.evse_bus.evse.model import (
    Command,
    DuplicateAddressError,
    EvseError,
    Fault,
    NotAvailableError,
    NotConfirmedError,
    OrderChange,
    RefusedOrderError,
    ReplyTimeoutError,
)
from tests.virtual import AblBox, Car, Request

from .scene import LIMIT, SETUP, STATE, Scene, config, orders, until

RESET, A1, E0, E2 = 0x5A5A, 0xA1A1, 0xE0E0, 0xE2E2
PAUSE = 1000


REAL = Dialogue.pauses
SHORT = Pauses(wake=0.3, setup=0.03, boot=0.08, retry=0.2, verify=0.05)


@pytest.fixture(autouse=True)
def short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the virtual car wake, and the virtual box start, sooner than real ones."""
    monkeypatch.setattr(Dialogue, "pauses", SHORT)


def sleepy() -> Car:
    """Return a car that is plugged in, may charge, and takes nothing."""
    car = Car(ramp=0.1, reaction=0.0)
    car.plug_in(request=False)
    return car


def box_with(car: Car | None = None, **settings: object) -> AblBox:
    return AblBox(1, car=car, boot_time=0.05, **settings)  # type: ignore[arg-type]


def answers(box: AblBox, *fates: str | bytes) -> None:
    """Say what becomes of the next answers: good, lose, or other bytes instead."""
    for fate in fates:
        if fate == "good":
            box.faults.once("noise", b"")
        elif isinstance(fate, bytes):
            box.faults.once("replace", fate)
        else:
            box.faults.once("lose")


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
        # Said once each: what is so already is not said again.
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


async def test_a_lost_answer_is_settled_by_the_state() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.quiet(charger)
        # The look before, and the answer to the write.
        answers(box, "good", "lose")
        await charger.command(Command.SET_OUTLET, value=False)
        assert box.state == "E0"
        assert scene.writes() == [E0]


async def test_a_lost_request_is_said_again() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.quiet(charger)
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


@pytest.mark.parametrize("value", [None, 1, "on"])
async def test_an_outlet_is_on_or_off(value: object) -> None:
    async with Scene(box_with()) as scene:
        charger = await scene.settled(config(), orders())
        with pytest.raises(RefusedOrderError):
            await charger.command(Command.SET_OUTLET, value=value)  # type: ignore[arg-type]
        assert scene.writes() == []


# -- Waking a car ------------------------------------------------------------------------


async def test_a_car_is_woken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Dialogue, "pauses", REAL)
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        await scene.polled(charger)
        await charger.command(Command.WAKE)
        assert scene.writes() == [E0, A1]
        times = [one.t for one in scene.requests() if one.register == STATE]
        assert 3.0 <= times[1] - times[0] <= 3.5
        # The others were heard meanwhile: it did not hold the bus.
        assert len(scene.reads(1)) > 20
        assert box.state != "E0"
        assert charger.owes is None


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


async def test_a_lost_port_delays_the_end_and_does_not_forget_it() -> None:
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


async def test_waking_ends_well_though_answers_are_lost() -> None:
    box = box_with(sleepy())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await until(lambda: box.state == "B2")
        await scene.quiet(charger)
        # The look before, E0, the state: it was taken; the state again, A1.
        answers(box, "good", "lose", "good", "good", "lose")
        await charger.command(Command.WAKE)
        assert scene.writes() == [E0, A1]
        assert box.state != "E0"


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
        await scene.quiet(charger)
        answers(box, "good", "lose")
        # The answer is lost, the state says that it happened.
        await charger.command(Command.RESET)
        assert box.resets == 1
        assert not charger.faults


async def test_a_reset_whose_answer_is_lost_is_not_repeated() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.quiet(charger)
        answers(box, "good", "lose")
        with pytest.raises(NotConfirmedError, match="not repeated"):
            await charger.command(Command.RESET)
        assert box.resets == 1
        assert scene.writes() == [RESET]


async def test_a_command_for_a_sleeping_box() -> None:
    box = box_with(sleep_after=1.0, wake_time=0.1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.quiet(charger)
        await until(lambda: box.asleep)
        await charger.command(Command.RESET)
        assert box.resets == 1


async def test_a_command_for_a_dead_box() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.quiet(charger)
        box.faults.dead = True
        with pytest.raises((ReplyTimeoutError, NotConfirmedError)):
            await charger.command(Command.RESET)
        assert scene.writes() == []


# -- Set-up ------------------------------------------------------------------------------


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


async def test_a_device_id_that_is_taken() -> None:
    stranger = AblBox(3, serial="2W22xy00000003", sleep_after=5, wake_time=0.1)
    async with Scene(box_with(), AblBox(2, serial="2W22xy00000002"), stranger) as scene:
        charger = await scene.settled(config(), orders())
        scene.add(config(2), orders())
        for address in (2, 3):
            with pytest.raises(DuplicateAddressError, match=str(address)):
                await charger.command(Command.SET_ADDRESS, address)
        assert scene.writes() == []
        assert charger.config.address == 1


@pytest.mark.parametrize("value", [0, 17, True, None, 2.0])
async def test_no_device_id(value: object) -> None:
    async with Scene(box_with()) as scene:
        charger = await scene.settled(config(), orders())
        with pytest.raises(RefusedOrderError):
            await charger.command(Command.SET_ADDRESS, value=value)  # type: ignore[arg-type]
        await charger.command(Command.SET_ADDRESS, 1)
        assert scene.writes() == []


async def test_no_set_up_with_a_car_or_without_a_serial_number() -> None:
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


async def test_a_refused_set_up_leaves_the_set_up_mode() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.quiet(charger)
        # The look before, E2, the state, and the set-up.
        answers(box, "good", "good", "good", b">0190046B\r\n")
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


async def test_a_setting_that_does_not_last() -> None:
    box = box_with()
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        # Somebody else's set-up goes into the box in place of ours.
        box._configure = lambda _value: True  # type: ignore[method-assign]
        with pytest.raises(NotConfirmedError, match="upstream_timeout"):
            await charger.command(Command.SET_UPSTREAM_TIMEOUT, value=True)
        assert box.state == "A1"


async def test_nothing_is_ever_said_to_all() -> None:
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
        await until(lambda: charger.owes is None)
        assert charger.config.address == box.device_id
