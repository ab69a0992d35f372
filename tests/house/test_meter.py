"""Freshness, period, silence and the age of a meter's values."""

from math import inf, nan
from random import Random

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.house.meter import (
    AHEAD,
    DEAD,
    LONGEST_PERIOD,
    PERIODS,
    SILENCE,
    History,
    Rhythm,
    Silence,
)
from custom_components.evse_bus.house.readings import BatteryReport, GridReport
from custom_components.evse_bus.house.surplus import Surplus


def reporting(period: float, count: int = 20) -> Rhythm:
    """Return the rhythm of a sensor whose last report is at 0."""
    rhythm = Rhythm()
    for at in range(-count, 1):
        rhythm.take(at * period, at * period)
    return rhythm


@pytest.mark.parametrize("period", [1, 10, 30, 60, 100])
def test_the_period_is_learnt(period: float) -> None:
    assert reporting(period).period == period


@pytest.mark.parametrize(
    ("period", "patience"), [(1, 90), (30, 90), (60, 150), (100, 250), (900, 300)]
)
def test_silence_is_noticed(period: float, patience: float) -> None:
    rhythm = reporting(period)
    assert rhythm.silence(min(patience, period)) in {Silence.NONE, Silence.NEW}
    assert rhythm.silence(patience + 1) is Silence.SILENT
    assert rhythm.silence(DEAD + 1) is Silence.DEAD


def test_one_report_and_then_silence_is_never_a_value() -> None:
    rhythm = Rhythm()
    assert rhythm.silence(0) is Silence.NEW
    assert rhythm.take(5, 5) == 0
    assert rhythm.silence(6) is Silence.NEW
    assert rhythm.silence(5 + SILENCE + 1) is Silence.SILENT


def test_no_report_at_all_is_silence() -> None:
    rhythm = Rhythm()
    assert rhythm.silence(1000) is Silence.NEW
    assert rhythm.silence(1000 + SILENCE + 1) is Silence.SILENT
    assert rhythm.silence(1000 + DEAD + 1) is Silence.DEAD


def test_after_a_gap_nothing_counts_and_a_second_report_is_wanted() -> None:
    rhythm = reporting(10)
    assert rhythm.take(200, 200) == 0
    assert rhythm.silence(200) is Silence.NEW
    assert rhythm.take(210, 210) == 10
    assert rhythm.silence(210) is Silence.NONE


def test_a_late_report_counts_for_two_and_a_half_periods_at_most() -> None:
    rhythm = reporting(10)
    assert rhythm.take(80, 80) == PERIODS * 10


def test_a_report_of_the_future_is_none() -> None:
    rhythm = reporting(10)
    assert rhythm.take(1000, 10) is None
    assert rhythm.take(10 + AHEAD, 10) is not None


def test_reports_within_a_second_count_as_one() -> None:
    rhythm = reporting(10)
    assert rhythm.take(0.5, 0.5) is None


def test_a_clock_that_goes_back_makes_everything_unknown() -> None:
    rhythm = reporting(10)
    assert rhythm.silence(-5000) is Silence.NEW
    assert rhythm.take(-4999, -4999) == 0
    assert rhythm.silence(-4999) is Silence.NEW


def test_a_clock_that_goes_forward_is_silence() -> None:
    rhythm = reporting(10)
    assert rhythm.silence(86400) is Silence.DEAD
    assert rhythm.take(86401, 86401) == 0


@given(st.lists(st.tuples(st.floats(-1e4, 1e4), st.floats(-5, 50)), max_size=40))
def test_time_is_never_counted_twice(steps: list[tuple[float, float]]) -> None:
    """Whatever comes, no more time is counted than has passed, and none is negative."""
    rhythm = Rhythm()
    now = 0.0
    counted = first = 0.0
    for report, step in steps:
        now += max(step, 0.0)
        at = now + report
        first = min(first, at)
        elapsed = rhythm.take(at, now)
        assert elapsed is None or 0 <= elapsed <= PERIODS * LONGEST_PERIOD
        counted += elapsed or 0.0
    assert counted <= now + AHEAD - first


def test_a_history_between_two_measurements() -> None:
    history = History(100)
    assert history.at(5) == 0
    history.note(0, 1000)
    history.note(10, 2000)
    assert [history.at(when) for when in (-1, 0, 5, 10, 20)] == [
        1000,
        1000,
        1500,
        2000,
        2000,
    ]
    history.note(5, 9)
    assert history.at(5) == 1500
    for at in range(11, 1000):
        history.note(at, at % 7)
    assert len(history._times) < 200
    history.note(-500, 3)
    assert history.at(0) == 3


