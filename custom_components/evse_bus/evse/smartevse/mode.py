"""Setting the mode of a SmartEVSE, until its next restart."""

from functools import partial
from typing import TYPE_CHECKING

from ..errors import NotAvailableError, NotConfirmedError, RefusedOrderError
from ..exchange import Talk
from ..model import Mode
from ..turns import Conversation, rest
from .dialects import MAPS
from .registers import write_mode

if TYPE_CHECKING:
    from .box import SmartEvseBox


def mode_conversation(box: SmartEvseBox, value: object) -> Conversation:
    """Return what sets the mode; RefusedOrderError for what is no mode."""
    try:
        mode = Mode(str(value))
    except ValueError as error:
        message = f"{value!r} is no mode of a SmartEVSE"
        raise RefusedOrderError(message) from error
    return partial(_set_mode, box, mode)


async def _set_mode(box: SmartEvseBox, mode: Mode, talk: Talk) -> None:
    with box.conversing():
        await box.reach(talk)
        await box.see(talk)
        if _mode_of(box) is mode:
            return
        _check_changeable(box)
        await rest(0.0)
        dialect = box.known_dialect
        request = partial(write_mode, box.config.address, dialect, mode)
        await box.write(talk, request, MAPS[dialect].mode_register)
        await rest(0.0)
        await box.see(talk)
    if _mode_of(box) is not mode:
        message = f"{box.config.name} did not take the mode {mode}"
        raise NotConfirmedError(message)


def _mode_of(box: SmartEvseBox) -> Mode | None:
    return box.status.mode if box.status is not None else None


def _check_changeable(box: SmartEvseBox) -> None:
    """Raise NotAvailableError where the box would ignore a write silently.

    In all dialects it does without load balancing, and in the mode normal.
    """
    name = box.config.name
    if box.configuration is None:
        message = f"{name} has not told its load balancing yet"
        raise NotAvailableError(message)
    if box.configuration.load_balancing == 0:
        message = (
            f"{name} changes its mode on request only as a load-balancing master: set "
            "LOAD BAL to Master in its menu, or change MODE there"
        )
        raise NotAvailableError(message)
    if _mode_of(box) is Mode.NORMAL:
        message = (
            f"{name} does not leave the mode normal on request: set MODE to Smart or "
            "Solar in its menu"
        )
        raise NotAvailableError(message)
