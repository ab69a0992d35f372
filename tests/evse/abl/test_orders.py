"""Orders and a box: writes that reach the wire, and writes that must not."""

import asyncio
from contextlib import suppress

from hypothesis import HealthCheck, given, settings, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import (
    EvseError,
    ExchangeRefusedError,
    LineLostError,
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
    ReplyTimeoutError,
)
from custom_components.evse_bus.evse.model import (
    Fault,
    OrderChange,
    OrderState,
    PauseReason,
    Status,
)
from tests.simulated_time import simulate
from tests.virtual import AblBox, Car, Request

from .scene import LIMIT, SERIAL, Scene, config, orders, until

PAUSE = 1000
ON = OrderChange(allowed=True)
OFF = OrderChange(allowed=False)


def limit(current: float) -> OrderChange:
    return OrderChange(current=current)


def plugged() -> Car:
    car = Car(ramp=0.1, reaction=0.0)
    car.plug_in()
    return car


async def test_a_limit_goes_down_and_up() -> None:
    async with Scene(AblBox(1, car=plugged())) as scene:
        charger = await scene.settled(config(), orders())
        await charger.change_orders(limit(10))
        assert scene.boxes[0].ic_amps == pytest.approx(9.96)
        assert charger.reading is not None
        assert charger.reading.offered_current == 9.96
        await charger.change_orders(limit(16))
        assert scene.writes(LIMIT) == [166, 266]
        assert charger.orders.limit.current == 16


async def test_a_limit_that_stands_is_not_written_again() -> None:
    async with Scene(AblBox(1)) as scene:
        charger = await scene.settled(config(), orders())
        await charger.change_orders(limit(10))
        await charger.change_orders(limit(10))
        assert scene.writes() == [166]


async def test_a_pause_keeps_plug_detection_and_ends_by_the_switch() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(allowed=True))
        await until(lambda: box.state == "C2")
        await charger.change_orders(OFF)
        await until(lambda: box.state == "B2")
        await scene.polled(charger)
        assert charger.reading is not None
        assert charger.reading.allowed is False
        assert charger.reading.offered_current == 0
        # The cable is still detected.
        connector = charger.reading.connectors[1]
        assert (connector.plugged, connector.status) == (True, Status.SUSPENDED_EVSE)
        await charger.change_orders(ON)
        assert scene.writes() == [PAUSE, 266]
        await until(lambda: box.state == "C2")


async def test_a_limit_changed_while_paused_is_only_stored() -> None:
    async with Scene(AblBox(1, car=plugged())) as scene:
        charger = await scene.settled(config(), orders(allowed=False))
        await until(lambda: scene.writes() == [PAUSE])
        await charger.change_orders(limit(8))
        await charger.change_orders(limit(13))
        await scene.polled(charger)
        assert scene.writes() == [PAUSE]
        assert charger.orders.limit.current == 13
        assert charger.orders.allowed is False
        await charger.change_orders(ON)
        assert scene.writes() == [PAUSE, 216]


@pytest.mark.parametrize("allowed", [None, True])
async def test_a_limit_does_not_end_a_pause_by_others(
    allowed: bool | None,  # noqa: FBT001
) -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(allowed=allowed))
        box.set_by_other_master(0)
        await scene.polled(charger)
        assert charger.reading is not None
        assert charger.reading.allowed is False
        await charger.change_orders(limit(8))
        await charger.change_orders(limit(10))
        await scene.polled(charger)
        assert scene.writes() == []
        assert charger.orders.limit.current == 10
        await charger.change_orders(ON)
        assert scene.writes() == [166]


async def test_a_limit_in_e0_is_only_lowered() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10))
        box.stop_locally()
        await scene.polled(charger)
        await charger.change_orders(limit(16))
        assert scene.writes() == [166]
        assert charger.orders.limit.current == 16
        await charger.change_orders(limit(8))
        assert scene.writes() == [166, 133]
        with pytest.raises(NotAvailableError, match="enable it first"):
            await charger.change_orders(ON)
        assert charger.orders.allowed is None
        assert box.state == "E0"
        assert scene.writes() == [166, 133]


