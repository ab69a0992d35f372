"""(l) An adapter that is away now and then: time until all is back."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from math import exp, log
from random import Random
from typing import Final, Literal

from custom_components.evse_bus.evse.recovery import SILENCES
from tests.virtual.ports import Answer

from .figures import Figure, percentile
from .progress import report
from .simulated import simulate_all
from .watched import Scene
from .watched_abl import AblScene
from .watched_evbox import EvboxScene
from .watched_ews import EwsScene
from .watched_smartevse import NODES, PolledScene, SlaveScene

NAME = "adapter-away"
AWAY: Final = (0.1, 600.0)
"""Shortest and longest absence, s; log-uniform."""
BETWEEN: Final = (5.0, 60.0)
"""Time between two absences, s."""
AIM: Final = 10.0
"""s"""
HALF_OPEN_AIM: Final = SILENCES[0] + AIM + 8.0
"""s; 8 s: up to so long until the first request that is not answered."""
_LOOK: Final = 0.02
_GIVES_UP: Final = 900.0

Kind = Literal["unplugged", "refuses", "ignores", "half-open"]
"""How the adapter is away: a serial one has no device file; one on the network refuses
connections, or is a black hole; or it works, but passes nothing on the connection that
is open."""

METHOD = f"""\
In simulated time, on the virtual chargers' wire at its pace, library alone. An adapter
is away for {AWAY[0]:g} s to {AWAY[1] / 60:g} min (log-uniform), {BETWEEN[0]:g} to
{BETWEEN[1]:g} s after the one before; in turn its port is missing (serial), refuses
connections, or ignores them (network). Time from its return until the library has it
open, and until all chargers have a reading again. Half-open: an adapter passes nothing
on the connection that is open, and works on a new one; time from then on, of which the
first {SILENCES[0]:g} s are the silence that shows it."""


@dataclass(frozen=True, slots=True)
class Case:
    """One scene."""

    name: str
    make: Callable[[int], Scene]
    times: int
    half_open: int
    seed: int = 1


@dataclass(slots=True)
class Outcome:
    """Times of one scene, s."""

    opened: list[float] = field(default_factory=list)
    read: list[float] = field(default_factory=list)
    half_open: list[float] = field(default_factory=list)


CASES: Final = {
    "abl": AblScene,
    "evbox": EvboxScene,
    "smartevse 2.17": partial(PolledScene, dialect="2.17"),
    "smartevse 2.30": partial(PolledScene, dialect="2.30"),
    "smartevse slaves": SlaveScene,
    "smartevse nodes": partial(SlaveScene, dialects=NODES),
    "ews": EwsScene,
}


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    times, half_open = (60, 5) if quick else (1000, 50)
    cases = [Case(name, make, times, half_open) for name, make in CASES.items()]
    report(f"{times} absences of each of {len(cases)} adapters")
    outcomes = await simulate_all(absences, cases)
    return [
        figure
        for case, outcome in zip(cases, outcomes, strict=True)
        for figure in case_figures(case.name, outcome)
    ]


async def absences(case: Case) -> Outcome:
    """Run one scene."""
    dice = Random(case.seed)  # noqa: S311 - repeatable on purpose
    outcome = Outcome()
    kinds: tuple[Kind, ...] = ("unplugged", "refuses", "ignores")
    async with case.make(case.seed) as scene:
        await _back(scene)
        for turn in range(case.times):
            await asyncio.sleep(dice.uniform(*BETWEEN))
            away = exp(dice.uniform(*map(log, AWAY)))
            opened, read = await _absence(scene, kinds[turn % len(kinds)], away)
            outcome.opened.append(opened)
            outcome.read.append(read)
        for _ in range(case.half_open):
            # A line that has worked begins anew with the shortest silence.
            await asyncio.sleep(dice.uniform(*BETWEEN))
            scene.disturbed()
            scene.virtual.adapter.stick()
            outcome.half_open.append(await _back(scene, scene.virtual.opened))
    return outcome


async def _absence(scene: Scene, kind: Kind, away: float) -> tuple[float, float]:
    """Be away in one way; return the times until it is open and all have a reading."""
    virtual = scene.virtual
    loop = asyncio.get_running_loop()
    before = virtual.opened
    if kind != "unplugged":
        answer: Answer = "refuses" if kind == "refuses" else "ignores"
        virtual.answer_calls(answer)
    virtual.unplug()
    await asyncio.sleep(away)
    virtual.replug()
    virtual.answer_calls("accepts")
    back = loop.time()
    while virtual.opened == before or not scene.bus.line.is_open:  # noqa: ASYNC110 - of the virtual bus
        await asyncio.sleep(_LOOK)
    opened = loop.time() - back
    return opened, opened + await _back(scene, before)


async def _back(scene: Scene, before: int = 0) -> float:
    """Wait until all chargers have a reading on a new connection; return the time, s."""
    loop = asyncio.get_running_loop()
    began = loop.time()
    async with asyncio.timeout(_GIVES_UP):
        while scene.virtual.opened == before or not all(  # noqa: ASYNC110 - as above
            one.available and one.reading is not None for one in scene.chargers
        ):
            await asyncio.sleep(_LOOK)
    return loop.time() - began


def case_figures(name: str, outcome: Outcome) -> list[Figure]:
    """Return the figures of one scene."""
    note = f"{len(outcome.opened)} absences"
    return [
        _seconds(f"{name}: until open, longest", max(outcome.opened), AIM, note),
        _seconds(f"{name}: until read, p99", percentile(outcome.read, 0.99)),
        _seconds(f"{name}: until read, longest", max(outcome.read), AIM),
        _seconds(
            f"{name}: half-open until read, longest",
            max(outcome.half_open),
            HALF_OPEN_AIM,
            f"{len(outcome.half_open)} times",
        ),
    ]


def _seconds(
    name: str, value: float, aim: float | None = None, note: str = ""
) -> Figure:
    return Figure(NAME, name, value, "s", aim=aim, digits=2, note=note)
