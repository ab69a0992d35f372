"""(g) From a set-point to a polled SmartEVSE that follows it, in each dialect."""

import asyncio
from typing import Final

from .figures import Figure
from .progress import say
from .set_points import set_point_figures, set_points, until_all_charge
from .setup import settled, smartevse_bus
from .witness import Witness

NAME = "smartevse-polled"
METHOD = """\
One virtual SmartEVSE of each dialect (2.17, 2.20, later), load balancing off, a car
charging all the time; each in a process of its own on a pty of its own paced at 9600
8N1, all three at the same time; library alone. 6 A and 16 A in turn at random moments;
from the call to the moment when the box's pilot says the new current (by the box's own
diary), and to the call's return, which is when the box was read back to follow. A box
follows with its own cycle of 2 s; a later one must not be asked anything for 6.5 s
before that."""

UNITS: Final = {"2.17": 0, "2.20": 1, "later": 1}
"""Where a box of each dialect answers."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    times = 6 if quick else 40
    say(f"{times} set-points in each dialect")
    all_of_them = await asyncio.gather(*(_one(one, times) for one in UNITS))
    return [figure for one in all_of_them for figure in one]


async def _one(dialect: str, times: int) -> list[Figure]:
    box = {"dialect": dialect, "cable": 32, "max_current": 32, "car": "plugged"}
    async with Witness("smartevse", boxes=[box]) as witness:
        bus = smartevse_bus(witness.url, UNITS[dialect])
        await bus.start()
        try:
            await settled(bus)
            chargers = list(bus.chargers.values())
            await until_all_charge(witness, chargers)
            called = await set_points(chargers, times)
            await asyncio.sleep(0.5)
        finally:
            await bus.stop()
        offers = await witness.offers()
    return set_point_figures(NAME, f"{dialect}: ", called, offers)
