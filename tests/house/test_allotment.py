"""Several chargers: rank, one pool of sun, cars that take nothing."""

from dataclasses import replace
from math import inf, nan
from typing import Any

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.house.account import PRESETS, Rounding, Waiting
from custom_components.evse_bus.house.allotment import (
    IDLE,
    SHY,
    Allotment,
    Take,
    share,
)
from custom_components.evse_bus.house.meter import Silence
from custom_components.evse_bus.house.readings import (
    ChargerReport,
    ChargerSettings,
    Mode,
)
from custom_components.evse_bus.house.visits import Kept

ONE = ChargerSettings(charger="one", step=0.1)
TWO = ChargerSettings(charger="two", step=0.1)
SMALL = ChargerSettings(charger="small", step=0.1, wired=1)


class Park:
    """Cars that take what they are offered, and a meter every 10 s."""

    def __init__(self, *settings: ChargerSettings) -> None:
        self.allotment = Allotment()
        self.allotment.configure(settings, {}, 0)
        self.settings = {one.charger: one for one in settings}
        self.now = 0.0
        self.most: dict[str, float] = {}
        """A that a car takes at most."""

    def go(self, sun: float, seconds: float) -> dict[str, float]:
        """Let this sun shine, and return the currents."""
        end = self.now + seconds
        while self.now < end:
            self.now += 10
            for name, one in self.allotment.contenders.items():
                current = min(one.account.current, self.most.get(name, inf))
                wired = self.settings[name].wired
                currents = tuple(current if at < wired else 0.0 for at in range(3))
                report = ChargerReport(
                    at=self.now, power=230 * sum(currents), plugged=True
                )
                one.take(report, self.now)
            decisions = self.allotment.look(self.now, sun, 10, Silence.NONE)
        return {name: one.current for name, one in decisions.items()}


def test_the_next_one_starts_on_what_the_first_cannot_take() -> None:
    park = Park(ONE, SMALL)
    assert park.go(5000, 600) == {"one": pytest.approx(7.2), "small": 0}
    assert park.go(11_040 + 1400, 1200) == {"one": 16, "small": 6}
    assert park.go(11_040 + 2300, 300) == {"one": 16, "small": 10}


def test_the_last_one_pauses_first() -> None:
    park = Park(ONE, SMALL)
    park.go(11_040 + 2300, 1200)
    found = park.go(8000, 300)
    assert found == {"one": pytest.approx(11.5), "small": 0}


def test_the_first_leaves_the_last_its_least_until_it_pauses() -> None:
    """So nothing is bought for a car that is about to pause."""
    park = Park(ONE, SMALL)
    park.go(11_040 + 2300, 1200)
    assert park.go(8000, 10) == {"one": pytest.approx(9.5), "small": 6}


def test_two_that_wait_do_not_start_on_the_same_sun() -> None:
    park = Park(ONE, TWO)
    found = park.go(6000, 3600)
    assert found == {"one": pytest.approx(8.6), "two": 0}
    assert park.allotment.contenders["two"].visit.starts == 0


def test_the_sun_waits_a_minute_for_the_first() -> None:
    park = Park(ONE, SMALL)
    park.allotment.contenders["one"].account._paused = 0
    assert park.go(5000, 120)["one"] == 6
    assert park.allotment.contenders["small"].visit.starts == 0
    other = Park(ONE, SMALL)
    other.allotment.contenders["one"].account._paused = 400
    assert other.go(5000, 120)["small"] > 6


def test_starts_are_counted_for_the_visit() -> None:
    park = Park(ONE)
    for _ in range(3):
        park.go(6000, 900)
        park.go(0, 300)
    assert park.allotment.contenders["one"].visit.starts == 3
    assert park.allotment.contenders["one"].kept.starts == 3


@pytest.mark.parametrize("bad", [nan, inf, -inf, 1e9])
def test_a_bad_power_counts_as_none(bad: float) -> None:
    park = Park(ONE, TWO)
    park.allotment.contenders["one"].take(ChargerReport(at=1, power=bad), 1)
    report = ChargerReport(at=1, currents=(bad if bad != 1e9 else nan, 2.0, None))
    park.allotment.contenders["two"].take(report, 1)
    assert park.allotment.contenders["one"].power is None
    assert park.allotment.power == 460


