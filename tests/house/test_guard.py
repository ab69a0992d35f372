"""The guard of the main fuse, at its numbers."""

from collections.abc import Sequence
from dataclasses import replace
import json
from math import inf, nan
from typing import Any

import pytest

from custom_components.evse_bus.house.fuse import (
    Fuse,
    Grant,
    Guarded,
    KeptPauses,
    PhaseReport,
    Reason,
)
from custom_components.evse_bus.house.guard import Guard
from custom_components.evse_bus.house.guarded import RESTARTS
from custom_components.evse_bus.house.meter import Silence
from custom_components.evse_bus.house.phases import Rotation
from custom_components.evse_bus.house.readings import (
    ChargerReport,
    ChargerSettings,
    Phases,
)

FUSE = Fuse(rating=25)


def box(  # noqa: PLR0917 - a row
    name: str = "one",
    maximum: float = 16,
    step: float = 0.1,
    wired: int = 3,
    rotation: Rotation = Rotation.RST,
    reaction: float = 10,
) -> Guarded:
    settings = ChargerSettings(charger=name, maximum=maximum, step=step, wired=wired)
    return Guarded(settings=settings, rotation=rotation, reaction=reaction)


class House:
    """A house whose boxes and cars follow at once, and a meter."""

    def __init__(
        self,
        *boxes: Guarded,
        fuse: Fuse = FUSE,
        kept: dict[str, KeptPauses] | None = None,
        period: float = 10,
    ) -> None:
        self.guard = Guard(fuse)
        self.boxes = boxes or (box(),)
        self.now = 1000.0
        self.guard.configure(self.boxes, kept or {}, self.now)
        self.period = period
        self.draws: dict[str, float] = {}
        """A that a car takes at most; 0: there is none."""
        self.measured = True
        self.offered: dict[str, float] = {}
        """A that a box offers, if it is not what it was granted."""
        self.grants: dict[str, Grant] = {}
        self.looked: list[tuple[float, dict[str, float]]] = []
        self.look()

    def look(self) -> None:
        self.grants = self.guard.look(self.now)
        found = {name: one.current for name, one in self.grants.items()}
        self.looked.append((self.now, found))

    def cars(self) -> list[float]:
        """Let all boxes report, and return what the cars draw on L1, L2, L3."""
        total = [0.0, 0.0, 0.0]
        for one in self.boxes:
            name = one.settings.charger
            offered = self.offered.get(name, self.grants[name].current)
            taken = min(offered, self.draws.get(name, 16.0))
            flows = [taken if at < one.settings.wired else 0.0 for at in range(3)]
            for at, phase in enumerate(one.phases):
                total[phase] += flows[at] if at < 3 else 0.0
            currents: Phases[float | None] = (flows[0], flows[1], flows[2])
            report = ChargerReport(
                at=self.now,
                currents=currents if self.measured else (None, None, None),
                offered=offered,
            )
            self.guard.charger(name, report, self.now)
        return total

    def go(
        self,
        rest: Sequence[float | None] | float,
        seconds: float,
        *,
        reports: bool = True,
    ) -> dict[str, float]:
        """Let the rest of the house draw this; return what is granted."""
        wanted = [rest] * 3 if isinstance(rest, int | float) else list(rest)
        end = self.now + seconds
        while self.now < end:
            self.now += self.period
            cars = self.cars()
            flows = [
                None if one is None else one + more
                for one, more in zip(wanted, cars, strict=True)
            ]
            if reports:
                self.report((flows[0], flows[1], flows[2]))
            self.look()
        return {name: one.current for name, one in self.grants.items()}

    def report(self, currents: Phases[float | None], at: float | None = None) -> None:
        report = PhaseReport(at=self.now if at is None else at, currents=currents)
        self.guard.meter(report, self.now)

    @property
    def one(self) -> Grant:
        return self.grants["one"]


def test_it_begins_with_the_safe_current_and_raises_after_a_minute() -> None:
    house = House()
    assert house.one == Grant(current=6, reason=Reason.METER)
    assert house.go(2, 70) == {"one": 6}
    assert house.go(2, 10) == {"one": 16}
    assert house.one.reason is Reason.NOTHING


