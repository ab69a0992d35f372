"""No energy total is carried from one module to another."""

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.evbox.meters import Meters
from custom_components.evse_bus.evse.meter import SLACK, Total, most_energy

CURRENT = 35.0


class Receiver:
    """Meters with a reply every 5 s."""

    def __init__(self) -> None:
        self.meters = Meters()
        self.now = 0.0

    def update(self, *totals: int) -> tuple[float | None, ...]:
        self.now += 5.0
        return tuple(self.meters.update(self._at(totals), CURRENT))

    def thrice(self, *totals: int) -> tuple[float | None, ...]:
        """Return what is shown at last; nothing is before the third reply."""
        assert self.update(*totals) == (None,) * len(totals)
        assert self.update(*totals) == (None,) * len(totals)
        return self.update(*totals)

    def _at(self, totals: tuple[int, ...], later: float = 0.0) -> tuple[Total, ...]:
        return tuple(Total(total, self.now + later) for total in totals)

    def jumps(self, *totals: int) -> dict[int, float]:
        return self.meters.jumps(self._at(totals, 5.0), CURRENT)

    def generations(self, count: int) -> list[int]:
        return [self.meters.generation(index) for index in range(count)]


def settled(*totals: int) -> Receiver:
    receiver = Receiver()
    assert receiver.thrice(*totals) == totals
    return receiver


def test_a_total_is_shown_when_three_replies_agree() -> None:
    receiver = Receiver()
    assert receiver.update(5000, 20) == (None, None)
    assert receiver.update(5005, 20) == (None, None)
    assert receiver.meters.unconfirmed
    assert receiver.update(5010, 20) == (5010, 20)
    assert not receiver.meters.unconfirmed
    assert receiver.generations(2) == [0, 0]


def test_a_first_total_that_is_not_confirmed_is_never_shown() -> None:
    receiver = Receiver()
    receiver.update(900_000)
    receiver.update(900_000)
    assert receiver.thrice(5000) == (5000,)
    assert receiver.generations(1) == [0]


def test_a_fall_and_a_growth_too_fast_are_jumps() -> None:
    receiver = settled(5000, 7000)
    assert receiver.jumps(5000, 7000) == {}
    assert receiver.jumps(4999, 7000) == {0: 4999}
    most = int(most_energy(5.0, CURRENT))
    assert receiver.jumps(5000, 7000 + most) == {}
    assert receiver.jumps(5000, 7001 + most) == {1: 7001 + most}


def test_an_accepted_jump_is_another_meter() -> None:
    receiver = settled(5000, 7000)
    assert receiver.update(5000, 90_000) == (5000, 90_000)
    assert receiver.generations(2) == [0, 1]


def test_a_meter_that_is_back_at_its_former_total_resumes() -> None:
    receiver = settled(5000, 7000)
    receiver.update(0, 7000)
    assert receiver.generations(2) == [1, 0]
    receiver.update(5000, 7000)
    assert receiver.generations(2) == [0, 0]


def test_an_added_module_is_unknown_at_first_and_the_others_continue() -> None:
    receiver = settled(5000, 70_000)
    assert receiver.thrice(5000, 70_001, 12) == (5000, 70_001, 12)
    assert receiver.generations(3) == [0, 0, 0]


def test_a_removed_module_moves_the_others_up() -> None:
    receiver = settled(5000, 70_000, 900_000)
    assert receiver.thrice(70_000, 900_000) == (70_000, 900_000)
    assert receiver.generations(2) == [1, 1]


def test_an_index_that_comes_back_starts_a_new_generation() -> None:
    receiver = settled(5000, 70_000)
    receiver.thrice(5000)
    assert receiver.generations(2) == [0, 0]
    receiver.thrice(5000, 70_000)
    assert receiver.generations(2) == [0, 1]


def test_meters_of_similar_totals_are_ambiguous() -> None:
    # One is removed: module 1 could be either of them now.
    receiver = settled(1000, 1000 + SLACK // 2)
    receiver.thrice(1000 + SLACK // 2)
    assert receiver.generations(1) == [1]


def test_one_reply_without_modules_starts_no_generation() -> None:
    receiver = settled(5000, 70_000)
    assert receiver.update() == ()
    assert receiver.thrice(5000, 70_000) == (5000, 70_000)
    assert receiver.generations(2) == [0, 0]


def test_after_an_absence_three_replies_are_needed_again() -> None:
    receiver = settled(5000)
    receiver.meters.require_confirmation()
    assert receiver.thrice(5100) == (5100,)
    assert receiver.generations(1) == [0]


def test_another_box_after_an_absence_is_another_meter() -> None:
    receiver = settled(5000)
    receiver.meters.require_confirmation()
    assert receiver.thrice(800_000) == (800_000,)
    assert receiver.generations(1) == [1]


@pytest.mark.parametrize("seconds", [-5.0, 0.0, 3600.0])
def test_the_most_a_meter_can_count(seconds: float) -> None:
    hours = max(seconds, 0.0) / 3600
    assert most_energy(seconds, 10.0) == pytest.approx(SLACK + 10 * 3 * 265 * hours)


totals = st.integers(0, 10_000_000)


@given(st.lists(st.lists(totals, max_size=4), max_size=12))
def test_a_shown_total_continues_the_one_before_or_starts_a_generation(
    replies: list[list[int]],
) -> None:
    """For any totals, although all of them are accepted."""
    receiver = Receiver()
    shown: dict[tuple[int, int], tuple[float, float]] = {}
    for reply in replies:
        for index, total in enumerate(receiver.update(*reply)):
            if total is None:
                continue
            key = (index, receiver.meters.generation(index))
            if key in shown:
                before, when = shown[key]
                most = most_energy(receiver.now - when, CURRENT)
                assert before <= total <= before + most
            shown[key] = (total, receiver.now)
