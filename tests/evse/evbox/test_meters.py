"""No total is carried from one module to another."""

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.evbox.meters import SLACK, Meters, most_energy

CURRENT = 35.0


class Followed:
    """Meters, with a reply every 5 s."""

    def __init__(self) -> None:
        self.meters = Meters()
        self.now = 0.0

    def take(self, *totals: int) -> tuple[float | None, ...]:
        self.now += 5.0
        return self.meters.take(totals, self.now, CURRENT)

    def jumps(self, *totals: int) -> dict[int, float]:
        return self.meters.jumps(totals, self.now + 5.0, CURRENT)

    def generations(self, count: int) -> list[int]:
        return [self.meters.generation(index) for index in range(count)]


def settled(*totals: int) -> Followed:
    followed = Followed()
    followed.take(*totals)
    assert followed.take(*totals) == totals
    return followed


def test_a_total_is_shown_when_two_replies_agree() -> None:
    followed = Followed()
    assert followed.take(5000, 20) == (None, None)
    assert followed.meters.settling
    assert followed.take(5010, 20) == (5010, 20)
    assert not followed.meters.settling
    assert followed.generations(2) == [0, 0]


def test_a_first_total_that_is_not_confirmed_is_never_shown() -> None:
    followed = Followed()
    followed.take(900_000)
    assert followed.take(5000) == (None,)
    assert followed.take(5000) == (5000,)
    assert followed.generations(1) == [0]


def test_backwards_and_too_fast_are_jumps() -> None:
    followed = settled(5000, 7000)
    assert followed.jumps(5000, 7000) == {}
    assert followed.jumps(4999, 7000) == {0: 4999}
    most = int(most_energy(5.0, CURRENT))
    assert followed.jumps(5000, 7000 + most) == {}
    assert followed.jumps(5000, 7001 + most) == {1: 7001 + most}


def test_a_jump_that_is_the_truth_is_another_meter() -> None:
    followed = settled(5000, 7000)
    assert followed.take(5000, 90_000) == (5000, 90_000)
    assert followed.generations(2) == [0, 1]


def test_a_module_more_is_unknown_at_first_and_the_others_go_on() -> None:
    followed = settled(5000, 70_000)
    assert followed.take(5000, 70_000, 12) == (None, None, None)
    assert followed.take(5000, 70_001, 12) == (5000, 70_001, 12)
    assert followed.generations(3) == [0, 0, 0]


def test_a_module_less_moves_the_others_up() -> None:
    followed = settled(5000, 70_000, 900_000)
    assert followed.take(70_000, 900_000) == (None, None)
    assert followed.take(70_000, 900_000) == (70_000, 900_000)
    assert followed.generations(2) == [1, 1]


def test_a_number_that_comes_back_starts_anew() -> None:
    followed = settled(5000, 70_000)
    followed.take(5000)
    followed.take(5000)
    assert followed.generations(2) == [0, 0]
    followed.take(5000, 70_000)
    followed.take(5000, 70_000)
    assert followed.generations(2) == [0, 1]


def test_meters_near_each_other_are_not_told_apart() -> None:
    # The first is taken away: what is number 1 now could be either of them.
    followed = settled(1000, 1000 + SLACK // 2)
    followed.take(1000 + SLACK // 2)
    followed.take(1000 + SLACK // 2)
    assert followed.generations(1) == [1]


def test_one_reply_without_modules_changes_nothing_for_long() -> None:
    followed = settled(5000, 70_000)
    assert followed.take() == ()
    assert followed.take(5000, 70_000) == (None, None)
    assert followed.take(5000, 70_000) == (5000, 70_000)
    assert followed.generations(2) == [0, 0]


def test_after_an_absence_two_replies_are_needed_again() -> None:
    followed = settled(5000)
    followed.meters.unsettle()
    assert followed.take(5100) == (None,)
    assert followed.take(5100) == (5100,)
    assert followed.generations(1) == [0]


def test_another_box_after_an_absence_is_another_meter() -> None:
    followed = settled(5000)
    followed.meters.unsettle()
    followed.take(800_000)
    assert followed.take(800_000) == (800_000,)
    assert followed.generations(1) == [1]


@pytest.mark.parametrize("seconds", [-5.0, 0.0, 3600.0])
def test_the_most_a_meter_can_count(seconds: float) -> None:
    hours = max(seconds, 0.0) / 3600
    assert most_energy(seconds, 10.0) == pytest.approx(SLACK + 10 * 3 * 265 * hours)


totals = st.integers(0, 10_000_000)


@given(st.lists(st.lists(totals, max_size=4), max_size=12))
def test_a_shown_total_goes_on_from_the_one_before_or_is_another_generation(
    replies: list[list[int]],
) -> None:
    """Whatever comes, and although all of it is taken as the truth."""
    followed = Followed()
    shown: dict[tuple[int, int], tuple[float, float]] = {}
    for reply in replies:
        for index, total in enumerate(followed.take(*reply)):
            if total is None:
                continue
            key = (index, followed.meters.generation(index))
            if key in shown:
                before, when = shown[key]
                most = most_energy(followed.now - when, CURRENT)
                assert before <= total <= before + most
            shown[key] = (total, followed.now)
