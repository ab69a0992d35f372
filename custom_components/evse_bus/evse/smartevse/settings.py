"""Changing a setting in the EEPROM of a SmartEVSE, once per request of the user.

The write may open access that was off (PROTOCOLS.md, 3): it is closed again in the
same conversation, before anything else. A car that is plugged in has no time to begin.
"""

from functools import partial

from ..conversation import Conversation, rest
from ..errors import (
    EvseError,
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
    SupersededError,
)
from ..exchange import Turn
from ..model import Setting
from .config import SmartEvseConfig
from .dialects import MAPS
from .reader import READ_AGAIN, READS, SmartEvseReader
from .registers import write_setting


def setting_conversation(
    reader: SmartEvseReader[SmartEvseConfig],
    setting: Setting,
    value: int,
    *,
    only_lower: bool = False,
) -> Conversation:
    """Return a conversation that changes a setting.

    ``only_lower``: one that is read to be lower stays. Raises NotAvailableError where
    the box has no such setting, RefusedOrderError for a value out of its range.
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
    lowest = min(value, 0) if only_lower else value
    return partial(_set, reader, setting, range(lowest, value + 1))


async def _set(
    reader: SmartEvseReader[SmartEvseConfig],
    setting: Setting,
    accepted: range,
    turn: Turn,
) -> None:
    """Write the highest of the accepted values, unless one of them stands."""
    value = accepted[-1]
    if (quiet := reader.minimum_pause(turn.now)) > 0:
        # Not counted as a conversation: what is urgent goes first.
        await rest(quiet)
    with reader.conversing():
        await reader.reach(turn)
        await reader.read_status(turn)
        await rest()
        await _check(reader, turn)
        if _stands(reader, setting, accepted):
            # The memory wears out: no value is written twice.
            return
        # Kept until access is certain: replies may be lost, or the line.
        reader.must_close_access |= reader.has_access is not True
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
    name = reader.config.name
    if reader.configuration is None:
        message = f"{setting} = {value} was sent to {name}, and could not be read back"
        raise NotConfirmedError(message)
    if not _stands(reader, setting, accepted):
        message = f"{name} did not take {setting} = {value}"
        raise NotConfirmedError(message)


async def _check(reader: SmartEvseReader[SmartEvseConfig], turn: Turn) -> None:
    """Read the settings; raise NotAvailableError where nothing may be written.

    Without them a value that already stands would be written again; without a known
    access, one that was off could not be put back.
    """
    name = reader.config.name
    if not await reader.read_configuration(turn):
        message = f"the settings of {name} could not be read: nothing was written"
        raise NotAvailableError(message, "smartevse_settings_not_read")
    if reader.has_access is None:
        message = f"the access of {name} has no known value: nothing was written"
        raise NotAvailableError(message, "smartevse_access_not_known")


def _stands(
    reader: SmartEvseReader[SmartEvseConfig], setting: Setting, accepted: range
) -> bool:
    configuration = reader.configuration
    return configuration is not None and configuration.settings.get(setting) in accepted


async def _close_access(reader: SmartEvseReader[SmartEvseConfig], turn: Turn) -> None:
    """Turn access off again where the write has opened it."""
    try:
        if MAPS[reader.known_dialect].balancing.access_is_volatile:
            # Not read before: a car could begin meanwhile.
            await reader.set_access(
                turn, allowed=False, still_wanted=lambda: reader.must_close_access
            )
            reader.must_close_access = False
        else:
            await reader.close_access(turn)
        await rest()
    except SupersededError:
        # The user has allowed it to charge meanwhile.
        pass
    except EvseError as error:
        message = (
            f"{reader.config.name}: access was off before the setting was written, "
            f"and it is not certain to be off now: {error}"
        )
        raise NotConfirmedError(message) from error


async def _read_back(reader: SmartEvseReader[SmartEvseConfig], turn: Turn) -> None:
    reader.configuration = None
    for pause in (0.0,) + (READ_AGAIN,) * (READS - 1):
        await rest(pause)
        if await reader.read_configuration(turn):
            return
    # The maximum may have changed: to be read as soon as possible.
    reader.configuration_due = 0.0
