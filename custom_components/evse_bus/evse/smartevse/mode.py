"""Changing the mode of a SmartEVSE, until its next restart."""

from functools import partial

from ..conversation import Conversation, rest
from ..errors import NotAvailableError, NotConfirmedError, RefusedOrderError
from ..exchange import Turn
from ..model import Mode
from .config import SmartEvseConfig
from .dialects import MAPS
from .reader import SmartEvseReader
from .registers import write_mode


def mode_conversation(
    reader: SmartEvseReader[SmartEvseConfig], value: object
) -> Conversation:
    """Return a conversation that changes the mode.

    Raises RefusedOrderError for a value that is no mode.
    """
    try:
        mode = Mode(str(value))
    except ValueError as error:
        message = f"{value!r} is no mode of a SmartEVSE"
        raise RefusedOrderError(message) from error
    return partial(_set_mode, reader, mode)


async def _set_mode(
    reader: SmartEvseReader[SmartEvseConfig], mode: Mode, turn: Turn
) -> None:
    with reader.conversing():
        await reader.reach(turn)
        await reader.read_status(turn)
        if _mode_of(reader) is mode:
            return
        _check_changeable(reader)
        await rest()
        dialect = reader.known_dialect
        request = partial(write_mode, reader.config.address, dialect, mode)
        await reader.write(turn, request, MAPS[dialect].mode_register)
        await rest()
        await reader.read_status(turn)
    if _mode_of(reader) is not mode:
        message = f"{reader.config.name} did not take the mode {mode}"
        raise NotConfirmedError(message)


def _mode_of(reader: SmartEvseReader[SmartEvseConfig]) -> Mode | None:
    return reader.status.mode if reader.status is not None else None


def _check_changeable(reader: SmartEvseReader[SmartEvseConfig]) -> None:
    """Raise NotAvailableError where the box would ignore the write.

    In all dialects it does without load balancing, and in the mode normal.
    """
    name = reader.config.name
    if reader.configuration is None:
        message = f"the load balancing of {name} has not been read yet"
        raise NotAvailableError(message, "smartevse_not_read")
    if reader.configuration.load_balancing == 0:
        message = (
            f"{name} changes its mode on request only as a load-balancing master: set "
            "LOAD BAL to Master in its menu, or change MODE there"
        )
        raise NotAvailableError(message, "smartevse_mode_load_balancing")
    if _mode_of(reader) is Mode.NORMAL:
        message = (
            f"{name} does not leave the mode normal on request: set MODE to Smart or "
            "Solar in its menu"
        )
        raise NotAvailableError(message, "smartevse_mode_normal")