def test_the_guard_leaves_an_ampere_on_the_worst_phase() -> None:
    house = House()
    assert house.go((2, 10.5, 5), 100) == {"one": pytest.approx(13.5)}
    assert house.one.reason is Reason.MAIN_FUSE
    assert house.one.phase == 1
    assert house.guard.headroom == (22, 13.5, 19)


def test_down_at_once_by_all_of_the_excess_and_up_after_a_minute() -> None:
    house = House()
    house.go(2, 100)
    assert house.go(15, 10) == {"one": 9}
    assert house.go(2, 60) == {"one": 9}
    assert house.go(2, 10) == {"one": 16}


def test_up_only_to_the_least_of_the_minute() -> None:
    house = House()
    house.go(2, 100)
    house.go(15, 10)
    house.go(2, 20)
    house.go(12, 10)
    assert house.go(2, 40) == {"one": 12}


def test_down_at_once_in_the_first_minute_too() -> None:
    house = House(fuse=Fuse(rating=25, safe=10))
    assert house.one.current == 10
    assert house.go(17, 20) == {"one": 7}


def test_below_the_minimum_it_pauses_after_15_s() -> None:
    house = House(period=5)
    house.go(2, 100)
    assert house.go(20, 15) == {"one": 6}
    assert house.go(20, 5) == {"one": 0}
    assert house.one.reason is Reason.RESTART
    assert house.one.short == pytest.approx(2)


def test_a_short_peak_is_no_pause() -> None:
    house = House(period=5)
    house.go(2, 100)
    for _ in range(10):
        assert house.go(20, 15) == {"one": 6}
        assert house.go(18, 5) == {"one": 6}


def test_it_pauses_at_once_when_more_than_6_a_are_missing() -> None:
    house = House()
    house.go(2, 100)
    assert house.go(24.1, 10) == {"one": 0}


def test_a_car_that_rises_is_no_reason_for_a_pause() -> None:
    """The meter shows it before the charger does; the current goes down all the same."""
    house = House()
    house.go(4, 100)
    house.draws["one"] = 0
    house.go(4, 100)
    house.draws["one"] = 16
    house.now += 10
    house.report((25, 25, 25))
    house.look()
    assert house.one.current == 6
    assert house.go(4, 10) == {"one": 6}


def test_restarts_after_5_10_20_and_40_minutes() -> None:
    house = House()
    paused: list[float] = []
    for _ in range(6):
        house.go(2, 200)
        house.go(25, 10)
        begun = house.now
        while not house.go(2, 10)["one"]:
            pass
        paused.append(house.now - begun)
    assert paused == [300, 600, 1200, 2400, 2400, 2400]
    house.go(25, 10)
    house.guard.begin_visit("one")
    house.go(2, 2390)
    assert house.go(2, 10)["one"]
    house.go(25, 10)
    house.go(2, 290)
    assert house.go(2, 10)["one"]


def test_a_restart_wants_an_ampere_to_spare() -> None:
    house = House()
    house.go(25, 100)
    assert house.go(17.1, 1000) == {"one": 0}
    assert house.go(17, 70) == {"one": 7}


def test_pauses_outlive_a_restart() -> None:
    house = House()
    for _ in range(4):
        house.go(2, RESTARTS[-1] + 100)
        house.go(25, 10)
    stored = json.loads(json.dumps(house.guard.kept["one"].as_dict()))
    kept = KeptPauses.from_dict(stored)
    assert kept == KeptPauses(pauses=4, paused=True)
    later = House(kept={"one": kept})
    assert later.one.current == 0
    assert later.go(2, 2390) == {"one": 0}
    assert later.go(2, 20)["one"]


@pytest.mark.parametrize(
    "stored",
    [
        None,
        [],
        {},
        {"pauses": -1, "paused": True},
        {"pauses": 1.5, "paused": True},
        {"pauses": True, "paused": True},
        {"pauses": 1, "paused": "yes"},
    ],
)
def test_what_is_no_pauses_is_none(stored: object) -> None:
    assert KeptPauses.from_dict(stored) is None


def test_a_silent_meter_lowers_to_the_safe_current() -> None:
    house = House()
    house.go(2, 100)
    assert house.go(2, 30, reports=False) == {"one": 16}
    assert house.go(2, 10, reports=False) == {"one": 6}
    assert house.one.reason is Reason.METER
    assert house.go(2, 3600, reports=False) == {"one": 6}
    assert house.go(2, 70) == {"one": 6}
    assert house.go(2, 10) == {"one": 16}