@pytest.mark.parametrize("bad", [nan, inf, -inf, 1e6, -1e6])
def test_an_impossible_power_is_no_report(bad: float) -> None:
    surplus = surplus_of(10, 0)
    before = surplus.power
    surplus.grid(GridReport(at=10, power=bad), 10)
    surplus.take_elapsed(10)
    assert surplus.power == before
    for at in range(20, 110, 10):
        surplus.grid(GridReport(at=at, power=bad), at)
    assert surplus.silence(110) is Silence.SILENT


def test_a_restored_state_is_no_report() -> None:
    surplus = Surplus(None)
    for at in range(5):
        surplus.grid(GridReport(at=at * 10, power=-5000, restored=True), at * 10)
    assert surplus.power is None
    assert surplus.silence(50) is Silence.NEW


def surplus_of(period: int, lag: int, *, swings: int = 60) -> Surplus:
    """Return what has seen a car change by 4 kW now and then; all ends at 0."""
    dice = Random(1)  # noqa: S311 - repeatable on purpose
    surplus = Surplus(None)
    car: dict[int, float] = {}
    power = 0.0
    for at in range(-100 * swings, 1):
        if dice.random() < 0.01 and at < -130:
            power = 4000.0 - power
            surplus.moved(at)
        car[at] = power
        if not at % 2:
            surplus.cars(at, power)
        if not at % period:
            grid = 300 + car.get(at - lag, 0.0)
            surplus.grid(GridReport(at=at, power=grid), at)
    surplus.take_elapsed(0)
    return surplus


@pytest.mark.parametrize("period", [1, 5, 10])
@pytest.mark.parametrize("lag", [0, 10, 20, 40, 60])
def test_the_age_of_the_values_is_learnt(period: int, lag: int) -> None:
    surplus = surplus_of(period, lag)
    assert abs(surplus.lag.seconds - lag) <= max(3, period // 2 + 1)
    if not lag:
        assert surplus.power == -300


def test_a_small_car_teaches_no_age() -> None:
    surplus = Surplus(None)
    for at in range(0, 5000, 2):
        power = 700.0 if at // 70 % 2 else 0.0
        surplus.cars(at, power)
        surplus.grid(GridReport(at=at, power=power), at)
    assert surplus.lag.seconds == 0


def test_a_report_waits_for_what_the_cars_took_at_its_time() -> None:
    """Else a change of the car between measurement and report looks like sun."""
    surplus = surplus_of(10, 0)
    steady = surplus.power
    assert steady == -300
    surplus.moved(4)
    surplus.grid(GridReport(at=10, power=4300), 10)
    assert surplus.take_elapsed(10) == 0
    surplus.cars(9, 4000)
    surplus.cars(11, 4000)
    assert surplus.take_elapsed(11) == 10
    assert surplus.power == -300
    surplus.moved(18)
    surplus.grid(GridReport(at=20, power=300), 20)
    assert surplus.take_elapsed(39) == 0
    assert surplus.take_elapsed(41) == 10


@pytest.mark.parametrize(
    ("priority", "charge", "power", "sun"),
    [
        (None, None, -2000, 1000),
        (80, 50.0, -2000, 1000),
        (80, 50.0, 500, 500),
        (80, 90.0, -2000, 3000),
        (80, None, -2000, 1000),
        (80, nan, -2000, 1000),
        (80, 250.0, -2000, 1000),
        (0, None, -2000, 3000),
        (0, None, 500, 500),
    ],
)
def test_the_battery(
    priority: float | None, charge: float | None, power: float, sun: float
) -> None:
    """Below its priority it keeps what it takes; what it gives is no sun."""
    surplus = Surplus(priority)
    for at in (0, 10):
        surplus.battery(BatteryReport(at=at, power=power, charge=charge), at)
        surplus.grid(GridReport(at=at, power=-1000), at)
    surplus.take_elapsed(40)
    assert surplus.power == sun
    assert surplus.silence(10) is Silence.NONE


def test_a_silent_battery_is_a_silent_meter() -> None:
    surplus = Surplus(80)
    for at in range(0, 200, 10):
        if at < 50:
            surplus.battery(BatteryReport(at=at, power=0), at)
        surplus.grid(GridReport(at=at, power=-1000), at)
    assert surplus.silence(200) is Silence.SILENT
    assert Surplus(None).silence(0) is Silence.NEW
