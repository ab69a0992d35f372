"""(f) Home Assistant as load-balancing master: broadcasts, replies, offers."""

import asyncio
from collections.abc import Sequence
from dataclasses import replace
from random import Random
from statistics import fmean
from typing import Final

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.model import Circuit, OrderChange

from .balancing import (
    PERIOD,
    REPEATS,
    SlaveRequest,
    asked_by_state,
    broadcasts,
    longest_silence,
    on_plan,
    readings,
    repeated,
    requests,
    rounds,
    sums,
)
from .figures import Figure, gaps, percentile
from .master_scene import MasterScene, Seen, at_real_pace, in_simulated_time
from .offers import Offer
from .oracle import Oracle
from .progress import report
from .set_points import (
    HIGH,
    LOW,
    PAUSES,
    Called,
    offered_after,
    set_point_figures,
    set_points,
    until_all_charge,
)
from .setup import master_bus, settled
from .simulated import HOUR, simulate_all

NAME = "smartevse-master"
OPTIONS: Final = ("minutes", "scene")
METHOD = """\
Virtual SmartEVSEs of one family, each polled every 2 s, in a process of their own on a
pty paced at 9600 8N1; library alone. Their cars come, wait, charge and leave by
themselves; meanwhile currents (6 to 16 A), permissions and the shared supply (some of
them too little for all) change at random moments, 1 s apart on average. Then the same
with one of them dead, and for some hours in simulated time. Then, with both cars of two
boxes charging all the time and 32 A to share, set-points alone; at last 22 A to share,
where one goes up only after the other has gone down. All times are from the virtual
bus's log and from the boxes' own records. Deviation: of a broadcast from a grid of
exactly 2 s, read once from the library at the beginning; broadcasts between, sent
because of a change, do not count as late or early. Answer: from the time the bus is idle
after a box's request (2.17), or from the end of the reading that shows its request (later
ones), to the first byte of our reply. Round: from a due broadcast until each box was
read. Offered: the pilot of the box has the new current."""

TWO_17: Final = MasterScene(
    "2.17 x3", ("2.17",) * 3, (32.0, 12.0, 16.0, 20.0, 25.0, 48.0)
)
SEVEN: Final = (80.0, 24.0, 32.0, 44.0, 50.0, 63.0, 112.0)
"""Supplies for seven boxes; 42 A is the least for all of them."""
TWO_20: Final = MasterScene("2.20 x7", ("2.20",) * 7, SEVEN)
LATER: Final = MasterScene(
    "2.30 to 3.x x7",
    ("2.30", "2.30", "2.30+", "2.30+", "3", "3.8", "3.6"),
    SEVEN,
)
SCENES: Final = (
    TWO_17,
    replace(TWO_17, name="2.17 x3, one dead", dead=True),
    TWO_20,
    LATER,
    replace(LATER, name="2.30 to 3.x x7, one dead", dead=True),
)
PAIRS: Final = tuple(
    MasterScene(f"{name} x2, set-points", dialects, TWO_17.supplies)
    for name, dialects in (
        ("2.17", ("2.17", "2.17")),
        ("2.20", ("2.20", "2.20")),
        ("2.30 to 3.x", ("2.30", "2.30+")),
    )
)
MINUTES: Final = 10.0
"""Of each scene; one with a dead box takes a fifth of it."""
SHORT: Final = 1 / 3
SIMULATED: Final = 2 * HOUR
SEED: Final = 3
FOLLOWED: Final = 3.0
"""Time after which all boxes have their new share, s."""
TOO_LONG: Final = 5.0
"""Longest time allowed without a broadcast, s."""


async def run(
    *, quick: bool, minutes: float | None = None, scene: str = ""
) -> list[Figure]:
    """Return the figures; ``minutes`` of each scene whose name has ``scene`` in it."""
    scenes = [one for one in SCENES if scene in one.name]
    figures: list[Figure] = []
    for one in scenes:
        length = minutes or (SHORT if quick else MINUTES)
        seconds = 60 * length / (5 if one.dead else 1)
        report(f"{one.name}, {seconds:.0f} s")
        figures += _figures(one, await at_real_pace(one, seconds))
    alive = [one for one in scenes if not one.dead]
    report(f"{len(alive)} scenes in simulated time")
    cases = [(one, HOUR / 6 if quick else SIMULATED) for one in alive]
    for some in await simulate_all(_simulated, cases):
        figures += some
    for two in PAIRS:
        if scene in two.name:
            report(two.name)
            figures += await _set_points(two, 10 if quick else 60)
    return figures


