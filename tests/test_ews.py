"""An EWS-Box in Home Assistant: what it tells, and the limits it is told."""

from contextlib import suppress
from math import inf, nan

from homeassistant.core import HomeAssistant
from homeassistant.exceptions import HomeAssistantError, ServiceValidationError
from homeassistant.helpers import entity_registry as er
from homeassistant.util import dt as dt_util
import pytest

from tests.common import (
    call,
    entity_id,
    get_entity,
    running,
    state_of,
    wait_for_state,
    wait_until,
)
from tests.ews import charge, limits, orders, plug_in, polled, quick_car
from tests.virtual import EwsBox


async def test_a_car_comes_charges_and_leaves(hass: HomeAssistant) -> None:
    car = quick_car()
    box = EwsBox(cars=(car,))
    port = box.ports[0]
    async with running(hass, box, fail_safe_current=10.0) as (entry, bus):
        status = await get_entity(hass, "sensor", entry, "1_status")

        def shown(*keys: str) -> list[str]:
            return [
                state_of(hass, entity_id(hass, platform, entry, f"1_{key}") or key)
                for platform, _, key in (one.partition(" ") for one in keys)
            ]

        assert shown(
            "sensor status",
            "sensor raw_state",
            "binary_sensor plugged",
            "binary_sensor charging",
            "binary_sensor contactor",
            "sensor cable_current",
            "sensor maximum_current",
        ) == ["available", "0x00", "off", "off", "off", "unknown", "32.0"]
        await plug_in(bus, box)
        raw = await get_entity(hass, "sensor", entry, "1_raw_state")
        await wait_for_state(hass, raw, "0x30")
        assert shown("sensor status", "binary_sensor plugged") == ["preparing", "on"]
        # Nobody has allowed it, and the box says so.
        assert shown("switch charging_allowed") == ["off"]
        await call(
            hass,
            "switch.turn_on",
            entity_id(hass, "switch", entry, "1_charging_allowed"),
        )
        await wait_for_state(hass, status, "charging")
        power = await get_entity(hass, "sensor", entry, "1_power")
        await wait_for_state(
            hass, power, lambda state: float(state.state) == round(30 * 230 * 0.98)
        )
        assert shown(
            "sensor raw_state",
            "binary_sensor charging",
            "binary_sensor contactor",
            "binary_sensor locked",
            "switch charging_allowed",
            "sensor offered_current",
            "sensor cable_current",
        ) == ["0x40", "on", "on", "off", "on", "10.0", "32.0"]
        assert port.offered == 10

        # The car is full, and then goes.
        car.finish()
        await wait_for_state(hass, status, "suspended_ev")
        assert shown("binary_sensor charging", "switch charging_allowed") == [
            "off",
            "on",
        ]
        car.leave()
        await wait_for_state(hass, status, "available")
        await wait_until(hass, lambda: shown("binary_sensor locked") == ["on"])
        assert shown("sensor last_result", "binary_sensor problem") == [
            "pilot_lost",
            "off",
        ]
        # Of the two ports one is empty all the time.
        assert state_of(hass, entity_id(hass, "sensor", entry, "2_status") or "") == (
            "available"
        )


async def test_meter_and_times(hass: HomeAssistant) -> None:
    car = quick_car()
    box = EwsBox(cars=(None, car))
    port = box.ports[1]
    async with running(hass, box, fail_safe_current=16.0) as (entry, bus):
        # Its clock has to be right before it tells when a charge has ended.
        await bus.wait_for_async(lambda: box.commands_named("sc"))
        await charge(hass, entry, bus, box, port=2)
        # As if it had begun long ago: three readings of that agree.
        port.session.wh += 400
        port.session.seconds += 150
        session = await get_entity(hass, "sensor", entry, "2_session_energy")
        await wait_for_state(hass, session, lambda state: float(state.state) > 0.3)
        time = await get_entity(hass, "sensor", entry, "2_session_time")
        await wait_for_state(hass, time, lambda state: float(state.state) > 2)
        box.press_key(2, 2)
        result = await get_entity(hass, "sensor", entry, "2_last_result")
        await wait_for_state(hass, result, "stopped")
        await polled(bus, box)
        await hass.async_block_till_done()
        told = port.session

        def number(key: str) -> float:
            return float(state_of(hass, entity_id(hass, "sensor", entry, key) or key))

        assert number("2_last_session_energy") == int(told.last_wh) / 1000
        assert number("2_session_energy") == int(told.wh) / 1000
        assert number("2_energy") == int(told.total_wh) / 1000
        assert number("2_last_session_time") == pytest.approx(
            int(told.last_seconds) / 60
        )
        assert number("1_energy") == 0
        ended = dt_util.parse_datetime(
            state_of(hass, entity_id(hass, "sensor", entry, "2_last_end") or "")
        )
        assert ended is not None
        year, month, day, hour, minute, second = told.last_end
        assert dt_util.as_local(ended).timetuple()[:6] == (
            *(year, month, day),
            *(hour, minute, second),
        )


