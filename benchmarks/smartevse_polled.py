"""(g) Time until a polled SmartEVSE follows a set-point, in each dialect."""

import asyncio
from typing import Final

from .figures import Figure
from .oracle import Oracle
from .progress import report
from .set_points import set_point_figures, set_points, until_all_charge
from .setup import settled, smartevse_bus

NAME = "smartevse-polled"
METHOD = """\
One virtual SmartEVSE of each dialect of v2, load balancing off, a car
charging all the time; each in a process of its own on a pty of its own paced at 9600
8N1, all three at the same time; library alone. 6 A and 16 A in turn at random moments;
time from the call until the pilot of the box has the new current (by the box's own
record), and until the call returns, when the new current was read back. A box follows
with its own cycle of 2 s; from 2.30 on it needs 6.5 s without a request before that."""

UNITS: Final = {"2.17": 0, "2.20": 0, "2.30": 1, "2.30+": 1}
"""The unit of a box of each dialect."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    times = 6 if quick else 40
    report(f"{times} set-points in each dialect")
    all_of_them = await asyncio.gather(*(_one(one, times) for one in UNITS))
    return [figure for one in all_of_them for figure in one]


async def _one(dialect: str, times: int) -> list[Figure]:
    box = {"dialect": dialect, "cable": 32, "max_current": 32, "car": "plugged"}
    async with Oracle("smartevse", boxes=[box]) as oracle:
        bus = smartevse_bus(oracle.url, UNITS[dialect])
        await bus.start()
        try:
            await settled(bus)
            chargers = list(bus.chargers.values())
            await until_all_charge(oracle, chargers)
            called = await set_points(chargers, times)
            await asyncio.sleep(0.5)
        finally:
            await bus.stop()
        offers = await oracle.offers()
    return set_point_figures(NAME, f"{dialect}: ", called, offers)
