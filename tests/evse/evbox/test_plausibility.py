"""What cannot be is held back; what insists is the truth."""

from collections.abc import Callable
from dataclasses import replace

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import ImplausibleReplyError
from custom_components.evse_bus.evse.evbox.frames import ModuleReply, Reply
from custom_components.evse_bus.evse.evbox.plausibility import (
    LARGEST_CONNECTION,
    Confirmed,
    Plausibility,
    Taken,
    used_currents,
)

from .replies import module, reply

GOOD = reply(module(amperes=16.0), module(energy=7000))


class Judge(Plausibility):
    """Plausibility, with a reply every 5 s."""

    def __init__(self, *replies: Reply) -> None:
        super().__init__()
        self.now = 0.0
        for one in replies:
            self.hear(one)

    def hear(self, one: Reply) -> Taken:
        self.now += 5.0
        return self.take(one, self.now)

    def refuses(self, one: Reply) -> None:
        before = self.__dict__ | {"_held": None, "now": None}
        values = (self.maximum.value, self.interval.value, self.minimum.value)
        with pytest.raises(ImplausibleReplyError):
            self.hear(one)
        assert self.__dict__ | {"_held": None, "now": None} == before
        assert values == (self.maximum.value, self.interval.value, self.minimum.value)


def steady() -> Judge:
    return Judge(GOOD, GOOD)


def with_module(**values: object) -> Reply:
    changed: ModuleReply = replace(GOOD.modules[0], **values)  # type: ignore[arg-type]
    return replace(GOOD, modules=(changed, GOOD.modules[1]))


IMPLAUSIBLE = {
    "maximum of nothing": reply(module(), module(energy=7000), maximum=0.0),
    "maximum of a town": replace(GOOD, maximum_current=LARGEST_CONNECTION + 0.1),
    "interval of hours": replace(GOOD, minimum_interval=0x1234),
    "minimum above any pilot": with_module(minimum_current=80.1),
    "more than the connection": with_module(currents=(16.0, 39.6, 16.0)),
    "cos phi above 1": with_module(cos_phi=(1.0, 1.001, 1.0)),
    "cos phi below -1": with_module(cos_phi=(1.0, 1.0, -1.001)),
    "voltage between phases": with_module(voltages=(230, 400, 230)),
    "meter backwards": with_module(energy=999),
    "meter ahead of itself": with_module(energy=5096),
}


@pytest.mark.parametrize("odd", IMPLAUSIBLE.values(), ids=IMPLAUSIBLE)
def test_one_or_two_are_held_back_and_the_third_is_the_truth(odd: Reply) -> None:
    judge = steady()
    judge.refuses(odd)
    assert judge.held == 1
    assert judge.unsettled
    judge.refuses(odd)
    assert judge.hear(odd).reply is odd
    assert judge.held == 0
    # From now on it needs no more insistence.
    assert judge.hear(odd).reply is odd


@pytest.mark.parametrize("odd", IMPLAUSIBLE.values(), ids=IMPLAUSIBLE)
def test_a_good_reply_between_begins_the_count_anew(odd: Reply) -> None:
    judge = steady()
    for _ in range(5):
        judge.refuses(odd)
        judge.refuses(odd)
        judge.hear(GOOD)


def test_replies_that_contradict_each_other_are_never_the_truth() -> None:
    judge = steady()
    for _ in range(3):
        for odd in IMPLAUSIBLE.values():
            judge.refuses(odd)


@pytest.mark.parametrize(
    "vary",
    [
        lambda n: with_module(cos_phi=(1.0 + 0.5 * (n + 1), 1.0, 1.0)),
        lambda n: with_module(voltages=(310 + 100 * n, 230, 230)),
        lambda n: with_module(energy=100_000 - n),
        lambda n: with_module(energy=100_000 + 5000 * n),
        lambda n: replace(GOOD, minimum_interval=1000 + n),
        lambda n: replace(GOOD, maximum_current=2000.0 + n),
        lambda n: with_module(minimum_current=90.0 + n),
        lambda n: with_module(currents=(100.0 * 4**n, 0.0, 0.0)),
        lambda n: replace(with_module(energy=1), serial=f"{n:08d}"),
    ],
)
def test_strange_in_the_same_place_and_not_agreeing(
    vary: Callable[[int], Reply],
) -> None:
    judge = steady()
    for number in range(6):
        judge.refuses(vary(number))


def test_an_over_current_is_told_apart_from_other_strange_values() -> None:
    judge = steady()
    over = with_module(currents=(50.0, 0.0, 0.0))
    judge.refuses(over)
    # A current moves while it is measured; a second phase may come and go.
    judge.refuses(with_module(currents=(55.0, 45.0, 0.0)))
    taken = judge.hear(over)
    assert taken.over_current
    assert not taken.strange
    assert not judge.hear(GOOD).over_current
    strange = with_module(cos_phi=(1.2, 1.0, 1.0))
    judge.refuses(strange)
    judge.refuses(strange)
    taken = judge.hear(strange)
    assert taken.strange
    assert not taken.over_current


