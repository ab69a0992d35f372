"""The sun account of one charger, at the numbers of its mode."""

from collections.abc import Iterator
from dataclasses import replace
from math import inf

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.house.account import (
    BETWEEN_CHANGES,
    PRESETS,
    Need,
    Rounding,
    SunAccount,
    Waiting,
)
from custom_components.evse_bus.house.meter import Silence
from custom_components.evse_bus.house.readings import Mode

NEED = Need(minimum=6, maximum=16, step=0.1, volts=230, phases=3)
LEAST = 4140.0


class Run:
    """An account with a meter that reports every 10 s."""

    def __init__(self, mode: Mode = Mode.SUN, *, charging: bool = False) -> None:
        self.account = SunAccount(PRESETS[mode], charging=charging)
        self.now = 0.0
        self.starts: list[float] = []
        self.pauses: list[float] = []

    def go(self, sun: float, seconds: float, *, period: float = 10) -> float:
        """Let this sun shine, and return the current."""
        end = self.now + seconds
        while self.now < end:
            self.now += period
            before = self.account.charging
            self.decision = self.account.decide(
                self.now, sun, period, NEED, len(self.starts)
            )
            if self.account.charging:
                self.account.follow(self.now, sun, NEED, fresh=True)
            if self.account.charging != before:
                (self.pauses if before else self.starts).append(self.now)
        return self.account.current


def test_it_starts_with_the_minimum_once_enough_was_missed() -> None:
    run = Run()
    assert run.go(LEAST, 190) == 0
    assert run.decision.waiting is Waiting.SUN
    assert run.decision.counted == pytest.approx(0.1 * LEAST * 190 / 3600)
    assert run.decision.needed == pytest.approx(20 * LEAST / 3600)
    assert run.go(LEAST, 10) == 6


def test_strong_sun_must_be_steady_for_a_minute() -> None:
    run = Run()
    assert run.go(3 * LEAST, 60) == 0
    assert run.decision.waiting is Waiting.STEADY
    assert run.decision.seconds == 10
    run.go(0.8 * LEAST, 10)
    assert run.go(3 * LEAST, 60) == 0
    assert run.go(3 * LEAST, 10) > 0


def test_a_peak_of_100_kw_starts_nothing() -> None:
    run = Run()
    for _ in range(20):
        assert run.go(100_000, 50) == 0
        assert run.go(0, 50) == 0


def test_it_buys_a_little_for_a_cloud_and_then_pauses() -> None:
    run = Run()
    run.go(2 * LEAST, 600)
    assert run.go(0, 40) == 6
    assert run.decision.waiting is Waiting.BUYING
    assert run.decision.short == LEAST
    run.go(2 * LEAST, 600)
    run.go(0, 50)
    assert run.account.current == 0
    assert run.decision.waiting is Waiting.SUN
    assert run.decision.short == 0.9 * LEAST
    run.go(0, 10)
    assert run.decision.waiting is Waiting.PAUSE


def test_a_charge_lasts_three_minutes_at_least() -> None:
    run = Run()
    run.go(3 * LEAST, 70)
    assert run.go(0, 170) == 6
    assert run.go(0, 10) == 0


def test_a_single_peak_does_not_count_for_more_than_three_times_the_least() -> None:
    account = SunAccount(PRESETS[Mode.SUN])
    decision = account.decide(10, 100_000, 10, NEED, 20)
    assert decision.counted == pytest.approx(2.1 * LEAST * 10 / 3600)


def test_what_the_house_takes_itself_is_not_bought_for_the_car() -> None:
    run, other = Run(), Run()
    for one, power in ((run, 0.0), (other, -50_000.0)):
        one.go(2 * LEAST, 600)
        one.go(power, 40)
    assert run.account.charging
    assert other.account.charging


def test_times_between_starts_and_pauses() -> None:
    run = Run()
    for _ in range(20):
        run.go(3 * LEAST, 300)
        run.go(0, 300)
    preset = PRESETS[Mode.SUN]
    gaps = zip(run.starts, run.starts[1:], strict=False)
    assert all(then - now >= preset.between for now, then in gaps)
    assert all(
        then - now >= preset.off
        for now, then in zip(run.pauses, run.starts[1:], strict=False)
    )
    assert all(
        then - now >= preset.on
        for now, then in zip(run.starts, run.pauses, strict=False)
    )


def test_each_further_start_of_a_visit_needs_more_sun() -> None:
    def needed(starts: int) -> float:
        account = SunAccount(PRESETS[Mode.SUN])
        return account.decide(0, 0, 10, NEED, starts).needed

    assert [needed(starts) / needed(0) for starts in (0, 1, 5)] == [
        pytest.approx(1.0),
        pytest.approx(1.2),
        pytest.approx(2.0),
    ]


def test_down_at_once_and_up_when_confirmed() -> None:
    run = Run()
    run.go(2 * LEAST, 600)
    assert run.account.current == 12
    assert run.go(1.5 * LEAST, 10) == 9
    assert run.go(2 * LEAST, 10) == 9
    assert run.go(2 * LEAST, 20) == 12


def test_a_current_stays_for_ten_seconds() -> None:
    run = Run()
    run.go(2 * LEAST, 600)
    run.go(1.9 * LEAST, 1, period=1)
    changed = run.now
    run.go(1.1 * LEAST, BETWEEN_CHANGES - 1, period=1)
    assert run.account.current == 11.4
    run.go(1.1 * LEAST, 1, period=1)
    assert run.now == changed + BETWEEN_CHANGES
    assert run.account.current == 6.6


