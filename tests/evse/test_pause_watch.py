"""When a car that charges against a pause is a fault."""

from hypothesis import given, strategies as st

from custom_components.evse_bus.evse.pause_watch import UNCONFIRMED, PauseWatch


def times(
    *readings: tuple[float, bool, bool, float | None],
) -> list[float]:
    """Return the times at which it was a fault."""
    watch = PauseWatch()
    return [
        now
        for now, ordered, shown, patience in readings
        if watch.charges(now, ordered=ordered, shown=shown, patience=patience)
    ]


def test_a_pause_that_is_shown_has_the_time_to_follow() -> None:
    assert times(*((t, True, True, 10) for t in range(13))) == [10, 11, 12]
    # So does one that was not ordered by us.
    assert times(*((t, False, True, 10) for t in range(13))) == [10, 11, 12]


def test_a_pause_that_is_not_shown_yet_has_more_time() -> None:
    assert times(*((t, True, False, 10) for t in range(32))) == [30, 31]
    # Once it is shown, the car gets its time.
    late = [(t, True, t >= 7, 10) for t in range(20)]
    assert times(*late) == [17, 18, 19]


def test_one_reading_that_does_not_show_it_does_not_start_anew() -> None:
    readings = [(t, True, t % 4 != 0, 10) for t in range(13)]
    assert times(*readings) == [11, 12]


def test_a_reading_without_current_starts_anew() -> None:
    readings = [(t, True, True, None if t == 5 else 10) for t in range(17)]
    assert times(*readings) == [16]


def test_without_a_pause_a_car_may_charge() -> None:
    assert times(*((t, False, False, 10) for t in range(100))) == []


@given(
    st.lists(
        st.tuples(
            st.floats(0.1, 20),
            st.booleans(),
            st.booleans(),
            st.sampled_from([None, 10.0, 30.0]),
        ),
        max_size=50,
    )
)
def test_never_sooner_than_its_patience_and_always_after_the_longest(
    steps: list[tuple[float, bool, bool, float | None]],
) -> None:
    watch = PauseWatch()
    now, since = 0.0, None
    for passed, ordered, shown, patience in steps:
        now += passed
        against = patience is not None and (ordered or shown)
        since = (now if since is None else since) if against else None
        fault = watch.charges(now, ordered=ordered, shown=shown, patience=patience)
        if since is None or now - since < (patience or 0.0):
            assert not fault
        elif now - since >= UNCONFIRMED:
            assert fault
