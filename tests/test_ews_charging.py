"""An EWS-Box is paused and goes on: one order 6, and the cable stays locked."""

import asyncio

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError
import pytest

from tests.common import (
    call,
    entity_id,
    get_entity,
    running,
    state_of,
    wait_for_state,
)
from tests.ews import (
    PAUSE,
    START,
    charge,
    limits,
    orders,
    plug_in,
    polled,
    quick_car,
)
from tests.virtual import EwsBox


@pytest.mark.parametrize("shows", [0x50, 0x42])
async def test_a_pause_is_said_once_and_keeps_the_cable_locked(
    hass: HomeAssistant, shows: int
) -> None:
    box = EwsBox(cars=(quick_car(),))
    port = box.ports[0]
    port.pause_status = shows  # type: ignore[assignment]
    async with running(hass, box) as (entry, bus):
        switch = await charge(hass, entry, bus, box)
        status = await get_entity(hass, "sensor", entry, "1_status")
        await call(hass, "switch.turn_off", switch)
        assert orders(box) == [START, PAUSE]
        assert not port.contactor
        assert port.locked
        await wait_for_state(hass, switch, "off")
        await wait_for_state(hass, status, "suspended_evse")
        offered = await get_entity(hass, "sensor", entry, "1_offered_current")
        assert state_of(hass, offered) == "0.0"

        # Off once more: a second 6 would unlock.
        await call(hass, "switch.turn_off", switch)
        await polled(bus, box)
        assert orders(box) == [START, PAUSE]

        await call(hass, "switch.turn_on", switch)
        assert orders(box) == [START, PAUSE, START]
        await wait_for_state(hass, status, "charging")
        assert state_of(hass, switch) == "on"
        assert port.session.cycles == 1
        assert not port.history.unlockings