async def test_nothing_is_written_in_set_up_mode() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        box.outlet.go("E2")
        await scene.polled(charger)
        with pytest.raises(NotAvailableError, match="set-up mode"):
            await charger.change_orders(limit(10))
        await scene.polled(charger)
        assert scene.writes() == []
        # The lowering stands, and is sent as soon as possible.
        box.outlet.go("A1")
        await until(lambda: scene.writes() == [166])


async def test_after_a_power_cycle_the_limit_is_reasserted_at_once() -> None:
    box = AblBox(1, boot_time=0.1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(poll_interval=0.2), orders(10))
        assert charger.statistics.reasserted == 0
        box.power_cycle()
        assert box.ic_amps > 15
        await until(lambda: scene.writes() == [166, 166])
        await scene.polled(charger)
        assert charger.statistics.reasserted == 1
        assert Fault.LIMIT_NOT_TAKEN not in charger.faults
        # No other exchange between the status above the limit and the write.
        registers = [one.register for one in scene.requests() if one.device_id == 1]
        second = len(registers) - 1 - registers[::-1].index(LIMIT)
        assert registers[second - 1 : second + 3] == [0x0F, LIMIT, 0x2E, 0x2E]


async def test_after_a_power_cycle_a_pause_is_reasserted_too() -> None:
    box = AblBox(1, car=plugged(), boot_time=0.1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(allowed=False))
        box.power_cycle()
        await until(lambda: scene.writes() == [PAUSE, PAUSE])
        await scene.polled(charger)
        assert charger.statistics.reasserted == 1
        assert box.ic_amps == 0


async def test_permission_is_never_given_without_the_user() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(allowed=True))
        box.set_by_other_master(0)
        await scene.polled(charger, 5)
        box.set_by_other_master(8)
        await scene.polled(charger, 5)
        # Neither a pause nor a lower limit set by others is undone.
        assert scene.writes() == []
        assert charger.orders.allowed is True


async def test_a_lower_ic_is_reported_and_accepted() -> None:
    async with Scene(AblBox(1, cable_current=13, car=plugged())) as scene:
        charger = await scene.settled(config(), orders(16))
        assert charger.reading is not None
        assert charger.reading.offered_current == pytest.approx(12.96)
        await charger.change_orders(limit(14))
        assert charger.orders.limit.current == 14
        assert Fault.LIMIT_NOT_TAKEN not in charger.faults


async def test_a_box_that_does_not_follow() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        box.outlet.ignore_limit = True
        with pytest.raises(NotConfirmedError):
            await charger.change_orders(limit(10))
        assert Fault.LIMIT_NOT_TAKEN in charger.faults
        assert charger.statistics.reasserted >= 1
        # The lowering stands all the same.
        assert charger.orders.limit.current == 10
        box.outlet.ignore_limit = False
        await until(lambda: box.ic_amps < 10)
        await until(lambda: Fault.LIMIT_NOT_TAKEN not in charger.faults)
        assert charger.available


async def test_a_lowered_limit_is_not_overtaken_by_the_write_under_way() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10))
        await scene.stop_polls(charger)
        box.outlet.ignore_limit = True
        raising = asyncio.create_task(charger.change_orders(limit(16)))
        await until(lambda: 266 in scene.writes(LIMIT))
        written = len(scene.writes(LIMIT))
        # A reply is missed: the box is identified before the next write.
        charger.on_missed(charger.slot.ready, "no reply")
        answer = box._answer
        lowering: list[asyncio.Task[None]] = []

        def lower(request: Request) -> bytes | None:
            if request.register == SERIAL and not lowering:
                lowering.append(asyncio.create_task(charger.change_orders(limit(6))))
            return answer(request)

        box._answer = lower  # type: ignore[method-assign]
        await until(lambda: lowering)
        box.outlet.ignore_limit = False
        await asyncio.gather(raising, *lowering, return_exceptions=True)
        assert charger.orders.limit.current == 6
        assert set(scene.writes(LIMIT)[written:]) == {100}


