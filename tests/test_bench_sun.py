"""The benchmark of the sun account: its simulated house, which is not tested by use."""

from functools import partial
from random import Random

import pytest

from benchmarks.sun import Figures, as_good, cell_figure, cells
from benchmarks.sun_controllers import Account, Automation, Evcc
from benchmarks.sun_month import MINUTES, Day, household, parsed
from benchmarks.sun_plant import (
    Battery,
    Car,
    Cell,
    Controller,
    Outcome,
    Seen,
    run_day,
)

HOUR = 3600
STEADY = Day([6900.0] * (4 * HOUR))
"""Four hours with sun for 10 A on three phases."""


def run(controller: Controller, cell: Cell, day: Day = STEADY) -> Outcome:
    outcome = Outcome()
    run_day(cell, day, controller, 0.0, outcome)
    return outcome


def test_a_file_of_the_station_is_read() -> None:
    lines = [
        "*U0010",
        "  1    0   555   0.1    0    0      0   0.0    0    0",
        "*U0100",
        "  1    0   -999 -99.9 -999 -999   -999 -99.9 -999 -999",
        "           -999 -99.9 -999 -999   -999 -99.9 -999 -999      9.3 100.5  958",
        "  1    1    250   0.1    0    0      0   0.0    0    0",
        "              0   0.2   -1    0    348   0.3  347  349      9.3 100.5  958",
        "  1    2   -999 -99.9 -999 -999   -999 -99.9 -999 -999",
        "              0   0.2   -1    0    348   0.3  347  349      9.3 100.5  958",
        " 30 1439     -3   0.1    0    0      0   0.0    0    0",
        "              0   0.2   -1    0    348   0.3  347  349      9.3 100.5  958",
        "*U0300",
        "  1    3    777   0.1    0    0      0   0.0    0    0",
    ]
    days = parsed(iter(lines))
    assert days[0][:4] == [0, 250, 250, 0]
    assert days[29][1439] == 0


def test_a_household_is_repeatable() -> None:
    power = household(Random(1))  # noqa: S311 - repeatable on purpose
    assert power == household(Random(1))  # noqa: S311
    assert len(power) == MINUTES * 60
    assert 4 < sum(power) / 3.6e6 < 20


@pytest.mark.parametrize("make", [Account, Automation, partial(Evcc, every=10)])
@pytest.mark.parametrize("period", [1, 10])
@pytest.mark.parametrize("priority", [None, 0.0])
def test_steady_sun_is_taken(
    make: type[Account], period: int, priority: float | None
) -> None:
    battery = None if priority is None else Battery(priority=priority, most=0.0)
    cell = Cell(name="a", period=period, battery=battery)
    sun, grid, starts = run(make(cell), cell).figures
    assert sun > 96
    assert grid < 1
    assert starts == 1


def test_only_the_account_can_use_a_slow_meter() -> None:
    cell = Cell(name="a", period=60)
    assert run(Account(cell), cell).figures[0] > 95
    assert run(Evcc(cell, 10), cell).figures[0] < 85
    assert run(Automation(cell), cell).figures[0] < 70


def test_without_sun_nothing_is_taken() -> None:
    cell = Cell(name="a")
    outcome = run(Account(cell), cell, Day([100.0] * HOUR))
    assert (outcome.sun, outcome.starts) == (0, 0)


def test_two_automations_give_one_surplus_twice() -> None:
    """The fault that the allotment is for."""
    cell = Cell(name="a", cars=(Car(), Car()))
    assert run(Automation(cell), cell).starts > 20
    assert run(Account(cell), cell).starts == 1


def test_a_car_that_refuses_takes_nothing_more() -> None:
    class Switch:
        every = 60
        every_report = False

        def measured(self, at: float, powers: object) -> None:
            pass

        def look(self, seen: Seen) -> list[float]:
            return [6.0 * (seen.at // 60 % 2)]

    cell = Cell(name="a", cars=(Car(refuses_after=3, delay=0),))
    outcome = run(Switch(), cell)
    assert outcome.starts == 120
    assert outcome.sun == pytest.approx(3 * 60 * 4140, rel=0.05)


def test_an_old_meter_shows_what_was() -> None:
    class Watch:
        every = HOUR
        every_report = True
        seen: list[Seen]

        def __init__(self) -> None:
            self.seen = []

        def measured(self, at: float, powers: object) -> None:
            pass

        def look(self, seen: Seen) -> list[float]:
            self.seen.append(seen)
            return [0.0]

    watch = Watch()
    run(watch, Cell(name="a", period=60, lag=20), Day([float(at) for at in range(999)]))
    fresh = [one for one in watch.seen if one.fresh]
    assert len(fresh) >= 16
    assert all(one.grid == 20 - one.at for one in fresh if one.at > 20)
    watch = Watch()
    run(
        watch,
        Cell(name="a", period=1, freezes=3),
        Day([float(at) for at in range(999)]),
    )
    assert any(one.grid != -one.at for one in watch.seen)
    watch = Watch()
    run(watch, Cell(name="a", period=1, dropouts=3), Day([0.0] * 999))
    assert len(watch.seen) < 990


@pytest.mark.parametrize(
    ("ours", "good"),
    [
        ((70.0, 3.0, 5.0), True),
        ((71.0, 2.0, 4.0), True),
        ((69.6, 3.0, 5.0), True),
        ((69.4, 0.0, 0.0), False),
        ((69.9, 3.1, 0.0), False),
        ((99.0, 0.0, 5.2), True),
        ((99.0, 0.0, 5.3), False),
    ],
)
def test_as_good_as_another(ours: Figures, *, good: bool) -> None:
    assert as_good(ours, (70.0, 3.0, 5.0)) is good


def test_the_figures_of_a_cell() -> None:
    ours = Outcome(days=1, sun=60.0, available=100.0, starts=5)
    worse = Outcome(days=1, sun=40.0, available=100.0, starts=5)
    better = Outcome(days=1, sun=80.0, available=100.0, starts=5)
    outcomes = {"account": ours, "evcc 10 s": worse, "evcc 30 s": better}
    figure = cell_figure("a", outcomes)
    assert (figure.value, figure.met) == (1, False)
    assert figure.note.startswith("account 60.0 / 0.0 / 5.0; evcc 10 s 40.0")


def test_the_cells() -> None:
    full, quick = cells(quick=False), cells(quick=True)
    assert len({one.name for one in full}) == len(full)
    assert {one.name for one in quick} < {one.name for one in full}
