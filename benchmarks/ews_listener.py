"""(j) 50 EWS-Boxes that dial one listener: their cost, and their poll periods."""

import asyncio
from collections.abc import Mapping, Sequence
from functools import partial
from statistics import fmean
import time
from typing import Any, Final, NamedTuple

from .cost import block_figure, busy_figure, cost_figures, measure
from .ews_boxes import REDIALS_AFTER
from .figures import Figure, gaps, percentile
from .house import LOADED, House, free_port
from .house_boxes import box_entry
from .oracle import Oracle
from .progress import report

NAME = "ews-listener"
_figure = partial(Figure, NAME)

BOXES: Final = 50
INTERVAL: Final = 2.0
FIRST_SERIAL: Final = 20_140_600_001
SHORT: Final = 3.0
"""Loss of the network that no end notices, s."""
LONG: Final = 40.0
"""Loss of the network after which all connections were given up, s."""
LONGEST: Final = 1800.0
"""Limit for the whole benchmark, s."""

METHOD = f"""\
A real Home Assistant ({LOADED}); {BOXES} virtual EWS-Boxes of two ports, in one other
process, dial its listener on 127.0.0.1, again {REDIALS_AFTER:g} s after each failed
attempt. All are polled every 2 s, once with free ports, then with a car charging at each
of the 100 ports. CPU, memory and blocks as in home-assistant. A period is the time
between two rc in the record of a box, while all are polled and nothing else. 'Until all
are available': until no port's status is unavailable; from the beginning of the set-up
(the boxes dial already), and from the time at which all network cables, which leave
half-open connections when pulled, are plugged in again: after {LONG:g} s, and after
{SHORT:g} s, when no end has noticed the loss; then it is until the last box has received
rc again. A serial number that is connected keeps its connection until the box has not
answered on it for 10 s."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    seconds = 15.0 if quick else 90.0
    serials = [f"{FIRST_SERIAL + number:012d}" for number in range(BOXES)]
    boxes = [{"serial": serial} for serial in serials]
    port = free_port()
    async with asyncio.timeout(LONGEST):
        report("starting Home Assistant")
        async with House() as house:
            # Its work after the start is not measured.
            await house.do("cost", seconds=15.0 if quick else 45.0)
            report(f"idle, 2 x {seconds:.0f} s")
            idle = await measure(house, seconds)
            async with Oracle("ews", boxes=boxes, dial=f"127.0.0.1:{port}") as oracle:
                report(f"adding {BOXES} boxes that dial already")
                entry = box_entry(
                    serials, interval=INTERVAL, host="127.0.0.1", port=port
                )
                adding = await house.do("add_boxes", **entry)
                begun = await house.do("statistics")
                new = await house.do("cost", seconds=0.1)
                # Clocks and limits are set; Home Assistant writes the new entities.
                await house.do("cost", seconds=20.0)
                return [
                    *await _polled(house, oracle, idle, seconds),
                    _figure(
                        "memory, more at once when they are added",
                        (new["memory"] - idle["memory"]) / 1e6,
                        "MB",
                        note="before Home Assistant writes its registries",
                    ),
                    *_there("added", adding["took"], begun),
                    block_figure(NAME, "longest block while they are added", adding),
                    busy_figure(NAME, "while they are added", adding),
                    *await _away(house, oracle, SHORT),
                    *await _away(house, oracle, LONG),
                    *await _reloaded(house),
                ]


async def _polled(
    house: House, oracle: Oracle, idle: Mapping[str, Any], seconds: float
) -> list[Figure]:
    """Measure with free ports, and with all ports charging."""
    counted = await house.do("statistics")
    before = (await oracle.stats())["dropped"]
    since = time.monotonic()
    report(f"{BOXES} boxes with free ports, 2 x {seconds:.0f} s")
    free = await measure(house, seconds)
    polls = [_Window(since, time.monotonic())]
    report("all charge")
    await oracle.plug_in()
    # A car is detected within a second; its port is read every two.
    await house.do("cost", seconds=5.0)
    took = await house.do("charge")
    await house.do("cost", seconds=10.0)
    report(f"{BOXES} boxes with 100 cars, 2 x {seconds:.0f} s")
    begun = time.monotonic()
    charging = await measure(house, seconds)
    polls.append(_Window(begun, time.monotonic()))
    commands = await oracle.commands(since)
    stats = await oracle.stats()
    after = await house.do("statistics")
    return [
        _figure(
            "CPU, more with free ports",
            (free["cpu"] - idle["cpu"]) * 100,
            "% of a core",
            note=f"{free['changes_per_second']:.0f} changes/s",
        ),
        *cost_figures(NAME, idle, charging, "100 cars charging"),
        _figure(
            "100 starts by one call",
            took,
            "s",
            digits=2,
            note=f"{_charging(stats)} ports charge",
        ),
        *period_figures(commands, polls),
        _figure(
            "missed deadlines",
            after["missed_deadlines"],
            aim=0,
            digits=0,
            note=f"{after['requests'] - counted['requests']} requests,"
            f" {after['timeouts']} time-outs, {after['bad_frames']} bad frames",
        ),
        _figure(
            "connections dropped",
            _dropped(stats["dropped"]) - _dropped(before),
            aim=0,
            digits=0,
            note=f"in {time.monotonic() - since:.0f} s",
        ),
    ]


def _charging(stats: Mapping[str, Any]) -> int:
    return sum(
        status in (0x40, 0x41)
        for device in stats["devices"].values()
        for status in device["status"]
    )


async def _away(house: House, oracle: Oracle, seconds: float) -> list[Figure]:
    """Pull all network cables, and plug them in again."""
    report(f"all network cables pulled for {seconds:.0f} s")
    before = await house.do("statistics")
    pulled = time.monotonic()
    await oracle.unplug()
    figures: list[Figure] = []
    name = f"away for {seconds:.0f} s"
    if seconds > SHORT:
        took = await house.do("until", available=False, since=pulled)
        figures.append(
            _figure(f"{name}: until all are unavailable", took, "s", digits=2)
        )
    await asyncio.sleep(pulled + seconds - time.monotonic())
    back = time.monotonic()
    await oracle.replug()
    polled = await _until_polled(oracle, back)
    took = max(polled, await house.do("until", available=True, since=back))
    after = await house.do("statistics")
    counted = {name: after[name] - before[name] for name in after}
    # The next measurement begins at rest.
    await house.do("cost", seconds=15.0)
    return [*figures, *_there(name, took, counted)]


async def _until_polled(oracle: Oracle, since: float) -> float:
    """Wait until each box has been polled; return the time it took, s."""
    while True:
        commands = (await oracle.commands(since)).values()
        first = [next(iter(_polls(one)), None) for one in commands]
        times = [at for at in first if at is not None]
        if len(times) == BOXES:
            return max(times) - since
        await asyncio.sleep(0.1)


async def _reloaded(house: House) -> list[Figure]:
    report("the listener is reloaded")
    reloaded = await house.do("reload")
    counted = await house.do("statistics")
    return [
        *_there("reloaded", reloaded["took"], counted),
        block_figure(NAME, "longest block while they are reloaded", reloaded),
        busy_figure(NAME, "while they are reloaded", reloaded),
    ]


def _there(name: str, seconds: float, counted: Mapping[str, int]) -> list[Figure]:
    note = (
        f"{counted['accepted']} accepted, {counted['crowded_out']} too many at once,"
        f" {counted['replaced']} replaced"
    )
    return [
        _figure(f"{name}: until all are available", seconds, "s", digits=2, note=note),
    ]


def _polls(commands: Sequence[tuple[float, str]]) -> list[float]:
    return [at for at, name in commands if name == "rc"]


class _Window(NamedTuple):
    """A span of time, s of CLOCK_MONOTONIC."""

    begin: float
    end: float


def period_figures(
    commands: Mapping[str, Sequence[tuple[float, str]]], windows: Sequence[_Window]
) -> list[Figure]:
    """Return the figures of the poll periods of all boxes."""
    each = [
        [
            period
            for begin, end in windows
            for period in gaps(at for at in _polls(one) if begin <= at < end)
        ]
        for one in commands.values()
    ]
    every = [period for one in each for period in one]
    worst = max(each, key=lambda one: percentile(one, 0.99))
    return [
        _seconds("poll period, mean", fmean(every)),
        _seconds("poll period, p50", percentile(every, 0.5)),
        _seconds(
            "poll period, p99",
            percentile(every, 0.99),
            f"{len(every)} periods of {len(each)} boxes",
        ),
        _seconds("poll period, longest", max(every)),
        _seconds(
            "poll period, p50 of the box with the worst p99", percentile(worst, 0.5)
        ),
        _seconds("poll period, p99 of that box", percentile(worst, 0.99)),
    ]


def _seconds(name: str, value: float, note: str = "") -> Figure:
    return _figure(name, value, "s", digits=3, note=note)


def _dropped(by_box: Mapping[str, Sequence[str]]) -> int:
    return sum(len(one) for one in by_box.values())
