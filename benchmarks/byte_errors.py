"""(k) A day with byte errors: what is shown, counted, kept alive."""

import asyncio
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from random import Random
from typing import Final

from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import OrderChange
from tests.virtual.faults import DAMAGES

from .figures import Figure, percentile
from .progress import report
from .simulated import DAY, HOUR, simulate_all
from .watched import Scene
from .watched_abl import AblScene
from .watched_evbox import EvboxScene
from .watched_ews import EwsNetworkScene, EwsScene
from .watched_smartevse import PolledScene, SlaveScene
from .witness import Findings

NAME = "byte-errors"
OPTIONS: Final = ("scene",)
RATE: Final = 1e-3
CURRENTS: Final = (6.0, 8.0, 10.0, 12.5, 14.0, 16.0)
FORBIDS: Final = 0.15
"""Share of commands that pause a charger; the next one allows it to charge again."""
BETWEEN_ORDERS: Final = (60.0, 900.0)
BETWEEN_LOSSES: Final = (1 * HOUR, 3 * HOUR)
LOSSES: Final = (0.1, 15.0)
"""Shortest and longest time, s."""

METHOD = f"""\
In simulated time, 24 h for each line of the table: library and virtual chargers on one
loop, the wire at its pace. Each byte on the wire, in both directions, is damaged with a
probability of {RATE:g}: one bit flips, another byte is in its place, it is lost, or a
byte comes before it; but not on the connection of a box that dials, since TCP checks
them. Cars come and go, the orders change every {BETWEEN_ORDERS[0]:g} to
{BETWEEN_ORDERS[1]:g} s, the port is away for {LOSSES[0]:g} to {LOSSES[1]:g} s every 1 to 3 h.
Wrong is a published value that the box had at no time in the 6 s before, one still
shown after 30 s (a value that is asked for less often: so much later), a total beyond
the meter or one that falls, an identity that is not that of the box. A keep-alive is
missed when the box says so: EVBox time-out, ABL F4 after 30 s, SmartEVSE NO_COMM, an
EWS-Box without a command for 30 s."""


@dataclass(frozen=True, slots=True)
class Case:
    """One scene."""

    name: str
    make: Callable[[int], Scene]
    seconds: float = DAY
    rate: float = RATE
    seed: int = 1


@dataclass(slots=True)
class Outcome:
    """What a scene has come to."""

    findings: list[Findings] = field(default_factory=list)
    replies: int = 0
    commands: list[float] = field(default_factory=list)
    """Time of each confirmed command, s."""
    failed: Counter[str] = field(default_factory=Counter)
    """Commands that failed, by error."""
    notes: list[str] = field(default_factory=list)
    """What failed, in words."""
    shared: int | None = None
    """Times at which a shared supply was exceeded."""
    longest_shared: float = 0.0


CASES: Final = {
    "abl": AblScene,
    "abl without 0x0F": partial(AblScene, tells_icmax=False),
    "evbox 68": EvboxScene,
    "evbox 68, serial 0": partial(EvboxScene, any_serial=True),
    "evbox 69": partial(EvboxScene, command=69, any_serial=True),
    "smartevse 2.17": partial(PolledScene, dialect="2.17"),
    "smartevse 2.20": partial(PolledScene, dialect="2.20"),
    "smartevse 2.30": partial(PolledScene, dialect="2.30"),
    "smartevse slaves": SlaveScene,
    "smartevse 2.20 nodes": partial(SlaveScene, dialects=("2.20",) * 3),
    "smartevse 2.30 nodes": partial(SlaveScene, dialects=("2.30", "2.30+", "2.30+")),
    "smartevse 3.x nodes": partial(SlaveScene, dialects=("3", "3.8", "3.6")),
    "ews rs-232": EwsScene,
    "ews network": EwsNetworkScene,
}


async def run(*, quick: bool, scene: str = "") -> list[Figure]:
    """Return the figures of the scenes whose name has ``scene`` in it."""
    seconds = HOUR if quick else DAY
    cases = [Case(name, make, seconds) for name, make in CASES.items() if scene in name]
    report(f"{len(cases)} scenes of {seconds / HOUR:g} h")
    outcomes = await simulate_all(watch, cases)
    figures: list[Figure] = []
    for case, outcome in zip(cases, outcomes, strict=True):
        figures += case_figures(case.name, outcome)
        found = [note for one in outcome.findings for note in one.notes]
        for note in (*found, *outcome.notes):
            report(f"{case.name}: {note}")
    return figures


