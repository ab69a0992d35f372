"""Limits and fail-safe values ordered through Home Assistant."""

from math import inf, nan

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError, ServiceValidationError
import probatio as vol
import pytest

from tests.common import (
    call,
    entity_id,
    get_entity,
    running,
    state_of,
    wait_for_state,
)
from tests.odd_boxes import ODD_BOXES
from tests.virtual import AblBox, Car, EvboxChargePoint, orders_in


def sent(bus) -> list[tuple[float, float, float]]:  # noqa: ANN001 - a virtual bus
    """Return the limits of all orders on the wire, A."""
    return [order.limits for order in orders_in(bus.log.bursts())]


async def test_a_limit_is_on_the_box_when_the_service_returns(
    hass: HomeAssistant,
) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        offered = await get_entity(hass, "sensor", entry, "offered_current")
        for amperes in (16, 6, 13.7, 10):
            await call(hass, "number.set_value", limit, value=amperes)
            assert amperes - 0.06 < box.ic_amps <= amperes
            assert state_of(hass, limit) == str(float(amperes))
        await wait_for_state(hass, offered, "9.96")


@pytest.mark.parametrize(
    ("value", "where"),
    [
        *((nan, 16), (inf, 16), (-inf, 16), (-6, 16), (10000, 16)),
        *((-1, 16), (-0.1, 16), (16.1, 16)),
        # As templates bring it.
        *(("nan", 16), ("inf", 16), ("-1", 16), ("1e4", 16), ("16.1", 16)),
    ],
)
async def test_absurd_values_are_refused(
    hass: HomeAssistant, value: float | str, where: float
) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=where)
        written = len(box.writes)
        with pytest.raises(ServiceValidationError):
            await call(hass, "number.set_value", limit, value=value)
        assert len(box.writes) == written
        assert state_of(hass, limit) == str(float(where))


@pytest.mark.parametrize("value", ["unknown", "unavailable", "", None, [], {}])
async def test_what_is_no_value_is_refused(hass: HomeAssistant, value: object) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        written = len(box.writes)
        with pytest.raises(vol.Invalid):
            await call(hass, "number.set_value", limit, value=value)
        assert len(box.writes) == written


@pytest.mark.parametrize(("asked", "sent_as"), [(6.97, 6.9), (6.9, 6.9), (15.99, 15.9)])
async def test_values_between_two_steps_are_rounded_down(
    hass: HomeAssistant, asked: float, sent_as: float
) -> None:
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    async with running(hass, box, poll_interval=0.5) as (entry, _):
        maximum = await get_entity(hass, "sensor", entry, "maximum_current")
        await wait_for_state(hass, maximum, "35.0")
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=asked)
        assert box.limits_in_force == (sent_as,) * 3
        assert state_of(hass, limit) == str(sent_as)


async def test_not_a_number_says_why(hass: HomeAssistant) -> None:
    """Home Assistant's own range check lets it through."""
    async with running(hass, AblBox(1)) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        with pytest.raises(ServiceValidationError) as refused:
            await call(hass, "number.set_value", limit, value=nan)
        assert refused.value.translation_key == "field_number"
        assert "Charging current must be a number from 0 to 16" in str(refused.value)


async def test_the_slider_does_not_follow_the_reading(hass: HomeAssistant) -> None:
    """A box that offers less (cable, its own choice) leaves the range as it is."""
    box = AblBox(1, cable_current=10.0)
    async with running(hass, box) as (entry, _):
        limit = await get_entity(hass, "number", entry, "charging_current")
        offered = await get_entity(hass, "sensor", entry, "offered_current")
        await call(hass, "number.set_value", limit, value=16)
        await wait_for_state(hass, offered, lambda state: float(state.state) <= 10)
        assert state_of(hass, limit) == "16.0"
        assert hass.states.get(limit).attributes["max"] == 16.0


