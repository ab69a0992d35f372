"""The last word to chargers when Home Assistant stops, or when they are removed."""

import asyncio
from collections.abc import Sequence
from typing import Final

from .const import LOGGER
from .evse.charger import Charger
from .evse.errors import EvseError

PATIENCE: Final = 5.0
"""Longest time that Home Assistant is kept from stopping, s."""


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