def test_all_modules_together_are_held_against_the_connection() -> None:
    judge = steady()
    both = reply(module(amperes=20.0), module(amperes=20.0, energy=7000))
    assert used_currents(both) == (40.0, 40.0, 40.0)
    judge.refuses(both)


def test_a_meter_that_insists_is_another_meter() -> None:
    judge = steady()
    swapped = with_module(energy=90_000)
    judge.refuses(swapped)
    judge.refuses(swapped)
    taken = judge.hear(swapped)
    assert taken.totals == (90_000, 7000)
    assert taken.generations == (1, 0)
    assert not taken.strange


# -- The maximum of the connection ---------------------------------------------------


def test_the_maximum_counts_when_two_replies_agree() -> None:
    judge = Judge()
    assert judge.maximum.value == 6.0
    judge.hear(GOOD)
    assert judge.maximum.value == 6.0
    assert judge.unsettled
    judge.hear(GOOD)
    assert judge.maximum.value == 35.0


def test_a_raised_maximum_counts_as_far_as_two_replies_agree() -> None:
    judge = steady()
    judge.hear(replace(GOOD, maximum_current=350.0))
    assert judge.maximum.value == 35.0
    judge.hear(GOOD)
    assert judge.maximum.value == 35.0
    judge.hear(replace(GOOD, maximum_current=63.0))
    judge.hear(replace(GOOD, maximum_current=60.0))
    assert judge.maximum.value == 60.0


def test_a_lowered_maximum_counts_at_once() -> None:
    judge = steady()
    judge.hear(replace(GOOD, maximum_current=16.0))
    assert judge.maximum.value == 16.0
    first = Judge()
    first.hear(replace(GOOD, maximum_current=5.0, modules=()))
    assert first.maximum.value == 5.0


def test_the_same_for_the_interval_and_the_minimum() -> None:
    judge = Judge()
    assert (judge.interval.value, judge.minimum.value) == (20, 6.0)
    needs = reply(module(minimum=12.0), module(minimum=8.0))
    judge.hear(needs)
    assert (judge.interval.value, judge.minimum.value) == (1, 6.0)
    judge.hear(needs)
    assert judge.minimum.value == 8.0
    judge.hear(reply(module(minimum=4.0)))
    assert judge.minimum.value == 6.0


def test_after_an_absence_the_maximum_is_unknown_again() -> None:
    judge = steady()
    judge.forget()
    assert judge.maximum.value == 6.0
    assert judge.maximum.told is None
    judge.hear(replace(GOOD, maximum_current=63.0))
    assert judge.maximum.value == 6.0


@given(st.lists(st.floats(0.1, 1000.0)), st.floats(0.1, 1000.0))
def test_one_reply_alone_never_raises(told: list[float], lie: float) -> None:
    one, two = Confirmed(6.0), Confirmed(6.0)
    for value in told:
        one.tell(value)
        two.tell(value)
    before = one.value
    one.tell(lie)
    assert one.value <= before or one.value <= max([*told[-1:], 6.0])
    assert one.value <= lie
    # And what is told next is not raised by the lie before it.
    for value in told[:1]:
        one.tell(value)
        assert one.value <= value


# -- Whatever comes ------------------------------------------------------------------

currents = st.floats(0, 6553.5).map(lambda value: round(value, 1))
odd_modules = st.builds(
    module,
    amperes=currents,
    cos_phi=st.floats(-32, 32),
    energy=st.integers(0, 0xFFFFFFFF),
    minimum=currents,
    voltages=st.tuples(*3 * [st.integers(0, 0xFFFF).map(float)]),
)
odd_replies = st.builds(
    lambda modules, maximum, interval: reply(
        *modules, maximum=maximum, interval=interval
    ),
    st.lists(odd_modules, max_size=4),
    currents,
    st.integers(0, 0xFFFF),
)


@given(st.lists(odd_replies, max_size=12))
def test_what_is_taken_can_be_or_has_insisted(replies: list[Reply]) -> None:
    judge = Judge()
    held = 0
    for one in replies:
        highest = judge.maximum.value
        try:
            taken = judge.hear(one)
        except ImplausibleReplyError:
            held += 1
            assert judge.maximum.value == highest
            continue
        if taken.oddities:
            assert held >= 2
        else:
            assert 0 < one.maximum_current <= LARGEST_CONNECTION
            carried = max(highest, one.maximum_current) * 1.1 + 1
            assert max(used_currents(one)) <= carried
            for part in one.modules:
                assert all(abs(value) <= 1 for value in part.cos_phi)
                assert all(value <= 300 for value in part.voltages or ())
        held = 0


@given(st.lists(odd_replies, max_size=8))
def test_a_good_box_is_believed_again_whatever_came_before(
    replies: list[Reply],
) -> None:
    judge = Judge()
    for one in replies:
        try:
            judge.hear(one)
        except ImplausibleReplyError:
            continue
    for _ in range(5):
        try:
            taken = judge.hear(GOOD)
        except ImplausibleReplyError:
            continue
    assert taken.reply is GOOD
    assert judge.maximum.value == 35.0
    assert None not in taken.totals