async def test_raising_a_limit_does_not_start_a_stopped_car(
    hass: HomeAssistant,
) -> None:
    car = Car(reaction=0.0, ramp=0.1)
    box = AblBox(1, car=car)
    async with running(hass, box) as (entry, bus):
        car.plug_in()
        status = await get_entity(hass, "sensor", entry, "1_status")
        await wait_for_state(hass, status, "charging")
        switch = await get_entity(hass, "switch", entry, "charging_allowed")
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "switch.turn_off", switch)
        await wait_for_state(hass, status, "suspended_evse")
        for amperes in (6, 16, 8):
            await call(hass, "number.set_value", limit, value=amperes)
            assert box.ic_amps == 0
        polls = len(bus.log.bursts())
        await bus.wait_for_async(lambda: len(bus.log.bursts()) > polls + 10)
        assert box.ic_amps == 0
        await call(hass, "switch.turn_on", switch)
        assert box.ic_amps == pytest.approx(7.98)


async def test_evbox_limits_per_phase(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    async with running(hass, box, poll_interval=0.5, installation_limit=20.0) as (
        entry,
        bus,
    ):
        maximum = await get_entity(hass, "sensor", entry, "maximum_current")
        await wait_for_state(hass, maximum, "35.0")
        limit = await get_entity(hass, "number", entry, "charging_current")
        phase = await get_entity(hass, "number", entry, "limit_l2")
        assert state_of(hass, phase) == "20.0"
        await call(hass, "number.set_value", limit, value=16.5)
        assert box.limits_in_force == (16.5, 16.5, 16.5)
        await call(hass, "number.set_value", phase, value=10)
        assert box.limits_in_force == (16.5, 10, 16.5)
        assert state_of(hass, phase) == "10.0"
        reason = await get_entity(hass, "sensor", entry, "pause_reason")
        assert state_of(hass, reason) == "none"
        # One phase below the minimum: no manual says what a box does with that.
        for low in (0, 3):
            await call(hass, "number.set_value", phase, value=low)
            assert box.limits_in_force == (0, 0, 0)
            assert state_of(hass, phase) == str(float(low))
            await wait_for_state(hass, reason, "limit_too_low")
        assert state_of(hass, limit) == "16.5"
        # The user has modules of one phase each: that phase alone is off, at once.
        [subentry] = entry.subentries.values()
        hass.config_entries.async_update_subentry(
            entry, subentry, data={**subentry.data, "one_phase_modules": True}
        )
        await bus.wait_for_async(lambda: box.limits_in_force == (16.5, 0, 16.5))
        await wait_for_state(hass, reason, "none")
        assert bus.opened == 1
        assert max(max(limits) for limits in sent(bus)) == 16.5


async def test_evbox_fail_safe_values(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054, 1, min_interval=0)
    async with running(hass, box, poll_interval=0.5) as (entry, bus):
        maximum = await get_entity(hass, "sensor", entry, "maximum_current")
        await wait_for_state(hass, maximum, "35.0")
        current = await get_entity(hass, "number", entry, "fail_safe_current")
        timeout = await get_entity(hass, "number", entry, "fail_safe_timeout")
        await call(hass, "number.set_value", current, value=8)
        await call(hass, "number.set_value", timeout, value=90)
        order = orders_in(bus.log.bursts())[-1]
        assert order.fallback == (8, 8, 8)
        assert order.timeout == 90
        assert range_of(hass, current) == (0, 16, 0.1)
        # Below the minimum there is no charging, but a fail-safe may be that too.
        await call(hass, "number.set_value", current, value=3)
        assert orders_in(bus.log.bursts())[-1].fallback == (3, 3, 3)
        await call(hass, "number.set_value", current, value=0)
        assert orders_in(bus.log.bursts())[-1].fallback == (0, 0, 0)
        for value in (nan, 0, 4000):
            with pytest.raises(ServiceValidationError):
                await call(hass, "number.set_value", timeout, value=value)
        assert state_of(hass, timeout) == "90"


# -- The range stands, whatever charger and cable can do ---------------------------


def range_of(hass: HomeAssistant, limit: str) -> tuple[float, float, float]:
    """Return what Home Assistant lets through: from, to, step."""
    attributes = hass.states.get(limit).attributes
    return attributes["min"], attributes["max"], attributes["step"]


@pytest.mark.parametrize("kind", ODD_BOXES)
@pytest.mark.parametrize("installation", [6.0, 13.7, 32.0])
async def test_any_current_within_the_installation_limit_is_taken(
    hass: HomeAssistant, kind: str, installation: float
) -> None:
    odd = ODD_BOXES[kind]
    async with running(
        hass, odd.make(Car()), installation_limit=installation, **odd.data
    ) as (entry, _):
        limit = await get_entity(hass, "number", entry, f"{odd.port}charging_current")
        reason = await get_entity(hass, "sensor", entry, f"{odd.port}pause_reason")
        allowed = await get_entity(hass, "switch", entry, f"{odd.port}charging_allowed")
        standing = state_of(hass, allowed)
        assert range_of(hass, limit) == (0, installation, odd.step)
        for asked in (installation, 6, 5.9, 0, min(15, installation), 3, installation):
            await call(hass, "number.set_value", limit, value=asked)
            assert state_of(hass, limit) == str(float(odd.kept(asked)))
            await wait_for_state(hass, reason, odd.reason(asked, installation))
            assert range_of(hass, limit) == (0, installation, odd.step)
            assert state_of(hass, allowed) == standing
        for absurd in (installation + 0.1, -0.1):
            with pytest.raises(ServiceValidationError):
                await call(hass, "number.set_value", limit, value=absurd)


async def test_evbox_clamps_to_its_connection(hass: HomeAssistant) -> None:
    box = EvboxChargePoint(1923054, 1, max_current=12.0, min_interval=0)
    async with running(hass, box, poll_interval=0.5, installation_limit=32.0) as (
        entry,
        bus,
    ):
        limit = await get_entity(hass, "number", entry, "charging_current")
        maximum = await get_entity(hass, "sensor", entry, "maximum_current")
        await wait_for_state(hass, maximum, "12.0")
        await call(hass, "number.set_value", limit, value=16)
        # The order stands; the box gets what its connection carries.
        assert state_of(hass, limit) == "16.0"
        assert box.limits_in_force == (12, 12, 12)
        assert max(max(limits) for limits in sent(bus)) == 12


async def test_a_charger_that_does_not_follow(hass: HomeAssistant) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=16)
        problem = entity_id(hass, "binary_sensor", entry, "problem")
        box.ignore_limits = True
        original = box._write
        box._write = lambda register, value: (
            True if register == 0x14 else original(register, value)
        )
        with pytest.raises(HomeAssistantError) as failed:
            await call(hass, "number.set_value", limit, value=8)
        assert failed.value.translation_key == "not_confirmed"
        # The lowering stands, and the problem is shown until it is followed.
        assert state_of(hass, limit) == "8.0"
        await wait_for_state(hass, problem, "on")
        box._write = original
        await wait_for_state(hass, problem, "off")
        await bus.wait_for_async(lambda: box.ic_amps <= 8)


