"""Implausible replies are quarantined; consistent ones in a row are accepted."""

from collections.abc import Callable
from dataclasses import replace

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import ImplausibleReplyError
from custom_components.evse_bus.evse.evbox.frames import ModuleReply, Reply
from custom_components.evse_bus.evse.evbox.plausibility import (
    LARGEST_CONNECTION,
    AcceptedReply,
    ConfirmedValue,
    Plausibility,
    used_currents,
)

from .replies import module, reply

GOOD = reply(module(amperes=16.0), module(energy=7000))


class Receiver(Plausibility):
    """Plausibility with a reply every 5 s."""

    def __init__(self, *replies: Reply) -> None:
        super().__init__()
        self.now = 0.0
        for one in replies:
            self.receive(one)

    def receive(self, one: Reply) -> AcceptedReply:
        self.now += 5.0
        return self.accept(one, self.now)

    def assert_quarantined(self, one: Reply) -> None:
        before = self.__dict__ | {"_quarantine": None, "now": None}
        values = (self.maximum.value, self.interval.value, self.minimum.value)
        with pytest.raises(ImplausibleReplyError):
            self.receive(one)
        assert self.__dict__ | {"_quarantine": None, "now": None} == before
        assert values == (self.maximum.value, self.interval.value, self.minimum.value)


def steady() -> Receiver:
    return Receiver(GOOD, GOOD, GOOD)


def with_module(**values: object) -> Reply:
    changed: ModuleReply = replace(GOOD.modules[0], **values)  # type: ignore[arg-type]
    return replace(GOOD, modules=(changed, GOOD.modules[1]))


IMPLAUSIBLE = {
    "maximum 0": reply(module(), module(energy=7000), maximum=0.0),
    "maximum too large": replace(GOOD, maximum_current=LARGEST_CONNECTION + 0.1),
    "interval too long": replace(GOOD, minimum_interval=0x1234),
    "minimum too high": with_module(minimum_current=80.1),
    "current above the connection": with_module(currents=(16.0, 39.6, 16.0)),
    "cos phi above 1": with_module(cos_phi=(1.0, 1.001, 1.0)),
    "cos phi below -1": with_module(cos_phi=(1.0, 1.0, -1.001)),
    "voltage too high": with_module(voltages=(230, 400, 230)),
    "meter backwards": with_module(energy=999),
    "meter too fast": with_module(energy=5096),
}


@pytest.mark.parametrize("implausible", IMPLAUSIBLE.values(), ids=IMPLAUSIBLE)
def test_two_are_quarantined_and_the_third_is_accepted(implausible: Reply) -> None:
    receiver = steady()
    receiver.assert_quarantined(implausible)
    assert receiver.quarantined == 1
    assert receiver.unconfirmed
    receiver.assert_quarantined(implausible)
    assert receiver.receive(implausible).reply is implausible
    assert receiver.quarantined == 0
    # From now on one reply is enough.
    assert receiver.receive(implausible).reply is implausible


@pytest.mark.parametrize("implausible", IMPLAUSIBLE.values(), ids=IMPLAUSIBLE)
def test_a_plausible_reply_between_restarts_the_count(implausible: Reply) -> None:
    receiver = steady()
    for _ in range(5):
        receiver.assert_quarantined(implausible)
        receiver.assert_quarantined(implausible)
        receiver.receive(GOOD)


def test_inconsistent_replies_are_never_accepted() -> None:
    receiver = steady()
    for _ in range(3):
        for implausible in IMPLAUSIBLE.values():
            receiver.assert_quarantined(implausible)


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
def test_different_values_in_the_same_place_are_never_accepted(
    vary: Callable[[int], Reply],
) -> None:
    receiver = steady()
    for number in range(6):
        receiver.assert_quarantined(vary(number))


def test_an_over_current_is_no_value_out_of_range() -> None:
    receiver = steady()
    over = with_module(currents=(50.0, 0.0, 0.0))
    receiver.assert_quarantined(over)
    # A measured current varies; one common phase is enough.
    receiver.assert_quarantined(with_module(currents=(55.0, 45.0, 0.0)))
    taken = receiver.receive(over)
    assert taken.over_current
    assert not taken.out_of_range
    assert not receiver.receive(GOOD).over_current
    impossible = with_module(cos_phi=(1.2, 1.0, 1.0))
    receiver.assert_quarantined(impossible)
    receiver.assert_quarantined(impossible)
    taken = receiver.receive(impossible)
    assert taken.out_of_range
    assert not taken.over_current


def test_the_sum_of_all_modules_is_compared_with_the_connection() -> None:
    receiver = steady()
    both = reply(module(amperes=20.0), module(amperes=20.0, energy=7000))
    assert used_currents(both) == (40.0, 40.0, 40.0)
    receiver.assert_quarantined(both)


