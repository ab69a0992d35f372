"""Who speaks next: the rules one by one, and for any set of slots."""

from math import inf

from hypothesis import given, strategies as st

from custom_components.evse_bus.evse.schedule import Kind, Slot, Turns, choose

times = st.floats(0, 100)
slots = st.builds(
    Slot,
    kind=st.sampled_from(Kind),
    ready=times,
    due=times,
    start_by=st.just(inf) | times,
    worst_case=st.floats(0.001, 2),
    usual=st.none() | st.floats(0.001, 2),
    served=st.just(-inf) | times,
    turn_at=st.just(-inf) | times,
)
turns = st.builds(Turns, probe=st.just(-inf) | times, extra=st.just(-inf) | times)


@given(st.lists(slots), times, turns)
def test_someone_speaks_or_there_is_a_time_to_look_again(
    waiting: list[Slot], now: float, last: Turns
) -> None:
    choice = choose(waiting, now, last)
    if choice.slot is None:
        assert choice.wake_at > now
        # Silence while somebody waits is kept only for a deadline still to come.
        if any(slot.ready <= now for slot in waiting):
            assert any(slot.ready > now and slot.start_by < inf for slot in waiting)
    else:
        assert choice.slot.ready <= now


@given(st.lists(slots), times, turns)
def test_nothing_is_started_that_would_make_a_deadline_late(
    waiting: list[Slot], now: float, last: Turns
) -> None:
    choice = choose(waiting, now, last)
    if choice.slot is None or choice.for_deadline or choice.is_extra:
        return
    end = now + choice.slot.worst_case
    for other in waiting:
        if other is not choice.slot and now <= other.start_by < inf:
            assert end <= max(other.start_by, other.ready)


@given(st.lists(slots, min_size=1), times)
def test_a_pause_waits_only_for_a_deadline(waiting: list[Slot], now: float) -> None:
    for slot in waiting:
        slot.start_by = inf
    waiting.append(Slot(kind=Kind.PAUSE, ready=now, due=now, worst_case=1.0))
    choice = choose(waiting, now, Turns())
    assert choice.slot is not None
    assert choice.slot.kind is Kind.PAUSE


def test_the_order_of_kinds_and_of_age() -> None:
    late, early = (Slot(kind=Kind.POLL, due=due) for due in (2.0, 1.0))
    probe = Slot(kind=Kind.PROBE, due=1.5)
    command = Slot(kind=Kind.COMMAND, due=3.0)
    pause = Slot(kind=Kind.PAUSE, due=4.0)
    waiting = [late, probe, command, early, pause]
    order = []
    while waiting:
        slot = choose(waiting, 10.0, Turns(probe=inf)).slot
        assert slot is not None
        order.append(slot)
        waiting.remove(slot)
    assert order == [pause, command, early, late, probe]


def test_a_probe_gets_in_after_a_round_of_the_living() -> None:
    served = Slot(kind=Kind.POLL, due=9.0, served=8.0)
    probe = Slot(kind=Kind.PROBE, due=1.0)
    assert choose([served, probe], 10.0, Turns(probe=5.0)).slot is probe
    unserved = Slot(kind=Kind.POLL, due=9.5, served=4.0)
    assert choose([served, probe, unserved], 10.0, Turns(probe=5.0)).slot is served


def test_a_deadline_is_served_early_when_nothing_else_fits() -> None:
    deadline = Slot(kind=Kind.POLL, due=9.0, start_by=10.5, worst_case=0.2)
    long = Slot(kind=Kind.COMMAND, worst_case=1.0)
    assert choose([long, deadline], 10.0, Turns()).slot is deadline
    deadline.start_by = 20.0
    assert choose([long, deadline], 10.0, Turns()).slot is long


def test_two_deadlines_that_only_fit_one_after_the_other() -> None:
    first = Slot(kind=Kind.POLL, due=1.0, start_by=10.5, worst_case=1.0)
    second = Slot(kind=Kind.POLL, due=0.5, start_by=11.2, worst_case=1.0)
    assert choose([first, second], 10.0, Turns()).slot is first


def test_a_late_deadline_does_not_hold_back_a_pause() -> None:
    late = Slot(kind=Kind.POLL, start_by=5.0, worst_case=1.0)
    pause = Slot(kind=Kind.PAUSE, worst_case=1.0)
    assert choose([late, pause], 10.0, Turns()).slot is pause


@given(st.lists(slots), times, turns)
def test_an_extra_turn_is_one_after_each_deadline(
    waiting: list[Slot], now: float, last: Turns
) -> None:
    choice = choose(waiting, now, last)
    if choice.slot is None or not choice.is_extra:
        return
    for other in waiting:
        if other.start_by < inf:
            assert other.turn_at >= max(choice.slot.due, last.extra)


def test_what_never_fits_is_let_in_once_a_round() -> None:
    deadline = Slot(kind=Kind.POLL, start_by=11.0, ready=10.5, worst_case=0.2)
    long = Slot(kind=Kind.COMMAND, due=9.0, worst_case=5.0)
    other = Slot(kind=Kind.COMMAND, due=9.1, worst_case=5.0)
    waiting = [deadline, long, other]
    assert choose(waiting, 10.0, Turns()).slot is None
    deadline.turn_at = 9.5
    assert choose(waiting, 10.0, Turns()).slot is long
    waiting.remove(long)
    assert choose(waiting, 10.0, Turns(extra=10.0)).slot is None
    deadline.turn_at = 10.6
    assert choose(waiting, 10.7, Turns(extra=10.0)).slot is other


def test_a_command_takes_the_turn_of_the_deadline_that_it_meets() -> None:
    first = Slot(kind=Kind.POLL, start_by=10.0, worst_case=1.0)
    second = Slot(kind=Kind.POLL, start_by=10.5, worst_case=1.0)
    third = Slot(kind=Kind.POLL, start_by=10.7, worst_case=1.0)
    command = Slot(kind=Kind.COMMAND, due=9.0, worst_case=1.0, meets=second)
    waiting = [first, second, third, command]
    assert choose(waiting, 9.9, Turns()).slot is first
    waiting.remove(first)
    choice = choose(waiting, 9.9, Turns())
    assert choice.slot is command
    assert choice.for_deadline
    # But not if it takes longer.
    command.worst_case = 2.0
    assert choose(waiting, 9.9, Turns()).slot is second


def test_the_turns_before_a_deadline_take_as_long_as_usual() -> None:
    deadlines = [
        Slot(kind=Kind.POLL, start_by=12.0, ready=11.0, worst_case=3.0, usual=0.3)
        for _ in range(3)
    ]
    command = Slot(kind=Kind.COMMAND, worst_case=1.0, usual=0.3)
    assert choose([command, *deadlines], 10.0, Turns()).slot is command
    command.worst_case = 1.5
    assert choose([command, *deadlines], 10.0, Turns()).slot is None
