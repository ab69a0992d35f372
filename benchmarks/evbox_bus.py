"""(b) 8 ChargePoints of 20 modules on one bus: deadlines, intervals, utilisation."""

import asyncio
from statistics import fmean

from .figures import Figure, gaps, percentile
from .progress import say
from .setup import evbox_bus
from .witness import Heard, Witness

NAME = "evbox-bus"
METHOD = """\
8 virtual ChargePoints of 20 modules, a car charging at each, in a process of their own
on a pty paced at 38400 8N1; command 68, period 5 s, time-out 60 s, library alone.
Intervals are from the virtual bus's log. The wire's share is bytes on the wire; the
bus's own utilisation also has the silence before the reply (100 ms) and what of ours
(100 ms asked for by the manual, 120 ms kept) was not over when its turn came. Ideal round: 8 x (278.6 + 2 x 100)
ms = 3.83 s of 5 s."""

SERIALS = range(1923051, 1923059)
MODULES = 20
PERIOD = 5.0
TIMEOUT = 60
WARM_UP = 25.0
"""Two replies must agree, and until then a box is left alone for 20 s."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    seconds = 30.0 if quick else 120.0
    async with Witness("evbox", serials=list(SERIALS), modules=MODULES) as witness:
        bus = evbox_bus(witness.url, SERIALS, period=PERIOD, timeout=TIMEOUT)
        await bus.start()
        try:
            say("8 ChargePoints get to know us")
            await asyncio.sleep(WARM_UP)
            loop = asyncio.get_running_loop()
            since, busy = loop.time(), bus.wire.statistics.busy_time
            say(f"8 ChargePoints of 20 modules for {seconds:.0f} s")
            await asyncio.sleep(seconds)
            elapsed = loop.time() - since
            busy = bus.wire.statistics.busy_time - busy
        finally:
            await bus.stop()
        log = await witness.log(since)
        devices = (await witness.stats())["devices"].values()
    statistics = bus.wire.statistics
    told = [heard for heard in log if heard.end <= since + elapsed]
    intervals = [
        interval for serial in SERIALS for interval in gaps(_requests_to(serial, told))
    ]
    on_wire = sum(heard.end - heard.start for heard in told)
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
            name="boxes fallen back, silence broken, spoken to too soon",
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


def _requests_to(serial: int, log: list[Heard]) -> list[float]:
    # STX, destination, source, command; then the serial number's eight digits.
    digits = f"{serial:08d}".encode()
    return [
        heard.start for heard in log if heard.from_client and heard.data[7:15] == digits
    ]


def _seconds(name: str, value: float, note: str = "") -> Figure:
    return Figure(benchmark=NAME, name=name, value=value, unit="s", digits=3, note=note)


def _percent(name: str, value: float) -> Figure:
    return Figure(benchmark=NAME, name=name, value=value * 100, unit="%")
