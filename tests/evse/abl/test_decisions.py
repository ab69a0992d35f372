"""The decision table of docs/abl.md, row by row, and when an order may be written."""

from dataclasses import replace
from math import inf

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.abl.decisions import (
    Decision,
    Evidence,
    Standing,
    Writes,
    decide,
    is_taken,
)
from custom_components.evse_bus.evse.model import OrderState

PAUSE = 0x3E8
A1, B1, B2, C2, C3, C4, E0, E1, E2, E3, F4 = (
    0xA1,
    0xB1,
    0xB2,
    0xC2,
    0xC3,
    0xC4,
    0xE0,
    0xE1,
    0xE2,
    0xE3,
    0xF4,
)
IDLE = (A1, B1, B2, E0)
LIMIT, LOWER, HIGHER, DEFAULT = 166, 100, 216, 0x10B

CONFIRMED = OrderState.CONFIRMED
NOT_READ_BACK = OrderState.NOT_READ_BACK
NOT_TAKEN = OrderState.NOT_TAKEN


def reports(
    icmax: int | None, ic: int = DEFAULT, state: int = B2, **seen: float | None
) -> Evidence:
    return Evidence(state=state, ic=ic, reports_icmax=True, icmax=icmax, **seen)  # type: ignore[arg-type]


def silent(ic: int, state: int = B2, **seen: float | None) -> Evidence:
    return Evidence(state=state, ic=ic, reports_icmax=False, **seen)


def limit(**standing: float | bool | None) -> Standing:
    return Standing(code=LIMIT, **standing)


def pause(**standing: float | bool | None) -> Standing:
    return Standing(code=PAUSE, **standing)


def summary(decision: Decision) -> tuple[OrderState | None, bool | None, bool]:
    return decision.state, decision.paused, decision.write


@pytest.mark.parametrize("state", [E1, E2, E3, F4, 0xFB, 0xF0])
@pytest.mark.parametrize("order", [limit(), pause(), limit(raised=True)])
@pytest.mark.parametrize("seen", [reports(PAUSE), reports(DEFAULT), silent(DEFAULT)])
def test_row_16_nothing_is_written_in_set_up_and_failure(
    state: int, order: Standing, seen: Evidence
) -> None:
    assert summary(decide(replace(seen, state=state), order)) == (None, None, False)


@pytest.mark.parametrize("state", [*IDLE, C2, 0xA0])
def test_row_14_a_pause_in_ic_is_a_pause(state: int) -> None:
    for seen in (silent(PAUSE, state), reports(None, PAUSE, state)):
        assert summary(decide(seen, pause())) == (CONFIRMED, True, False)
        assert summary(decide(seen, limit(raised=True))) == (
            OrderState.PAUSED_ELSEWHERE,
            True,
            False,
        )


@pytest.mark.parametrize("state", IDLE)
@pytest.mark.parametrize("ic", [DEFAULT, LOWER, 0])
def test_row_1_word_3_tells_a_pause_whatever_ic_shows(state: int, ic: int) -> None:
    seen = reports(PAUSE, ic, state)
    ours = decide(seen, pause())
    assert summary(ours) == (CONFIRMED, True, False)
    assert ours.offered == PAUSE
    for order in (limit(), limit(raised=True), limit(allowed=True, confirmed=True)):
        assert summary(decide(seen, order)) == (
            OrderState.PAUSED_ELSEWHERE,
            True,
            False,
        )


@pytest.mark.parametrize("state", [C2, C3, C4, 0xA0, 0xD1])
@pytest.mark.parametrize(
    ("order", "charging", "write"),
    [
        # Written just now: the car has 10 s.
        (pause(acknowledged=2), 60, False),
        (pause(acknowledged=9), 60, False),
        (pause(acknowledged=10), 60, True),
        # It came to C after the write, or nothing was written since connecting.
        (pause(acknowledged=100), 0, True),
        (pause(), 0, True),
    ],
)
def test_row_2_a_car_that_is_not_off_yet(
    state: int,
    order: Standing,
    charging: float,
    write: bool,  # noqa: FBT001
) -> None:
    seen = reports(PAUSE, state=state, charging_for=charging)
    decision = decide(seen, order)
    assert summary(decision) == (CONFIRMED, True, write)
    too_long = decide(seen, replace(order, charges=True))
    assert summary(too_long) == (NOT_TAKEN, True, write)
    # The box has taken it: the car is the problem.
    assert not too_long.ignored
    # Nor is a pause by another ended, or repeated.
    assert not decide(seen, limit()).write


