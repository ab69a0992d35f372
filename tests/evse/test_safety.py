"""From a wish to a set-point: what may never come out, whatever goes in."""

import ast
from dataclasses import replace
from decimal import Decimal
from math import inf, nan
from pathlib import Path

from hypothesis import assume, given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import RefusedOrderError
from custom_components.evse_bus.evse.model import (
    MINIMUM_CURRENT,
    UNKNOWN_PHASES,
    CurrentLimit,
    Limits,
    OrderChange,
    Orders,
    PauseReason,
)
from custom_components.evse_bus.evse.safety import (
    MAXIMUM_TIMEOUT,
    cautious,
    check_change,
    clamp,
    expired,
    number,
    pause_reason,
    round_down,
)

EVSE = Path(__file__).parents[2] / "custom_components/evse_bus/evse"

amperes = st.floats(0, 10_000, allow_nan=False)
maybe_amperes = st.none() | amperes
phases = st.tuples(maybe_amperes, maybe_amperes, maybe_amperes)
wishes = st.builds(CurrentLimit, current=amperes, phases=phases)
orders = st.builds(
    Orders,
    limit=wishes,
    allowed=st.none() | st.booleans(),
    fail_safe=wishes,
    fail_safe_timeout=st.integers(0, 100_000),
)
limits = st.builds(
    Limits,
    installation=st.floats(0, 80),
    reports_maximum=st.booleans(),
    reported=st.none() | st.floats(0, 80),
    minimum=st.floats(6, 32),
    step=st.sampled_from((0.1, 0.5, 1.0)),
    phases_alone=st.booleans(),
)
changes = st.builds(
    OrderChange,
    allowed=st.none() | st.booleans(),
    current=maybe_amperes,
    phases=phases,
    fail_safe_current=maybe_amperes,
    fail_safe_phases=phases,
    fail_safe_timeout=st.none() | st.integers(1, MAXIMUM_TIMEOUT),
)
odd_numbers = st.sampled_from(
    (nan, inf, -inf, -1, -0.001, "16", "nan", None, True, False, Decimal("NaN"), b"1")
)


@given(orders, limits)
def test_no_value_above_the_ceiling_comes_out(orders: Orders, limits: Limits) -> None:
    setpoint = clamp(orders, limits)
    for value in (*setpoint.currents, *setpoint.fail_safe):
        assert 0 <= value <= limits.ceiling
        assert value <= limits.installation
        if limits.reported is not None:
            assert value <= limits.reported
        elif limits.reports_maximum:
            assert value <= MINIMUM_CURRENT


@given(orders, limits)
def test_a_setpoint_is_a_pause_or_at_least_the_minimum(
    orders: Orders, limits: Limits
) -> None:
    for value in clamp(orders, limits).currents:
        assert value == 0 or value >= limits.minimum


@given(orders, limits)
def test_no_value_is_above_the_wish_and_all_are_on_the_step(
    orders: Orders, limits: Limits
) -> None:
    setpoint = clamp(orders, limits)
    wishes = zip(orders.limit.effective(), setpoint.currents, strict=True)
    backs = zip(orders.fail_safe.effective(), setpoint.fail_safe, strict=True)
    for wish, value in (*wishes, *backs):
        assert value <= wish
        steps = Decimal(repr(value)) / Decimal(repr(limits.step))
        assert steps == steps.to_integral_value()


@given(orders, limits, st.lists(changes))
def test_no_sequence_of_limits_starts_what_was_stopped(
    orders: Orders, limits: Limits, changes: list[OrderChange]
) -> None:
    standing = OrderChange(allowed=False).apply(orders)
    for change in changes:
        assume(change.allowed is None)
        standing = change.apply(standing)
        assert clamp(standing, limits).paused
        assert clamp(cautious(orders, standing), limits).paused
        assert clamp(expired(standing), limits).paused


@given(orders, changes, limits)
def test_what_is_stored_before_sending_is_below_both(
    old: Orders, change: OrderChange, limits: Limits
) -> None:
    new = change.apply(old)
    middle = clamp(cautious(old, new), limits)
    for other in (clamp(old, limits), clamp(new, limits)):
        for lower, higher in (
            *zip(middle.currents, other.currents, strict=True),
            *zip(middle.fail_safe, other.fail_safe, strict=True),
        ):
            assert lower <= higher


# -- What may be asked: the range is the installation's, and nothing else ---------