async def test_a_box_that_does_not_follow_the_permission() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(allowed=False))
        box.outlet.ignore_limit = True
        with pytest.raises(NotConfirmedError):
            await charger.change_orders(ON)
        # A raise that was not confirmed does not stand.
        assert charger.orders.allowed is False


async def test_a_box_that_refuses() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.stop_polls(charger)
        answer = box._answer

        def refuse(request: Request) -> bytes | None:
            return b">0190046B\r\n" if request.value == PAUSE else answer(request)

        box._answer = refuse  # type: ignore[method-assign]
        with pytest.raises(ExchangeRefusedError, match="exception 4") as caught:
            await charger.change_orders(OFF)
        assert caught.value.code == 4
        assert charger.statistics.refused == 1
        assert Fault.LIMIT_NOT_TAKEN in charger.faults
        assert scene.writes() == [PAUSE] * 3
        # The pause stands, and is written again.
        box._answer = answer  # type: ignore[method-assign]
        scene.resume_polls(charger)
        await until(lambda: Fault.LIMIT_NOT_TAKEN not in charger.faults, 20)
        assert box.ic_amps == 0


async def test_a_pause_refused_once_is_repeated() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.stop_polls(charger)
        box.faults.once("replace", b">0190046B\r\n")
        await charger.change_orders(OFF)
        assert scene.writes()[0] == PAUSE
        assert charger.order_state is OrderState.CONFIRMED


async def test_after_lost_and_late_replies_a_pause_is_repeated() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        await scene.stop_polls(charger)
        late = scene.bus.wire.statistics.late
        box.faults.once("lose")
        # It comes in the pause before the next attempt: too late to count.
        box.faults.once("late", 0.45)
        await charger.change_orders(OFF)
        assert box.ic_amps == 0
        assert scene.writes() == [PAUSE] * 3
        assert charger.orders.allowed is False
        assert scene.bus.wire.statistics.late == late + 1


async def test_a_command_to_a_dead_box_fails() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders())
        box.faults.dead = True
        with pytest.raises(ReplyTimeoutError):
            await charger.change_orders(limit(8))
        assert charger.orders.limit.current == 8
        box.faults.clear()
        await until(lambda: box.ic_amps < 8)


async def test_a_pause_is_never_merged_away() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(allowed=True))
        results = await asyncio.gather(
            *(
                charger.change_orders(change)
                for change in (limit(8), limit(9), ON, limit(10), OFF, limit(11))
            ),
            return_exceptions=True,
        )
        assert not isinstance(results[4], BaseException)
        assert scene.writes()[0] == PAUSE
        assert set(scene.writes()) == {PAUSE}
        assert charger.orders.limit == limit(11).apply(orders()).limit
        assert charger.orders.allowed is False


async def test_a_pause_during_a_start() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(allowed=False))
        box.outlet.ignore_limit = True
        on = asyncio.create_task(charger.change_orders(ON))
        await until(lambda: 266 in scene.writes())
        box.outlet.ignore_limit = False
        await charger.change_orders(OFF)
        with suppress(EvseError):
            await on
        await scene.polled(charger)
        assert box.ic_amps == 0
        assert charger.orders.allowed is False


async def test_a_limit_of_0_a_pauses_and_another_limit_ends_it() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(allowed=True))
        await charger.change_orders(limit(0))
        assert box.ic_amps == 0
        await charger.change_orders(limit(10))
        assert scene.writes() == [PAUSE, 166]
        # A pause by the switch is not ended, though.
        await charger.change_orders(OFF)
        await charger.change_orders(limit(0))
        await charger.change_orders(limit(10))
        assert scene.writes() == [PAUSE, 166, PAUSE]


