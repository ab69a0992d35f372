"""(m) Chargers behind a slow network adapter."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from random import Random
from typing import Any, Final

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import OrderChange
from tests.virtual.adapter import Adapter

from .figures import Figure, gaps, percentile
from .progress import report
from .simulated import HOUR, simulate_all
from .watched import Scene
from .watched_abl import AblScene
from .watched_evbox import EvboxScene
from .watched_ews import EwsNetworkScene
from .watched_smartevse import NODES, PolledScene, SlaveScene
from .witness import Findings

NAME = "slow-lines"
DELAYS: Final = ((0.0, 0.0), (0.05, 0.0), (0.16, 0.0), (0.4, 0.0), (0.16, 0.3))
"""Delay each way, and up to how much more for each piece, s."""
BETWEEN_ORDERS: Final = (20.0, 60.0)
CURRENTS: Final = (6.0, 8.0, 10.0, 12.5, 14.0, 16.0)
QUIET: Final = 1.5
"""No request is under way after so much silence, s; less than a poll interval."""
_PATIENCE: Final = 60.0

METHOD = """\
In simulated time, an hour for each line and delay, library alone, cars coming and going,
a new limit every 20 to 60 s. The adapter delays all bytes, each way; with jitter each
piece up to 0.3 s more, in order. A late answer is used if the library takes a reply that
the box had sent before it received the request (each piece that the adapter brings back
has the number of the last request that had reached the wire). Poll period: time between
two good turns of one charger."""


@dataclass(frozen=True, slots=True)
class Case:
    """One scene at one delay."""

    name: str
    make: Callable[[int], Scene]
    delay: float
    jitter: float
    seconds: float = HOUR
    seed: int = 1


@dataclass(slots=True)
class Outcome:
    """What a scene has come to."""

    findings: list[Findings] = field(default_factory=list)
    requests: int = 0
    timeouts: int = 0
    late: int = 0
    """Replies that came after their time-out."""
    used_late: int = 0
    commands: list[float] = field(default_factory=list)
    """Time of each confirmed command, s."""
    failed: int = 0
    periods: list[float] = field(default_factory=list)
    """Time between two good turns of one charger, s."""


CASES: Final = {
    "abl": AblScene,
    "evbox": EvboxScene,
    "smartevse 2.17": partial(PolledScene, dialect="2.17"),
    "smartevse 2.20": partial(PolledScene, dialect="2.20"),
    "smartevse 2.30": partial(PolledScene, dialect="2.30"),
    "smartevse slaves": SlaveScene,
    "smartevse nodes": partial(SlaveScene, dialects=NODES),
    "ews network": EwsNetworkScene,
}


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    cases = [
        Case(name, make, delay, jitter, HOUR / 6 if quick else HOUR)
        for name, make in CASES.items()
        for delay, jitter in DELAYS
    ]
    report(f"{len(cases)} scenes of {cases[0].seconds / 60:g} min")
    outcomes = await simulate_all(watch, cases)
    for case, outcome in zip(cases, outcomes, strict=True):
        for found in outcome.findings:
            for note in found.notes[:5]:
                report(f"{label(case)}: {note}")
    return [
        figure
        for case, outcome in zip(cases, outcomes, strict=True)
        for figure in case_figures(case, outcome)
    ]


class LateReplies:
    """Finds replies that the library takes for the answer to a later request.

    Requests are numbered, and pieces that come back by the last request on the wire.
    """

    def __init__(self, adapter: Adapter, bus: Bus) -> None:
        """Count from now on; the adapter must not be in use yet."""
        self.used = 0
        self._written = 0
        self._at_wire = 0
        self._received = 0
        self._numbers = count(1)
        self._watch_adapter(adapter)
        self._watch_exchanges(bus)

    def _watch_adapter(self, adapter: Adapter) -> None:
        take, give = adapter._out, adapter._in  # noqa: SLF001 - a benchmark looks inside

        def out(connection: int, data: bytes) -> None:
            self._at_wire += 1
            take(connection, data)

        def back(connection: int, data: bytes, at_wire: int) -> None:
            self._received = at_wire
            give(connection, data)

        def to_client(data: bytes) -> None:
            forward = partial(_last, back, self._at_wire)
            if not adapter.delay_in and not adapter.jitter:
                forward(adapter._connection, data)  # noqa: SLF001
            else:
                adapter._later(1, adapter.delay_in, forward, data)  # noqa: SLF001

        adapter._out = out  # type: ignore[method-assign] # noqa: SLF001
        adapter.to_client = to_client  # type: ignore[method-assign]

    def _watch_exchanges(self, bus: Bus) -> None:
        wire, write = bus.wire, bus.line.write
        exchange = wire.exchange

        def counted(data: bytes, **options: Any) -> float:  # noqa: ANN401 - of write
            self._written = next(self._numbers)
            return write(data, **options)

        async def watched(*args: Any, **options: Any) -> Any:  # noqa: ANN401 - of exchange
            result = await exchange(*args, **options)
            self.used += self._received != self._written
            return result

        bus.line.write = counted  # type: ignore[method-assign]
        wire.exchange = watched  # type: ignore[method-assign]


def _last(
    function: Callable[[int, bytes, int], None],
    number: int,
    connection: int,
    data: bytes,
) -> None:
    function(connection, data, number)


async def watch(case: Case) -> Outcome:
    """Run one scene."""
    dice = Random(case.seed)  # noqa: S311 - repeatable on purpose
    outcome = Outcome()
    async with case.make(case.seed) as scene:
        adapter = scene.virtual.adapter
        adapter.delay_out = adapter.delay_in = case.delay
        adapter.jitter = case.jitter
        if scene.dials:
            # Requests before it is identified are not those of its bus.
            await _settled(scene)
        late = LateReplies(adapter, scene.bus)
        # What the library must learn about a slow line first is not counted.
        await asyncio.sleep(_PATIENCE)
        turns = [_turns(one) for one in scene.chargers]
        ordering = asyncio.create_task(_order(scene.chargers, dice, outcome))
        await asyncio.sleep(case.seconds)
        ordering.cancel()
        await asyncio.wait([ordering])
        if not ordering.cancelled() and ordering.exception() is not None:
            raise RuntimeError from ordering.exception()
        outcome.periods = [period for times in turns for period in gaps(times)]
        outcome.findings = [witness.end() for witness in scene.witnesses]
        statistics = scene.bus.wire.statistics
        outcome.requests = statistics.requests
        outcome.timeouts = statistics.timeouts
        outcome.late = statistics.late
        outcome.used_late = late.used
    return outcome


async def _settled(scene: Scene) -> None:
    """Wait until all chargers have a reading, and the line is quiet."""
    loop = asyncio.get_running_loop()
    line = scene.bus.line
    while (  # noqa: ASYNC110 - there is no event for silence
        not all(one.available for one in scene.chargers)
        or loop.time() - line.last_activity < QUIET
    ):
        await asyncio.sleep(QUIET / 10)


def _turns(charger: Charger) -> list[float]:
    """Return a list that gets the time of each good turn of a charger."""
    times: list[float] = []
    on_reply = charger.on_reply

    def counted(now: float) -> None:
        times.append(now)
        on_reply(now)

    charger.on_reply = counted  # type: ignore[method-assign]
    return times


async def _order(chargers: list[Charger], dice: Random, outcome: Outcome) -> None:
    loop = asyncio.get_running_loop()
    while True:
        await asyncio.sleep(dice.uniform(*BETWEEN_ORDERS))
        charger = dice.choice(chargers)
        began = loop.time()
        try:
            await charger.change_orders(OrderChange(current=dice.choice(CURRENTS)))
        except EvseError:
            outcome.failed += 1
        else:
            outcome.commands.append(loop.time() - began)


def label(case: Case) -> str:
    """Return the name of a case."""
    jitter = f" + {case.jitter * 1000:.0f}" if case.jitter else ""
    return f"{case.name}, {case.delay * 1000:.0f}{jitter} ms"


def case_figures(case: Case, outcome: Outcome) -> list[Figure]:
    """Return the figures of one scene."""
    found = outcome.findings
    watched = sum(one.watched for one in found) or 1.0
    away = sum(one.away for one in found)
    wrong = sum(one.wrong + one.wrong_totals + one.wrong_identities for one in found)
    commands = outcome.commands or [0.0]
    periods = outcome.periods or [0.0]
    name = label(case)
    return [
        Figure(
            NAME,
            f"{name}: late answers used, wrong values, missed keep-alives",
            outcome.used_late + wrong + sum(one.missed for one in found),
            aim=0,
            digits=0,
            note=f"{outcome.used_late}, {wrong}, {sum(one.missed for one in found)};"
            f" {outcome.timeouts} time-outs of {outcome.requests} requests,"
            f" {outcome.late} late answers",
        ),
        Figure(
            NAME,
            f"{name}: available",
            100 * (1 - away / watched),
            "%",
            digits=2,
            note=f"poll period {percentile(periods, 0.5):.1f} s,"
            f" p99 {percentile(periods, 0.99):.1f} s",
        ),
        Figure(
            NAME,
            f"{name}: command until confirmed, p99",
            percentile(commands, 0.99),
            "s",
            digits=2,
            note=f"median {percentile(commands, 0.5):.2f} s,"
            f" {outcome.failed} of {len(outcome.commands) + outcome.failed} failed",
        ),
    ]
