"""(b) 8 ChargePoints of 20 modules on one bus: deadlines, intervals, utilisation."""

import asyncio
from statistics import fmean

from .figures import Figure, gaps, percentile
from .oracle import LoggedFrame, Oracle
from .progress import report
from .setup import evbox_bus

NAME = "evbox-bus"
METHOD = """\
8 virtual ChargePoints of 20 modules, a car charging at each, in a process of their own
on a pty paced at 38400 8N1; command 68, period 5 s, time-out 60 s, library alone.
Intervals are from the virtual bus's log. The share of the wire is bytes on the wire; the
utilisation of the bus also includes the silence before the reply (100 ms) and the rest
of the silence before our request (100 ms by the manual, 120 ms kept). Ideal round: 8 x
(278.6 + 2 x 100) ms = 3.83 s of 5 s."""

SERIALS = range(1923051, 1923059)
MODULES = 20
PERIOD = 5.0
TIMEOUT = 60
WARM_UP = 25.0
"""Two replies must agree, and until then the minimum interval is 20 s."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    seconds = 30.0 if quick else 120.0
    async with Oracle("evbox", serials=list(SERIALS), modules=MODULES) as oracle:
        bus = evbox_bus(oracle.url, SERIALS, period=PERIOD, timeout=TIMEOUT)
        await bus.start()
        try:
            report("8 ChargePoints are polled for the first time")
            await asyncio.sleep(WARM_UP)
            loop = asyncio.get_running_loop()
            since, busy = loop.time(), bus.wire.statistics.busy_time
            report(f"8 ChargePoints of 20 modules for {seconds:.0f} s")
            await asyncio.sleep(seconds)
            elapsed = loop.time() - since
            busy = bus.wire.statistics.busy_time - busy
        finally:
            await bus.stop()
        log = await oracle.log(since)
        devices = (await oracle.stats())["devices"].values()
    statistics = bus.wire.statistics
    frames = [frame for frame in log if frame.end <= since + elapsed]
    intervals = [
        interval
        for serial in SERIALS
        for interval in gaps(_requests_to(serial, frames))
    ]
    on_wire = sum(frame.end - frame.start for frame in frames)
    return [
        Figure(
            benchmark=NAME,
            name="missed deadlines (since the start)",
            value=statistics.missed_deadlines,
            aim=0,
            digits=0,
            note=f"{statistics.requests} requests, {statistics.timeouts} time-outs,"
            f" {statistics.for_deadline} early for a deadline",
        ),
        Figure(
            benchmark=NAME,
            name="fail-backs, silence violations, requests too soon",
            value=sum(
                device[name]
                for device in devices
                for name in ("fail_backs", "silence_violations", "too_soon")
            ),
            aim=0,
            digits=0,
            note="counted by the virtual ChargePoints",
        ),
        _seconds("mean interval", fmean(intervals), note=f"wanted {PERIOD:.0f} s"),
        _seconds("p99 interval", percentile(intervals, 0.99)),
        _seconds("longest interval", max(intervals), note=f"time-out {TIMEOUT} s"),
        _percent("utilisation of the bus, silences included", busy / elapsed),
        _percent("bytes on the wire", on_wire / elapsed),
    ]


def _requests_to(serial: int, log: list[LoggedFrame]) -> list[float]:
    # STX, destination, source, command; then the serial number's eight digits.
    digits = f"{serial:08d}".encode()
    return [
        frame.start for frame in log if frame.from_client and frame.data[7:15] == digits
    ]


def _seconds(name: str, value: float, note: str = "") -> Figure:
    return Figure(benchmark=NAME, name=name, value=value, unit="s", digits=3, note=note)


def _percent(name: str, value: float) -> Figure:
    return Figure(benchmark=NAME, name=name, value=value * 100, unit="%")