async def watch(case: Case) -> Outcome:
    """Run one scene."""
    dice = Random(case.seed)  # noqa: S311 - repeatable on purpose
    outcome = Outcome()
    async with case.make(case.seed) as scene:
        if not scene.checks_bytes:
            scene.virtual.faults.damage = DAMAGES
            scene.virtual.faults.byte_error_rate = case.rate
        tasks = [
            asyncio.create_task(_order(scene, dice, outcome)),
            asyncio.create_task(_lose(scene, dice)),
        ]
        await asyncio.sleep(case.seconds)
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        for task in tasks:
            if not task.cancelled() and task.exception() is not None:
                raise RuntimeError from task.exception()
        outcome.findings = [witness.end() for witness in scene.witnesses]
        if scene.shared is not None:
            outcome.shared, outcome.longest_shared = (
                scene.shared.times,
                scene.shared.longest,
            )
        outcome.replies = sum(one.statistics.replies for one in scene.chargers)
    return outcome


async def _order(scene: Scene, dice: Random, outcome: Outcome) -> None:
    """Change orders now and then."""
    loop = asyncio.get_running_loop()
    while True:
        await asyncio.sleep(dice.uniform(*BETWEEN_ORDERS))
        charger = dice.choice(scene.chargers)
        if charger.orders.allowed is False:
            change = OrderChange(allowed=True)
        elif dice.random() < FORBIDS:
            change = OrderChange(allowed=False)
        else:
            change = OrderChange(current=dice.choice(CURRENTS))
        began = loop.time()
        try:
            with scene.ordering(charger, change):
                await charger.change_orders(change)
        except EvseError as error:
            outcome.failed[type(error).__name__] += 1
            outcome.notes.append(
                f"[{loop.time():.2f} s, {charger.config.name}] {change} failed: {error}"
            )
        else:
            outcome.commands.append(loop.time() - began)


async def _lose(scene: Scene, dice: Random) -> None:
    """Lose the port now and then."""
    while True:
        await asyncio.sleep(dice.uniform(*BETWEEN_LOSSES))
        await scene.lose_port(dice.uniform(*LOSSES))


def case_figures(name: str, outcome: Outcome) -> list[Figure]:
    """Return the figures of one scene."""
    found = outcome.findings
    wrong = sum(one.wrong for one in found)
    totals = sum(one.wrong_totals for one in found)
    identities = sum(one.wrong_identities for one in found)
    watched = sum(one.watched for one in found)
    away = sum(one.away for one in found)
    problems = sum((one.problems for one in found), Counter[str]())
    counted = sum(one.counted for one in found)
    lost = sum(one.lost for one in found)
    commands = outcome.commands or [0.0]
    shared = ""
    if outcome.shared is not None:
        shared = (
            f"; shared supply {outcome.shared} times,"
            f" longest {outcome.longest_shared:.1f} s"
        )
    return [
        Figure(
            NAME,
            f"{name}: wrong values, totals, identities",
            wrong + totals + identities,
            aim=0,
            digits=0,
            note=f"{wrong}, {totals}, {identities};"
            f" {counted / 1000:.1f} kWh counted, {lost / 1000:.2f} missing",
        ),
        Figure(
            NAME,
            f"{name}: missed keep-alives",
            sum(one.missed for one in found),
            aim=0,
            digits=0,
        ),
        Figure(
            NAME,
            f"{name}: limits above their order for too long",
            sum(one.over for one in found) + (outcome.shared or 0),
            aim=0,
            digits=0,
            note=f"longest {max(one.longest_over for one in found):.1f} s{shared}",
        ),
        Figure(
            NAME,
            f"{name}: available",
            100 * (1 - away / watched) if watched else 0.0,
            "%",
            digits=3,
            note=f"{sum(one.absences for one in found)} absences,"
            f" {outcome.replies * HOUR / (watched / len(found)):.0f} replies an hour;"
            f" noticed: {_list(problems)}",
        ),
        Figure(
            NAME,
            f"{name}: command until confirmed, p99",
            percentile(commands, 0.99),
            "s",
            note=f"{len(outcome.commands)} confirmed, failed: {_list(outcome.failed)}",
        ),
    ]


def _list(counted: Counter[str]) -> str:
    return ", ".join(f"{n} {name}" for name, n in counted.items()) or "none"