@pytest.mark.parametrize(
    ("what", "fault", "raw"),
    [
        ("RCD", "rcd", "0xA8"),
        ("lock", "socket_lock", "0xA1"),
        ("contactor", "contactor_open", "0xA3"),
        ("fan", "ventilation_requested", "0x60"),
    ],
)
async def test_faults_are_named_and_shown_as_a_problem(
    hass: HomeAssistant, what: str, fault: str, raw: str
) -> None:
    car = quick_car()
    box = EwsBox(cars=(car,))
    port = box.ports[0]
    async with running(hass, box) as (entry, bus):
        problem = await get_entity(hass, "binary_sensor", entry, "1_problem")
        shown = await get_entity(hass, "sensor", entry, "1_fault")
        switch = await get_entity(hass, "switch", entry, "1_charging_allowed")
        assert (state_of(hass, shown), state_of(hass, problem)) == ("none", "off")
        await plug_in(bus, box)
        if what == "lock":
            port.lock.jammed = "lock"
        elif what == "contactor":
            port.relay.broken = "open"
        elif what == "fan":
            port.wants_fan = True
        else:
            box.trip_rcd(1)
        if what != "RCD":
            # How the start itself ends is another matter.
            with suppress(HomeAssistantError):
                await call(hass, "switch.turn_on", switch)
        await wait_for_state(hass, shown, fault)
        await wait_for_state(hass, problem, "on")
        state = await get_entity(hass, "sensor", entry, "1_raw_state")
        await wait_for_state(hass, state, raw)
        other = entity_id(hass, "binary_sensor", entry, "2_problem")
        assert state_of(hass, other or "") == "off"


async def test_a_car_that_wants_the_room_to_be_ventilated(
    hass: HomeAssistant,
) -> None:
    box = EwsBox(cars=(quick_car(), quick_car()), fan=True)
    box.ports[1].wants_fan = True
    async with running(hass, box) as (entry, bus):
        asks = await get_entity(hass, "binary_sensor", entry, "2_ventilation_requested")
        runs = await get_entity(hass, "binary_sensor", entry, "ventilating")
        await charge(hass, entry, bus, box, 2)
        await wait_for_state(hass, asks, "on")
        other = entity_id(hass, "binary_sensor", entry, "1_ventilation_requested")
        assert state_of(hass, other or "") == "off"
        # It is the box's fan, and told with the box.
        await wait_for_state(hass, runs, "on")


async def test_who_charges_is_private(hass: HomeAssistant) -> None:
    box = EwsBox(rfid=True)
    async with running(hass, box) as (entry, _):
        await get_entity(hass, "sensor", entry, "2_status")
        await hass.async_block_till_done()
        registry = er.async_get(hass)
        users = [
            one
            for one in er.async_entries_for_config_entry(registry, "bus")
            if one.unique_id.endswith("_user")
        ]
        assert len(users) == 2
        disabled = er.RegistryEntryDisabler.INTEGRATION
        assert all(one.disabled_by is disabled for one in users)


# -- Limits ----------------------------------------------------------------------


async def test_a_limit_is_in_the_box_when_the_action_returns(
    hass: HomeAssistant,
) -> None:
    box = EwsBox()
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        await bus.wait_for_async(lambda: box.ports[0].limit == 6)
        # Whole amperes, and never more than was asked for.
        for asked, said in ((16, 16), (9.7, 9), (6.99, 6), (13.0, 13)):
            await call(hass, "number.set_value", limit, value=asked)
            assert limits(box)[-1] == box.ports[0].limit == said
            assert state_of(hass, limit) == str(float(said))
        attributes = hass.states.get(limit).attributes
        assert [attributes[key] for key in ("min", "max", "step")] == [0, 16, 1]
        # Port 2 has its own.
        assert set(limits(box, 2)) == {6}
        # 0 would take the limit away.
        assert 0 not in limits(box)


@pytest.mark.parametrize(
    "value", [-1, -6, 16.01, 32, 255, 262, nan, inf, -inf, "nan", "-5"]
)
async def test_what_is_no_limit_is_refused(
    hass: HomeAssistant, value: float | str
) -> None:
    box = EwsBox()
    async with running(hass, box) as (entry, _):
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        await call(hass, "number.set_value", limit, value=9)
        told = limits(box)
        with pytest.raises(ServiceValidationError):
            await call(hass, "number.set_value", limit, value=value)
        assert limits(box) == told
        assert state_of(hass, limit) == "9.0"