def test_a_lower_limit_counts_at_once() -> None:
    run = Run()
    run.go(2 * LEAST, 600)
    run.go(1.5 * LEAST, 1, period=1)
    lower = replace(NEED, maximum=7)
    assert run.account.follow(run.now, 2 * LEAST, lower, fresh=False) == 7


def test_minimum_and_sun_starts_at_once_and_never_pauses() -> None:
    run = Run(Mode.MINIMUM_AND_SUN)
    assert run.go(-3000, 10) == 6
    assert run.go(-3000, 86400) == 6
    assert run.go(2 * LEAST, 60) == 12
    assert run.account.blind(run.now, NEED, Silence.SILENT).current == 6
    assert run.account.blind(run.now, NEED, Silence.DEAD).current == 0


def test_sun_only_leaves_its_reserve() -> None:
    run = Run(Mode.SUN_ONLY)
    run.go(2 * LEAST, 600)
    assert run.account.current == pytest.approx((2 * LEAST - 100) / 690, abs=0.1)
    assert run.account.current * 690 <= 2 * LEAST - 100


def test_a_blind_account_goes_down_and_never_starts() -> None:
    run = Run()
    run.go(2 * LEAST, 600)
    assert run.account.blind(run.now, NEED, Silence.SILENT).current == 6
    assert run.account.blind(run.now, NEED, Silence.DEAD).current == 0
    assert run.account.blind(run.now, NEED, Silence.SILENT).current == 0
    assert run.account.blind(run.now, NEED, Silence.NEW).current == 0
    assert not run.account.charging


def test_steadiness_begins_anew_after_silence() -> None:
    run = Run()
    run.go(3 * LEAST, 50)
    run.account.blind(run.now, NEED, Silence.SILENT)
    assert run.go(3 * LEAST, 60) == 0
    assert run.go(3 * LEAST, 10) > 0


def test_after_a_restart_the_times_count_anew() -> None:
    run = Run()
    run.account.hold_back(0)
    assert run.go(3 * LEAST, 590) == 0
    assert run.decision.waiting is Waiting.PAUSE
    assert run.go(3 * LEAST, 20) > 0


def test_a_parked_account_keeps_its_times() -> None:
    run = Run()
    run.go(2 * LEAST, 600)
    assert run.account.park(run.now, Waiting.CAR).current == 0
    assert run.go(3 * LEAST, 110) == 0


@given(
    power=st.floats(-1e6, 1e6),
    step=st.sampled_from([0.1, 0.5, 1.0, 4.0]),
    maximum=st.floats(6, 80),
    rounding=st.sampled_from(Rounding),
)
def test_a_current_is_never_below_the_minimum_or_above_the_maximum(
    power: float, step: float, maximum: float, rounding: Rounding
) -> None:
    need = Need(minimum=6, maximum=maximum, step=step, volts=230, phases=3)
    current = need.current(power, rounding)
    assert 6 <= current <= maximum
    if rounding is Rounding.DOWN and current > 6:
        assert current * need.per_ampere <= power + 0.001


def suns() -> st.SearchStrategy[list[tuple[float, float]]]:
    """Powers and how long each lasts."""
    return st.lists(
        st.tuples(
            st.one_of(
                st.floats(-20_000, 40_000),
                st.sampled_from([-inf, inf, 0.0, 0.9 * LEAST, LEAST, 1e5]),
            ),
            st.floats(0.5, 300),
        ),
        max_size=60,
    )


def looks(account: SunAccount, drawn: list[tuple[float, float]]) -> Iterator[float]:
    now = 1e6
    starts = 0
    for sun, seconds in drawn:
        for _ in range(3):
            now += seconds
            before = account.charging
            account.decide(now, sun, seconds, NEED, starts)
            if account.charging:
                account.follow(now, sun, NEED, fresh=True)
                starts += not before
            yield now


@given(drawn=suns(), mode=st.sampled_from(list(PRESETS)))
def test_whatever_the_sun_does_the_times_are_kept(
    drawn: list[tuple[float, float]], mode: Mode
) -> None:
    account = SunAccount(PRESETS[mode])
    preset = account.preset
    started = paused = -inf
    charging = False
    for now in looks(account, drawn):
        assert account.current == 0 or 6 <= account.current <= 16
        assert bool(account.current) == account.charging
        if account.charging and not charging:
            assert now - started >= preset.between
            assert now - paused >= preset.off
            started = now
        elif charging and not account.charging:
            assert preset.pauses
            assert now - started >= preset.on
            paused = now
        charging = account.charging


@given(drawn=suns())
def test_no_more_is_bought_than_the_mode_allows(
    drawn: list[tuple[float, float]],
) -> None:
    """Beyond the shortest time of a charge and one report."""
    account = SunAccount(PRESETS[Mode.SUN])
    bought = 0.0
    last, started = 1e6, -inf
    suns_ = (sun for sun, _ in drawn for _ in range(3))
    charging = False
    for now, sun in zip(looks(account, drawn), suns_, strict=True):
        if account.charging and not charging:
            started, bought = now, 0.0
        elif charging:
            missing = 0.9 * LEAST - max(sun, 0)
            bought = max(0.0, bought + missing * (now - last))
            if account.charging and now - started >= 180:
                assert bought < 40 * LEAST + 1e-3
        charging, last = account.charging, now
