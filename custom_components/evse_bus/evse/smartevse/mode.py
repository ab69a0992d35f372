"""Setting the mode of a SmartEVSE, until its next restart."""

from functools import partial
from typing import TYPE_CHECKING

from ..conversation import Conversation, rest
from ..errors import NotAvailableError, NotConfirmedError, RefusedOrderError
from ..exchange import Turn
from ..model import Mode
from .dialects import MAPS
from .registers import write_mode

if TYPE_CHECKING:
    from .box import SmartEvseBox
    from .config import PolledConfig


def mode_conversation(box: SmartEvseBox[PolledConfig], value: object) -> Conversation:
    """Return what sets the mode; RefusedOrderError for what is no mode."""
    try:
        mode = Mode(str(value))
    except ValueError as error:
        message = f"{value!r} is no mode of a SmartEVSE"
        raise RefusedOrderError(message) from error
    return partial(_set_mode, box, mode)


async def _set_mode(box: SmartEvseBox[PolledConfig], mode: Mode, turn: Turn) -> None:
    with box.conversing():
        await box.reach(turn)
        await box.see(turn)
        if _mode_of(box) is mode:
            return
        _check_changeable(box)
        await rest(0.0)
        dialect = box.known_dialect
        request = partial(write_mode, box.config.address, dialect, mode)
        await box.write(turn, request, MAPS[dialect].mode_register)
        await rest(0.0)
        await box.see(turn)
    if _mode_of(box) is not mode:
        message = f"{box.config.name} did not take the mode {mode}"
        raise NotConfirmedError(message)


def _mode_of(box: SmartEvseBox[PolledConfig]) -> Mode | None:
    return box.status.mode if box.status is not None else None


def _check_changeable(box: SmartEvseBox[PolledConfig]) -> None:
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
