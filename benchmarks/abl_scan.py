"""(a) Period of 16 ABL boxes, and of one box beside 15 dead ones."""

import asyncio
from collections.abc import Sequence
from functools import partial
from statistics import fmean, median

from custom_components.evse_bus.evse.abl import PROTOCOL

from .figures import Figure, gaps, percentile
from .oracle import LoggedFrame, Oracle
from .progress import report
from .setup import READING_REQUEST, abl_bus, settled, starts_of

NAME = "abl-scan"
_figure = partial(Figure, NAME)
METHOD = """\
16 virtual ABL boxes in a process of their own on a pty paced at 38400 8E1, poll
interval 0, library alone. A period is the time between two reads of 0x002E of the
same box, taken from the virtual bus's log. Ideal: 16 x (13.75 ms on the wire + 2 ms
turn-round of the box). Reads of the flags (every 30 s for each box) in between count.
The period of one box beside 15 dead ones is compared with that of the same box alone on
the bus; a reply time-out begins when its request (4.9 ms) has left."""

IDS = range(1, 17)
DEAD = range(2, 17)
WIRE_TIME = 13.75e-3
TURN_ROUND = 2e-3
REPLY_TIMEOUT = PROTOCOL.timing.reply_timeout
REQUEST = 17 * PROTOCOL.settings.byte_time
IDEAL = len(IDS) * (WIRE_TIME + TURN_ROUND)


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    report("16 boxes polled without pause")
    log = await _watch(IDS, seconds=6 if quick else 40)
    periods = [p for one in IDS for p in gaps(starts_of(log, one, READING_REQUEST))]
    report("one box alone")
    alone = _periods_of_first(await _watch([1], seconds=3 if quick else 8))
    report("one box with 15 dead ones")
    log = await _watch(IDS, dead=DEAD, seconds=15 if quick else 60)
    living = _periods_of_first(log)
    report("15 boxes die at the same moment")
    dying = _periods_of_first(await _watch(IDS, kill=DEAD, seconds=8))
    grown = max(living) - fmean(alone)
    return [
        _figure("16 boxes: mean period", fmean(periods) * 1000, "ms"),
        _figure("16 boxes: median period", median(periods) * 1000, "ms"),
        _figure("16 boxes: p99 period", percentile(periods, 0.99) * 1000, "ms"),
        _figure("16 boxes: longest period", max(periods) * 1000, "ms"),
        _figure(
            "16 boxes: mean period / ideal",
            fmean(periods) / IDEAL,
            digits=3,
            aim=1.10,
            note=f"ideal {IDEAL * 1000:.0f} ms",
        ),
        _figure("1 box alone: mean period", fmean(alone) * 1000, "ms"),
        _figure("1 living, 15 dead: mean period", fmean(living) * 1000, "ms"),
        _figure("1 living, 15 dead: longest period", max(living) * 1000, "ms"),
        _figure(
            "longest, longer than alone by",
            grown / (REPLY_TIMEOUT + REQUEST),
            "exchanges that time out",
            digits=2,
            aim=1.05,
            note=f"{grown * 1000:.0f} ms; time-out {REPLY_TIMEOUT * 1000:.0f} ms"
            " + 4.9 ms request",
        ),
        _figure(
            "15 die at once: longest period of the 16th",
            max(dying) * 1000,
            "ms",
            note="until they are found to be dead",
        ),
    ]


async def _watch(
    ids: Sequence[int],
    *,
    seconds: float,
    dead: Sequence[int] = (),
    kill: Sequence[int] = (),
) -> list[LoggedFrame]:
    """Poll boxes for a while; return the frames on the wire."""
    async with Oracle("abl", ids=list(ids), dead=list(dead)) as oracle:
        bus = abl_bus(oracle.url, ids)
        await bus.start()
        try:
            await settled(bus, [f"abl-{one}" for one in dead])
            since = asyncio.get_running_loop().time()
            if kill:
                await oracle.kill([f"abl-{one}" for one in kill])
            await asyncio.sleep(seconds)
        finally:
            await bus.stop()
        return await oracle.log(since)


def _periods_of_first(log: Sequence[LoggedFrame]) -> list[float]:
    return gaps(starts_of(log, 1, READING_REQUEST))