async def test_a_charger_that_does_not_answer(hass: HomeAssistant) -> None:
    box = AblBox(1)
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        await call(hass, "number.set_value", limit, value=16)
        bus.remove(box)
        with pytest.raises(HomeAssistantError) as failed:
            await call(hass, "number.set_value", limit, value=8)
        assert failed.value.translation_key == "no_reply"
        bus.add(box)
        await bus.wait_for_async(lambda: box.ic_amps <= 8, timeout=15)
        await wait_for_state(hass, limit, "8.0")


async def test_orders_that_nobody_renews(hass: HomeAssistant) -> None:
    """After the lifetime the fail-safe counts, and the slider says so."""
    box = AblBox(1)
    async with running(
        hass, box, order_lifetime=0.02, fail_safe_current=6.5, poll_interval=0.1
    ) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "charging_current")
        expired = await get_entity(hass, "binary_sensor", entry, "orders_expired")
        await call(hass, "number.set_value", limit, value=14)
        assert state_of(hass, expired) == "off"
        await wait_for_state(hass, expired, "on")
        await wait_for_state(hass, limit, "6.5")
        await bus.wait_for_async(lambda: box.ic_amps <= 6.5)
        await call(hass, "number.set_value", limit, value=12)
        assert state_of(hass, expired) == "off"
        assert state_of(hass, limit) == "12.0"