def test_a_small_car_takes_what_is_too_little_for_the_first() -> None:
    park = Park(ONE, SMALL)
    assert park.go(3000, 600) == {"one": 0, "small": 13}


def test_a_car_that_takes_nothing_keeps_its_minimum_and_its_sun_goes_on() -> None:
    park = Park(ONE, TWO)
    park.most["one"] = 0
    park.go(6000, 200)
    found = park.go(6000, IDLE + 200)
    assert found == {"one": 6, "two": pytest.approx(8.6)}
    assert park.allotment.contenders["one"].decision.waiting is Waiting.CAR
    # In the dark as well: it costs nothing, and is no further start.
    assert park.go(0, 3600) == {"one": 6, "two": 0}
    del park.most["one"]
    # It wakes: the sun is its own again, or it pauses without.
    assert park.go(6000, 60)["one"] > 6
    assert park.go(0, 600)["one"] == 0


def test_what_a_small_battery_cannot_take_goes_on() -> None:
    park = Park(ONE, SMALL)
    park.most["one"] = 8
    found = park.go(9000, SHY + 900)
    assert found["one"] == pytest.approx(9, abs=0.1)
    assert found["small"] == pytest.approx((9000 - 9 * 690) / 230, abs=0.2)
    del park.most["one"]
    assert park.go(9000, 900)["one"] == pytest.approx(13)


def test_no_car_gets_no_start_and_no_sun() -> None:
    allotment = Allotment()
    allotment.configure([ONE, TWO], {}, 0)
    for now in range(0, 900, 10):
        allotment.contenders["one"].take(ChargerReport(at=now, plugged=False), now)
        allotment.contenders["two"].take(ChargerReport(at=now, plugged=True), now)
        found = allotment.look(now, 6000, 10, Silence.NONE)
    assert found["one"].waiting is Waiting.CAR
    assert found["two"].current > 6


def test_a_limit_below_the_minimum_is_a_pause() -> None:
    park = Park(ONE)
    park.go(6000, 300)
    park.allotment.configure([replace(ONE, maximum=5)], {}, park.now)
    assert park.go(6000, 10) == {"one": 0}
    assert park.allotment.contenders["one"].decision.waiting is Waiting.CHARGER


def test_a_lower_limit_counts_at_once() -> None:
    park = Park(ONE)
    park.go(11_000, 300)
    park.allotment.configure([replace(ONE, maximum=7)], {}, park.now)
    assert (
        park.allotment.look(park.now + 1, 11_000, 0, Silence.NONE)["one"].current == 7
    )


def test_what_was_kept_goes_on() -> None:
    kept = Kept(mode=Mode.SUN, session="7", starts=3, charging=True)
    allotment = Allotment()
    allotment.configure([ONE, TWO], {"one": kept}, 0)
    found = allotment.look(1, None, 0, Silence.NEW)
    assert (found["one"].current, found["two"].current) == (6, 0)
    assert allotment.contenders["one"].kept == kept
    assert not allotment.contenders["two"].kept.charging


def test_after_a_restart_the_times_between_starts_count_anew() -> None:
    park = Park(ONE)
    kept = {"one": Kept(mode=Mode.SUN, starts=3)}
    park.allotment.configure([], {}, 0)
    park.allotment.configure([ONE], kept, 0)
    assert park.go(9000, 590) == {"one": 0}
    assert park.go(9000, 60)["one"] > 0
    assert park.allotment.contenders["one"].visit.starts == 4


def test_two_chargers_of_one_name_are_refused() -> None:
    with pytest.raises(ValueError, match="two chargers"):
        Allotment().configure([ONE, ONE], {}, 0)


def test_a_charger_that_left_is_forgotten() -> None:
    park = Park(ONE, TWO)
    park.allotment.configure([TWO], {}, 0)
    assert list(park.allotment.contenders) == ["two"]


def powers() -> st.SearchStrategy[float]:
    return st.floats(-20_000, 120_000)


