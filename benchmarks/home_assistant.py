"""(e) The cost of many chargers in Home Assistant."""

from typing import Any

from .cost import block_figure, busy_figure, cost_figures, measure
from .figures import Figure
from .house import LOADED, House
from .oracle import Oracle
from .progress import report
from .setup import ABL_LIMIT, EVBOX_LIMIT

NAME = "home-assistant"
METHOD = f"""\
One real Home Assistant ({LOADED}), started as its own runner does; measured idle,
then after adding 16 ABL boxes and 8 EVBox ChargePoints of 20 modules (a car charging
at each), all polled every 5 s as the config flow proposes, on two paced virtual buses
in processes of their own. CPU: user and system time of all its threads, as a share of
one core. Memory: resident set after a garbage collection. Blocks: wall time of every
callback of the event loop (asyncio's Handle._run is timed, after the other figures);
time that other processes take is included, so there is a figure for idle too. Own time:
processor time of the event loop's thread in the longest one; 'most own time of one
callback': in any of them, without garbage collection, which takes longer the more
objects Home Assistant holds."""

IDS = range(1, 17)
SERIALS = range(1923051, 1923059)
MODULES = 20
INTERVAL = 5.0


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    seconds = 15.0 if quick else 60.0
    async with (
        Oracle("abl", ids=list(IDS), plugged=True) as abl,
        Oracle("evbox", serials=list(SERIALS), modules=MODULES) as evbox,
    ):
        report("starting Home Assistant")
        async with House() as house:
            # Its work after the start is not measured.
            await house.do("cost", seconds=15.0 if quick else 45.0)
            report(f"idle, 2 x {seconds:.0f} s")
            idle = await measure(house, seconds)
            report("adding 16 ABL boxes and 8 ChargePoints of 20 modules")
            adding = await house.do("watched_add", buses=[_abl(abl), _evbox(evbox)])
            # EVBox: two replies must agree, and until then its minimum interval is long.
            await house.do("cost", seconds=30.0)
            report(f"all polled, 2 x {seconds:.0f} s")
            polled = await measure(house, seconds)
    return [
        *cost_figures(NAME, idle, polled, "all chargers"),
        block_figure(NAME, "longest block while they are added", adding),
        busy_figure(NAME, "while they are added", adding),
    ]


def _abl(oracle: Oracle) -> dict[str, Any]:
    return {
        "protocol": "abl",
        "device": oracle.url,
        "chargers": [
            {
                "address": one,
                "serial": f"2W22xy{one:08d}",
                "installation_limit": ABL_LIMIT,
                "poll_interval": INTERVAL,
                "fail_safe_current": 6.0,
                "phase_order": [1, 2, 3],
            }
            for one in IDS
        ],
    }


def _evbox(oracle: Oracle) -> dict[str, Any]:
    return {
        "protocol": "evbox",
        "device": oracle.url,
        "chargers": [
            {
                "address": one,
                "serial": f"{one:08d}",
                "installation_limit": EVBOX_LIMIT,
                "poll_interval": INTERVAL,
                "fail_safe_current": EVBOX_LIMIT,
                "fail_safe_timeout": 60,
                "command": 68,
                "information": "00" * 16,
            }
            for one in SERIALS
        ],
    }