@pytest.mark.parametrize("state", [*IDLE, C2])
@pytest.mark.parametrize(
    ("ic", "offered"), [(LIMIT, LIMIT), (LOWER, LOWER), (DEFAULT, DEFAULT)]
)
def test_rows_3_and_7_word_3_is_the_order(state: int, ic: int, offered: int) -> None:
    decision = decide(reports(LIMIT, ic, state), limit())
    assert summary(decision) == (CONFIRMED, False, False)
    assert decision.offered == offered


@pytest.mark.parametrize("state", [*IDLE, C2])
def test_row_4_a_lower_limit_is_raised_once_if_ordered(state: int) -> None:
    seen = reports(LOWER, LOWER, state)
    decision = decide(seen, limit())
    assert summary(decision) == (OrderState.LOWER_THAN_ORDERED, False, False)
    assert decision.offered == LOWER
    assert decide(seen, limit(raised=True)).write is (state != E0)


@pytest.mark.parametrize("state", [*IDLE, C2, 0xA0])
@pytest.mark.parametrize("icmax", [HIGHER, DEFAULT, 1, 0x4F, 0x3CB, 0x3E7, 0x3E9])
def test_row_5_a_lost_limit_is_written(state: int, icmax: int) -> None:
    decision = decide(reports(icmax, state=state), limit())
    assert (decision.state, decision.write) == (NOT_READ_BACK, True)
    failed = decide(reports(icmax, state=state), limit(failed=True))
    assert (failed.state, failed.write, failed.ignored) == (NOT_TAKEN, True, True)


@pytest.mark.parametrize("state", [*IDLE, C2])
@pytest.mark.parametrize("icmax", [LOWER, LIMIT, DEFAULT, 50])
def test_row_5_a_lost_pause_is_written(state: int, icmax: int) -> None:
    assert decide(reports(icmax, state=state), pause()).write


@pytest.mark.parametrize(
    ("state", "charging", "acknowledged", "current", "write"),
    [
        (C2, 10, 10, None, True),
        (C2, 10, None, None, True),
        (C2, 10, 10, 11.1, True),
        (C2, 10, 10, 10.9, False),
        # In the time to follow.
        (C2, 9, 20, None, False),
        (C2, 60, 9, 15.0, False),
        (B2, 0, 20, None, False),
    ],
)
def test_row_6_register_against_register(
    state: int,
    charging: float,
    acknowledged: float | None,
    current: float | None,
    write: bool,  # noqa: FBT001
) -> None:
    seen = reports(LIMIT, state=state, charging_for=charging, current=current)
    decision = decide(seen, limit(acknowledged=acknowledged))
    assert decision.write is write
    assert decision.offered == DEFAULT


@pytest.mark.parametrize("state", [*IDLE, C2])
@pytest.mark.parametrize("ic", [LIMIT, LOWER])
def test_row_8_ic_confirms_a_limit(state: int, ic: int) -> None:
    decision = decide(silent(ic, state), limit(allowed=True))
    assert summary(decision) == (CONFIRMED, False, False)
    assert decision.offered == ic
    # Unless the user has allowed charging, it may be paused all the same.
    assert decide(silent(ic, state), limit()).paused is (False if state == C2 else None)
    # A raise ordered meanwhile goes out where it cannot end a pause.
    raised = decide(silent(ic, state), limit(raised=True))
    assert raised.write is (state == C2 and ic < LIMIT)


@pytest.mark.parametrize("state", [C2, C3, C4, 0xA0])
def test_row_9_a_limit_is_lost_in_c(state: int) -> None:
    for order in (limit(), limit(confirmed=True), limit(allowed=True)):
        decision = decide(silent(DEFAULT, state), order)
        assert summary(decision) == (NOT_READ_BACK, False, True)
    unknown = Evidence(state=state, ic=DEFAULT, reports_icmax=None)
    assert decide(unknown, limit()).write
    assert decide(reports(None, state=state), limit()).write


@pytest.mark.parametrize("state", IDLE)
def test_row_10_after_a_missed_answer_it_was_a_power_cut(state: int) -> None:
    confirmed = limit(confirmed=True, missed=True)
    assert decide(silent(DEFAULT, state), confirmed).write
    held = decide(silent(DEFAULT, state), limit(confirmed=True))
    assert summary(held) == (NOT_READ_BACK, None, False)


@pytest.mark.parametrize("state", IDLE)
def test_row_11_nothing_known_is_left_alone(state: int) -> None:
    for order in (limit(), limit(missed=True), limit(raised=True)):
        decision = decide(silent(DEFAULT, state), order)
        assert summary(decision) == (NOT_READ_BACK, None, False)