@given(limits, st.data())
def test_every_current_within_the_installation_limit_is_taken(
    limits: Limits, data: st.DataObject
) -> None:
    """Whatever charger and cable can do: a guard's request is never refused."""
    within = st.floats(0, limits.installation)
    current, one, two, three, back = (data.draw(within) for _ in range(5))
    taken = check_change(
        OrderChange(
            current=current,
            phases=(one, two, three),
            fail_safe_current=back,
            fail_safe_phases=(three, None, one),
        ),
        limits,
    )
    assert taken.current == round_down(current, limits.step)
    assert taken.phases == tuple(
        round_down(value, limits.step) for value in (one, two, three)
    )
    assert taken.fail_safe_current == round_down(back, limits.step)
    # No cable, no box and no minimum makes a difference.
    bare = Limits(installation=limits.installation, step=limits.step)
    assert check_change(OrderChange(current=current), bare).current == taken.current


@given(st.floats(6, 80), st.floats(0.001, 100))
def test_more_than_the_installation_limit_is_refused(
    installation: float, more: float
) -> None:
    limits = Limits(installation=installation)
    for change in (
        OrderChange(current=installation + more),
        OrderChange(phases=(None, installation + more, None)),
        OrderChange(fail_safe_current=installation + more),
    ):
        with pytest.raises(RefusedOrderError, match="above"):
            check_change(change, limits)


@given(orders, orders, limits)
def test_lower_orders_are_never_more_current(
    one: Orders, other: Orders, limits: Limits
) -> None:
    """A limit below the minimum, of one phase or of all, is no exception."""
    lowered = clamp(cautious(one, other), limits)
    for lower, higher in (
        *zip(lowered.currents, clamp(one, limits).currents, strict=True),
        *zip(lowered.fail_safe, clamp(one, limits).fail_safe, strict=True),
    ):
        assert lower <= higher


@given(orders, limits, st.floats(0, 80), st.floats(0, 80))
def test_what_carries_less_is_never_more_current(
    orders: Orders, limits: Limits, cable: float, minimum: float
) -> None:
    before = clamp(orders, limits).currents
    lower = replace(limits, reported=min(limits.ceiling, cable))
    needs_more = replace(limits, minimum=max(limits.minimum, minimum))
    for tighter in (lower, needs_more):
        after = clamp(orders, tighter).currents
        assert all(new <= old for new, old in zip(after, before, strict=True))


@given(orders, limits)
def test_one_phase_below_the_minimum_pauses_all(orders: Orders, limits: Limits) -> None:
    """Unless each phase stands alone: that one can be left out is in no manual."""
    one = clamp(orders, replace(limits, phases_alone=True))
    all_of_them = clamp(orders, replace(limits, phases_alone=False))
    assert all_of_them.currents == (
        one.currents if all(one.currents) else (0.0, 0.0, 0.0)
    )
    assert all_of_them.fail_safe == one.fail_safe


@given(orders, limits)
def test_a_pause_has_a_reason_and_nothing_else_has(
    orders: Orders, limits: Limits
) -> None:
    reason = pause_reason(orders, limits)
    assert (reason is not None) == clamp(orders, limits).paused
    assert (reason is PauseReason.NOT_ALLOWED) == (orders.allowed is False)
    if reason is PauseReason.LIMIT_TOO_LOW:
        high = replace(orders, limit=CurrentLimit(current=limits.installation))
        assert pause_reason(high, limits) is None
    if reason is PauseReason.MAXIMUM_TOO_LOW:
        assert round_down(limits.ceiling, limits.step) < limits.minimum


@pytest.mark.parametrize(
    ("limit", "minimum", "step", "currents"),
    [
        (CurrentLimit(current=0.0), 6.0, 0.1, (0.0, 0.0, 0.0)),
        (CurrentLimit(current=5.9), 6.0, 0.1, (0.0, 0.0, 0.0)),
        # A household socket: 16 A or nothing.
        (CurrentLimit(current=15.0), 16.0, 1.0, (0.0, 0.0, 0.0)),
        (CurrentLimit(current=16.0), 16.0, 1.0, (16.0, 16.0, 16.0)),
        # An EVBox whose modules need 14 A.
        (CurrentLimit(current=13.9), 14.0, 0.1, (0.0, 0.0, 0.0)),
        (
            CurrentLimit(current=16.0, phases=(None, 3.0, None)),
            6.0,
            0.1,
            (0.0, 0.0, 0.0),
        ),
        (
            CurrentLimit(current=16.0, phases=(None, 6.0, 8.0)),
            6.0,
            0.1,
            (16.0, 6.0, 8.0),
        ),
    ],
)
def test_a_limit_below_the_minimum_is_a_pause(
    limit: CurrentLimit, minimum: float, step: float, currents: tuple[float, ...]
) -> None:
    limits = Limits(installation=32.0, minimum=minimum, step=step)
    assert clamp(Orders(limit=limit), limits).currents == currents


