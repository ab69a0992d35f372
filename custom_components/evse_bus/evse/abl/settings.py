"""The box's own settings: upstream time-out, enable after a power cycle.

Register 0x002C accepts them in state E2; they count after a reset and survive power
cycles. The box must have been identified by its serial number (PROTOCOLS.md, 2).
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from ..errors import (
    EvseError,
    NotAvailableError,
    NotConfirmedError,
    ReplyTimeoutError,
)
from ..exchange import Turn
from .registers import Reading, StateCode
from .states import A1, E0, E2
from .steps import (
    hold_polls,
    reach,
    reach_state,
    recover,
    refuse_in,
    rest_without_polls,
    restore,
)
from .writer import AblWriter, Cleanup


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """A change of register 0x002C; ``None``: no change."""

    upstream_timeout: bool | None = None
    needs_enable: bool | None = None
    """A plugged car must be enabled anew after a power cycle."""


async def change_settings(writer: AblWriter, settings: Settings, turn: Turn) -> None:
    """Write settings in E2, reset the box, and check that it has taken them.

    Raises NotAvailableError in a state without E2 and without a serial number,
    NotConfirmedError.
    """
    before = await reach(writer, turn)
    _check_ready(writer, before)
    was_disabled = before.state == E0
    writer.pending_cleanup = (
        Cleanup(StateCode.E0) if was_disabled else Cleanup(StateCode.A1, E2)
    )
    try:
        await _write(writer, turn, settings)
    except EvseError:
        # Leave E2 after any error.
        with suppress(EvseError):
            await restore(writer, turn)
        raise
    await recover(writer, turn, was_disabled=was_disabled)
    await writer.read_flags(turn)
    _check_taken(writer, settings)


def _check_ready(writer: AblWriter, status: Reading) -> None:
    """Raise NotAvailableError for a box whose settings cannot be changed now."""
    if status.state not in (A1, E0):
        why = "settings are changed in A1 or E0"
        raise refuse_in(writer, status, "abl_settings_state", why)
    if writer.serial is None:
        message = (
            f"{writer.config.name} has no serial number: it cannot be distinguished "
            "from another box with the same device-ID"
        )
        raise NotAvailableError(message, "abl_no_serial")


async def _write(writer: AblWriter, turn: Turn, settings: Settings) -> None:
    """Go to E2, write the settings, and reset the box."""
    hold_polls(writer, turn)
    await reach_state(writer, turn, StateCode.E2, lambda now: now.state == E2)
    await rest_without_polls(writer, turn, writer.pauses.settings)
    write = partial(
        writer.set_configuration,
        turn,
        upstream_timeout=settings.upstream_timeout,
        needs_enable=settings.needs_enable,
    )
    try:
        await write()
    except ReplyTimeoutError:
        # Not readable before the reset; to write the same value again is harmless.
        await write()
    await rest_without_polls(writer, turn, writer.pauses.settings)
    if not await writer.set_state(turn, StateCode.RESET):
        with suppress(ReplyTimeoutError):
            if (await writer.read_status(turn)).state == E2:
                await writer.set_state(turn, StateCode.RESET)


def _check_taken(writer: AblWriter, settings: Settings) -> None:
    """Raise NotConfirmedError when a setting has not been taken."""
    options = writer.info.options if writer.info is not None else {}
    enable = None if settings.needs_enable is None else not settings.needs_enable
    wanted = {
        "upstream_timeout": settings.upstream_timeout,
        "enable_after_power_cycle": enable,
    }
    for name, value in wanted.items():
        if value is not None and options.get(name) is not value:
            message = f"{writer.config.name} did not take {name} = {value}"
            raise NotConfirmedError(message)