def test_a_confirmed_jump_is_another_meter() -> None:
    receiver = steady()
    swapped = with_module(energy=90_000)
    receiver.assert_quarantined(swapped)
    receiver.assert_quarantined(swapped)
    taken = receiver.receive(swapped)
    assert taken.totals == (90_000, 7000)
    assert taken.generations == (1, 0)
    assert not taken.out_of_range


# -- The maximum of the connection ---------------------------------------------------


def test_the_maximum_counts_when_two_replies_agree() -> None:
    receiver = Receiver()
    assert receiver.maximum.value == 6.0
    receiver.receive(GOOD)
    assert receiver.maximum.value == 6.0
    assert receiver.unconfirmed
    receiver.receive(GOOD)
    assert receiver.maximum.value == 35.0


def test_a_raised_maximum_counts_as_far_as_two_replies_agree() -> None:
    receiver = steady()
    receiver.receive(replace(GOOD, maximum_current=350.0))
    assert receiver.maximum.value == 35.0
    receiver.receive(GOOD)
    assert receiver.maximum.value == 35.0
    receiver.receive(replace(GOOD, maximum_current=63.0))
    receiver.receive(replace(GOOD, maximum_current=60.0))
    assert receiver.maximum.value == 60.0


def test_a_lowered_maximum_counts_at_once() -> None:
    receiver = steady()
    receiver.receive(replace(GOOD, maximum_current=16.0))
    assert receiver.maximum.value == 16.0
    first = Receiver()
    first.receive(replace(GOOD, maximum_current=5.0, modules=()))
    assert first.maximum.value == 5.0


def test_the_interval_and_the_minimum_are_confirmed_too() -> None:
    receiver = Receiver()
    assert (receiver.interval.value, receiver.minimum.value) == (20, 6.0)
    twelve_and_eight = reply(module(minimum=12.0), module(minimum=8.0))
    receiver.receive(twelve_and_eight)
    assert (receiver.interval.value, receiver.minimum.value) == (1, 6.0)
    receiver.receive(twelve_and_eight)
    assert receiver.minimum.value == 8.0
    receiver.receive(reply(module(minimum=4.0)))
    assert receiver.minimum.value == 6.0


def test_after_an_absence_the_maximum_is_unknown_again() -> None:
    receiver = steady()
    receiver.reset()
    assert receiver.maximum.value == 6.0
    assert receiver.maximum.reported is None
    receiver.receive(replace(GOOD, maximum_current=63.0))
    assert receiver.maximum.value == 6.0


@given(st.lists(st.floats(0.1, 1000.0)), st.floats(0.1, 1000.0))
def test_one_reply_alone_never_raises(reported: list[float], wrong: float) -> None:
    one, two = ConfirmedValue(6.0), ConfirmedValue(6.0)
    for value in reported:
        one.update(value)
        two.update(value)
    before = one.value
    one.update(wrong)
    assert one.value <= before or one.value <= max([*reported[-1:], 6.0])
    assert one.value <= wrong
    # And the next value is not raised by the wrong one before it.
    for value in reported[:1]:
        one.update(value)
        assert one.value <= value


# -- Arbitrary replies ---------------------------------------------------------------

currents = st.floats(0, 6553.5).map(lambda value: round(value, 1))
any_modules = st.builds(
    module,
    amperes=currents,
    cos_phi=st.floats(-32, 32),
    energy=st.integers(0, 0xFFFFFFFF),
    minimum=currents,
    voltages=st.tuples(*3 * [st.integers(0, 0xFFFF).map(float)]),
)
any_replies = st.builds(
    lambda modules, maximum, interval: reply(
        *modules, maximum=maximum, interval=interval
    ),
    st.lists(any_modules, max_size=4),
    currents,
    st.integers(0, 0xFFFF),
)


@given(st.lists(any_replies, max_size=12))
def test_an_accepted_reply_is_plausible_or_confirmed(replies: list[Reply]) -> None:
    receiver = Receiver()
    quarantined = 0
    for one in replies:
        highest = receiver.maximum.value
        try:
            taken = receiver.receive(one)
        except ImplausibleReplyError:
            quarantined += 1
            assert receiver.maximum.value == highest
            continue
        if taken.implausible:
            assert quarantined >= 2
        else:
            assert 0 < one.maximum_current <= LARGEST_CONNECTION
            highest_current = max(highest, one.maximum_current) * 1.1 + 1
            assert max(used_currents(one)) <= highest_current
            for part in one.modules:
                assert all(abs(value) <= 1 for value in part.cos_phi)
                assert all(value <= 300 for value in part.voltages or ())
        quarantined = 0


@given(st.lists(any_replies, max_size=8))
def test_plausible_replies_are_accepted_after_any_others(
    replies: list[Reply],
) -> None:
    receiver = Receiver()
    for one in replies:
        try:
            receiver.receive(one)
        except ImplausibleReplyError:
            continue
    for _ in range(5):
        try:
            taken = receiver.receive(GOOD)
        except ImplausibleReplyError:
            continue
    assert taken.reply is GOOD
    assert receiver.maximum.value == 35.0
    assert None not in taken.totals