async def _simulated(case: tuple[MasterScene, float]) -> list[Figure]:
    scene, seconds = case
    name = f"{scene.name}, {seconds / HOUR:.1f} h simulated"
    return _figures(replace(scene, name=name), await in_simulated_time(*case))


# -- A busy bus ------------------------------------------------------------------


def _figures(scene: MasterScene, seen: Seen) -> list[Figure]:
    begin, end = seen.given.begin, seen.given.end
    times = [time for time in broadcasts(seen.log) if time >= begin - 1.0]
    made = requests(seen.log)
    asks = [*repeated(made, end), *asked_by_state(seen.log, end)]
    late = [one for one in asks if one.since > begin and one.waited > PERIOD]
    waited = [one.waited for one in asks if one.answered is not None] or [0.0]
    kinds = sorted({one.kind for one in asks})
    counted = ", ".join(
        f"{kind}: {sum(one.kind == kind for one in asks)}" for kind in kinds
    )
    # Requests at the very end had no time for a reply.
    in_time = [one for one in made if begin < one.end < end - REPEATS]
    prefix = f"{scene.name}: "
    return [
        *_punctuality(prefix, times, begin, end),
        *_readings(prefix, scene, times, seen),
        *_safety(prefix, seen),
        _count(
            f"{prefix}boxes left without an answer for more than {PERIOD:.0f} s",
            len(late),
            note=f"of {len(asks)} ({counted}); longest {max(waited):.2f} s",
        ),
        _milliseconds(
            f"{prefix}box's request to its answer, p50", percentile(waited, 0.5)
        ),
        _milliseconds(
            f"{prefix}box's request to its answer, p99", percentile(waited, 0.99)
        ),
        *_answers(prefix, in_time),
        _given(prefix, seen),
        Figure(
            NAME,
            f"{prefix}processor time",
            100 * seen.given.processor / (end - begin),
            "%",
            note="of one core; where simulated, with the boxes",
        ),
    ]


def _punctuality(
    prefix: str, times: Sequence[float], begin: float, end: float
) -> list[Figure]:
    due = on_plan(times, begin)
    intervals = gaps(time for time, _ in due)
    off = [abs(deviation) for _, deviation in due]
    silence = longest_silence(times, end)
    between = len(times) - len(due)
    return [
        _milliseconds(
            f"{prefix}interval, max",
            max(intervals),
            note=f"{len(due)} due; mean {fmean(intervals) * 1000:.1f} ms,"
            f" min {min(intervals) * 1000:.1f} ms",
        ),
        _milliseconds(f"{prefix}deviation from the plan, p50", percentile(off, 0.5)),
        _milliseconds(
            f"{prefix}deviation from the plan, p99", percentile(off, 0.99), 50
        ),
        _milliseconds(f"{prefix}deviation from the plan, max", max(off)),
        _count(
            f"{prefix}times without a broadcast over {TOO_LONG:.0f} s",
            sum(gap > TOO_LONG for gap in gaps([*times, end])),
            note=f"longest {silence:.3f} s; {between} broadcasts between the due ones",
        ),
    ]


def _readings(
    prefix: str, scene: MasterScene, times: Sequence[float], seen: Seen
) -> list[Figure]:
    due = [time for time, _ in on_plan(times, seen.given.begin)]
    made = [one for one in readings(seen.log) if one.start >= seen.given.begin]
    lengths, left_out = rounds(due, made, scene.living)
    missed = sum(one.end is None for one in made if one.unit in scene.living)
    periods = [
        gap
        for unit in scene.living
        for gap in gaps(
            one.start for one in made if one.unit == unit and one.end is not None
        )
    ]
    return [
        _milliseconds(
            f"{prefix}round, p50",
            percentile(lengths or [0.0], 0.5),
            note=f"p99 {percentile(lengths or [0.0], 0.99) * 1000:.0f} ms,"
            f" max {max(lengths, default=0.0) * 1000:.0f} ms",
        ),
        Figure(
            NAME,
            f"{prefix}boxes left out of a round",
            left_out,
            digits=0,
            note=f"of {len(due)} rounds; longest time between two readings of a box"
            f" {max(periods, default=0.0):.2f} s",
        ),
        Figure(
            NAME,
            f"{prefix}readings without a reply",
            missed,
            digits=0,
            note=f"of {len(made)}",
        ),
    ]


