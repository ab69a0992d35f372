"""Commands to chargers at random moments."""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Final

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.errors import EvseError
from custom_components.evse_bus.evse.model import Circuit, OrderChange

from .balancing import Shared

CURRENTS: Final = (6.0, 8.0, 10.0, 12.5, 14.0, 16.0)
FORBIDS: Final = 0.1
"""Share of commands that pause a charger; the next one allows it to charge again."""
SHARES: Final = 0.3
"""Share of commands that change the supply."""
PAUSES: Final = (0.2, 2.0)
"""Shortest and longest time between two commands, s."""


@dataclass(slots=True)
class RandomCommands:
    """Sets currents, pauses and allows chargers, and changes the shared supply."""

    bus: Bus
    chargers: Sequence[Charger]
    shared: list[Shared]
    """The supplies that were shared, by time."""
    supplies: Sequence[float]
    """Supplies to choose from, A."""
    dice: Random
    given: int = 0
    refused: list[str] = field(default_factory=list)
    """The errors of commands that failed."""

    async def run(self, seconds: float) -> None:
        """Give commands for this time (s)."""
        loop = asyncio.get_running_loop()
        end = loop.time() + seconds
        while (left := end - loop.time()) > 0:
            await asyncio.sleep(min(left, self.dice.uniform(*PAUSES)))
            self.given += 1
            try:
                await self._command()
            except EvseError as error:
                self.refused.append(f"{type(error).__name__}: {error}")

    async def _command(self) -> None:
        kind = self.dice.random()
        charger = self.dice.choice(self.chargers)
        if charger.orders.allowed is False:
            change = OrderChange(allowed=True)
        elif kind < FORBIDS:
            change = OrderChange(allowed=False)
        elif kind < FORBIDS + SHARES:
            await self.share(self.dice.choice(self.supplies))
            return
        else:
            change = OrderChange(current=self.dice.choice(CURRENTS))
        await charger.change_orders(change)

    async def share(self, amps: float) -> None:
        """Change the shared supply (A)."""
        master = self.bus.master
        if master is not None:
            self.shared.append(Shared(asyncio.get_running_loop().time(), amps))
            await master.change_circuit(Circuit(limit=amps))
