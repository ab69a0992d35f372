"""(i) Time from a key or a start request at an EWS-Box to Home Assistant."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from functools import partial
from random import Random
from typing import Any, Final

from .figures import Figure, percentile
from .house import LOADED, House, free_port
from .house_boxes import box_entry
from .oracle import LoggedFrame, Oracle
from .progress import report

NAME = "ews-events"
_figure = partial(Figure, NAME)
METHOD = f"""\
A real Home Assistant ({LOADED}) with one EWS-Box of two ports, in manual I/O mode, a car
waiting at each, in a process of its own: on a pty paced at 115200 8N1, then dialling
Home Assistant's listener. Once polled every 2 s and nothing else; once 'busy': poll
interval 0, and number.set_value for port 1 and 2 in turn, the next one 20 to 100 ms
after the one before was confirmed. At random moments key 1 of a port is pressed and,
150 ms or more later, released: time until the state_changed event of that port's event
entity (one monotonic clock for both processes). 'On our side': from the end of the info
record on the wire, which takes 1.4 ms of RS-232 and waits for the end of an answer.
Start requests are made, and withdrawn 0.3 to 0.6 s later, on the box's web page: time
until the state_changed event of the binary sensor, for which the box must be read first
(rc and rd, 21 ms of RS-232)."""

SERIAL: Final = "000000000701"
BOX: Final = f"ews-{SERIAL}"
SLOW: Final = 2.0
REST: Final = 1.5
"""Longest time until the last action shows, s."""
RECORD: Final = b"\x02\x00\x0bIif"
"""The first bytes of an info record."""
LONGEST: Final = 1800.0
"""Limit for the whole benchmark, s."""


@dataclass(frozen=True, slots=True)
class Occurrence:
    """An action at a box or a change in Home Assistant, at s of CLOCK_MONOTONIC."""

    at: float
    port: int
    state: str
    """As Home Assistant shows it."""


@dataclass(frozen=True, slots=True)
class _Kind:
    """A kind of actions at a box, and the entity that shows them."""

    name: str
    platform: str
    key: str
    actions: tuple[tuple[str, str], tuple[str, str]]
    """The actions in turn, and the state that shows each."""
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
    (("request_start", "on"), ("withdraw", "off")),
    # Not sooner: after an info record a box is read again only after INFO_PAUSE.
    (0.3, 0.6),
)


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    seconds = 10.0 if quick else 90.0
    figures: list[Figure] = []
    async with asyncio.timeout(LONGEST):
        report("starting Home Assistant")
        async with House() as house:
            # Its work after the start is not measured.
            await house.do("cost", seconds=5.0 if quick else 45.0)
            for line, way in (("RS-232", _serial), ("TCP", _network)):
                for busy in (False, True):
                    name = f"{line}, busy" if busy else line
                    figures += await way(
                        house,
                        0.0 if busy else SLOW,
                        partial(_measure, house, name, busy=busy, seconds=seconds),
                    )
    return figures


type _Measure = Callable[[Oracle], Awaitable[list[Figure]]]


async def _serial(house: House, interval: float, measure: _Measure) -> list[Figure]:
    async with Oracle("ews", boxes=_boxes()) as oracle:
        await house.do(
            "add_boxes", **box_entry([SERIAL], interval=interval, device=oracle.url)
        )
        figures = await measure(oracle)
        await house.do("remove")
    return figures


async def _network(house: House, interval: float, measure: _Measure) -> list[Figure]:
    port = free_port()
    async with Oracle("ews", boxes=_boxes(), dial=f"127.0.0.1:{port}") as oracle:
        address: dict[str, Any] = {"host": "127.0.0.1", "port": port}
        await house.do("add_boxes", **box_entry([SERIAL], interval=interval, **address))
        figures = await measure(oracle)
        await house.do("remove")
    return figures


def _boxes() -> list[dict[str, Any]]:
    return [{"serial": SERIAL, "manual_io": True, "plugged": True}]


async def _measure(
    house: House, name: str, oracle: Oracle, *, busy: bool, seconds: float
) -> list[Figure]:
    # It was just added: limit and clock are set, the entities are added.
    await house.do("cost", seconds=5.0)
    figures: list[Figure] = []
    for kind in (KEY, START):
        report(f"{name}: {kind.name}s for {seconds:.0f} s")
        watched, done = await asyncio.gather(
            house.do(
                "watch_states",
                seconds=seconds + REST,
                platform=kind.platform,
                key=kind.key,
                busy=busy,
            ),
            _do_at_random(oracle, kind, seconds),
        )
        seen = [Occurrence(at, port, state) for at, port, state in watched["seen"]]
        figures += _figures(f"{name}, {kind.name}", done, seen, watched)
        reported = reported_by(await oracle.log(done[0].at), done)
        figures += _own_figures(f"{name}, {kind.name}", reported, seen)
    return figures


async def _do_at_random(
    oracle: Oracle, kind: _Kind, seconds: float
) -> list[Occurrence]:
    """Do these actions at both ports in turn, for this time (s)."""
    dice = Random(1)  # noqa: S311 - repeatable on purpose
    loop = asyncio.get_running_loop()
    until = loop.time() + seconds
    done: list[Occurrence] = []
    while loop.time() < until:
        port = 1 + len(done) // 2 % 2
        for action, state in kind.actions:
            await asyncio.sleep(dice.uniform(*kind.pauses))
            at = await oracle.operate(BOX, action, port, *kind.values)
            done.append(Occurrence(at, port, state))
    return done


def delays(done: Sequence[Occurrence], seen: Sequence[Occurrence]) -> list[float]:
    """Return the time from each action to its change, s; without a change: left out.

    A change belongs to the last action of its kind before it.
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


def _alike(one: Occurrence, two: Occurrence) -> bool:
    return (one.port, one.state) == (two.port, two.state)


def reported_by(
    log: Sequence[LoggedFrame], done: Sequence[Occurrence]
) -> list[Occurrence]:
    """Return the ends of the info records that report these actions."""
    records = [
        frame for frame in log if not frame.from_client and RECORD in frame.data[:6]
    ]
    reported: list[Occurrence] = []
    for one in done:
        record = next((frame for frame in records if frame.start >= one.at), None)
        if record is not None:
            reported.append(Occurrence(record.end, one.port, one.state))
    return reported


def _figures(
    name: str,
    done: Sequence[Occurrence],
    seen: Sequence[Occurrence],
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


def _own_figures(
    name: str, reported: Sequence[Occurrence], seen: Sequence[Occurrence]
) -> list[Figure]:
    took = delays(reported, seen)
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