@given(orders, limits)
def test_the_time_out_is_never_zero(orders: Orders, limits: Limits) -> None:
    assert 1 <= clamp(orders, limits).fail_safe_timeout <= MAXIMUM_TIMEOUT


@given(odd_numbers)
def test_what_is_no_number_is_refused(value: object) -> None:
    with pytest.raises(RefusedOrderError):
        number(value)


@given(odd_numbers.filter(lambda value: value is not None), st.integers(0, 7))
def test_no_odd_number_gets_through_in_any_place(value: float, place: int) -> None:
    limit = [16.0] * 4
    back = [6.0] * 4
    (limit if place < 4 else back)[place % 4] = value
    bad = Orders(
        limit=CurrentLimit(current=limit[0], phases=(limit[1], limit[2], limit[3])),
        fail_safe=CurrentLimit(current=back[0], phases=(back[1], back[2], back[3])),
        allowed=place % 2 == 0,
    )
    with pytest.raises(RefusedOrderError):
        clamp(bad, Limits(installation=16.0))
    with pytest.raises(RefusedOrderError):
        check_change(
            OrderChange(
                current=limit[0],
                phases=(limit[1], limit[2], limit[3]),
                fail_safe_current=back[0],
                fail_safe_phases=(back[1], back[2], back[3]),
            ),
            Limits(installation=16.0),
        )


@pytest.mark.parametrize(
    ("wish", "step", "result"),
    [
        (6.9, 1.0, 6.0),
        (6.9, 0.1, 6.9),
        (6.99, 0.1, 6.9),
        (16.0, 1.0, 16.0),
        (0.3, 0.1, 0.3),
        (15.999999999, 0.5, 15.5),
    ],
)
def test_values_are_rounded_down_to_the_step(
    wish: float, step: float, result: float
) -> None:
    assert round_down(wish, step) == result


@pytest.mark.parametrize("wish", [nan, inf, -inf, -6, 10_000, 32.1], ids=str)
def test_an_absurd_current_is_refused_with_a_reason(wish: float) -> None:
    with pytest.raises(RefusedOrderError, match=r"^current .*(finite|negative|above)"):
        check_change(OrderChange(current=wish), Limits(installation=32.0))


@pytest.mark.parametrize("wish", [0, 0.1, 5.9, 6, 6.9, 32])
def test_a_usable_current_is_taken(wish: float) -> None:
    change = check_change(OrderChange(current=wish), Limits(installation=32.0))
    assert change.current == wish


@pytest.mark.parametrize("seconds", [0, -1, 0.5, 65_536, nan])
def test_an_absurd_time_out_is_refused(seconds: int) -> None:
    with pytest.raises(RefusedOrderError, match="time-out"):
        check_change(OrderChange(fail_safe_timeout=seconds), Limits(installation=32.0))


def test_six_amperes_until_a_maximum_is_told() -> None:
    wish = Orders(
        limit=CurrentLimit(current=32.0), fail_safe=CurrentLimit(current=20.0)
    )
    before = clamp(wish, Limits(installation=32.0, reports_maximum=True))
    assert before.currents == before.fail_safe == (6.0, 6.0, 6.0)
    after = clamp(wish, Limits(installation=32.0, reports_maximum=True, reported=25.0))
    assert after.currents == (25.0, 25.0, 25.0)
    assert after.fail_safe == (20.0, 20.0, 20.0)


def test_a_phase_may_be_lower_than_the_total() -> None:
    wish = Orders(limit=CurrentLimit(current=16.0, phases=(10.0, None, 20.0)))
    setpoint = clamp(wish, Limits(installation=32.0))
    assert setpoint.currents == (10.0, 16.0, 16.0)
    assert setpoint.current == 10.0


def test_the_newer_change_wins_where_both_speak() -> None:
    older = OrderChange(current=10.0, phases=(8.0, None, None))
    newer = OrderChange(fail_safe_current=7.0, phases=(9.0, 12.0, None))
    assert older.merged_with(newer) == OrderChange(
        current=10.0, phases=(9.0, 12.0, None), fail_safe_current=7.0
    )
    assert OrderChange().phases == UNKNOWN_PHASES


def test_only_the_clamp_makes_a_setpoint() -> None:
    """An encoder takes a `Setpoint`; nobody else may make one."""
    makers = set()
    for path in EVSE.parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and "Setpoint" in ast.unparse(node.func):
                makers.add(path.relative_to(EVSE).as_posix())
            if isinstance(node, ast.Call) and "replace" in ast.unparse(node.func):
                assert "setpoint" not in ast.unparse(node).lower(), path
    assert makers == {"safety.py"}
