"""Changing a setting in the EEPROM of a SmartEVSE, once per request of the user.

The write may open access that was off (PROTOCOLS.md, 3): it is closed again in the
same conversation, before anything else.
"""

from functools import partial

from ..conversation import Conversation, rest
from ..errors import (
    EvseError,
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
)
from ..exchange import Turn
from ..model import Setting
from .config import SmartEvseConfig
from .dialects import MAPS
from .reader import SmartEvseReader
from .registers import write_setting


def setting_conversation(
    reader: SmartEvseReader[SmartEvseConfig], setting: Setting, value: int
) -> Conversation:
    """Return a conversation that changes a setting.

    Raises NotAvailableError where the box has no such setting, RefusedOrderError
    for a value out of its range.
    """
    span = reader.settings.get(setting)
    if span is None:
        message = f"{reader.config.name} has no setting {setting}"
        raise NotAvailableError(message)
    if isinstance(value, bool) or not isinstance(value, int):
        message = f"{setting}: {value!r} is no whole number"
        raise RefusedOrderError(message)
    if not span.minimum <= value <= span.maximum:
        message = f"{setting} is {span.minimum} to {span.maximum}, not {value}"
        raise RefusedOrderError(message)
    return partial(_set, reader, setting, value)


async def _set(
    reader: SmartEvseReader[SmartEvseConfig], setting: Setting, value: int, turn: Turn
) -> None:
    with reader.conversing():
        await reader.reach(turn)
        await reader.read_status(turn)
        await rest()
        await reader.read_configuration(turn)
        if _is_set(reader, setting, value):
            # The memory wears out: an equal value is not written.
            return
        # Kept until access is certain: replies may be lost, or the line.
        reader.must_close_access |= (
            reader.status is not None and reader.status.access is False
        )
        dialect = reader.known_dialect
        # Once, whatever the reply: the read-back shows whether it took effect.
        await reader.write(
            turn,
            partial(write_setting, reader.config.address, dialect, setting, value),
            MAPS[dialect].settings[setting].register,
        )
        await rest()
        if reader.must_close_access:
            await _close_access(reader, turn)
        await _read_back(reader, turn)
    if not _is_set(reader, setting, value):
        message = f"{reader.config.name} did not take {setting} = {value}"
        raise NotConfirmedError(message)


def _is_set(
    reader: SmartEvseReader[SmartEvseConfig], setting: Setting, value: int
) -> bool:
    configuration = reader.configuration
    return configuration is not None and configuration.settings.get(setting) == value


async def _close_access(reader: SmartEvseReader[SmartEvseConfig], turn: Turn) -> None:
    """Turn access off again where the write has opened it."""
    try:
        await reader.close_access(turn)
        await rest()
    except EvseError as error:
        message = (
            f"{reader.config.name}: access was off before the setting was written, "
            f"and it is not certain to be off now: {error}"
        )
        raise NotConfirmedError(message) from error


async def _read_back(reader: SmartEvseReader[SmartEvseConfig], turn: Turn) -> None:
    reader.configuration = None
    await reader.read_configuration(turn)
    if reader.configuration is None:
        # The maximum may have changed: to be read as soon as possible.
        reader.configuration_due = 0.0
