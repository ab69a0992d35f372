"""The ceilings of a house: the least of sun and main fuse, with its reason."""

from dataclasses import replace
import json
from math import inf, nan
from typing import Any

from hypothesis import given, settings, strategies as st
import pytest

from custom_components.evse_bus.house.account import PRESETS, Waiting
from custom_components.evse_bus.house.composition import Ceiling, House, Limit
from custom_components.evse_bus.house.fuse import (
    Fuse,
    Guarded,
    PhaseReport,
    Reason,
)
from custom_components.evse_bus.house.meter import DEAD, SILENCE
from custom_components.evse_bus.house.phases import Rotation
from custom_components.evse_bus.house.readings import (
    BatteryReport,
    ChargerReport,
    ChargerSettings,
    GridReport,
    Mode,
)

FUSE = Fuse(rating=35)


def charger(name: str, **values: Any) -> Guarded:  # noqa: ANN401 - of the settings
    return Guarded(
        settings=ChargerSettings(charger=name, step=0.1, **values),
        rotation=Rotation.RST,
        reaction=10,
    )


class Scene:
    """A house whose cars take what they are offered, and meters every 10 s."""

    def __init__(self, *chargers: Guarded, fuse: Fuse | None = None) -> None:
        self.house = House(fuse=fuse)
        self.chargers = chargers
        self.house.configure(chargers, {}, 0)
        self.now = 0.0
        self.ceilings: dict[str, Ceiling] = {}
        self.base = [5.0, 5.0, 5.0]
        """A on each phase that is not of the cars."""
        self.reports = True

    def go(self, sun: float, seconds: float) -> dict[str, float]:
        """Let this sun be left over by the house; return the ceilings, A."""
        end = self.now + seconds
        while self.now < end:
            self.now += 10
            total = 0.0
            loads = list(self.base)
            for one in self.chargers:
                name, wired = one.settings.charger, one.settings.wired
                now = self.ceilings.get(name)
                current = now.current if now is not None else 0.0
                one_phase = [current if at < wired else 0.0 for at in range(3)]
                currents = (one_phase[0], one_phase[1], one_phase[2])
                total += 230 * sum(currents) if one.settings.mode != Mode.FAST else 0
                power = 230 * sum(currents)
                for phase in one.phases:
                    loads[phase] += current
                for at in (self.now - 6, self.now - 3, self.now):
                    report = ChargerReport(at=at, power=power, currents=currents)
                    self.house.charger(name, replace(report, plugged=True), at)
            if self.reports:
                grid = GridReport(at=self.now, power=total - sun)
                self.house.grid(grid, self.now)
                phases = (loads[0], loads[1], loads[2])
                self.house.phases(PhaseReport(at=self.now, currents=phases), self.now)
            self.ceilings = dict(self.house.look(self.now))
        return {name: one.current for name, one in self.ceilings.items()}


def test_fast_without_a_fuse_is_the_order_alone() -> None:
    scene = Scene(charger("a", mode=Mode.FAST))
    assert scene.go(0, 10) == {"a": 16}
    assert scene.ceilings["a"].limit is Limit.NOTHING
    assert scene.ceilings["a"].guard == inf


def test_the_sun_says_what_is_missing() -> None:
    scene = Scene(charger("a"))
    scene.go(3000, 600)
    found = scene.ceilings["a"]
    assert (found.current, found.limit) == (0, Limit.SUN)
    assert found.sun is not None
    assert found.sun.short == pytest.approx(726)
    assert (found.sun.waiting, found.sun.counted) == (Waiting.SUN, 0)
    scene.go(6900, 300)
    assert (scene.ceilings["a"].current, scene.ceilings["a"].limit) == (10, Limit.SUN)
    scene.go(20_000, 300)
    assert scene.ceilings["a"].limit is Limit.NOTHING


def test_the_fuse_beats_the_sun() -> None:
    scene = Scene(charger("a"), fuse=FUSE)
    scene.base = [22] * 3
    scene.go(20_000, 600)
    found = scene.ceilings["a"]
    assert 11 <= found.current <= 12
    assert found.limit is Limit.MAIN_FUSE
    assert found.fuse is not None
    assert found.guard == found.fuse.current == found.current
    assert found.sun is not None
    assert found.sun.current == found.current
    scene.base = [10] * 3
    scene.go(20_000, 600)
    assert scene.ceilings["a"].current == 16


def test_a_start_that_the_fuse_refuses_is_none() -> None:
    scene = Scene(charger("a"), fuse=FUSE)
    scene.base = [30] * 3
    scene.go(20_000, 1000)
    assert scene.ceilings["a"].current == 0
    assert scene.house.kept["a"]["sun"]["starts"] == 0
    scene.base = [10] * 3
    # It need not wait for the time between two starts.
    scene.go(20_000, 150)
    assert scene.ceilings["a"].current > 0
    assert scene.house.kept["a"]["sun"]["starts"] == 1