@pytest.mark.parametrize("state", IDLE)
@pytest.mark.parametrize(
    ("order", "paused", "write"),
    [
        (pause(acknowledged=5), True, False),
        (pause(acknowledged=60), True, True),
        (pause(acknowledged=5, state_changed=True), True, True),
        (pause(), None, True),
    ],
)
def test_row_12_a_pause_that_is_not_read_back(
    state: int,
    order: Standing,
    paused: bool | None,  # noqa: FBT001
    write: bool,  # noqa: FBT001
) -> None:
    for ic in (DEFAULT, LOWER):
        decision = decide(silent(ic, state), order)
        assert summary(decision) == (NOT_READ_BACK, paused, write)
    # A box that reports Icmax is read first.
    assert not decide(reports(None, state=state), order).write


@pytest.mark.parametrize(
    ("order", "charging", "write", "state", "ignored"),
    [
        (pause(acknowledged=9), 60, False, NOT_READ_BACK, False),
        (pause(acknowledged=10), 60, True, NOT_READ_BACK, False),
        (pause(acknowledged=60), 1, True, NOT_READ_BACK, False),
        (pause(), 60, True, NOT_READ_BACK, False),
        # Acknowledged, the box has taken it: the car is the problem.
        (pause(acknowledged=2, charges=True), 60, False, NOT_TAKEN, False),
        (pause(acknowledged=2, failed=True), 60, False, NOT_TAKEN, False),
        (pause(failed=True), 60, True, NOT_TAKEN, True),
    ],
)
def test_row_13_a_pause_not_followed_yet(
    order: Standing,
    charging: float,
    write: bool,  # noqa: FBT001
    state: OrderState,
    ignored: bool,  # noqa: FBT001
) -> None:
    for seen in (silent(DEFAULT, C2), reports(None, state=C2)):
        decision = decide(replace(seen, charging_for=charging), order)
        assert (decision.write, decision.ignored) == (write, ignored)
        assert decision.state is state


@pytest.mark.parametrize("state", IDLE)
def test_an_icmax_that_is_not_known_now_holds(state: int) -> None:
    for seen in (reports(None, state=state), reports(0, state=state)):
        for order in (limit(confirmed=True, missed=True), limit(raised=True)):
            assert not decide(seen, order).write


@pytest.mark.parametrize("state", [*IDLE, C2])
@pytest.mark.parametrize("ic", [DEFAULT, LIMIT, LOWER])
def test_a_limit_ends_the_pause_of_our_limit_alone(state: int, ic: int) -> None:
    for seen in (reports(PAUSE, ic, state), silent(ic, state)):
        assert decide(seen, limit(raised=True, ends_pause=True)).write
    # That the order before was a pause does not prove whose pause stands.
    assert not decide(reports(PAUSE, ic, state), limit(after_pause=True)).write
    order = limit(after_pause=True, raised=True, confirmed=True, missed=True)
    if state != C2:
        decision = decide(silent(ic, state), order)
        assert summary(decision) == (NOT_READ_BACK, None, False)


@pytest.mark.parametrize("state", [*IDLE, C2])
def test_a_pause_is_repeated_after_a_limit_that_may_still_take_effect(
    state: int,
) -> None:
    order = pause(acknowledged=1)
    seen = reports(PAUSE, state=state, charging_for=60.0)
    assert not decide(seen, order).write
    assert decide(seen, replace(order, unsettled=True)).write


@pytest.mark.parametrize(
    ("seen", "order", "taken", "at_last", "as_start"),
    [
        # A pause that is read back is below any limit, but no start.
        (reports(PAUSE), pause(), True, True, True),
        (reports(PAUSE), limit(), True, True, False),
        (silent(PAUSE), limit(), True, True, False),
        (reports(LIMIT), limit(), True, True, True),
        (reports(HIGHER), limit(), False, False, False),
        # A raise is waited for.
        (reports(LOWER), limit(), False, True, False),
        (reports(LIMIT), pause(), False, False, False),
        (reports(None), limit(acknowledged=0), False, False, False),
        # By Ic alone, and only after an acknowledged write.
        (silent(LIMIT), limit(acknowledged=0), True, True, True),
        (silent(LOWER), limit(acknowledged=0), True, True, True),
        (silent(LIMIT), limit(), False, False, False),
        (silent(DEFAULT), limit(acknowledged=0), False, False, False),
        (silent(0), limit(acknowledged=0), False, False, False),
        (silent(DEFAULT), pause(acknowledged=0), True, True, True),
        (silent(DEFAULT, C2), pause(acknowledged=0), False, False, False),
        (
            Evidence(state=B2, ic=LIMIT, reports_icmax=None),
            limit(acknowledged=0),
            False,
            False,
            False,
        ),
    ],
)
def test_what_confirms_a_write(
    seen: Evidence,
    order: Standing,
    taken: bool,  # noqa: FBT001
    at_last: bool,  # noqa: FBT001
    as_start: bool,  # noqa: FBT001
) -> None:
    assert is_taken(seen, order, starts=False, is_last=False) is taken
    assert is_taken(seen, order, starts=False, is_last=True) is at_last
    assert is_taken(seen, order, starts=True, is_last=False) is as_start