async def test_each_port_has_a_limit_of_its_own(hass: HomeAssistant) -> None:
    box = EwsBox()
    async with running(
        hass, box, installation_limit=16.0, installation_limit_2=10.0
    ) as (entry, bus):
        one = await get_entity(hass, "number", entry, "1_charging_current")
        two = await get_entity(hass, "number", entry, "2_charging_current")
        assert hass.states.get(one).attributes["max"] == 16
        assert hass.states.get(two).attributes["max"] == 10
        await call(hass, "number.set_value", one, value=16)
        await call(hass, "number.set_value", two, value=10)
        with pytest.raises(ServiceValidationError):
            await call(hass, "number.set_value", two, value=11)
        # A lower limit of the installation counts at once.
        subentry = entry.subentries["ews01"]
        hass.config_entries.async_update_subentry(
            entry, subentry, data={**subentry.data, "installation_limit_2": 8.0}
        )
        await bus.wait_for_async(lambda: box.ports[1].limit == 8)
        await wait_for_state(hass, two, "8.0")
        assert box.ports[0].limit == 16
        assert max(limits(box, 2)) == 10
        assert not orders(box)


async def test_jumper_and_parameters_clamp_and_the_range_stands(
    hass: HomeAssistant,
) -> None:
    box = EwsBox(jumper=20, max_current=13)
    box.extra.max_current_2 = 16
    box.take_parameters()
    async with running(
        hass, box, installation_limit=32.0, installation_limit_2=32.0
    ) as (entry, bus):
        for port, highest in ((1, 13), (2, 16)):
            limit = await get_entity(hass, "number", entry, f"{port}_charging_current")
            assert hass.states.get(limit).attributes["max"] == 32
            await call(hass, "number.set_value", limit, value=20)
            assert state_of(hass, limit) == "20.0"
            await bus.wait_for_async(
                lambda port=port, highest=highest: box.ports[port - 1].limit == highest
            )
            assert max(limits(box, port)) == highest


async def test_the_limit_follows_the_cable_and_the_slider_does_not(
    hass: HomeAssistant,
) -> None:
    """A thin cable lowers what reaches the wire; the order stands for the next one."""
    car = quick_car()
    box = EwsBox(cars=(car,))
    port = box.ports[0]
    port.cable = 13
    async with running(hass, box, fail_safe_current=16.0) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        await bus.wait_for_async(lambda: port.limit == 16)
        await charge(hass, entry, bus, box)
        cable = await get_entity(hass, "sensor", entry, "1_cable_current")
        await wait_for_state(hass, cable, "13.0")
        await bus.wait_for_async(lambda: port.limit == 13)
        car.leave()
        await wait_for_state(hass, cable, "unknown")
        await bus.wait_for_async(lambda: port.limit == 16)
        assert state_of(hass, limit) == "16.0"


async def test_somebody_else_sets_a_limit(hass: HomeAssistant) -> None:
    """The order stands: it is said again, and counted."""
    box = EwsBox()
    async with running(hass, box) as (entry, bus):
        limit = await get_entity(hass, "number", entry, "1_charging_current")
        await call(hass, "number.set_value", limit, value=10)

        def set_by_somebody() -> None:
            box.ports[0].limit = 16

        bus.call(set_by_somebody)
        await bus.wait_for_async(lambda: limits(box)[-2:] == [10, 10])
        assert box.ports[0].limit == 10
        coordinator = entry.runtime_data
        assert coordinator.chargers["ews01_1"].charger.statistics.reasserted == 1
        assert state_of(hass, limit) == "10.0"


async def test_orders_that_nobody_renews(hass: HomeAssistant) -> None:
    """After the lifetime the fail-safe counts, on that port alone."""
    box = EwsBox()
    async with running(hass, box, order_lifetime=0.05, fail_safe_current=7.0) as (
        entry,
        bus,
    ):
        one = await get_entity(hass, "number", entry, "1_charging_current")
        two = await get_entity(hass, "number", entry, "2_charging_current")
        expired = await get_entity(hass, "binary_sensor", entry, "1_orders_expired")
        other = await get_entity(hass, "binary_sensor", entry, "2_orders_expired")
        await call(hass, "number.set_value", two, value=12)
        await call(hass, "number.set_value", one, value=14)
        assert state_of(hass, expired) == "off"
        await wait_for_state(hass, other, "on")
        await wait_for_state(hass, two, "7.0")
        await call(hass, "number.set_value", two, value=11)
        assert state_of(hass, other) == "off"
        await wait_for_state(hass, expired, "on")
        await bus.wait_for_async(lambda: box.ports[0].limit == 7)
        await wait_for_state(hass, one, "7.0")
        await call(hass, "number.set_value", one, value=13)
        assert box.ports[0].limit == 13
        assert state_of(hass, expired) == "off"
