"""Energy totals: they grow by what has flowed, and by nothing else."""

from datetime import timedelta

from homeassistant.core import HomeAssistant, State
from homeassistant.util import dt as dt_util
from hypothesis import given, strategies as st
from pytest_homeassistant_custom_component.common import (
    mock_restore_cache_with_extra_data,
)

from custom_components.evse_bus.energy import HIGHEST_POWER, MeterTotal, SummedTotal
from tests.common import get_entity, running, wait_for_state
from tests.virtual import AblBox, Car, EvboxChargePoint, Module

meters = st.floats(0, 1e9)


@given(meters, meters)
def test_the_first_meter_is_shown_as_it_is(first: float, rise: float) -> None:
    total = MeterTotal()
    assert total.update(first, 0) == first
    assert total.update(first + rise, 0) == first + rise


@given(meters, st.lists(st.tuples(meters, st.integers(0, 3)), min_size=1))
def test_another_meter_never_makes_a_step(
    first: float, readings: list[tuple[float, int]]
) -> None:
    total = MeterTotal()
    shown = total.update(first, 0)
    before = {0: first}
    for meter, generation in readings:
        previous, shown = shown, total.update(meter, generation)
        # A generation that is resumed has counted since its own last value, at most.
        growth = max(meter - before.get(generation, meter), 0.0)
        assert 0 <= shown - previous <= growth + 1e-6 * (1 + meter + shown)
        before[generation] = meter


def test_a_meter_that_reads_zero_for_a_while_is_counted_once() -> None:
    total = MeterTotal()
    assert total.update(5000, 0) == 5000
    assert total.update(0, 1) == 5000
    assert total.update(30, 1) == 5030
    assert total.update(5050, 0) == 5050
    assert total.update(5060, 0) == 5060


@given(meters, meters, st.floats(0, 1e7))
def test_after_a_restart_only_what_can_have_flowed(
    kept: float, meter: float, away: float
) -> None:
    total = MeterTotal(total=kept)
    shown = total.update(meter, 0, away)
    assert 0 <= shown - kept <= HIGHEST_POWER * away / 3600 + 1 + 1e-6 * kept
    if 0 <= meter - kept <= HIGHEST_POWER * away / 3600:
        assert shown == meter


def test_a_sum_goes_on_when_its_source_begins_anew() -> None:
    total = SummedTotal(total=100.0)
    assert total.update(5.0, "one") == 105.0
    assert total.update(7.0, "one") == 107.0
    assert total.update(2.0, "two") == 109.0
    assert total.update(1.0, "two") == 110.0


async def test_estimated_energy_goes_on_after_a_restart(hass: HomeAssistant) -> None:
    mock_restore_cache_with_extra_data(
        hass,
        [
            (
                State("sensor.charger_1_estimated_energy", "12.5"),
                {"native_value": 12500.0, "native_unit_of_measurement": "Wh"},
            )
        ],
    )
    car = Car(reaction=0.0, ramp=0.1)
    async with running(hass, AblBox(1, car=car)) as (entry, _):
        energy = await get_entity(hass, "sensor", entry, "1_estimated_energy")
        assert float(hass.states.get(energy).state) == 12.5
        car.plug_in()
        await wait_for_state(hass, energy, lambda state: float(state.state) > 12.5)


async def test_a_meter_exchanged_during_a_restart_is_no_consumption(
    hass: HomeAssistant,
) -> None:
    mock_restore_cache_with_extra_data(
        hass,
        [
            (
                State(
                    "sensor.charger_1923054_energy",
                    "10.0",
                    last_updated=dt_util.utcnow() - timedelta(minutes=5),
                ),
                {
                    "native_value": 10000.0,
                    "native_unit_of_measurement": "Wh",
                    "offset": 4000.0,
                },
            )
        ],
    )
    box = EvboxChargePoint(1923054, [Module(energy_wh=750_000)], min_interval=0)
    async with running(hass, box, poll_interval=0.2) as (entry, _):
        energy = await get_entity(hass, "sensor", entry, "1_energy")
        state = await wait_for_state(hass, energy, lambda _: True)
        assert float(state.state) == 10.0


async def test_the_same_meter_after_a_restart(hass: HomeAssistant) -> None:
    mock_restore_cache_with_extra_data(
        hass,
        [
            (
                State("sensor.charger_1923054_energy", "10.0"),
                {
                    "native_value": 10000.0,
                    "native_unit_of_measurement": "Wh",
                    "offset": 4000.0,
                },
            )
        ],
    )
    box = EvboxChargePoint(1923054, [Module(energy_wh=6001)], min_interval=0)
    async with running(hass, box, poll_interval=0.2) as (entry, _):
        energy = await get_entity(hass, "sensor", entry, "1_energy")
        state = await wait_for_state(hass, energy, lambda _: True)
        assert float(state.state) == 10.001
