"""What chargers say, as sensors; and what they do not say."""

from homeassistant.core import HomeAssistant

from tests.common import (
    call,
    entity_id,
    get_entity,
    running,
    state_of,
    wait_for_state,
)
from tests.virtual import AblBox, Car, EvboxChargePoint, Module


async def test_a_car_comes_charges_and_leaves(hass: HomeAssistant) -> None:
    car = Car(reaction=0.0, ramp=0.1, phases=1)
    box = AblBox(1, car=car)
    async with running(hass, box, fail_safe_current=10.0) as (entry, _):
        status = await get_entity(hass, "sensor", entry, "1_status")
        raw = await get_entity(hass, "sensor", entry, "1_raw_state")
        plugged = await get_entity(hass, "binary_sensor", entry, "1_plugged")
        charging = await get_entity(hass, "binary_sensor", entry, "1_charging")
        power = await get_entity(hass, "sensor", entry, "1_estimated_power")
        assert [state_of(hass, one) for one in (status, raw, plugged, charging)] == [
            "available",
            "A1",
            "off",
            "off",
        ]
        car.plug_in()
        await wait_for_state(hass, status, "charging")
        await wait_for_state(hass, raw, "C2")
        await wait_for_state(hass, plugged, "on")
        await wait_for_state(hass, charging, "on")
        # One phase at 10 A and 230 V, as the car rounds it.
        await wait_for_state(
            hass, power, lambda state: 2200 < float(state.state) < 2310
        )
        two = entity_id(hass, "sensor", entry, "1_current_l2")
        assert state_of(hass, two) == "0.0"
        car.finish()
        await wait_for_state(hass, status, "suspended_ev")
        await wait_for_state(hass, charging, "off")
        car.leave()
        await wait_for_state(hass, status, "available")
        await wait_for_state(hass, plugged, "off")


async def test_faults_are_named_and_shown_as_a_problem(hass: HomeAssistant) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        fault = await get_entity(hass, "sensor", entry, "fault")
        problem = await get_entity(hass, "binary_sensor", entry, "problem")
        status = await get_entity(hass, "sensor", entry, "1_status")
        assert (state_of(hass, fault), state_of(hass, problem)) == ("none", "off")
        box.fail(9)
        state = await wait_for_state(hass, fault, lambda state: state.state != "none")
        assert state.attributes["codes"] == ["F9"]
        assert state.attributes["faults"] == [state.state]
        await wait_for_state(hass, problem, "on")
        await wait_for_state(hass, status, "faulted")
        box.clear_failure()
        await wait_for_state(hass, fault, "none")
        await wait_for_state(hass, problem, "off")


async def test_what_is_not_told_is_unknown(hass: HomeAssistant) -> None:
    """In E0 nobody knows whether there is a cable, nor what is offered."""
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        plugged = await get_entity(hass, "binary_sensor", entry, "1_plugged")
        offered = await get_entity(hass, "sensor", entry, "offered_current")
        box.stop_locally()
        await wait_for_state(hass, plugged, "unknown")
        await wait_for_state(hass, offered, "unknown")


async def test_voltages_exist_only_where_they_are_told(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    async with running(hass, box, poll_interval=0.5, command=69) as (entry, _):
        await get_entity(hass, "sensor", entry, "1_estimated_power")
        assert entity_id(hass, "sensor", entry, "1_voltage_l1") is None
        assert entity_id(hass, "sensor", entry, "1_power") is None


async def test_modules_that_come_while_it_runs(hass: HomeAssistant) -> None:
    car = Car(reaction=0.0, ramp=0.1)
    box = EvboxChargePoint(1923054, 0, min_interval=0)
    async with running(hass, box, poll_interval=0.5, fail_safe_current=8.0) as (
        entry,
        _,
    ):
        await get_entity(hass, "sensor", entry, "maximum_current")
        assert entity_id(hass, "sensor", entry, "1_power") is None
        car.plug_in()
        box.add_module(Module(car))
        power = await get_entity(hass, "sensor", entry, "1_power")
        await wait_for_state(hass, power, lambda state: float(state.state) > 5000)


async def test_a_meter_that_jumps_is_no_consumption(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054, [Module(energy_wh=1000)], min_interval=0)
    async with running(hass, box, poll_interval=0.3) as (entry, bus):
        energy = await get_entity(hass, "sensor", entry, "1_energy")
        await wait_for_state(hass, energy, "1.0")
        seen: list[str] = []
        hass.bus.async_listen(
            "state_changed",
            lambda event: (
                seen.append(event.data["new_state"].state)
                if event.data["entity_id"] == energy
                else None
            ),
        )
        box.modules[0].energy_wh = 900_000
        polls = len(box.orders)
        await bus.wait_for_async(lambda: len(box.orders) > polls + 8, timeout=30)
        await hass.async_block_till_done()
        assert set(seen) <= {"1.0", "unknown", "unavailable"}
        await wait_for_state(hass, energy, "1.0")


async def test_the_fail_safe_is_told_as_it_is(hass: HomeAssistant) -> None:
    """An ABL box has one only when it was switched on in the box."""
    async with running(hass, AblBox(1)) as (entry, _):
        own = await get_entity(hass, "switch", entry, "upstream_timeout")
        fail_safe = await get_entity(hass, "sensor", entry, "fail_safe")
        await call(hass, "switch.turn_off", own)
        await wait_for_state(hass, fail_safe, "nothing")
        await call(hass, "switch.turn_on", own)
        await wait_for_state(hass, fail_safe, "stops")