def test_a_pause_for_the_fuse_gives_its_sun_to_the_next() -> None:
    scene = Scene(charger("a"), charger("b"), fuse=replace(FUSE, rating=25))
    scene.go(7000, 600)
    assert scene.ceilings["a"].current > 6
    scene.base = [40] * 3
    scene.go(7000, 120)
    assert scene.ceilings["a"].current == 0
    assert scene.ceilings["a"].limit is Limit.MAIN_FUSE


def test_what_the_fuse_cuts_off_goes_to_the_next() -> None:
    fuse = replace(FUSE, rating=25)
    first = replace(charger("a", wired=1), rotation=Rotation.L1)
    second = replace(charger("b", wired=1), rotation=Rotation.L2)
    scene = Scene(first, second, fuse=fuse)
    scene.base = [16, 2, 2]
    scene.go(4000, 2400)
    assert 7 <= scene.ceilings["a"].current <= 8
    assert 8 <= scene.ceilings["b"].current <= 10


def test_one_that_the_sun_pauses_does_not_want_the_fuse() -> None:
    scene = Scene(charger("a"), fuse=FUSE)
    scene.go(0, 300)
    found = scene.ceilings["a"].fuse
    assert found is not None
    assert found.reason is Reason.NOT_WANTED


def test_pauses_for_the_fuse_outlive_a_restart_and_end_with_the_visit() -> None:
    scene = Scene(charger("a", mode=Mode.FAST), fuse=FUSE)
    scene.go(0, 300)
    scene.base = [40] * 3
    scene.go(0, 60)
    assert scene.house.kept["a"]["fuse"]["pauses"] == 1
    after = House(fuse=FUSE)
    after.configure(scene.chargers, json.loads(json.dumps(scene.house.kept)), 0)
    assert after.look(1)["a"].current == 0
    assert after.kept["a"]["fuse"] == {"pauses": 1, "paused": True}
    for plugged in (False, True):
        scene.now += 1
        report = ChargerReport(at=scene.now, plugged=plugged)
        scene.house.charger("a", report, scene.now)
    assert scene.house.kept["a"]["fuse"]["pauses"] == 0


def test_a_changed_ceiling_makes_reports_wait_for_a_measurement() -> None:
    scene = Scene(charger("a"))
    scene.go(9000, 80)
    assert scene.ceilings["a"].current > 0
    assert scene.house.surplus._moved == 80


def test_silence_lowers_and_says_so() -> None:
    scene = Scene(charger("a"), charger("fast", mode=Mode.FAST), fuse=FUSE)
    scene.go(20_000, 1200)
    assert scene.ceilings["a"].current > 6
    scene.reports = False
    scene.go(0, SILENCE + 20)
    assert scene.ceilings["a"].current == 6
    assert scene.ceilings["a"].limit is Limit.METER_SILENT
    assert scene.ceilings["fast"].current == 6
    assert scene.ceilings["fast"].limit is Limit.METER_SILENT
    scene.go(0, DEAD)
    assert scene.ceilings["a"].current == 0
    assert scene.ceilings["a"].limit is Limit.METER_SILENT


def test_nothing_is_known_yet() -> None:
    scene = Scene(charger("a"), charger("fast", mode=Mode.FAST), fuse=FUSE)
    found = scene.house.look(1)
    assert (found["a"].current, found["fast"].current) == (0, 6)
    assert found["fast"].fuse is not None
    assert found["fast"].fuse.reason is Reason.METER


def test_no_order_no_ceiling_above_it() -> None:
    scene = Scene(charger("a", maximum=5, mode=Mode.FAST), charger("b", maximum=5))
    scene.go(20_000, 300)
    for one in scene.ceilings.values():
        assert (one.current, one.limit) == (0, Limit.CHARGER)


def test_a_change_of_mode_stops_no_car_that_has_its_sun() -> None:
    scene = Scene(charger("a", mode=Mode.FAST))
    scene.go(9000, 60)
    scene.house.configure([charger("a")], {}, scene.now)
    scene.chargers = (charger("a"),)
    assert scene.go(9000, 60)["a"] > 6
    scene.house.configure([charger("a", mode=Mode.FAST)], {}, scene.now)
    scene.chargers = (charger("a", mode=Mode.FAST),)
    assert scene.go(9000, 10) == {"a": 16}


