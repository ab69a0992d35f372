"""(o) The main fuse: seconds above its rating, with our guard and with an automation."""

import asyncio
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
import multiprocessing
import os
from typing import Final

from custom_components.evse_bus.house.phases import Rotation

from .figures import Figure
from .fuse_house import house
from .fuse_plant import (
    RATING,
    Automation,
    Box,
    Car,
    Controller,
    Meter,
    OurGuard,
    Outcome,
    Unguarded,
    run as run_house,
)
from .progress import report

NAME = "fuse"
METHOD = """\
A synthetic winter house on 3 x 25 A (seeded, see fuse_house.py), second by second; cars
of 16 A from 17:00 to 07:00 that take what they are offered. Only the pure guard of
house/, no line: a box gets a ceiling, and reports the car's current, with each of its
requests, follows within the time that is given, and its car within another one, both
drawn at random. Seconds are those with any phase above 25 A, or 31 A (what a gG fuse of
25 A holds for an hour); energy is the share of what the cars would take without a
fuse."""

EVBOX: Final = Box("EVBox 5 s", 5, 0, 10)
EVBOX_SLOW: Final = Box("EVBox 20 s", 20, 0, 10)
SMARTEVSE: Final = Box("SmartEVSE, later", 2, 6.5, 2)
ONE: Final = Car()
METERS: Final = (1, 5, 10, 15, 30, 60)
ROTATED: Final = Car(phases=1, order=(1, 2, 0), rotation=Rotation.STR)
ROTATIONS: Final = (
    ("right", ROTATED),
    ("unknown", replace(ROTATED, rotation=Rotation.UNKNOWN)),
    ("wrong", replace(ROTATED, rotation=Rotation.RST)),
)


@dataclass(frozen=True, slots=True)
class Case:
    """One run."""

    name: str
    meter: Meter
    box: Box = EVBOX
    cars: tuple[Car, ...] = (ONE,)
    control: str = "guard"
    safe: float = 6.0
    expected: bool = False
    """The figures of SUN.md are for this one."""


def cases() -> list[Case]:
    """Return all runs."""
    ten = Meter(10)
    found = [
        Case("no guard", ten, control="none"),
        Case("automation at 23 A on L1, meter 10 s", ten, control="automation"),
    ]
    for box in (EVBOX, SMARTEVSE, EVBOX_SLOW):
        found += [
            Case(
                f"{box.name}, meter {period} s",
                Meter(period),
                box,
                expected=period == 10 and box is EVBOX,  # noqa: PLR2004
            )
            for period in METERS
        ]
    found += [
        Case("meter 10 s, 20 drop-outs a day", Meter(10, drop_outs=20)),
        Case("the same, safe value 0 A", Meter(10, drop_outs=20), safe=0),
        Case("meter 10 s, 20 freezes a day", Meter(10, freezes=20)),
        Case("two cars, meter 10 s", ten, cars=(ONE, ONE)),
        Case("two cars, automation", ten, cars=(ONE, ONE), control="automation"),
        Case("car not measured, meter 10 s", ten, cars=(replace(ONE, measured=False),)),
    ]
    found += [
        Case(f"one-phase car, rotation {name}", ten, cars=(car,))
        for name, car in ROTATIONS
    ]
    return found


def controller(case: Case) -> Controller:
    """Return what controls the boxes of a case."""
    names = [str(at) for at in range(len(case.cars))]
    if case.control == "none":
        return Unguarded(names)
    if case.control == "automation":
        return Automation(names)
    return OurGuard(case.box, case.cars, case.safe)


def outcome(case: Case, days: int) -> Outcome:
    """Run a case."""
    return run_house(house(days), controller(case), case.meter, case.box, case.cars)


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    days = 2 if quick else 10
    found = cases()
    report(f"{len(found)} houses, {days} days each")
    loop = asyncio.get_running_loop()
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
        runs = (loop.run_in_executor(pool, outcome, one, days) for one in found)
        outcomes = await asyncio.gather(*runs)
    phases = zip(*house(days).phases, strict=True)
    alone = sum(max(one) > RATING for one in phases) / days
    figures = [Figure(NAME, "the house alone", alone, "s/d", digits=0)]
    for case, result in zip(found, outcomes, strict=True):
        figures += _figures(case, result)
    return figures


def _figures(case: Case, result: Outcome) -> list[Figure]:
    seconds = [one / result.days for one in result.seconds]
    note = (
        f"longest {result.longest[0]} s; above 31 A {seconds[1]:.0f} s a day, longest"
        f" {result.longest[1]} s; energy {100 * result.energy:.1f} %;"
        f" {result.pauses / result.days:.1f} pauses a day"
    )
    aim = 236 if case.expected else None
    figures = [Figure(NAME, case.name, seconds[0], "s/d", aim=aim, digits=0, note=note)]
    if case.expected:
        figures += [
            Figure(NAME, f"{case.name}: {name}", value, unit, aim=most)
            for name, value, unit, most in (
                ("longest above 25 A", result.longest[0], "s", 34),
                ("longest above 31 A", result.longest[1], "s", 14),
                ("energy that is lost", 100 * (1 - result.energy), "%", 3.4),
            )
        ]
    return figures
