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
from .reader import AblReader, Cleanup
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """A change of register 0x002C; ``None``: no change."""

    upstream_timeout: bool | None = None
    needs_enable: bool | None = None
    """A plugged car must be enabled anew after a power cycle."""


async def change_settings(reader: AblReader, settings: Settings, turn: Turn) -> None:
    """Write settings in E2, reset the box, and check that it has taken them.

    Raises NotAvailableError in a state without E2 and without a serial number,
    NotConfirmedError.
    """
    before = await reach(reader, turn)
    _check_ready(reader, before)
    was_disabled = before.state == E0
    reader.pending_cleanup = (
        Cleanup(StateCode.E0) if was_disabled else Cleanup(StateCode.A1, E2)
    )
    try:
        await _write(reader, turn, settings)
    except EvseError:
        # Leave E2 after any error.
        with suppress(EvseError):
            await restore(reader, turn)
        raise
    await recover(reader, turn, was_disabled=was_disabled)
    await reader.read_flags(turn)
    _check_taken(reader, settings)


def _check_ready(reader: AblReader, status: Reading) -> None:
    """Raise NotAvailableError for a box whose settings cannot be changed now."""
    if status.state not in (A1, E0):
        why = "settings are changed in A1 or E0"
        raise refuse_in(reader, status, "abl_settings_state", why)
    if reader.serial is None:
        message = (
            f"{reader.config.name} has no serial number: it cannot be distinguished "
            "from another box with the same device-ID"
        )
        raise NotAvailableError(message, "abl_no_serial")


async def _write(reader: AblReader, turn: Turn, settings: Settings) -> None:
    """Go to E2, write the settings, and reset the box."""
    hold_polls(reader, turn)
    await reach_state(reader, turn, StateCode.E2, lambda now: now.state == E2)
    await rest_without_polls(reader, turn, reader.pauses.settings)
    write = partial(
        reader.set_configuration,
        turn,
        upstream_timeout=settings.upstream_timeout,
        needs_enable=settings.needs_enable,
    )
    try:
        await write()
    except ReplyTimeoutError:
        # Not readable before the reset; to write the same value again is harmless.
        await write()
    await rest_without_polls(reader, turn, reader.pauses.settings)
    if not await reader.set_state(turn, StateCode.RESET):
        with suppress(ReplyTimeoutError):
            if (await reader.read_status(turn)).state == E2:
                await reader.set_state(turn, StateCode.RESET)


def _check_taken(reader: AblReader, settings: Settings) -> None:
    """Raise NotConfirmedError when a setting has not been taken."""
    options = reader.info.options if reader.info is not None else {}
    enable = None if settings.needs_enable is None else not settings.needs_enable
    wanted = {
        "upstream_timeout": settings.upstream_timeout,
        "enable_after_power_cycle": enable,
    }
    for name, value in wanted.items():
        if value is not None and options.get(name) is not value:
            message = f"{reader.config.name} did not take {name} = {value}"
            raise NotConfirmedError(message)