def test_a_silent_meter_pauses_if_that_was_chosen() -> None:
    house = House(fuse=Fuse(rating=25, safe=0))
    house.go(2, 100)
    assert house.go(2, 40, reports=False) == {"one": 0}
    assert house.go(2, 290) == {"one": 0}
    assert house.go(2, 10) == {"one": 16}


def test_what_is_paused_stays_paused_while_the_meter_is_silent() -> None:
    house = House()
    house.go(25, 100)
    assert house.go(2, 10_000, reports=False) == {"one": 0}


def test_nothing_is_raised_while_a_report_is_overdue() -> None:
    house = House()
    house.go(2, 60)
    assert house.go(2, 20, reports=False) == {"one": 6}
    assert house.go(2, 10) == {"one": 16}


def test_one_report_and_then_silence_raises_nothing() -> None:
    house = House()
    house.go(0, 10)
    assert house.go(0, 1000, reports=False) == {"one": 6}


def test_a_slow_meter_is_silent_after_two_and_a_half_periods() -> None:
    house = House(box(reaction=5), period=20)
    house.go(2, 200)
    assert house.guard.slow
    assert house.go(2, 40, reports=False) == {"one": 16}
    assert house.go(2, 20, reports=False) == {"one": 6}


def test_meters_slower_than_a_minute_are_refused() -> None:
    house = House(box(reaction=0), period=60)
    house.go(2, 600)
    assert not house.guard.refused
    refused = House(box(reaction=0), period=65)
    assert refused.go(2, 6500) == {"one": 6}
    assert refused.guard.refused
    assert refused.one.reason is Reason.METER_SLOW
    assert not House(period=15).guard.slow


def test_more_than_30_s_of_reaction_is_no_more_than_the_minimum() -> None:
    house = House(box(reaction=21))
    assert house.go(2, 1000) == {"one": 6}
    assert house.one.reason is Reason.REACTION
    assert house.guard.reaction("one") == 31
    assert House(box(reaction=20)).go(2, 1000) == {"one": 16}


def test_a_car_that_is_not_measured_counts_as_nothing() -> None:
    house = House()
    house.measured = False
    house.go(2, 100)
    assert house.go(2, 20)["one"] < 16
    assert house.guard.headroom == (pytest.approx(22 - house.one.current),) * 3


def test_an_old_measurement_of_a_car_counts_as_nothing() -> None:
    house = House()
    house.go(2, 100)
    for _ in range(4):
        house.now += 10
        house.report((18, 18, 18))
        house.look()
    assert house.one.current == 6


def test_the_lowest_current_near_the_report_counts() -> None:
    house = House()
    house.go(2, 100)
    house.now += 10
    house.cars()
    house.report((18, 18, 18))
    house.look()
    assert house.guard.headroom == (22, 22, 22)
    house.now += 2
    report = ChargerReport(at=house.now, currents=(9, 9, 9), offered=16)
    house.guard.charger("one", report, house.now)
    house.look()
    assert house.guard.headroom == (15, 15, 15)
    assert house.one.current == 15


def test_a_rotated_one_phase_car_counts_on_its_own_phase() -> None:
    house = House(box(wired=1, rotation=Rotation.L3))
    assert house.go((23, 23, 2), 100) == {"one": 16}
    assert house.go((2, 2, 14), 10) == {"one": 10}


def test_an_unknown_rotation_counts_on_the_worst_phase() -> None:
    house = House(box(wired=3, rotation=Rotation.UNKNOWN))
    assert house.go((2, 13, 2), 100) == {"one": 11}


def test_export_on_a_phase_is_not_granted_beyond_the_rating() -> None:
    house = House(box(maximum=32, step=1))
    assert house.go(-20, 100) == {"one": 24}


def test_two_share_by_rank() -> None:
    house = House(box("first"), box("second"))
    assert house.go(0, 100) == {"first": 16, "second": 8}
    assert house.go(4, 10) == {"first": 14, "second": 6}
    assert house.go(12.5, 10) == {"first": 6, "second": 6}
    assert house.go(12.5, 30) == {"first": 11.5, "second": 0}


def test_chargers_share_a_phase_only_with_those_on_it() -> None:
    house = House(
        box("a", wired=1, rotation=Rotation.L2),
        box("b", wired=1, rotation=Rotation.L2),
        box("c", wired=1, rotation=Rotation.L3),
    )
    assert house.go((23, 4, 2), 100) == {"a": 14, "b": 6, "c": 16}


