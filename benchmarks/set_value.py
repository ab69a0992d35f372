"""(c) Time from `number.set_value` to the wire, on a busy bus of 16 ABL boxes."""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from .figures import Figure, percentile
from .house import LOADED, House
from .oracle import LoggedFrame, Oracle
from .progress import report
from .setup import ABL_LIMIT, LIMIT_REQUEST, unit_of

NAME = "set-value"
METHOD = f"""\
A real Home Assistant ({LOADED}) with the integration, 16 virtual ABL boxes in a process
of their own on a pty paced at 38400 8E1, poll interval 0: the bus is never idle. The
service number.set_value is called in the process of Home Assistant at random moments,
box by box, 16 A and 6 A in turn. Time from the call to the first byte on the wire, by
the virtual bus's log (one monotonic clock). A lowering is on disk before it is sent.
'Own turn': the first request made for the call (the library reads the box before it
writes a limit); 'limit': the write of the limit. For comparison, the exchange that was
in progress at the call."""

LOW = 6.0


@dataclass(frozen=True, slots=True)
class _Call:
    """One call and its times, s."""

    raises: bool
    turn: float
    """Until the first request made for it."""
    limit: float
    """Until the write of the limit."""
    done: float
    """Until the service call returned: confirmed by the box."""
    in_progress: float
    """Length of the exchange under way at the call."""
    rest: float
    """The rest of it after the call."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    ids = list(range(1, 17))
    report("starting Home Assistant")
    async with Oracle("abl", ids=ids) as oracle, House() as house:
        await house.do(
            "add",
            protocol="abl",
            device=oracle.url,
            chargers=[
                {
                    "address": one,
                    "serial": f"2W22xy{one:08d}",
                    "installation_limit": ABL_LIMIT,
                    "poll_interval": 0.0,
                    "fail_safe_current": LOW,
                    "phase_order": [1, 2, 3],
                }
                for one in ids
            ],
        )
        times = 64 if quick else 480
        report(f"{times} times number.set_value")
        called = await house.do("set_values", times=times, values=[ABL_LIMIT, LOW])
        await asyncio.sleep(0.1)
        log = await oracle.log()
    calls = [
        _seen(log, unit, before, after, raises=value > LOW)
        for unit, value, before, after in called
    ]
    # The first call for each box is a raise from its value at the start.
    return [
        *_figures("raise", [one for one in calls if one.raises]),
        *_figures("lowering", [one for one in calls if not one.raises]),
        _milliseconds(
            "exchange in progress: mean length", [fmean(c.in_progress for c in calls)]
        ),
        _milliseconds("exchange in progress: p99 length", _of(calls, "in_progress")),
    ]


def _figures(name: str, calls: Sequence[_Call]) -> list[Figure]:
    waited = [call.turn - call.rest for call in calls]
    return [
        _milliseconds(f"{name}: own turn, p50", _of(calls, "turn"), 0.5),
        _milliseconds(
            f"{name}: own turn, p99",
            _of(calls, "turn"),
            note=f"{len(calls)} calls",
        ),
        _milliseconds(
            f"{name}: own turn after the end of the exchange in progress, p50",
            waited,
            0.5,
        ),
        _milliseconds(
            f"{name}: own turn after the end of the exchange in progress, p99", waited
        ),
        _milliseconds(f"{name}: limit, p50", _of(calls, "limit"), 0.5),
        _milliseconds(f"{name}: limit, p99", _of(calls, "limit")),
        _milliseconds(
            f"{name}: confirmed by the box, p99",
            _of(calls, "done"),
            note="the service call returns",
        ),
    ]


def _of(calls: Sequence[_Call], name: str) -> list[float]:
    return [getattr(call, name) for call in calls]


def _milliseconds(
    name: str, seconds: Sequence[float], share: float = 0.99, note: str = ""
) -> Figure:
    value = percentile(seconds, share) * 1000
    return Figure(benchmark=NAME, name=name, value=value, unit="ms", note=note)


def _seen(
    log: Sequence[LoggedFrame], unit: int, before: float, after: float, *, raises: bool
) -> _Call:
    """Find the exchanges of a call in the log."""
    requests = [frame for frame in log if frame.from_client and frame.start <= after]
    at = next(
        index
        for index, frame in enumerate(requests)
        if frame.start >= before
        and unit_of(frame) == unit
        and frame.data[3:9] == LIMIT_REQUEST
    )
    write = requests[at]
    first = at
    # Requests to this box just before, since the call, belong to the same turn.
    while requests[first - 1].start >= before and unit_of(requests[first - 1]) == unit:
        first -= 1
    under_way = [frame for frame in log if before - 1.0 <= frame.start <= before]
    request = max(
        (frame for frame in under_way if frame.from_client), key=lambda one: one.start
    )
    reply = min(
        (one for one in log if not one.from_client and one.start >= request.end),
        key=lambda one: one.start,
    )
    return _Call(
        raises=raises,
        turn=requests[first].start - before,
        limit=write.start - before,
        done=after - before,
        in_progress=reply.end - request.start,
        rest=max(reply.end - before, 0.0),
    )
