"""Setting what a SmartEVSE keeps in its EEPROM: once for each wish of the user.

Such a write may open access that was off (PROTOCOLS.md, 3): it is closed again in the
same conversation, before anything else.
"""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from ..errors import (
    EvseError,
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
)
from ..exchange import Talk
from ..model import Setting
from ..turns import Turns
from .dialects import MAPS
from .registers import write_setting

if TYPE_CHECKING:
    from .box import SmartEvseBox


class SetUp:
    """The conversation that sets one thing."""

    def __init__(self, box: SmartEvseBox) -> None:
        """Take the box, for its state and its access."""
        self._box = box

    def conversation(self, setting: Setting, value: int) -> Callable[[Talk], Turns]:
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

    async def _set(self, setting: Setting, value: int, talk: Talk) -> Turns:
        box = self._box
        token = box.begin()
        try:
            async for pause in self._look(talk):
                yield pause
            if self._is_set(setting, value):
                # What is set already is not written: the memory wears out.
                return
            # Remembered until it is certain: answers may be lost, or the line.
            box.must_close |= box.status is not None and not box.status.access
            async for pause in self._write(setting, value, talk):
                yield pause
            if box.must_close:
                async for pause in self._close(talk):
                    yield pause
            async for pause in self._read_back(talk):
                yield pause
        finally:
            box.end(token)
        if not self._is_set(setting, value):
            message = f"{box.config.name} did not take {setting} = {value}"
            raise NotConfirmedError(message)

    async def _look(self, talk: Talk) -> Turns:
        """Read access and settings as they are now."""
        box = self._box
        async for pause in box.reach(talk):
            yield pause
        async for pause in box.see(talk):
            yield pause
        yield 0.0
        async for pause in box.read_configuration(talk):
            yield pause

    async def _read_back(self, talk: Talk) -> Turns:
        box = self._box
        box.configuration = None
        async for pause in box.read_configuration(talk):
            yield pause
        if box.configuration is None:
            # Nobody knows what it may offer now: to be read as soon as it can be.
            box.configuration_due = 0.0

    def _is_set(self, setting: Setting, value: int) -> bool:
        configuration = self._box.configuration
        return configuration is not None and configuration.settings[setting] == value

    async def _write(self, setting: Setting, value: int, talk: Talk) -> Turns:
        box = self._box
        dialect = box.known_dialect
        # Once, whatever the answer: the read-back tells whether it worked.
        await box.write(
            talk,
            partial(write_setting, box.config.address, dialect, setting, value),
            MAPS[dialect].settings[setting].register,
        )
        yield 0.0

    async def _close(self, talk: Talk) -> Turns:
        """Turn access off again where the write has opened it."""
        box = self._box
        try:
            async for pause in box.close_again(talk):
                yield pause
            yield 0.0
        except EvseError as error:
            message = (
                f"{box.config.name}: access was off before the setting was written, "
                f"and it is not certain to be off now: {error}"
            )
            raise NotConfirmedError(message) from error
