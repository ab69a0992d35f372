"""(s) The sun account on a month of real sun, beside evcc and a plain automation."""

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
import multiprocessing
import os
from typing import Final

from custom_components.evse_bus.house.readings import Mode

from .figures import Figure
from .progress import report
from .sun_controllers import Account, Automation, Evcc
from .sun_month import DAYS, month
from .sun_plant import Battery, Car, Cell, Controller, Outcome, run_day

NAME = "sun"
METHOD = """\
Each cell is a house of 9.8 kWp with the sun of June 2016 in Payerne (BSRN, a value a
minute), invented appliances, and a car at home from 6 to 22 h local time that takes all it
is offered (6 to 16 A); 1 s a step. Three figures: how much of the sun that the car could
have taken it took, how much of its energy was not of the sun, and starts a day. The
value is for how many of two rivals (evcc's PV mode by description, each 10 s and each
30 s) the account is not at least as good in two of the figures, or more than 0.5 points
(0.2 starts) worse in the third. The automation offers the floor of the surplus every
20 s."""

TOLERANCE: Final = (0.5, 0.5, 0.2)
"""Points of sun and of grid, and starts a day, by which the third may be worse."""
QUICK_DAYS: Final = 6

type Figures = tuple[float, float, float]
type Make = Callable[[Cell], Controller]

RIVALS: Final[dict[str, Make]] = {
    "evcc 10 s": partial(Evcc, every=10),
    "evcc 30 s": partial(Evcc, every=30),
}
OTHERS: Final[dict[str, Make]] = {"automation": Automation}
MODES: Final = (Mode.MOST_SUN, Mode.SUN_ONLY, Mode.MINIMUM_AND_SUN)

USUAL: Final = Cell(name="3-phase, 0.1 A, meter 10 s")
SPECIAL: Final = (
    replace(USUAL, name="charger measured every 10 s", measured_every=10),
    replace(USUAL, name="drop-outs, 6 a day", dropouts=6),
    replace(USUAL, name="meter freezes, 6 a day", freezes=6),
    replace(USUAL, name="slow car", cars=(Car(delay=60, slew=0.2),)),
    replace(USUAL, name="car that takes 11 A", cars=(Car(most=11.0),)),
    replace(
        USUAL, name="car that refuses after 8 starts", cars=(Car(refuses_after=8),)
    ),
    replace(USUAL, name="battery, car first", battery=Battery(priority=0.0)),
    replace(USUAL, name="battery first, to 60 %", battery=Battery(priority=60.0)),
    replace(USUAL, name="two 3-phase cars", cars=(Car(), Car())),
    replace(USUAL, name="3-phase and 1-phase car", cars=(Car(), Car(phases=1))),
    replace(
        USUAL,
        name="two 3-phase cars, meter 60 s",
        period=60,
        cars=(Car(), Car()),
    ),
)


def cells(*, quick: bool) -> list[Cell]:
    """Return the houses."""
    found = [
        Cell(
            name=f"{phases}-phase, {step:g} A, meter {period} s, {lag} s old",
            period=period,
            lag=lag,
            cars=(Car(phases=phases, step=step),),
        )
        for phases in (3, 1)
        for step in (0.1, 1.0)
        for period in (1, 10, 30, 60)
        for lag in (0, 10, 20)
        if not quick or (period in {10, 60} and lag != 10)  # noqa: PLR2004
    ]
    return [*found, *SPECIAL]


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    days = QUICK_DAYS if quick else DAYS
    makes: dict[str, Make] = {"account": Account, **RIVALS, **OTHERS}
    houses = cells(quick=quick)
    jobs = [(cell, make) for cell in houses for make in makes.values()]
    jobs += [(USUAL, partial(Account, mode=mode)) for mode in MODES]
    report(f"{len(jobs)} runs of {days} days")
    outcomes = iter(await _run_all(jobs, days))
    found = [
        cell_figure(cell.name, {name: next(outcomes) for name in makes})
        for cell in houses
    ]
    return [*found, *(mode_figure(mode, next(outcomes)) for mode in MODES)]


async def _run_all(jobs: Sequence[tuple[Cell, Make]], days: int) -> list[Outcome]:
    """Run the jobs in as many processes as there are cores."""
    loop = asyncio.get_running_loop()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
        runs = (
            loop.run_in_executor(pool, run_cell, cell, make, days)
            for cell, make in jobs
        )
        return await asyncio.gather(*runs)


def run_cell(cell: Cell, make: Make, days: int) -> Outcome:
    """Run the month with one controller, which remembers nothing of before."""
    outcome = Outcome()
    controller = make(cell)
    for at, day in enumerate(month(days)):
        run_day(cell, day, controller, at * 86400.0, outcome)
    return outcome


def as_good(ours: Figures, theirs: Figures) -> bool:
    """Return whether ours are as good in two figures, and hardly worse in the third."""
    signs = (1, -1, -1)
    better = [
        sign * (mine - other)
        for sign, mine, other in zip(signs, ours, theirs, strict=True)
    ]
    return sum(one >= 0 for one in better) >= len(better) - 1 and all(
        one >= -most - 1e-9 for one, most in zip(better, TOLERANCE, strict=True)
    )


def _shown(outcome: Outcome) -> str:
    sun, grid, starts = outcome.figures
    return f"{sun:.1f} / {grid:.1f} / {starts:.1f}"


def cell_figure(name: str, outcomes: dict[str, Outcome]) -> Figure:
    """Return the comparison in one house."""
    ours = outcomes["account"].figures
    worse = [rival for rival in RIVALS if not as_good(ours, outcomes[rival].figures)]
    shown = (f"{who} {_shown(outcome)}" for who, outcome in outcomes.items())
    return Figure(NAME, name, len(worse), aim=0, digits=0, note="; ".join(shown))


def mode_figure(mode: Mode, outcome: Outcome) -> Figure:
    """Return the sun that was taken in another mode, with its other figures."""
    name = f"{USUAL.name}, mode {mode.value}"
    return Figure(NAME, name, outcome.figures[0], "%", note=_shown(outcome))