def test_an_idle_charger_gets_what_the_others_leave() -> None:
    """It is offered for all that: a car may come at any time."""
    house = House(box("idle"), box("used"))
    house.draws["idle"] = 0
    assert house.go(0, 300) == {"idle": 8, "used": 16}
    house.draws["idle"] = 16
    for _ in range(20):
        found = house.go(0, 10)
        assert sum(found.values()) <= 24
    assert found == {"idle": 16, "used": 8}


def test_a_raise_waits_until_the_other_box_has_followed() -> None:
    house = House(box("idle"), box("used"))
    house.draws["idle"] = 0
    house.go(0, 300)
    house.draws["idle"] = 16
    house.offered["used"] = 16
    assert house.go(0, 100)["idle"] == 8
    del house.offered["used"]
    assert house.go(0, 100)["idle"] == 16


def test_a_box_that_ignores_its_limit_lowers_the_others() -> None:
    house = House(box("first"), box("second"))
    house.offered["second"] = 16
    assert house.go(0, 100)["first"] == 8


def test_a_charger_that_is_not_wanted_has_no_part_and_no_pause() -> None:
    house = House(box("first", maximum=0), box("second"))
    assert house.go(4, 100) == {"first": 0, "second": 16}
    assert house.grants["first"].reason is Reason.NOT_WANTED
    house.boxes = (box("first"), box("second"))
    house.guard.configure(house.boxes, {}, house.now)
    assert house.go(4, 60) == {"first": 14, "second": 6}
    assert house.guard.kept["first"] == KeptPauses()


def test_a_fuse_of_0_a_pauses_everything() -> None:
    house = House(box("first"), box("second"), fuse=Fuse(rating=0))
    assert house.go(0, 20) == {"first": 0, "second": 0}


@pytest.mark.parametrize(
    "wrong",
    [
        {"rating": nan},
        {"rating": -1.0},
        {"rating": inf},
        {"rating": 25.0, "safe": nan},
        {"rating": 25.0, "safe": -1.0},
        {"rating": 25.0, "signed": False},
    ],
)
def test_a_fuse_that_cannot_be_guarded(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"."):
        Fuse(**wrong)


def test_unsigned_currents_where_nothing_feeds_in() -> None:
    assert Fuse(rating=25, signed=False, feeds_in=False).rating == 25


@pytest.mark.parametrize("reaction", [nan, -1.0, inf])
def test_a_reaction_is_a_time(reaction: float) -> None:
    with pytest.raises(ValueError, match="reaction"):
        replace(box(), reaction=reaction)


@pytest.mark.parametrize("bad", [nan, inf, -inf, 1e6, None])
def test_what_is_no_current_is_no_report(bad: float | None) -> None:
    house = House()
    house.go(2, 100)
    house.go((bad, 2, 2), 40)
    assert house.guard.silence(house.now) is Silence.SILENT
    assert house.one.current == 6


def test_an_incomplete_report_lowers_all_the_same() -> None:
    house = House()
    house.go(2, 100)
    assert house.go((None, 14, 2), 10) == {"one": 10}


def test_a_restored_report_is_none() -> None:
    house = House()
    report = PhaseReport(at=house.now, currents=(0, 0, 0), restored=True)
    house.guard.meter(report, house.now)
    assert house.guard.headroom is None


def test_a_late_report_only_lowers() -> None:
    house = House()
    house.go(2, 200)
    house.now += 1
    house.report((31, 18, 18), at=house.now - 15)
    house.look()
    assert house.one.current == 9
    house.report((0, 0, 0), at=house.now - 15)
    house.look()
    assert house.one.current == 9


def test_a_report_of_a_wrong_clock_only_lowers() -> None:
    house = House()
    house.go(2, 100)
    for _ in range(8):
        house.now += 10
        house.cars()
        house.report((18, 18, 18), at=house.now + 3600)
        house.look()
    assert house.one.reason is Reason.METER
    assert house.one.current == 6


def test_a_clock_that_goes_back_lowers_and_starts_anew() -> None:
    house = House()
    house.go(2, 100)
    house.now -= 900
    assert house.go(2, 70) == {"one": 6}
    assert house.go(2, 20) == {"one": 16}
