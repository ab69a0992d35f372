"""(f) Home Assistant as load-balancing master: broadcasts, replies, offers."""

import asyncio
from collections.abc import Sequence
from math import inf
from random import Random
from statistics import fmean
from typing import Final

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.model import Circuit, OrderChange
from custom_components.evse_bus.evse.smartevse.master import SLACK

from .balancing import (
    REPEATS,
    Shared,
    SlaveRequest,
    broadcasts,
    longest_silence,
    on_plan,
    requests,
    sums,
)
from .figures import Figure, gaps, percentile
from .offers import Offer
from .oracle import Oracle
from .progress import report
from .random_commands import RandomCommands
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

NAME = "smartevse-master"
METHOD = """\
Two virtual SmartEVSEs (2.17, slaves 2 and 3) in a process of their own on a pty paced
at 9600 8N1, each polled every 2 s; library alone. Their cars come, wait, charge and
leave by themselves; meanwhile currents (6 to 16 A), permissions and the shared supply
(12 to 32 A) change at random moments, 1 s apart on average. Then the same with one of
them dead, and then, with both cars charging all the time and 32 A to share, set-points
alone; at last 22 A to share, where one goes up only after the other has gone down. All
times are from the virtual bus's log and from the boxes' own records. Deviation: of a
broadcast from a grid of exactly 2 s, read once from the library at the beginning;
broadcasts between, sent because of a change, do not count as late or early. Answer:
from the time the bus is idle after a box's request to the first byte of our reply.
Offered: the pilot of the box has the new current."""

UNITS: Final = (2, 3)
SUPPLY: Final = 32.0
LIFE: Final = {
    "away": [1.0, 8.0],
    "hesitates": [0.0, 4.0],
    "wants_wh": [5.0, 60.0],
    "stays": [1.0, 6.0],
}
"""The lives of the cars: a charge takes less than a minute."""
SEED: Final = 3
FOLLOWED: Final = 3.0
"""Time after which all boxes have their new share, s."""
TOO_LONG: Final = 5.0
"""Longest time allowed without a broadcast, s."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    report("two slaves with cars that come and go")
    both = await _busy(20.0 if quick else 600.0)
    report("the same with one of them dead")
    one = await _busy(20.0 if quick else 120.0, dead=True)
    report("set-points")
    return [*both, *one, *await _set_points(10 if quick else 100)]


# -- A busy bus ------------------------------------------------------------------


async def _busy(seconds: float, *, dead: bool = False) -> list[Figure]:
    boxes = [
        {
            "load_balance": unit,
            "cable": 32,
            "max_current": 32,
            "car": LIFE | {"seed": s},
        }
        for s, unit in enumerate(UNITS)
    ]
    loop = asyncio.get_running_loop()
    async with Oracle("smartevse", boxes=boxes) as oracle:
        bus = master_bus(oracle.url, UNITS, SUPPLY)
        chargers = list(bus.chargers.values())
        shared = [Shared(loop.time(), SUPPLY)]
        await bus.start()
        try:
            await settled(bus)
            if dead:
                await oracle.kill([chargers[1].config.key])
                del chargers[1]
            begin = await _plan(bus)
            commands = RandomCommands(bus, chargers, shared, Random(SEED))  # noqa: S311
            await commands.run(seconds)
            end = loop.time()
        finally:
            await bus.stop()
        log = [frame for frame in await oracle.log(begin - 1.0) if frame.start <= end]
        offers = [offer for offer in await oracle.offers() if offer.at <= end]
    times = [time for time in broadcasts(log) if time >= begin - 1.0]
    prefix = "one dead: " if dead else ""
    figures = [
        *_punctuality(prefix, times, begin, end),
        *_safety(prefix, offers, shared, end),
        _given(prefix, commands),
    ]
    if not dead:
        # Requests at the very end had no time for a reply.
        made = [one for one in requests(log) if begin < one.end < end - REPEATS]
        figures[-1:-1] = _answers(made)
    return figures


async def _plan(bus: Bus) -> float:
    """Return the time of a due broadcast, once there are any."""
    async with asyncio.timeout(10.0):
        while True:
            if bus.master is not None and bus.master.slot.start_by < inf:
                return bus.master.slot.start_by - SLACK
            await asyncio.sleep(0.1)


def _punctuality(
    prefix: str, times: Sequence[float], begin: float, end: float
) -> list[Figure]:
    due = on_plan(times, begin)
    intervals = gaps(time for time, _ in due)
    off = [abs(deviation) for _, deviation in due]
    silence = longest_silence(times, end)
    between = len(times) - len(due)
    return [
        _milliseconds(f"{prefix}interval, min", min(intervals), note=f"{len(due)} due"),
        _milliseconds(f"{prefix}interval, mean", fmean(intervals)),
        _milliseconds(f"{prefix}interval, p99", percentile(intervals, 0.99)),
        _milliseconds(f"{prefix}interval, max", max(intervals)),
        _milliseconds(f"{prefix}deviation from the plan, mean", fmean(off)),
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


def _answers(made: Sequence[SlaveRequest]) -> list[Figure]:
    clean = [one for one in made if not one.garbled]
    answered = [one for one in clean if one.replied is not None]
    waited = [one.replied - one.idle for one in answered if one.replied is not None]
    total = [one.replied - one.end for one in answered if one.replied is not None]
    kinds = ", ".join(
        f"{register:02d}: {sum(one.register == register for one in made)}"
        for register in (1, 2, 3, 4)
    )
    if not waited:
        return [_count("requests of the boxes", 0, note="there were none")]
    return [
        _milliseconds("answer to a box's request, p50", percentile(waited, 0.5)),
        _milliseconds(
            "answer to a box's request, p99",
            percentile(waited, 0.99),
            200,
            note=f"{len(made)} requests ({kinds})",
        ),
        _milliseconds("answer to a box's request, max", max(waited), 1000),
        _milliseconds("request over to answer, max", max(total), 1000),
        _count(
            "requests that were not answered in time",
            len(clean) - len(answered),
            note=f"beside {len(made) - len(clean)} that collided with our own frames",
        ),
    ]


def _safety(
    prefix: str, offers: Sequence[Offer], shared: Sequence[Shared], end: float
) -> list[Figure]:
    found = sums(offers, shared, end)
    return [
        _count(
            f"{prefix}sum of the offers risen above the supply",
            found.violations,
            note=f"highest {found.most:.1f} A; {len(offers)} changes of an offer",
        ),
        _milliseconds(
            f"{prefix}lowered supply to the boxes below it, max", found.longest
        ),
    ]


def _given(prefix: str, commands: RandomCommands) -> Figure:
    errors = "; ".join(sorted(set(commands.refused))[:3])
    return _count(
        f"{prefix}commands that failed",
        len(commands.refused),
        note=f"of {commands.given}" + (f": {errors}" if errors else ""),
    )


# -- Set-points ------------------------------------------------------------------


async def _set_points(times: int) -> list[Figure]:
    boxes = [
        {"load_balance": unit, "cable": 32, "max_current": 32, "car": "plugged"}
        for unit in UNITS
    ]
    async with Oracle("smartevse", boxes=boxes) as oracle:
        bus = master_bus(oracle.url, UNITS, SUPPLY)
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
        *set_point_figures(NAME, "", called, offers),
        *_share_figures("one lowered to the other risen", freed, offers),
        *_share_figures("one raised to its share offered", restored, offers),
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