def _answers(prefix: str, made: Sequence[SlaveRequest]) -> list[Figure]:
    """Return the figures of the single requests of 2.17, repetitions included."""
    clean = [one for one in made if not one.garbled]
    answered = [one for one in clean if one.replied is not None]
    waited = [one.replied - one.idle for one in answered if one.replied is not None]
    if not waited:
        return []
    return [
        _milliseconds(f"{prefix}answer to a request, p50", percentile(waited, 0.5)),
        _milliseconds(
            f"{prefix}answer to a request, p99",
            percentile(waited, 0.99),
            200,
            note=f"{len(made)} requests",
        ),
        _milliseconds(f"{prefix}answer to a request, max", max(waited), 1000),
        _count(
            f"{prefix}requests that were not answered in time",
            len(clean) - len(answered),
            note=f"beside {len(made) - len(clean)} that collided with other frames",
        ),
    ]


def _safety(prefix: str, seen: Seen) -> list[Figure]:
    found = sums(seen.offers, seen.shared, seen.given.end)
    return [
        _count(
            f"{prefix}sum of the offers risen above the supply",
            found.violations,
            note=f"for {found.seconds:.1f} s; highest {found.most:.1f} A;"
            f" {len(seen.offers)} changes of an offer",
        ),
        _milliseconds(
            f"{prefix}lowered supply to the boxes below it, max", found.longest
        ),
    ]


def _given(prefix: str, seen: Seen) -> Figure:
    refused = seen.given.commands.refused
    errors = "; ".join(sorted(set(refused))[:3])
    return _count(
        f"{prefix}commands that failed",
        len(refused),
        note=f"of {seen.given.commands.given}" + (f": {errors}" if errors else ""),
    )


# -- Set-points ------------------------------------------------------------------


async def _set_points(two: MasterScene, times: int) -> list[Figure]:
    async with Oracle("smartevse", boxes=two.boxes(plugged=True)) as oracle:
        bus = master_bus(oracle.url, two.units, two.supplies[0])
        await bus.start()
        try:
            await settled(bus)
            chargers = list(bus.chargers.values())
            await until_all_charge(oracle, chargers)
            called = await set_points(chargers, times)
            report("one box lowered, so that the other may go up")
            freed, restored = await _shares(bus, times // 5)
        finally:
            await bus.stop()
        offers = await oracle.offers()
    return [
        *set_point_figures(NAME, f"{two.name}: ", called, offers),
        *_share_figures(f"{two.name}: one lowered to the other risen", freed, offers),
        *_share_figures(
            f"{two.name}: one raised to its share offered", restored, offers
        ),
    ]


async def _shares(bus: Bus, times: int) -> tuple[list[Called], list[Called]]:
    """Lower one box and raise it again; return the expected offers of both boxes."""
    dice = Random(SEED)  # noqa: S311 - repeatable on purpose
    loop = asyncio.get_running_loop()
    one, other = bus.chargers.values()
    for charger in (one, other):
        await charger.change_orders(OrderChange(current=HIGH))
    if bus.master is not None:
        await bus.master.change_circuit(Circuit(limit=HIGH + LOW))
    await asyncio.sleep(FOLLOWED)
    freed: list[Called] = []
    restored: list[Called] = []
    for _ in range(times):
        for seen, charger, amps, ordered in (
            (freed, other, HIGH, LOW),
            (restored, one, (HIGH + LOW) / 2, HIGH),
        ):
            begin = loop.time()
            await one.change_orders(OrderChange(current=ordered))
            seen.append(Called(charger.config.key, amps, begin, loop.time()))
            await asyncio.sleep(FOLLOWED + dice.uniform(*PAUSES))
    return freed, restored


def _share_figures(
    name: str, called: Sequence[Called], offers: Sequence[Offer]
) -> list[Figure]:
    waited = [offered_after(one, offers) for one in called]
    there = [one for one in waited if one is not None]
    note = f"{len(there)} of {len(called)} followed"
    if not there:
        return [_count(f"{name}: never", len(called), note=note)]
    return [
        _milliseconds(f"{name}, {words}", percentile(there, share), note=note)
        for words, share in (("p50", 0.5), ("p99", 0.99))
    ]


def _milliseconds(
    name: str, seconds: float, aim: float | None = None, note: str = ""
) -> Figure:
    return Figure(
        benchmark=NAME, name=name, value=seconds * 1000, unit="ms", aim=aim, note=note
    )


def _count(name: str, value: int, note: str = "") -> Figure:
    return Figure(benchmark=NAME, name=name, value=value, aim=0, digits=0, note=note)
