"""Setting what a SmartEVSE keeps in its EEPROM: once for each wish of the user.

Such a write may open access that was off (PROTOCOLS.md, 3): it is closed again in the
same conversation, before anything else.
"""

from functools import partial
from typing import TYPE_CHECKING

from ..conversation import Conversation, rest
from ..errors import (
    EvseError,
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
)
from ..exchange import Turn
from ..model import Setting
from .dialects import MAPS
from .registers import write_setting

if TYPE_CHECKING:
    from .box import SmartEvseBox
    from .config import SmartEvseConfig


class SetUp:
    """The conversation that sets one thing."""

    def __init__(self, box: SmartEvseBox[SmartEvseConfig]) -> None:
        """Take the box, for its state and its access."""
        self._box = box

    def conversation(self, setting: Setting, value: int) -> Conversation:
        """Return what sets something.

        Raises NotAvailableError where the box has no such setting, RefusedOrderError
        for a value out of its range.
        """
        name = self._box.config.name
        span = self._box.settings.get(setting)
        if span is None:
            message = f"{name} has no setting {setting}"
            raise NotAvailableError(message)
        if isinstance(value, bool) or not isinstance(value, int):
            message = f"{setting}: {value!r} is no whole number"
            raise RefusedOrderError(message)
        if not span.minimum <= value <= span.maximum:
            message = f"{setting} is {span.minimum} to {span.maximum}, not {value}"
            raise RefusedOrderError(message)
        return partial(self._set, setting, value)

    async def _set(self, setting: Setting, value: int, turn: Turn) -> None:
        box = self._box
        with box.conversing():
            await self._look(turn)
            if self._is_set(setting, value):
                # What is set already is not written: the memory wears out.
                return
            # Remembered until it is certain: answers may be lost, or the line.
            box.must_close |= box.status is not None and not box.status.access
            await self._write(setting, value, turn)
            if box.must_close:
                await self._close(turn)
            await self._read_back(turn)
        if not self._is_set(setting, value):
            message = f"{box.config.name} did not take {setting} = {value}"
            raise NotConfirmedError(message)

    async def _look(self, turn: Turn) -> None:
        """Read access and settings as they are now."""
        box = self._box
        await box.reach(turn)
        await box.see(turn)
        await rest(0.0)
        await box.read_configuration(turn)

    async def _read_back(self, turn: Turn) -> None:
        box = self._box
        box.configuration = None
        await box.read_configuration(turn)
        if box.configuration is None:
            # Nobody knows what it may offer now: to be read as soon as it can be.
            box.configuration_due = 0.0

    def _is_set(self, setting: Setting, value: int) -> bool:
        configuration = self._box.configuration
        return configuration is not None and configuration.settings[setting] == value

    async def _write(self, setting: Setting, value: int, turn: Turn) -> None:
        box = self._box
        dialect = box.known_dialect
        # Once, whatever the answer: the read-back tells whether it worked.
        await box.write(
            turn,
            partial(write_setting, box.config.address, dialect, setting, value),
            MAPS[dialect].settings[setting].register,
        )
        await rest(0.0)

    async def _close(self, turn: Turn) -> None:
        """Turn access off again where the write has opened it."""
        box = self._box
        try:
            await box.close_again(turn)
            await rest(0.0)
        except EvseError as error:
            message = (
                f"{box.config.name}: access was off before the setting was written, "
                f"and it is not certain to be off now: {error}"
            )
            raise NotConfirmedError(message) from error
