"""What a person has an EWS-Box do: its lock, optimised charging, its buttons."""

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
    DO_NOT_OPTIMISE,
    LOCK,
    OPTIMISE,
    PAUSE,
    REQUEST_START,
    START,
    STOP,
    charge,
    limits,
    orders,
    plug_in,
    polled,
    quick_car,
)
from tests.virtual import EwsBox

# -- The lock ------------------------------------------------------------------------


async def test_the_plug_of_a_car_that_waits_is_locked_and_unlocked(
    hass: HomeAssistant,
) -> None:
    box = EwsBox(cars=(quick_car(),))
    port = box.ports[0]
    async with running(hass, box) as (entry, bus):
        lock = await get_entity(hass, "switch", entry, "1_cable_lock")
        locked = await get_entity(hass, "binary_sensor", entry, "1_locked")
        status = await get_entity(hass, "sensor", entry, "1_status")
        # Home Assistant's class is on when something is open.
        assert (state_of(hass, lock), state_of(hass, locked)) == ("off", "on")
        await plug_in(bus, box)
        await wait_for_state(hass, status, "preparing")
        await call(hass, "switch.turn_on", lock)
        assert orders(box) == [LOCK]
        assert port.locked
        await wait_for_state(hass, lock, "on")
        await wait_for_state(hass, locked, "off")
        await call(hass, "switch.turn_off", lock)
        assert not port.locked
        assert len(orders(box)) == 2
        await wait_for_state(hass, lock, "off")
        assert port.status == 0x30
        # Free already: nothing has to be said.
        await call(hass, "switch.turn_off", lock)
        assert len(orders(box)) == 2


async def test_the_plug_is_unlocked_after_our_pause(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    port = box.ports[0]
    async with running(hass, box) as (entry, bus):
        lock = await get_entity(hass, "switch", entry, "1_cable_lock")
        switch = await charge(hass, entry, bus, box)
        await call(hass, "switch.turn_off", switch)
        assert port.locked
        await call(hass, "switch.turn_off", lock)
        assert not port.locked
        assert orders(box)[:2] == [START, PAUSE]
        assert orders(box)[2:] in ([PAUSE], [STOP])
        # That was the end of this charge.
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "finishing")
        await call(hass, "switch.turn_on", switch)
        await polled(bus, box, 10)
        assert not port.contactor
        assert len(orders(box)) == 3


async def test_unlocking_while_charging_stops(hass: HomeAssistant) -> None:
    """Order 1; 6 would only pause, and leave the plug locked."""
    box = EwsBox(cars=(quick_car(),))
    port = box.ports[0]
    async with running(hass, box) as (entry, bus):
        lock = await get_entity(hass, "switch", entry, "1_cable_lock")
        await charge(hass, entry, bus, box)
        await wait_for_state(hass, lock, "on")
        await call(hass, "switch.turn_off", lock)
        assert orders(box) == [START, STOP]
        assert not port.locked
        assert not port.contactor
        assert not port.history.unlocked_under_power


async def test_locking_an_empty_socket_is_refused(hass: HomeAssistant) -> None:
    box = EwsBox()
    async with running(hass, box) as (entry, _):
        lock = await get_entity(hass, "switch", entry, "2_cable_lock")
        with pytest.raises(HomeAssistantError) as refused:
            await call(hass, "switch.turn_on", lock)
        assert refused.value.translation_key == "ews_lock_state"
        assert "0x00" in str(refused.value)
        assert not orders(box, 2)
        assert state_of(hass, lock) == "off"


async def test_a_plug_that_does_not_move(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        lock = await get_entity(hass, "switch", entry, "1_cable_lock")
        problem = await get_entity(hass, "binary_sensor", entry, "1_problem")
        await plug_in(bus, box)
        await polled(bus, box)
        box.ports[0].lock.jammed = "lock"
        with pytest.raises(HomeAssistantError):
            await call(hass, "switch.turn_on", lock)
        await wait_for_state(hass, problem, "on")
        assert state_of(hass, lock) == "off"


async def test_a_fixed_cable_has_no_lock(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),), fixed_cable=True)
    async with running(hass, box) as (entry, bus):
        plugged = await get_entity(hass, "binary_sensor", entry, "1_plugged")
        assert state_of(hass, plugged) == "off"
        await charge(hass, entry, bus, box)
        assert state_of(hass, plugged) == "on"
        assert not entity_id(hass, "switch", entry, "1_cable_lock")
        assert not entity_id(hass, "binary_sensor", entry, "1_locked")


# -- Optimised charging --------------------------------------------------------------


