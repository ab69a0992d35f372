"""(h) Poll period of an EWS-Box, on a line that could carry more."""

import asyncio
from collections.abc import Iterable, Sequence
from functools import partial
from statistics import fmean, median
from typing import Final

from .figures import Figure, gaps, percentile
from .oracle import LoggedFrame, Oracle
from .progress import report
from .setup import ews_bus, settled

NAME = "ews-poll"
_figure = partial(Figure, NAME)

PORTS_REQUEST: Final = b"Crc"
"""The bytes of `rc` after its length."""
_BYTE: Final = 10 / 115200
RC: Final = (7 + 115) * _BYTE
RD: Final = (7 + 63) * _BYTE
TURN_ROUND: Final = 2e-3
IDEAL: Final = RC + RD + 2 * TURN_ROUND
INTERVAL: Final = 2.0
LATE: Final = 50.0
"""Aim, ms."""
OVER: Final = 1.15
"""Aim: 1.6 ms for each exchange beyond wire and turn-round, as in `abl-scan`."""

METHOD = f"""\
One virtual EWS-Box in a process of its own on a pty paced at 115200 8N1, library alone,
its two ports (each a charger of its own) polled. A period is the time between two rc
of the box, taken from the virtual bus's log; an rd follows each of them, and an rs every
10 s. Ideal: rc {RC * 1000:.1f} ms and rd {RD * 1000:.1f} ms on the wire, and 2 ms
turn-round of the box each. Poll interval 0, and the 2 s that the config flow proposes,
which count from the end of a poll."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    report("two ports polled without pause")
    fast = await _periods((1, 2), interval=0.0, seconds=6 if quick else 40)
    report("one port polled without pause")
    one = await _periods((1,), interval=0.0, seconds=6 if quick else 40)
    report("two ports polled every 2 s")
    slow = await _periods((1, 2), interval=INTERVAL, seconds=12 if quick else 120)
    late = [period - INTERVAL for period in slow]
    return [
        _milliseconds("interval 0: mean period", fmean(fast)),
        _milliseconds("interval 0: median period", median(fast)),
        _milliseconds("interval 0: p99 period", percentile(fast, 0.99)),
        _milliseconds("interval 0: longest period", max(fast)),
        _ratio("interval 0: mean period / ideal", fast),
        _ratio("interval 0, one port: mean period / ideal", one),
        _figure(
            "2 s: mean period", fmean(slow), "s", digits=3, note=f"{len(slow)} periods"
        ),
        _milliseconds("2 s: later than that, p50", percentile(late, 0.5)),
        _milliseconds("2 s: later than that, p99", percentile(late, 0.99), aim=LATE),
        _milliseconds("2 s: later than that, most", max(late)),
        _milliseconds("2 s: later than that, least", min(late)),
    ]


async def _periods(
    ports: Iterable[int], *, interval: float, seconds: float
) -> list[float]:
    """Poll for a while; return the periods, s."""
    async with Oracle("ews", boxes=[{"plugged": True}]) as oracle:
        bus = ews_bus(oracle.url, ports, poll_interval=interval)
        await bus.start()
        try:
            await settled(bus)
            since = asyncio.get_running_loop().time()
            await asyncio.sleep(seconds)
        finally:
            await bus.stop()
        return gaps(polls(await oracle.log(since)))


def polls(log: Sequence[LoggedFrame]) -> list[float]:
    """Return the start times of the polls of the box."""
    return [
        frame.start
        for frame in log
        if frame.from_client and frame.data[3:6] == PORTS_REQUEST
    ]


def _ratio(name: str, periods: Sequence[float]) -> Figure:
    return _figure(
        name,
        fmean(periods) / IDEAL,
        digits=3,
        aim=OVER,
        note=f"ideal {IDEAL * 1000:.1f} ms, {len(periods)} periods",
    )


def _milliseconds(name: str, seconds: float, aim: float | None = None) -> Figure:
    return _figure(name, seconds * 1000, "ms", aim=aim)
