"""(g) Time until a polled SmartEVSE follows an order, in each dialect."""

import asyncio
from collections.abc import Sequence
from typing import Final

from .figures import Figure, spread
from .oracle import Oracle
from .polled_orders import LABELS, UNITS, Case, Orders, Outcome, watch
from .progress import report
from .set_points import offered_after, set_points, until_all_charge
from .setup import settled, smartevse_bus
from .simulated import simulate_all

NAME = "smartevse-polled"
METHOD = """\
One virtual SmartEVSE of each dialect of v2, load balancing off, a car charging all the
time; library alone. In simulated time, on the virtual wire at its pace: currents of 6
to 16 A in turn at random moments, up to 30 s after the one before was in force; the
same right after a start of the library, to a box that charges; then new cars, with a
limit of 6 A standing. Time from the call until the pilot of the box has the new current
(by the box's own record), and until the call returns, when it was read back; writes of
the current from the call until it returns. Then, as a check, 6 A and 16 A in turn on a
pty of its own at the same pace in real time. A box follows with its own cycle of 2 s;
from 2.30 on it needs 6.5 s without a request before that. HEAD follows no order in the
first 85 s of a car, which are left out but for the new cars."""

QUICK: Final = (40, 10, 5)
FULL: Final = (1000, 200, 50)
"""Orders, starts and cars of each dialect."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    cases = [Case(dialect, *(QUICK if quick else FULL)) for dialect in UNITS]
    report(f"{cases[0].orders} orders in each dialect, simulated")
    outcomes = await simulate_all(watch, cases)
    times = 6 if quick else 40
    report(f"{times} orders in each dialect, in real time")
    real = await asyncio.gather(*(_in_real_time(one, times) for one in UNITS))
    return [
        figure
        for case, outcome, seen in zip(cases, outcomes, real, strict=True)
        for figure in _figures(case.dialect, outcome, seen)
    ]


async def _in_real_time(dialect: str, times: int) -> Orders:
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
    found = [offered_after(one, offers) for one in called]
    return Orders(
        offered=[one for one in found if one is not None],
        confirmed=[one.done - one.at for one in called if not one.error],
        failed=[one.error for one in called if one.error],
    )


def _figures(dialect: str, outcome: Outcome, real: Orders) -> list[Figure]:
    name = LABELS.get(dialect, dialect)
    steady, first = outcome.steady, outcome.first
    figures = [
        _seconds(f"{name}: order to pilot, longest", steady.offered),
        _seconds(f"{name}: order to confirmation, longest", steady.confirmed),
        _seconds(f"{name}: first order after a start to pilot, longest", first.offered),
        _seconds(f"{name}: the same to confirmation, longest", first.confirmed),
        _seconds(f"{name}: in real time: order to pilot, longest", real.offered),
        _seconds(f"{name}: the same to confirmation, longest", real.confirmed),
        _seconds(f"{name}: new car offered more than its limit, longest", outcome.cars),
    ]
    writes = [*steady.writes, *first.writes]
    failed = [*steady.failed, *first.failed, *real.failed]
    return [
        *(one for one in figures if one is not None),
        Figure(
            NAME,
            f"{name}: writes for one order, most",
            max(writes, default=0),
            aim=1,
            digits=0,
            note=f"{sum(one > 1 for one in writes)} of {len(writes)} orders took more;"
            f" beside them {outcome.refreshed:.0f} an hour",
        ),
        Figure(
            NAME,
            f"{name}: orders that were not confirmed",
            len(failed),
            aim=0,
            digits=0,
            note="; ".join(sorted(set(failed))[:2]),
        ),
    ]


def _seconds(name: str, times: Sequence[float]) -> Figure | None:
    if not times:
        return None
    return Figure(NAME, name, max(times), "s", digits=2, note=spread(times))