async def test_optimised_charging(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        optimised = await get_entity(hass, "switch", entry, "1_optimised_charging")
        raw = await get_entity(hass, "sensor", entry, "1_raw_state")
        assert state_of(hass, optimised) == "off"
        await call(hass, "switch.turn_on", optimised)
        assert orders(box) == [OPTIMISE]
        await wait_for_state(hass, optimised, "on")
        await call(hass, "switch.turn_off", optimised)
        assert orders(box) == [OPTIMISE, DO_NOT_OPTIMISE]
        await wait_for_state(hass, optimised, "off")
        await call(hass, "switch.turn_on", optimised)
        # Somebody presses the key for it, at the box.
        box.press_key(1, 3)
        await wait_for_state(hass, optimised, "off")
        box.press_key(1, 3)
        await wait_for_state(hass, optimised, "on")
        await charge(hass, entry, bus, box)
        await wait_for_state(hass, raw, "0x41")
        assert not orders(box, 2)


# -- Buttons -------------------------------------------------------------------------


async def test_stop_and_unlock(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    port = box.ports[0]
    async with running(hass, box) as (entry, bus):
        button = await get_entity(hass, "button", entry, "1_stop_and_unlock")
        switch = await charge(hass, entry, bus, box)
        status = await get_entity(hass, "sensor", entry, "1_status")
        await call(hass, "button.press", button)
        assert orders(box) == [START, STOP]
        assert not port.contactor
        assert not port.locked
        await wait_for_state(hass, status, "finishing")
        result = await get_entity(hass, "sensor", entry, "1_last_result")
        assert state_of(hass, result) == "stopped"
        # It is no pause: the switch does not let it go on.
        await call(hass, "switch.turn_on", switch)
        await polled(bus, box, 10)
        assert orders(box) == [START, STOP]


async def test_request_a_start(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        button = await get_entity(hass, "button", entry, "1_request_start")
        asked = await get_entity(hass, "binary_sensor", entry, "1_start_requested")
        with pytest.raises(HomeAssistantError) as refused:
            await call(hass, "button.press", button)
        assert refused.value.translation_key == "ews_request_start_state"
        assert not orders(box)
        await plug_in(bus, box)
        await polled(bus, box)
        await call(hass, "button.press", button)
        assert orders(box) == [REQUEST_START]
        assert box.ports[0].start_mode == 1
        await wait_for_state(hass, asked, "on")
        # Asked is not allowed.
        await polled(bus, box, 10)
        assert box.ports[0].status == 0x30


async def test_restart_and_the_limits_are_said_again(hass: HomeAssistant) -> None:
    box = EwsBox(cars=(quick_car(),))
    async with running(hass, box) as (entry, bus):
        one = await get_entity(hass, "number", entry, "1_charging_current")
        two = await get_entity(hass, "number", entry, "2_charging_current")
        await call(hass, "number.set_value", one, value=12)
        await call(hass, "number.set_value", two, value=9)
        button = await get_entity(hass, "button", entry, "reset")
        before = len(box.currents_set)
        await call(hass, "button.press", button)
        await bus.wait_for_async(lambda: box.restarts == 1)
        assert box.ports[0].limit == box.ports[1].limit == 0
        await bus.wait_for_async(
            lambda: (box.ports[0].limit, box.ports[1].limit) == (12, 9), timeout=20
        )
        told = {(limit.port, limit.amps) for limit in box.currents_set[before:]}
        assert told == {(1, 12), (2, 9)}
        await wait_for_state(hass, one, "12.0")
        assert not orders(box)
        # The button is the box's: there is one.
        assert not entity_id(hass, "button", entry, "1_reset")
        assert not entity_id(hass, "button", entry, "2_reset")


async def test_a_power_cut_in_the_middle_of_a_charge(hass: HomeAssistant) -> None:
    """It goes on by itself, at the jumper's current, until it can be told again."""
    box = EwsBox(cars=(quick_car(),), restart_after_power=True)
    port = box.ports[0]
    async with running(hass, box, fail_safe_current=8.0) as (entry, bus):
        await charge(hass, entry, bus, box)
        status = await get_entity(hass, "sensor", entry, "1_status")
        box.power_cycle(6.0)
        await wait_for_state(hass, status, "unavailable")
        await bus.wait_for_async(lambda: port.contactor, timeout=20)
        await bus.wait_for_async(lambda: port.limit == 8, timeout=20)
        await wait_for_state(hass, status, "charging")
        assert set(limits(box)) == {8}
        assert orders(box) == [START]
