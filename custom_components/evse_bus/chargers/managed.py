"""One charger as Home Assistant manages it: a whole box, or one port of a box."""

import asyncio
from collections.abc import Sequence
from typing import Final

from homeassistant.config_entries import ConfigSubentry
from homeassistant.core import CALLBACK_TYPE
from homeassistant.helpers.entity import Entity

from ..configuration import port_count
from ..const import LOGGER
from ..evse.bus import Bus
from ..evse.charger import Charger
from ..evse.errors import EvseError
from ..evse.events import Events
from ..evse.readings import ConnectorReading
from ..identity import identity_of

SHUTDOWN_TIMEOUT: Final = 5.0
"""Longest time a charger may delay the stop of Home Assistant, s."""


class ManagedCharger:
    """A charger of the library, with the state Home Assistant keeps beside it."""

    def __init__(
        self,
        subentry: ConfigSubentry,
        charger: Charger,
        bus: Bus,
        order_key: str,
        port_number: int | None = None,
    ) -> None:
        """Start without connectors, entities or subscriptions."""
        self.key = charger.config.key
        """Its key in listener contexts, as long as it is configured."""
        self.identity = identity_of(subentry)
        """What its box is known by; identifies the device of the box."""
        self.order_key = order_key
        """Key of its stored orders."""
        self.subentry_id = subentry.subentry_id
        self.subentry = subentry
        self.charger = charger
        """Replaced when the configuration changes in a way that requires it."""
        self.address = charger.config.address
        """Its address as it is stored."""
        self.bus = bus
        self.port_number = port_number
        """Which port of its box this is, from 1; ``None``: a whole box."""
        self.device_id = ""
        self.has_child_devices = False
        """Each connector or port has a device of its own below that of the box."""
        self.added_entities: set[tuple[str, str]] = set()
        """Platform and unique id of each entity added so far."""
        self.entities: set[Entity] = set()
        """Entities that Home Assistant has added."""
        self.connectors: dict[int, ConnectorReading] = {}
        """Readings last passed to the listeners; empty while it is unavailable."""
        self.connector_numbers: set[int] = set()
        """Connectors seen since the start."""
        self.structure: object = None
        """All that decides which entities exist, when they were last added."""
        self.events = Events()
        """Events of the charger; subscriptions survive a replaced `charger`."""
        self.subscriptions: list[CALLBACK_TYPE] = []
        """Callbacks that end the subscriptions to `charger` and `bus`."""

    @property
    def unique_key(self) -> str:
        """Return the prefix of its unique ids, which identifies its device."""
        if self.port_number is None:
            return self.identity
        return self.connector_key(self.port_number)

    @property
    def name(self) -> str:
        """Return the name given by the user."""
        return self.charger.config.name

    @property
    def port_count(self) -> int:
        """Return how many ports of its box are used."""
        return port_count(self.subentry.data)

    @property
    def is_primary_port(self) -> bool:
        """Return whether the entities of the whole box belong to it."""
        return self.port_number in (None, 1)

    def connector_key(self, number: int) -> str:
        """Return the prefix of a connector's device identifier and unique ids."""
        return f"{self.identity}_{number}"

    def connector(self, number: int) -> ConnectorReading | None:
        """Return a connector's current reading; ``None``: not available."""
        reading = self.charger.reading
        if reading is None or not self.charger.available:
            return None
        return reading.connectors.get(number)

    def remove_connector(self, number: int) -> None:
        """Drop a connector and its entities; they are added again if it returns."""
        self.connector_numbers.discard(number)
        prefix = f"{self.connector_key(number)}_"
        self.added_entities = {
            (platform, unique_id)
            for platform, unique_id in self.added_entities
            if not unique_id.startswith(prefix)
        }
        self.structure = None

    async def async_remove_entities(self) -> None:
        """Remove its entities; they stay registered."""
        for entity in tuple(self.entities):
            await entity.async_remove()

    def unsubscribe(self) -> None:
        """End all subscriptions to the charger and its bus."""
        while self.subscriptions:
            self.subscriptions.pop()()


async def async_shut_down_chargers(
    chargers: Sequence[Charger],
    *,
    removed: bool = False,
    why: str = "Home Assistant stops",
) -> None:
    """Send each charger its configured shutdown command, if any; raises nothing.

    ``removed``: these chargers are removed while Home Assistant keeps running; else
    ``why``: for the log. The orders stay as they are: a shutdown command is not an order
    of the user.
    """
    results = await asyncio.gather(
        *(_async_shut_down(charger, removed) for charger in chargers),
        return_exceptions=True,
    )
    for charger, result in zip(chargers, results, strict=True):
        if result is not None:
            LOGGER.error(
                "The shutdown command to %s failed (%s): %s",
                charger.config.name,
                "it is removed" if removed else why,
                result if isinstance(result, EvseError) else repr(result),
            )


async def _async_shut_down(charger: Charger, removed: bool) -> None:  # noqa: FBT001
    async with asyncio.timeout(SHUTDOWN_TIMEOUT):
        await charger.on_shutdown(removed=removed)
