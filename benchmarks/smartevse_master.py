"""(f) Home Assistant as load-balancing master: is it punctual, quick, never too much."""

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
    Asked,
    Shared,
    broadcasts,
    longest_silence,
    on_plan,
    requests,
    sums,
)
from .commands import House
from .figures import Figure, gaps, percentile
from .offers import Offer
from .progress import say
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
from .witness import Witness

NAME = "smartevse-master"
METHOD = """\
Two virtual SmartEVSEs (2.17, slaves 2 and 3) in a process of their own on a pty paced
at 9600 8N1, each polled every 2 s; library alone. Their cars come, wait, charge and
leave by themselves; meanwhile currents (6 to 16 A), permissions and the shared supply
(12 to 32 A) change at random moments, 1 s apart on average. Then the same with one of
them dead, and then, with both cars charging all the time and 32 A to share, set-points
alone; at last 22 A to share, where one goes up only after the other has gone down. All times are from the virtual bus's log and from the boxes' own diaries.
Deviation: of a broadcast from a grid of exactly 2 s, read once from the library at the
beginning; broadcasts sent between, because something had changed, are not counted as
late or early ones. Answer: from the moment when nobody speaks any more after a box's
request to the first byte of ours. Offered: the box's pilot says the new current."""

UNITS: Final = (2, 3)
SUPPLY: Final = 32.0
LIFE: Final = {
    "away": [1.0, 8.0],
    "hesitates": [0.0, 4.0],
    "wants_wh": [5.0, 60.0],
    "stays": [1.0, 6.0],
}
"""Habits of the cars: all of it within a minute."""
SEED: Final = 3
FOLLOWED: Final = 3.0
"""By then all boxes have their new share, s."""
TOO_LONG: Final = 5.0
"""No time without a broadcast may be longer, s."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    say("two slaves with cars that come and go")
    both = await _busy(20.0 if quick else 600.0)
    say("the same with one of them dead")
    one = await _busy(20.0 if quick else 120.0, dead=True)
    say("set-points")
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
    async with Witness("smartevse", boxes=boxes) as witness:
        bus = master_bus(witness.url, UNITS, SUPPLY)
        chargers = list(bus.chargers.values())
        shared = [Shared(loop.time(), SUPPLY)]
        await bus.start()
        try:
            await settled(bus)
            if dead:
                await witness.kill([chargers[1].config.key])
                del chargers[1]
            begin = await _plan(bus)
            house = House(bus, chargers, shared, Random(SEED))  # noqa: S311
            await house.live(seconds)
            end = loop.time()
        finally:
            await bus.stop()
        log = [heard for heard in await witness.log(begin - 1.0) if heard.start <= end]
        offers = [offer for offer in await witness.offers() if offer.at <= end]
    times = [time for time in broadcasts(log) if time >= begin - 1.0]
    what = "one dead: " if dead else ""
    figures = [
        *_punctuality(what, times, begin, end),
        *_safety(what, offers, shared, end),
        _given(what, house),
    ]
    if not dead:
        # What came at the very end had no time to be answered.
        asked = [one for one in requests(log) if begin < one.end < end - REPEATS]
        figures[-1:-1] = _answers(asked)
    return figures


async def _plan(bus: Bus) -> float:
    """Return when a broadcast is due, as soon as there are any."""
    async with asyncio.timeout(10.0):
        while True:
            if bus.master is not None and bus.master.slot.start_by < inf:
                return bus.master.slot.start_by - SLACK
            await asyncio.sleep(0.1)


def _punctuality(
    what: str, times: Sequence[float], begin: float, end: float
) -> list[Figure]:
    due = on_plan(times, begin)
    intervals = gaps(time for time, _ in due)
    off = [abs(deviation) for _, deviation in due]
    silence = longest_silence(times, end)
    between = len(times) - len(due)
    return [
        _milliseconds(f"{what}interval, min", min(intervals), note=f"{len(due)} due"),
        _milliseconds(f"{what}interval, mean", fmean(intervals)),
        _milliseconds(f"{what}interval, p99", percentile(intervals, 0.99)),
        _milliseconds(f"{what}interval, max", max(intervals)),
        _milliseconds(f"{what}deviation from the plan, mean", fmean(off)),
        _milliseconds(f"{what}deviation from the plan, p99", percentile(off, 0.99), 50),
        _milliseconds(f"{what}deviation from the plan, max", max(off)),
        _count(
            f"{what}times without a broadcast over {TOO_LONG:.0f} s",
            sum(gap > TOO_LONG for gap in gaps([*times, end])),
            note=f"longest {silence:.3f} s; {between} broadcasts between the due ones",
        ),
    ]


def _answers(asked: Sequence[Asked]) -> list[Figure]:
    heard = [one for one in asked if not one.garbled]
    answered = [one for one in heard if one.answered is not None]
    waited = [one.answered - one.idle for one in answered if one.answered is not None]
    total = [one.answered - one.end for one in answered if one.answered is not None]
    kinds = ", ".join(
        f"{register:02d}: {sum(one.register == register for one in asked)}"
        for register in (1, 2, 3, 4)
    )
    if not waited:
        return [_count("requests of the boxes", 0, note="none came")]
    return [
        _milliseconds("answer to a box's request, p50", percentile(waited, 0.5)),
        _milliseconds(
            "answer to a box's request, p99",
            percentile(waited, 0.99),
            200,
            note=f"{len(asked)} requests ({kinds})",
        ),
        _milliseconds("answer to a box's request, max", max(waited), 1000),
        _milliseconds("request over to answer, max", max(total), 1000),
        _count(
            "requests that were not answered in time",
            len(heard) - len(answered),
            note=f"beside {len(asked) - len(heard)} that collided with our own words",
        ),
    ]


def _safety(
    what: str, offers: Sequence[Offer], shared: Sequence[Shared], end: float
) -> list[Figure]:
    found = sums(offers, shared, end)
    return [
        _count(
            f"{what}sum of the offers risen above the supply",
            found.violations,
            note=f"highest {found.most:.1f} A; {len(offers)} changes of an offer",
        ),
        _milliseconds(
            f"{what}lowered supply to the boxes below it, max", found.longest
        ),
    ]


def _given(what: str, house: House) -> Figure:
    why = "; ".join(sorted(set(house.refused))[:3])
    return _count(
        f"{what}commands that were not obeyed",
        len(house.refused),
        note=f"of {house.given}" + (f": {why}" if why else ""),
    )


# -- Set-points ------------------------------------------------------------------


async def _set_points(times: int) -> list[Figure]:
    boxes = [
        {"load_balance": unit, "cable": 32, "max_current": 32, "car": "plugged"}
        for unit in UNITS
    ]
    async with Witness("smartevse", boxes=boxes) as witness:
        bus = master_bus(witness.url, UNITS, SUPPLY)
        await bus.start()
        try:
            await settled(bus)
            chargers = list(bus.chargers.values())
            await until_all_charge(witness, chargers)
            called = await set_points(chargers, times)
            say("one box lowered, so that the other may go up")
            freed, given_back = await _shares(bus, times // 5)
        finally:
            await bus.stop()
        offers = await witness.offers()
    return [
        *set_point_figures(NAME, "", called, offers),
        *_share_figures("one lowered to the other risen", freed, offers),
        *_share_figures("one raised to its share offered", given_back, offers),
    ]


async def _shares(bus: Bus, times: int) -> tuple[list[Called], list[Called]]:
    """Let one box down and up again; return what is to be seen at the two boxes."""
    dice = Random(SEED)  # noqa: S311 - repeatable on purpose
    loop = asyncio.get_running_loop()
    one, other = bus.chargers.values()
    for charger in (one, other):
        await charger.change_orders(OrderChange(current=HIGH))
    if bus.master is not None:
        await bus.master.change_circuit(Circuit(limit=HIGH + LOW))
    await asyncio.sleep(FOLLOWED)
    freed: list[Called] = []
    given_back: list[Called] = []
    for _ in range(times):
        for seen, charger, amps, ordered in (
            (freed, other, HIGH, LOW),
            (given_back, one, (HIGH + LOW) / 2, HIGH),
        ):
            begin = loop.time()
            await one.change_orders(OrderChange(current=ordered))
            seen.append(Called(charger.config.key, amps, begin, loop.time()))
            await asyncio.sleep(FOLLOWED + dice.uniform(*PAUSES))
    return freed, given_back


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
