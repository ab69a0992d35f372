"""(i) From a key at an EWS-Box to the event in Home Assistant, and from a wish to it."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import Any, Final

from .figures import Figure, percentile
from .house import LOADED, House, free_port
from .house_boxes import box_entry
from .progress import say
from .witness import Heard, Witness

NAME = "ews-events"
_figure = partial(Figure, NAME)
METHOD = f"""\
A real Home Assistant ({LOADED}) with one EWS-Box of two ports, in manual I/O mode, a car
waiting at each, in a process of its own: on a pty paced at 115200 8N1, then dialling
Home Assistant's listener. Once polled every 2 s and nothing else; once 'busy': poll
interval 0, and number.set_value for port 1 and 2 in turn, the next one 20 to 100 ms
after the one before was confirmed. At random moments key 1 of a port goes down and,
150 ms or more later, up: until the state_changed event of that port's event entity
(one monotonic clock for both processes). 'On our side': from the end of the info
record on the wire, which takes 1.4 ms of RS-232 and waits for the end of an answer.
Start requests are made, and taken back 0.3 to 0.6 s later, by the box's web page: until
the state_changed event of the binary sensor, for which the box has to be asked (rc and
rd, 21 ms of RS-232) first."""

SERIAL: Final = "000000000701"
BOX: Final = f"ews-{SERIAL}"
SLOW: Final = 2.0
REST: Final = 1.5
"""So long what was done last may take, s."""
RECORD: Final = b"\x02\x00\x0bIif"
"""What an info record begins with."""
LONGEST: Final = 1800.0
"""All of it, s."""


@dataclass(frozen=True, slots=True)
class Happened:
    """Something that was done or seen, s of CLOCK_MONOTONIC."""

    at: float
    port: int
    what: str
    """As Home Assistant is to show it."""


@dataclass(frozen=True, slots=True)
class _Kind:
    """What is done at a box, and where Home Assistant shows it."""

    name: str
    platform: str
    key: str
    deeds: tuple[tuple[str, str], tuple[str, str]]
    """What is done in turn, and what is to be seen then."""
    pauses: tuple[float, float]
    """Shortest and longest time between two of them, s."""
    values: tuple[int, ...] = ()


KEY: Final = _Kind(
    "key",
    "event",
    "key_1",
    (("key_down", "press_start"), ("key_up", "press_end")),
    (0.15, 0.45),
    (1,),
)
START: Final = _Kind(
    "start request",
    "binary_sensor",
    "start_requested",
    (("ask_for_start", "on"), ("take_back", "off")),
    # Sooner, the second one would wait: a box is not asked more often than this
    # because of what it tells (INFO_PAUSE).
    (0.3, 0.6),
)


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    seconds = 10.0 if quick else 90.0
    figures: list[Figure] = []
    async with asyncio.timeout(LONGEST):
        say("starting Home Assistant")
        async with House() as house:
            # What it does after its start is not ours.
            await house.do("cost", seconds=5.0 if quick else 45.0)
            for what, way in (("RS-232", _serial), ("TCP", _network)):
                for busy in (False, True):
                    name = f"{what}, busy" if busy else what
                    figures += await way(
                        house,
                        0.0 if busy else SLOW,
                        partial(_measure, house, name, busy=busy, seconds=seconds),
                    )
    return figures


type _Then = Callable[[Witness], Awaitable[list[Figure]]]


async def _serial(house: House, interval: float, then: _Then) -> list[Figure]:
    async with Witness("ews", boxes=_boxes()) as witness:
        await house.do(
            "add_boxes", **box_entry([SERIAL], interval=interval, device=witness.url)
        )
        figures = await then(witness)
        await house.do("remove")
    return figures


async def _network(house: House, interval: float, then: _Then) -> list[Figure]:
    port = free_port()
    async with Witness("ews", boxes=_boxes(), dial=f"127.0.0.1:{port}") as witness:
        where: dict[str, Any] = {"host": "127.0.0.1", "port": port}
        await house.do("add_boxes", **box_entry([SERIAL], interval=interval, **where))
        figures = await then(witness)
        await house.do("remove")
    return figures


def _boxes() -> list[dict[str, Any]]:
    return [{"serial": SERIAL, "manual_io": True, "plugged": True}]


async def _measure(
    house: House, name: str, witness: Witness, *, busy: bool, seconds: float
) -> list[Figure]:
    # It has just been met: limit and clock are set, the entities are added.
    await house.do("cost", seconds=5.0)
    figures: list[Figure] = []
    for kind in (KEY, START):
        say(f"{name}: {kind.name}s for {seconds:.0f} s")
        watched, done = await asyncio.gather(
            house.do(
                "watch_states",
                seconds=seconds + REST,
                platform=kind.platform,
                key=kind.key,
                busy=busy,
            ),
            _do_at_random(witness, kind, seconds),
        )
        seen = [Happened(at, port, what) for at, port, what in watched["seen"]]
        figures += _figures(f"{name}, {kind.name}", done, seen, watched)
        told = told_by(await witness.log(done[0].at), done)
        figures += _told_figures(f"{name}, {kind.name}", told, seen)
    return figures


async def _do_at_random(
    witness: Witness, kind: _Kind, seconds: float
) -> list[Happened]:
    """Do it, and undo it, at a port and then at the other, for so long."""
    dice = Random(1)  # noqa: S311 - repeatable on purpose
    loop = asyncio.get_running_loop()
    until = loop.time() + seconds
    done: list[Happened] = []
    while loop.time() < until:
        port = 1 + len(done) // 2 % 2
        for deed, what in kind.deeds:
            await asyncio.sleep(dice.uniform(*kind.pauses))
            at = await witness.touch(BOX, deed, port, *kind.values)
            done.append(Happened(at, port, what))
    return done


def delays(done: Sequence[Happened], seen: Sequence[Happened]) -> list[float]:
    """Return how long it took until each of them was seen; those never seen are missing.

    What is seen belongs to the last of its kind that was done before.
    """
    took: list[float] = []
    for at, one in enumerate(done):
        later = (two.at for two in done[at + 1 :] if _alike(one, two))
        until = next(later, float("inf"))
        first = next(
            (two.at for two in seen if _alike(one, two) and one.at <= two.at < until),
            None,
        )
        if first is not None:
            took.append(first - one.at)
    return took


def _alike(one: Happened, two: Happened) -> bool:
    return (one.port, one.what) == (two.port, two.what)


def told_by(log: Sequence[Heard], done: Sequence[Happened]) -> list[Happened]:
    """Return when the box had told what was done: at the end of its info record."""
    records = [
        heard for heard in log if not heard.from_client and RECORD in heard.data[:6]
    ]
    told: list[Happened] = []
    for one in done:
        record = next((heard for heard in records if heard.start >= one.at), None)
        if record is not None:
            told.append(Happened(record.end, one.port, one.what))
    return told


def _figures(
    name: str,
    done: Sequence[Happened],
    seen: Sequence[Happened],
    watched: dict[str, Any],
) -> list[Figure]:
    took = delays(done, seen)
    commands = f"{watched['commands']} commands, {watched['refused']} refused"
    return [
        *_times(name, took, commands if watched["commands"] else ""),
        _figure(
            f"{name}: never seen",
            len(done) - len(took),
            aim=0,
            digits=0,
            note=f"of {len(done)}",
        ),
    ]


def _told_figures(
    name: str, told: Sequence[Happened], seen: Sequence[Happened]
) -> list[Figure]:
    took = delays(told, seen)
    return [
        _milliseconds(f"{name}: on our side, p50", percentile(took, 0.5)),
        _milliseconds(f"{name}: on our side, p99", percentile(took, 0.99)),
    ]


def _times(name: str, took: Sequence[float], note: str) -> list[Figure]:
    return [
        _milliseconds(f"{name}: p50", percentile(took, 0.5), note),
        _milliseconds(f"{name}: p99", percentile(took, 0.99)),
        _milliseconds(f"{name}: longest", max(took)),
    ]


def _milliseconds(name: str, seconds: float, note: str = "") -> Figure:
    return _figure(name, seconds * 1000, "ms", note=note)