def test_an_unknown_charger_and_two_of_one_name() -> None:
    house = House()
    house.charger("a", ChargerReport(at=0), 0)
    assert house.look(0) == {}
    with pytest.raises(ValueError, match="two chargers"):
        house.configure([charger("a"), charger("a")], {}, 0)


def test_a_restart_in_mid_cloud() -> None:
    """What charged goes on with the minimum, what was paused is; starts count on."""
    scene = Scene(charger("a"), charger("b"), fuse=FUSE)
    scene.go(7000, 600)
    kept = json.loads(json.dumps(scene.house.kept))
    assert kept["a"]["sun"]["charging"]
    after = Scene(charger("a"), charger("b"), fuse=FUSE)
    after.house = House(fuse=FUSE)
    after.house.configure(after.chargers, kept, 0)
    found = after.house.look(1)
    assert {name: one.current for name, one in found.items()} == {"a": 6, "b": 0}
    assert after.house.kept["a"]["sun"]["starts"] == 1
    assert after.go(30_000, 590)["b"] == 0


BAD = st.sampled_from([nan, inf, -inf, 1e9])


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.one_of(st.floats(low, high), st.floats(low, high), BAD)


ROW = st.fixed_dictionaries(
    {
        "seconds": st.sampled_from([1.0, 10.0, 10.0, 30.0, 100.0, 700.0, -500.0]),
        "repeat": st.integers(1, 8),
        "late": st.sampled_from([0.0, 0.0, 0.0, 5.0, -40.0]),
        "grid": numbers(-20_000, 10_000),
        "phase": numbers(-20, 60),
        "current": numbers(0, 32),
        "power": st.one_of(st.none(), numbers(0, 11_000)),
        "battery": numbers(-5000, 5000),
        "charge": st.one_of(st.none(), numbers(0, 100)),
        "plugged": st.sampled_from([None, True, True, False]),
        "reports": st.sampled_from([True, True, True, False]),
        "maximum": st.sampled_from([0.0, 5.0, 6.0, 16.0, 16.0, 32.0]),
        "restart": st.sampled_from([False] * 9 + [True]),
    }
)


@settings(max_examples=60)
@given(
    rows=st.lists(ROW, max_size=15),
    mode=st.sampled_from(list(Mode)),
    fuse=st.sampled_from([None, FUSE, Fuse(rating=0), Fuse(rating=16, safe=0)]),
)
def test_whatever_comes_in(
    rows: list[dict[str, Any]], mode: Mode, fuse: Fuse | None
) -> None:
    """No ceiling above the fuse, the order or the sun's rules; no start from nothing."""
    chargers = [charger("a", mode=mode), charger("b", mode=mode, wired=1)]
    house = House(50, fuse)
    house.configure(chargers, {}, 0)
    now = 1e5
    before: dict[str, float] = {"a": 0, "b": 0}
    paused = dict.fromkeys(before, -inf)
    for row in rows:
        chargers[0] = charger("a", mode=mode, maximum=row["maximum"])
        if row["restart"]:
            kept = json.loads(json.dumps(house.kept))
            house = House(50, fuse)
            house.configure(chargers, kept, now)
        house.configure(chargers, {}, now)
        for _ in range(row["repeat"]):
            now += row["seconds"]
            back = row["seconds"] < 0
            at = now - row["late"]
            if row["reports"]:
                house.grid(GridReport(at=at, power=row["grid"]), now)
                battery = BatteryReport(
                    at=at, power=row["battery"], charge=row["charge"]
                )
                house.battery(battery, now)
                house.phases(PhaseReport(at=at, currents=(row["phase"],) * 3), now)
            report = ChargerReport(
                at=at,
                power=row["power"],
                currents=(row["current"],) * 3,
                plugged=row["plugged"],
            )
            house.charger("a", report, now)
            silence = house.silence(now)
            for name, one in house.look(now).items():
                own = chargers[name == "b"].settings
                assert one.current == 0 or own.minimum <= one.current
                assert one.current <= max(own.maximum, 0)
                assert one.current <= one.guard
                if fuse is not None:
                    assert one.fuse is not None
                    assert one.current <= one.fuse.current
                if mode != Mode.FAST:
                    _check_sun(one, mode, silence, before[name], now - paused[name])
                if one.limit is Limit.NOTHING:
                    assert one.current == own.maximum
                if (before[name] and not one.current) or back:
                    paused[name] = -inf if back else now
                before[name] = one.current


def _check_sun(
    one: Ceiling, mode: Mode, silence: str, before: float, off: float
) -> None:
    """Check a charger that charges from the sun, in a house of any state."""
    if silence == "dead":
        assert one.current == 0
    elif silence != "none":
        assert one.current <= max(before, 6.0)
        assert before or not one.current
    if one.current and not before:
        assert off >= PRESETS[mode].off