async def test_off_twice_at_once(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        switch = await charge(hass, entry, bus, box)
        await asyncio.gather(
            *(call(hass, "switch.turn_off", switch) for _ in range(3)),
            return_exceptions=True,
        )
        await wait_for_state(hass, switch, "off")
        await polled(bus, box, 20)
        assert orders(box) == [START, PAUSE]
        assert box.ports[0].locked
        assert not box.ports[0].history.unlockings


async def test_a_stop_outruns_a_start(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        switch = await get_entity(hass, "switch", entry, "1_charging_allowed")
        await plug_in(bus, box)
        _, stopped = await asyncio.gather(
            call(hass, "switch.turn_on", switch),
            call(hass, "switch.turn_off", switch),
            return_exceptions=True,
        )
        # The start may have been quicker; it does not come after the stop.
        assert stopped is None
        await polled(bus, box, 20)
        assert box.ports[0].status in (0x30, 0x50)
        assert not box.ports[0].contactor
        assert state_of(hass, switch) == "off"


@pytest.mark.parametrize("reaches", [True, False])
async def test_a_lost_answer_to_the_pause_unlocks_nobody(
    hass: HomeAssistant,
    reaches: bool,  # noqa: FBT001 - a parameter of a test
) -> None:
    """What has become of it the next look tells; it is said again only if need be."""
    box = EwsBox(cars=(quick_car(),))
    port = box.ports[0]
    async with running(hass, box) as (entry, bus):
        switch = await charge(hass, entry, bus, box)
        if reaches:
            follow = port.pause

            def pause() -> None:
                follow()
                box.faults.once("lose")

            port.pause = pause  # type: ignore[method-assign]
        else:
            # Refused in silence, as by a box that has not understood.
            box.unanswered.add("sl")
        stopping = hass.async_create_task(call(hass, "switch.turn_off", switch))
        if not reaches:
            await bus.wait_for_async(lambda: len(orders(box)) == 2)
            box.unanswered.clear()
        await stopping
        assert not port.contactor
        assert port.locked
        assert not port.history.unlockings
        assert orders(box) == [START, *[PAUSE] * (1 if reaches else 2)]
        await wait_for_state(hass, switch, "off")
        await polled(bus, box, 20)
        assert len(orders(box)) == (2 if reaches else 3)
        assert not port.history.unlockings


async def test_a_slider_moved_while_paused_starts_nobody(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        switch = await charge(hass, entry, bus, box)
        await call(hass, "switch.turn_off", switch)
        for value in (16, 6, 11):
            await call(hass, "number.set_value", limit, value=value)
            await bus.wait_for_async(
                lambda value=value: box.ports[0].limit == value  # type: ignore[misc]
            )
        await polled(bus, box, 20)
        assert orders(box) == [START, PAUSE]
        assert not box.ports[0].contactor
        assert state_of(hass, switch) == "off"
        # What was set meanwhile counts from the moment it goes on.
        await call(hass, "switch.turn_on", switch)
        assert box.ports[0].offered == 11
        assert 0 not in limits(box)


async def test_a_slider_starts_nobody_who_has_just_come(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        switch = await get_entity(hass, "switch", entry, "1_charging_allowed")
        await plug_in(bus, box)
        await call(hass, "number.set_value", limit, value=16)
        await wait_for_state(hass, switch, "off")
        await polled(bus, box, 10)
        assert not orders(box)


async def test_switched_on_without_a_car_starts_nobody_later(
    hass: HomeAssistant,
) -> None:
    """An order 3 would let whoever comes next start."""
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        switch = await get_entity(hass, "switch", entry, "1_charging_allowed")
        await call(hass, "switch.turn_on", switch)
        await plug_in(bus, box)
        await polled(bus, box, 10)
        assert not orders(box)
        await wait_for_state(hass, switch, "off")


async def test_a_charge_that_begins_against_a_pause_is_paused(
    hass: HomeAssistant,
) -> None:
    car = quick_car()
    box = EwsBox(cars=(car,), mode="standalone")
    port = box.ports[0]
    async with running(hass, box) as (entry, bus):
        switch = await get_entity(hass, "switch", entry, "1_charging_allowed")
        await call(hass, "switch.turn_off", switch)
        await plug_in(bus, box)
        box.start_on_web_page(1)
        await bus.wait_for_async(lambda: port.history.starts)
        await bus.wait_for_async(lambda: PAUSE in orders(box))
        await wait_for_state(hass, switch, "off")
        assert not port.contactor
        assert port.locked
        await polled(bus, box, 20)
        assert orders(box) == [PAUSE]
        fail_safe = await get_entity(hass, "sensor", entry, "1_power")
        assert state_of(hass, fail_safe) == "0.0"


async def test_orders_that_nobody_renews_pause_and_go_on(hass: HomeAssistant) -> None:
    """With a fail-safe of 0 A: the permission stands, only the current is missing."""
    box = EwsBox(cars=(quick_car(),))
    port = box.ports[0]
    async with running(hass, box, order_lifetime=0.1, fail_safe_current=0.0) as (
        entry,
        bus,
    ):
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        expired = await get_entity(hass, "binary_sensor", entry, "1_orders_expired")
        await call(hass, "number.set_value", limit, value=12)
        switch = await charge(hass, entry, bus, box)
        assert port.limit == 12
        await wait_for_state(hass, expired, "on")
        await bus.wait_for_async(lambda: not port.contactor, timeout=10)
        assert orders(box) == [START, PAUSE]
        assert port.locked
        assert state_of(hass, switch) == "on"
        await polled(bus, box, 10)
        await call(hass, "number.set_value", limit, value=9)
        await bus.wait_for_async(lambda: port.contactor, timeout=10)
        assert orders(box) == [START, PAUSE, START]
        assert port.limit == 9
        assert not port.history.unlockings
        assert 0 not in limits(box)


async def test_ended_at_the_box_stays_ended(hass: HomeAssistant) -> None:
    """A stop key has unlocked the cable: nobody's switch starts that charge again."""
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        switch = await charge(hass, entry, bus, box)
        status = await get_entity(hass, "sensor", entry, "1_status")
        box.press_key(1, 2)
        await wait_for_state(hass, status, "finishing")
        await call(hass, "switch.turn_off", switch)
        await call(hass, "switch.turn_on", switch)
        await polled(bus, box, 10)
        assert orders(box) == [START]
        assert box.ports[0].status == 0x50
        assert state_of(hass, switch) == "on"
        reason = await get_entity(hass, "sensor", entry, "1_pause_reason")
        assert state_of(hass, reason) == "charge_ended"


async def test_ports_are_paused_each_for_itself(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(), quick_car()))
    async with running(hass, box) as (entry, bus):
        one = await charge(hass, entry, bus, box, 1)
        two = await charge(hass, entry, bus, box, 2)
        await call(hass, "switch.turn_off", two)
        await polled(bus, box)
        assert box.ports[0].contactor
        assert not box.ports[1].contactor
        assert (state_of(hass, one), state_of(hass, two)) == ("on", "off")
        assert orders(box, 1) == [START]
        assert orders(box, 2) == [START, PAUSE]


async def test_a_household_socket_has_no_limit(hass: HomeAssistant) -> None:
    """Mode 1: 16 A or nothing; there is no pilot that could tell a car less."""
    car = quick_car()
    box = EwsBox(cars=(None, car), mode1=(False, True))
    async with running(hass, box, fail_safe_current=16.0) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "2_charging_current")
        switch = await get_entity(hass, "switch", entry, "2_charging_allowed")
        reason = await get_entity(hass, "sensor", entry, "2_pause_reason")
        await call(hass, "number.set_value", limit, value=10)
        assert not limits(box, 2)
        await wait_for_state(hass, reason, "limit_too_low")
        # What it does not have is nowhere, and the other port has it.
        await get_entity(hass, "sensor", entry, "2_status")
        await hass.async_block_till_done()
        for platform, key in (
            ("sensor", "offered_current"),
            ("sensor", "cable_current"),
            ("binary_sensor", "locked"),
            ("switch", "cable_lock"),
        ):
            assert entity_id(hass, platform, entry, f"1_{key}")
            assert not entity_id(hass, platform, entry, f"2_{key}")
        await plug_in(bus, box, 2)
        status = await get_entity(hass, "sensor", entry, "2_status")
        await wait_for_state(hass, status, "preparing")
        await call(hass, "switch.turn_on", switch)
        await polled(bus, box)
        assert not orders(box, 2)
        assert state_of(hass, switch) == "on"
        await call(hass, "number.set_value", limit, value=16)
        await wait_for_state(hass, status, "charging")
        await call(hass, "switch.turn_off", switch)
        assert not box.ports[1].contactor
        assert orders(box, 2) == [START, PAUSE]
        assert not limits(box, 2)


async def test_a_household_socket_on_a_small_fuse_never_charges(
    hass: HomeAssistant,
) -> None:
    car = quick_car()
    box = EwsBox(cars=(None, car), mode1=(False, True))
    async with running(
        hass, box, installation_limit_2=10.0, fail_safe_current=16.0
    ) as (entry, bus):
        switch = await get_entity(hass, "switch", entry, "2_charging_allowed")
        await plug_in(bus, box, 2)
        with pytest.raises(HomeAssistantError, match="needs 16 A") as refused:
            await call(hass, "switch.turn_on", switch)
        assert refused.value.translation_key == "ews_maximum_too_low"
        await polled(bus, box, 20)
        assert state_of(hass, switch) == "off"
        assert START not in orders(box, 2)
        assert not box.ports[1].contactor
