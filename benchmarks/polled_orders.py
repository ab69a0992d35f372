"""A polled SmartEVSE in simulated time: from an order to its pilot."""

import asyncio
from dataclasses import dataclass, field
from random import Random
from typing import Any, Final

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import OrderChange
from tests.virtual import VirtualBus

from .offers import RecordingSmartEvse, smartevse_boxes
from .setup import SMARTEVSE_LIMIT, settled, smartevse_bus
from .simulated import HOUR

UNITS: Final = {"2.17": 0, "2.20": 0, "2.30": 1, "2.30+": 1}
"""The unit of a box of each dialect."""
LABELS: Final = {"2.30+": "HEAD"}
CURRENTS: Final = (6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0)
BETWEEN: Final = (0.0, 30.0)
"""Shortest and longest time between two orders, s."""
FOLLOWS_WITHIN: Final = 60.0
MEASURES_FOR: Final = 120.0
"""After so long from its car's first charge a box follows its orders, s."""
AWAY: Final = (0.5, 30.0)
"""Time for which the library is stopped, s."""
CAR_AWAY: Final = 30.0
WATCHED: Final = 150.0
"""Time for which a new car is watched, s."""
_LOOK: Final = 0.05
_CLOSE: Final = 0.01
"""Currents that differ by less are the same, A."""


@dataclass(frozen=True, slots=True)
class Case:
    """One dialect."""

    dialect: str
    orders: int
    starts: int
    cars: int
    seed: int = 1


@dataclass(slots=True)
class Orders:
    """Times of orders, s; writes of each."""

    offered: list[float] = field(default_factory=list)
    confirmed: list[float] = field(default_factory=list)
    writes: list[int] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)


@dataclass(slots=True)
class Outcome:
    """What a dialect has come to."""

    steady: Orders = field(default_factory=Orders)
    """Orders at any moment."""
    first: Orders = field(default_factory=Orders)
    """Orders given at the start of the library, to a box that charges."""
    refreshed: float = 0.0
    """Writes in an hour that no order has called for."""
    cars: list[float] = field(default_factory=list)
    """How long each new car was offered more than its limit, s."""


async def watch(case: Case) -> Outcome:
    """Run one dialect."""
    dice = Random(case.seed)  # noqa: S311 - repeatable on purpose
    spec: dict[str, Any] = {"dialect": case.dialect, "car": "plugged"}
    (box,) = smartevse_boxes([spec | {"cable": 32, "max_current": 32}])
    if not isinstance(box, RecordingSmartEvse):
        raise TypeError
    virtual = VirtualBus.in_loop(box, seed=case.seed, ring=100)
    virtual.start()
    url, unit = virtual.url, UNITS[case.dialect]
    outcome = Outcome()
    bus = smartevse_bus(url, unit)
    await bus.start()
    await settled(bus)
    await asyncio.sleep(MEASURES_FOR)
    loop = asyncio.get_running_loop()
    began, before = loop.time(), _writes(box)
    for _ in range(case.orders):
        await asyncio.sleep(dice.uniform(*BETWEEN))
        await _order(bus, box, _other(box, dice), outcome.steady)
    others = _writes(box) - before - sum(outcome.steady.writes)
    outcome.refreshed = others * HOUR / (loop.time() - began)
    for _ in range(case.starts):
        await bus.stop()
        await asyncio.sleep(dice.uniform(*AWAY))
        bus = smartevse_bus(url, unit)
        await bus.start()
        await _order(bus, box, _other(box, dice), outcome.first)
        # The stored order of each start.
        await _order(bus, box, SMARTEVSE_LIMIT, Orders())
    await _order(bus, box, CURRENTS[0], Orders())
    for _ in range(case.cars):
        outcome.cars.append(await _new_car(box, dice))
    await bus.stop()
    virtual.stop()
    return outcome


def _other(box: RecordingSmartEvse, dice: Random) -> float:
    """Return a current that the box does not offer."""
    return dice.choice([a for a in CURRENTS if abs(a - box.pilot_current) > _CLOSE])


async def _order(bus: Bus, box: RecordingSmartEvse, amps: float, seen: Orders) -> None:
    """Order a current, and wait until the pilot has it."""
    loop = asyncio.get_running_loop()
    (charger,) = bus.chargers.values()
    began, before, written = loop.time(), len(box.offers), _writes(box, amps)
    try:
        await charger.change_orders(OrderChange(current=amps))
    except EvseError as error:
        seen.failed.append(f"{type(error).__name__}: {error}")
        return
    seen.confirmed.append(loop.time() - began)
    seen.writes.append(_writes(box, amps) - written)
    async with asyncio.timeout(FOLLOWS_WITHIN):
        while abs(box.pilot_current - amps) > _CLOSE:  # noqa: ASYNC110 - of the virtual box
            await asyncio.sleep(_LOOK)
    changed = [
        offer.at for offer in box.offers[before:] if abs(offer.amps - amps) < _CLOSE
    ]
    # One that began a moment before is in force at once.
    seen.offered.append(max(changed[0] - began, 0.0) if changed else 0.0)


def _writes(box: RecordingSmartEvse, amps: float | None = None) -> int:
    """Return the number of writes of a current, or of all, so far."""
    register = box.controller.dialect.register_of("current")
    values = [one.values for one in box.writes if one.register == register]
    return len(values) if amps is None else values.count((round(amps * 10),))


async def _new_car(box: RecordingSmartEvse, dice: Random) -> float:
    """Let another car come; return how long it is offered more than the limit, s."""
    car, limit = box.car, CURRENTS[0]
    if car is None:
        raise TypeError
    car.leave()
    await asyncio.sleep(CAR_AWAY + dice.uniform(*BETWEEN))
    before = len(box.offers)
    car.plug_in()
    await asyncio.sleep(WATCHED)
    above = 0.0
    end = asyncio.get_running_loop().time()
    for offer in reversed(box.offers[before:]):
        if offer.closed and offer.amps > limit + _CLOSE:
            above += end - offer.at
        end = offer.at
    return above
