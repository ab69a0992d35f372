"""One charger as the integration sees it: a box, or one port of a box."""

import asyncio
from collections.abc import Sequence
from typing import Final

from homeassistant.config_entries import ConfigSubentry
from homeassistant.core import CALLBACK_TYPE

from .configuration import port_count
from .const import LOGGER
from .evse.bus import Bus
from .evse.charger import Charger
from .evse.errors import EvseError
from .evse.ews.events import Events
from .evse.readings import ConnectorReading

PATIENCE: Final = 5.0
"""Longest time that Home Assistant is kept from stopping, s."""


class ChargerUnit:
    """One charger and what the integration knows about it."""

    def __init__(
        self,
        subentry: ConfigSubentry,
        charger: Charger,
        bus: Bus,
        part: int | None = None,
    ) -> None:
        """Start with nothing shown; ``part``: see there."""
        self.key = charger.config.key
        """Its unique ids, its contexts and its orders begin with it."""
        self.subentry_id = subentry.subentry_id
        self.subentry = subentry
        self.charger = charger
        """The library's charger; another one after the set-up was changed."""
        self.bus = bus
        self.part = part
        """Number of the port that it is; ``None``: it is a whole box."""
        self.device_id = ""
        self.split = False
        """Its connectors are devices of their own."""
        self.added: set[tuple[str, str]] = set()
        """Platform and unique id of the entities that exist."""
        self.connectors: dict[int, ConnectorReading] = {}
        """As last told to listeners; empty: the charger is not available."""
        self.numbers: set[int] = set()
        """Connectors seen since the start."""
        self.shape: object = None
        """What entities have been made for: capabilities, connectors and the like."""
        self.events = Events()
        """What happens at the charger, whichever object of the library it is now."""
        self.unsubscribe: CALLBACK_TYPE = lambda: None

    @property
    def name(self) -> str:
        """Return what the user calls it."""
        return self.charger.config.name

    @property
    def parts(self) -> int:
        """Return how many ports of its box are used."""
        return port_count(self.subentry.data)

    @property
    def leads(self) -> bool:
        """Return whether it stands for its whole box."""
        return self.part in (None, 1)

    def connector(self, number: int) -> ConnectorReading | None:
        """Return what is known of a connector now."""
        reading = self.charger.reading
        if reading is None or not self.charger.available:
            return None
        return reading.connectors.get(number)


async def async_say_farewell(
    chargers: Sequence[Charger], *, for_good: bool = False
) -> None:
    """Let each charger be told what its set-up asks for; raises nothing.

    ``for_good``: these chargers are removed, and Home Assistant goes on.

    Orders stay as they are: what a charger is told now is not what the user wants
    to stand.
    """
    results = await asyncio.gather(
        *(_async_tell(charger, for_good) for charger in chargers),
        return_exceptions=True,
    )
    for charger, result in zip(chargers, results, strict=True):
        if result is not None:
            LOGGER.error(
                "%s was not told that %s: %s",
                charger.config.name,
                "it is removed" if for_good else "Home Assistant stops",
                result if isinstance(result, EvseError) else repr(result),
            )


async def _async_tell(charger: Charger, for_good: bool) -> None:  # noqa: FBT001
    async with asyncio.timeout(PATIENCE):
        await charger.farewell(for_good=for_good)
