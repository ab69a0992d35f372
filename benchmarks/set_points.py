"""Times from a set-point to the offer of the box, and to its confirmation."""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from random import Random
from typing import Final

from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import OrderChange

from .figures import Figure, percentile
from .offers import Offer
from .oracle import Oracle
from .setup import SMARTEVSE_LIMIT

LOW: Final = 6.0
HIGH: Final = SMARTEVSE_LIMIT
PAUSES: Final = (0.1, 2.1)
"""Shortest and longest time between two set-points, s: any moment of the 2 s."""
CHARGES_WITHIN: Final = 150.0
"""HEAD measures for 85 s first, s."""


@dataclass(frozen=True, slots=True)
class Called:
    """One call of `change_orders`, which returns when the box has confirmed it."""

    name: str
    amps: float
    at: float
    done: float
    error: str = ""


async def set_points(
    chargers: Sequence[Charger], times: int, seed: int = 1
) -> list[Called]:
    """Set each box in turn, all of them low, then all of them high, and so on."""
    dice = Random(seed)  # noqa: S311 - repeatable on purpose
    loop = asyncio.get_running_loop()
    called: list[Called] = []
    for at in range(times):
        charger = chargers[at % len(chargers)]
        amps = HIGH if at // len(chargers) % 2 else LOW
        await asyncio.sleep(dice.uniform(*PAUSES))
        begin, error = loop.time(), ""
        try:
            await charger.change_orders(OrderChange(current=amps))
        except EvseError as failure:
            error = f"{type(failure).__name__}: {failure}"
        called.append(Called(charger.config.key, amps, begin, loop.time(), error))
    return called


async def until_all_charge(oracle: Oracle, chargers: Sequence[Charger]) -> None:
    """Wait until each box offers its full current."""
    async with asyncio.timeout(CHARGES_WITHIN):
        while True:
            if _all_charge(await oracle.offers(), chargers):
                return
            await asyncio.sleep(0.2)


def _all_charge(offers: Sequence[Offer], chargers: Sequence[Charger]) -> bool:
    last = {offer.name: (offer.amps, offer.closed) for offer in offers}
    return all(last.get(one.config.key) == (HIGH, True) for one in chargers)


def offered_after(called: Called, offers: Sequence[Offer]) -> float | None:
    """Return the time until the box offered it, s; ``None``: never."""
    for offer in offers:
        if (
            (offer.name, offer.amps) == (called.name, called.amps)
            and offer.closed
            and offer.at >= called.at
        ):
            return offer.at - called.at
    return None


def set_point_figures(
    benchmark: str, prefix: str, called: Sequence[Called], offers: Sequence[Offer]
) -> list[Figure]:
    """Return the times of raises and lowerings."""
    figures: list[Figure] = []
    for name, amps in (("raise", HIGH), ("lowering", LOW)):
        these = [one for one in called if one.amps == amps]
        offered = [offered_after(one, offers) for one in these]
        there = [one for one in offered if one is not None]
        confirmed = [one.done - one.at for one in these if not one.error]
        note = f"{len(there)} of {len(these)} followed, {len(confirmed)} confirmed"
        for kind, seconds in (("offered", there), ("confirmed", confirmed)):
            if not seconds:
                continue
            figures += [
                Figure(
                    benchmark=benchmark,
                    name=f"{prefix}{name} to {kind}, {words}",
                    value=percentile(seconds, share) * 1000,
                    unit="ms",
                    digits=0,
                    note=note,
                )
                for words, share in (("p50", 0.5), ("p99", 0.99))
            ]
    errors = sorted({one.error for one in called if one.error})
    figures.append(
        Figure(
            benchmark=benchmark,
            name=f"{prefix}set-points that were not confirmed",
            value=sum(bool(one.error) for one in called),
            aim=0,
            digits=0,
            note="; ".join(errors[:2]),
        )
    )
    return figures
