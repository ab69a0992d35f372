"""(e) What a house with many chargers costs Home Assistant."""

from typing import Any

from .cost import block_figure, busy_figure, cost_figures, measure
from .figures import Figure
from .house import LOADED, House
from .progress import say
from .setup import ABL_LIMIT, EVBOX_LIMIT
from .witness import Witness

NAME = "home-assistant"
METHOD = f"""\
One real Home Assistant ({LOADED}), started as its own runner does; measured idle,
then after adding 16 ABL boxes and 8 EVBox ChargePoints of 20 modules (a car charging
at each), all polled every 5 s as the config flow proposes, on two paced virtual buses
in processes of their own. CPU: user and system time of all its threads, as a share of
one core. Memory: resident set after a garbage collection. Blocks: wall time of every
callback of the event loop (asyncio's Handle._run timed, in a time of its own); what
other processes of the machine take counts as if it were ours, so idle stands beside
it. Own time: processor time of the event loop's thread in the longest one; 'most own
time of one callback': in any of them, without the interpreter's garbage collection,
which stops everything for the longer the more Home Assistant holds."""

IDS = range(1, 17)
SERIALS = range(1923051, 1923059)
MODULES = 20
INTERVAL = 5.0


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    seconds = 15.0 if quick else 60.0
    async with (
        Witness("abl", ids=list(IDS), plugged=True) as abl,
        Witness("evbox", serials=list(SERIALS), modules=MODULES) as evbox,
    ):
        say("starting Home Assistant")
        async with House() as house:
            # What it does after its start is not ours.
            await house.do("cost", seconds=15.0 if quick else 45.0)
            say(f"idle, 2 x {seconds:.0f} s")
            idle = await measure(house, seconds)
            say("adding 16 ABL boxes and 8 ChargePoints of 20 modules")
            adding = await house.do("watched_add", buses=[_abl(abl), _evbox(evbox)])
            # EVBox: two replies must agree, and until then a box is left alone.
            await house.do("cost", seconds=30.0)
            say(f"all polled, 2 x {seconds:.0f} s")
            polled = await measure(house, seconds)
    return [
        *cost_figures(NAME, idle, polled, "all chargers"),
        block_figure(NAME, "longest block while they are added", adding),
        busy_figure(NAME, "while they are added", adding),
    ]


def _abl(witness: Witness) -> dict[str, Any]:
    return {
        "protocol": "abl",
        "device": witness.url,
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


def _evbox(witness: Witness) -> dict[str, Any]:
    return {
        "protocol": "evbox",
        "device": witness.url,
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