_evidence = st.builds(
    Evidence,
    state=st.integers(0, 0xFF),
    ic=st.integers(0, 0xFFF),
    reports_icmax=st.sampled_from([None, False, True]),
    icmax=st.none() | st.just(PAUSE) | st.integers(0, 0xFFF),
    current=st.none() | st.floats(0, 80),
    charging_for=st.floats(0, 100),
)
_standing = st.builds(
    Standing,
    code=st.just(PAUSE) | st.integers(100, 970),
    acknowledged=st.none() | st.floats(0, 100),
    state_changed=st.booleans(),
    unsettled=st.booleans(),
    raised=st.booleans(),
    after_pause=st.booleans(),
    confirmed=st.booleans(),
    missed=st.booleans(),
    allowed=st.booleans(),
    failed=st.booleans(),
    charges=st.booleans(),
)


@given(_evidence, _standing)
def test_a_pause_of_another_is_never_ended(seen: Evidence, order: Standing) -> None:
    decision = decide(seen, order)
    if order.code != PAUSE and PAUSE in (seen.ic, seen.icmax):
        assert not decision.write
    if seen.state in (E1, E2, E3) or seen.state >= 0xF0:
        assert not decision.write


@given(_evidence, _standing)
def test_a_pause_of_ours_is_confirmed_by_a_register_alone(
    seen: Evidence, order: Standing
) -> None:
    if order.code == PAUSE and decide(seen, order).state is CONFIRMED:
        assert PAUSE in (seen.ic, seen.icmax)


# -- When it is written ----------------------------------------------------------------


def test_writes_at_0_3_8_s_then_ever_more_rarely() -> None:
    writes = Writes()
    times = []
    now = 0.0
    while now < 300:
        if writes.due(LIMIT) <= now:
            writes.wrote(LIMIT, now)
            writes.acknowledge(now)
            times.append(now)
        now += 0.5
    assert times == [0, 3, 8, 18, 48, 108, 168, 228, 288]
    assert writes.failed(LIMIT, 300)


def test_three_writes_have_15_s_to_be_followed() -> None:
    writes = Writes()
    for now in (0.0, 3.0, 8.0):
        assert not writes.failed(LIMIT, now + 2)
        writes.wrote(LIMIT, now)
    assert not writes.failed(LIMIT, 14.9)
    assert writes.failed(LIMIT, 15.0)
    assert not writes.failed(PAUSE, 15.0)


def test_another_order_is_written_at_once() -> None:
    writes = Writes()
    writes.wrote(LIMIT, 0.0)
    writes.acknowledge(0.0)
    assert writes.due(PAUSE) == -inf
    writes.wrote(PAUSE, 0.1)
    assert writes.acknowledged is None
    assert writes.settled(PAUSE, 0.2)
    assert not writes.settled(LIMIT, 0.2)
    assert writes.settled(LIMIT, 15.1)


def test_two_writes_without_a_reply_are_repeated_at_once() -> None:
    writes = Writes()
    for due in (-inf, -inf, 12.0):
        writes.wrote(LIMIT, 2.0)
        writes.unanswered()
        assert writes.due(LIMIT) == due


@given(
    st.lists(
        st.tuples(st.floats(0, 5), st.booleans()),
        min_size=1,
        max_size=200,
    )
)
def test_writes_of_one_order_are_bounded(
    steps: list[tuple[float, bool]],
) -> None:
    """However often it is tried and answered: at most ten a minute."""
    writes = Writes()
    now, times = 0.0, [-inf]
    for passed, answered in steps:
        now += passed
        if writes.due(LIMIT) <= now:
            writes.wrote(LIMIT, now)
            times.append(now)
            if answered:
                writes.acknowledge(now)
            else:
                writes.unanswered()
    for begin in times:
        assert sum(begin <= time < begin + 60 for time in times) <= 10