async def test_a_limit_below_the_minimum_is_kept_and_pauses() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(allowed=True))
        await until(lambda: box.state == "C2")
        await charger.change_orders(limit(5.9))
        assert charger.orders.limit.current == 5.9
        assert charger.orders.allowed is True
        assert scene.writes() == [PAUSE]
        assert charger.pause_reason is PauseReason.LIMIT_TOO_LOW
        # Allowed once more, it still waits for a limit that is high enough.
        await charger.change_orders(ON)
        await charger.change_orders(limit(3))
        assert set(scene.writes()) == {PAUSE}
        await charger.change_orders(limit(6))
        assert scene.writes()[-1] == 100
        assert charger.pause_reason is None


async def test_what_was_allowed_below_the_minimum_starts_with_a_higher_limit() -> None:
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(allowed=True))
        await charger.change_orders(OFF)
        await charger.change_orders(limit(0))
        assert charger.pause_reason is PauseReason.NOT_ALLOWED
        await charger.change_orders(ON)
        assert charger.pause_reason is PauseReason.LIMIT_TOO_LOW
        assert set(scene.writes()) == {PAUSE}
        await charger.change_orders(limit(10))
        assert scene.writes()[-1] == 166


async def test_a_limit_below_the_minimum_does_not_claim_the_pause_of_another() -> None:
    """Paused elsewhere: neither the low limit nor the next one is a reason to start."""
    box = AblBox(1, car=plugged())
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(allowed=True))
        await until(lambda: box.state == "C2")
        box.set_by_other_master(0)
        await scene.polled(charger)
        for current in (3, 10, 0, 16):
            await charger.change_orders(limit(current))
        await scene.polled(charger)
        assert box.ic_amps == 0
        assert 166 not in scene.writes()
        assert charger.pause_reason is PauseReason.NOT_ALLOWED
        await charger.change_orders(ON)
        assert scene.writes()[-1] == 266


async def test_invalid_limits_are_refused() -> None:
    async with Scene(AblBox(1)) as scene:
        charger = await scene.settled(config(), orders(10))
        for current in (float("nan"), float("inf"), -1, 10000, 17):
            with pytest.raises(RefusedOrderError):
                await charger.change_orders(limit(current))
        assert scene.writes() == [166]
        assert charger.orders.limit.current == 10


async def test_a_lost_port_and_back() -> None:
    box = AblBox(1)
    async with Scene(box) as scene:
        charger = await scene.settled(config(), orders(10))
        scene.virtual.unplug()
        await until(lambda: not charger.available)
        box.power_cycle()
        with pytest.raises(LineLostError):
            await charger.change_orders(limit(8))
        scene.virtual.replug()
        await until(lambda: box.ic_amps < 8)
        assert scene.writes() == [166, 133]


# -- Any sequence ----------------------------------------------------------------------

_changes = st.lists(
    st.one_of(
        st.sampled_from([0.0, 3.0, 5.9, 6.0, 7.3, 10.0, 15.9, 16.0]).map(limit),
        st.just(OFF),
        st.just(ON),
    ),
    min_size=1,
    max_size=6,
)


@settings(
    max_examples=8, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)
@given(_changes)
def test_no_sequence_of_changes_starts_a_car_stopped_by_the_switch(
    changes: list[OrderChange],
) -> None:
    async def scene_of() -> None:
        box = AblBox(1, car=plugged(), turn_round=0.0005)
        async with Scene(box) as scene:
            charger = scene.add(config(installation_limit=12), orders(6))
            await until(lambda: charger.available and scene.writes())
            allowed: bool | None = None
            for change in changes:
                before = len(scene.writes())
                with suppress(RefusedOrderError):
                    await charger.change_orders(change)
                if change.allowed is not None:
                    allowed = change.allowed
                new = scene.writes()[before:]
                assert all(duty == PAUSE or duty <= 200 for duty in new)
                if allowed is False:
                    assert set(new) <= {PAUSE}
                    assert box.ic_amps == 0
                assert charger.orders.allowed is allowed

    simulate(scene_of())
