"""(c) From `number.set_value` to the wire, on an ABL bus of 16 that is never idle."""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from .figures import Figure, percentile
from .house import LOADED, House
from .progress import say
from .setup import ABL_LIMIT, LIMIT_REQUEST, unit_of
from .witness import Heard, Witness

NAME = "set-value"
METHOD = f"""\
A real Home Assistant ({LOADED}) with the integration, 16 virtual ABL boxes in a process
of their own on a pty paced at 38400 8E1, poll interval 0: the bus is never idle. The
service number.set_value is called in the process of Home Assistant at random moments,
box by box, 16 A and 6 A in turn. Time from the call to the first byte on the wire as
the virtual bus's log has it (one monotonic clock). A lowering is on disk before it is
sent. 'Own turn': the first request made for the call (the library reads the box before
it writes a limit); 'limit': the write that carries it. Beside it the exchange that was
in progress at the call."""

LOW = 6.0


@dataclass(frozen=True, slots=True)
class _Call:
    """One call and what became of it, s."""

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
    """What was left of it."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    ids = list(range(1, 17))
    say("starting Home Assistant")
    async with Witness("abl", ids=ids) as witness, House() as house:
        await house.do(
            "add",
            protocol="abl",
            device=witness.url,
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
        say(f"{times} times number.set_value")
        called = await house.do("set_values", times=times, values=[ABL_LIMIT, LOW])
        await asyncio.sleep(0.1)
        log = await witness.log()
    calls = [
        _seen(log, unit, before, after, raises=value > LOW)
        for unit, value, before, after in called
    ]
    # Each box's first one is a raise from where it has been put at the start.
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
    log: Sequence[Heard], unit: int, before: float, after: float, *, raises: bool
) -> _Call:
    """Find in the log what a call has brought about."""
    requests = [heard for heard in log if heard.from_client and heard.start <= after]
    at = next(
        index
        for index, heard in enumerate(requests)
        if heard.start >= before
        and unit_of(heard) == unit
        and heard.data[3:9] == LIMIT_REQUEST
    )
    write = requests[at]
    first = at
    # What was said to this box just before, since the call, is the same turn.
    while requests[first - 1].start >= before and unit_of(requests[first - 1]) == unit:
        first -= 1
    under_way = [heard for heard in log if before - 1.0 <= heard.start <= before]
    request = max(
        (heard for heard in under_way if heard.from_client), key=lambda one: one.start
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