@given(
    power=powers(),
    takes=st.lists(
        st.builds(
            lambda least, more, held: Take(least=least, most=least + more, held=held),
            st.floats(1000, 20_000),
            st.floats(0, 20_000),
            st.sampled_from([0.0, 0.0, 4000.0, 11_000.0]),
        ),
        max_size=5,
    ),
)
def test_one_surplus_is_never_given_twice(power: float, takes: list[Take]) -> None:
    parts = share(power, takes)
    assert sum(parts) <= max(power, 0) + 0.01
    for take, part in zip(takes, parts, strict=True):
        assert 0 <= part <= take.most
    free = sum(part for take, part in zip(takes, parts, strict=True) if not take.held)
    held = sum(
        max(take.held, part)
        for take, part in zip(takes, parts, strict=True)
        if take.held
    )
    assert not free or free + held <= max(power, 0) + 0.01


STRANGE = st.sampled_from([nan, inf, -inf, 1e9, -1e9])


@st.composite
def scenes(draw: st.DrawFn) -> list[dict[str, Any]]:
    """Draw looks at three chargers with good and bad readings."""
    return draw(
        st.lists(
            st.fixed_dictionaries(
                {
                    "seconds": st.sampled_from([0.5, 1, 10, 10, 10, 60, 700]),
                    "sun": st.one_of(powers(), st.sampled_from([5000.0, 13_000.0])),
                    "repeat": st.integers(1, 20),
                    "silence": st.sampled_from([Silence.NONE] * 6 + list(Silence)),
                    "fresh": st.booleans(),
                    "power": st.one_of(st.none(), st.floats(-100, 12_000), STRANGE),
                    "current": st.one_of(st.none(), st.floats(0, 32), STRANGE),
                    "volts": st.one_of(st.none(), st.floats(200, 250), STRANGE),
                    "plugged": st.sampled_from([None, True, True, False]),
                    "who": st.integers(0, 2),
                    "maximum": st.sampled_from([0, 5, 6, 10, 16, 16, 16, 32]),
                }
            ),
            max_size=40,
        )
    )


@given(scene=scenes(), mode=st.sampled_from(list(PRESETS)))
def test_whatever_comes_in(scene: list[dict[str, Any]], mode: Mode) -> None:
    """What goes out obeys limits and times, and the sun of all is the sun there is."""
    settings = [replace(one, mode=mode) for one in (ONE, TWO, SMALL)]
    allotment = Allotment()
    allotment.configure(settings, {}, 0)
    now = 1000.0
    before = dict.fromkeys(("one", "two", "small"), 0.0)
    started = dict.fromkeys(before, -inf)
    paused = dict.fromkeys(before, -inf)
    preset = PRESETS[mode]
    for row in scene:
        settings[row["who"]] = replace(settings[row["who"]], maximum=row["maximum"])
        allotment.configure(settings, {}, now)
        for _ in range(row["repeat"]):
            now += row["seconds"]
            who = settings[row["who"]].charger
            report = ChargerReport(
                at=now,
                power=row["power"],
                currents=(row["current"], row["current"], 0.0),
                volts=row["volts"],
                plugged=row["plugged"],
            )
            allotment.contenders[who].take(report, now)
            elapsed = row["seconds"] if row["fresh"] else 0.0
            found = allotment.look(now, row["sun"], elapsed, row["silence"])
            raised = False
            for one in settings:
                name, current = one.charger, found[one.charger].current
                assert current == 0 or one.minimum <= current <= one.maximum
                if current and not before[name]:
                    assert row["silence"] is Silence.NONE
                    assert now - started[name] >= preset.between
                    assert now - paused[name] >= preset.off
                    started[name] = now
                elif current > before[name]:
                    raised |= current > one.minimum
                if row["silence"] in {Silence.SILENT, Silence.DEAD}:
                    assert current <= before[name] or current == one.minimum
                if row["silence"] is Silence.DEAD:
                    assert current == 0
                if before[name] and not current:
                    paused[name] = now
                before[name] = current
            if raised:
                _check_sum(allotment, row["sun"], now, preset.rounding)


def _check_sum(
    allotment: Allotment, sun: float, now: float, rounding: Rounding
) -> None:
    """Where a current was raised, all together take no more than the sun."""
    taken = slack = 0.0
    for one in allotment.contenders.values():
        if one.account.charging and not one.idle(now):
            taken += one.account.current * one.need.per_ampere
            if rounding is Rounding.NEAREST:
                slack += one.need.step * one.need.per_ampere / 2
    assert taken <= max(sun, 0) + slack + 0.5
