"""Two boxes with one address garble nearly all replies; a bad line garbles some."""

from custom_components.evse_bus.evse.collisions import (
    GARBLED,
    NO_GOOD_ONE,
    Collisions,
)


def test_before_any_good_reply_some_garbled_ones_are_enough() -> None:
    collisions = Collisions()
    assert [collisions.garbled(n) for n in range(GARBLED)] == [False, False, True]


def test_after_a_good_reply_they_must_last() -> None:
    collisions = Collisions()
    collisions.good(100.0)
    assert not any(collisions.garbled(100.0 + n) for n in range(10))
    assert collisions.garbled(100.0 + NO_GOOD_ONE)
    collisions.good(140.0)
    assert not collisions.garbled(141.0)


def test_one_garbled_reply_after_a_long_time_is_no_evidence() -> None:
    collisions = Collisions()
    collisions.good(100.0)
    assert not collisions.garbled(1000.0)
