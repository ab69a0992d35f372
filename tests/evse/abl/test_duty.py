"""Current and duty cycle: never more than ordered."""

from decimal import Decimal

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.abl.duty import (
    PAUSE,
    current_for,
    duty_for,
    highest_current,
)
from custom_components.evse_bus.evse.errors import RefusedOrderError

_tenths = st.integers(60, 800).map(lambda tenths: tenths / 10)


@pytest.mark.parametrize(
    ("current", "duty"),
    [
        (0, 1000),
        (6, 100),
        (6.1, 101),
        (10, 166),  # manual, 1.3: 16.6 %
        (16, 0x10A),  # manual, 1.3: 26.6 %
        (20, 333),
        (32, 533),
        (50.9, 848),
        (51, 850),
        # The branches do not meet.
        (51.1, 850),
        (52.4, 850),
        (52.5, 850),
        (52.7, 850),
        (52.8, 851),
        (63, 892),
        (80, 960),
        (125, 960),
    ],
)
def test_duty_cycles(current: float, duty: int) -> None:
    assert duty_for(current) == duty


@pytest.mark.parametrize(
    ("duty", "current"),
    [
        (0, None),
        (50, None),
        (79, None),
        (80, 6),
        (100, 6),
        (101, 6.06),
        (166, 9.96),
        (266, 15.96),
        (850, 51),
        (851, 52.75),
        (960, 80),
        (970, 80),
        (971, None),
        (999, None),
        (1000, 0),
        (1001, None),
        (0xFFF, None),
    ],
)
def test_currents(duty: int, current: float | None) -> None:
    assert current_for(duty) == current


@pytest.mark.parametrize("current", [-1, 0.1, 5.99, float("nan")])
def test_a_current_without_a_duty_cycle_is_refused(current: float) -> None:
    with pytest.raises(RefusedOrderError):
        duty_for(current)


@given(_tenths)
def test_never_above_the_order_and_close_below(current: float) -> None:
    offered = current_for(duty_for(current))
    assert offered is not None
    assert 6 <= offered <= current
    # One step of 0.1 % is 0.06 A below 51 A, 0.25 A above; the gap between is 1.75 A.
    step = 0.06 if current <= 51 else 0.25 if current >= 52.75 else 1.75
    assert Decimal(repr(current)) - Decimal(repr(offered)) < Decimal(repr(step))


@given(st.floats(min_value=6, max_value=1e9))
def test_any_current_is_never_exceeded(current: float) -> None:
    offered = current_for(duty_for(current))
    assert offered is not None
    assert offered <= current
    assert 80 <= duty_for(current) <= 960


@given(_tenths, _tenths)
def test_a_higher_current_is_never_a_lower_duty_cycle(one: float, two: float) -> None:
    low, high = sorted((one, two))
    assert duty_for(low) <= duty_for(high)


@pytest.mark.parametrize(
    ("duty", "current"),
    [
        # Idefault as boxes of 6, 8, 16, 20, 32 and 80 A report it.
        (0x64, 6.0),
        (0x85, 8.0),
        (0x10A, 16.0),
        (0x10B, 16.0),
        (0x14D, 20.0),
        (0x215, 32.0),
        (960, 80.0),
        (970, 80.0),
        (99, None),
        (971, None),
        (PAUSE, None),
        (0, None),
    ],
)
def test_the_highest_current_within_a_duty_cycle(
    duty: int, current: float | None
) -> None:
    assert highest_current(duty) == current


@given(st.integers(100, 970))
def test_the_highest_current_is_never_above_its_duty_cycle(duty: int) -> None:
    highest = highest_current(duty)
    assert highest is not None
    assert duty_for(highest) <= duty
    if highest < 80:
        assert duty_for(round(highest + 0.1, 1)) > duty or 850 <= duty < 885
