"""Commands of an ABL wallbox beside its orders, each as one conversation.

A state that a command brings about on its way (E0, E2) is ended again, also after an
error: until then it is the writer's `pending_cleanup`.
"""

from contextlib import suppress
from functools import partial

from ..conversation import Conversation, rest
from ..errors import (
    ExchangeRefusedError,
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
    ReplyTimeoutError,
)
from ..exchange import Turn
from ..model import Command, Persistence
from .duty import PAUSE
from .registers import StateCode, limit_duty
from .settings import Settings, change_settings
from .states import B2, E0, E2, state_of
from .steps import disable, lower_limit, reach, reach_state, recover, refuse_in, restore
from .writer import AblWriter, Cleanup


def conversation_for(
    writer: AblWriter, command: Command, value: object
) -> tuple[Conversation, Persistence]:
    """Return the conversation that carries out a command, and how it may be repeated.

    Raises RefusedOrderError for an invalid value, NotAvailableError for a command that
    an ABL box does not have.
    """
    match command:
        case Command.RESET:
            return partial(_reset, writer), Persistence.ONCE
        case Command.WAKE:
            return partial(_wake, writer), Persistence.ONCE
        case Command.SET_OUTLET:
            enable = _on_or_off(command, value)
            outlet = _enable_outlet if enable else _disable_outlet
            # Either reads the state first, so a repeat changes nothing.
            return partial(outlet, writer), Persistence.REPEATABLE
        case Command.SET_UPSTREAM_TIMEOUT:
            settings = Settings(upstream_timeout=_on_or_off(command, value))
        case Command.SET_ENABLE_AFTER_POWER_CYCLE:
            settings = Settings(needs_enable=not _on_or_off(command, value))
        case _:
            message = f"{writer.config.name} has no command {command}"
            raise NotAvailableError(message)
    return partial(change_settings, writer, settings), Persistence.ONCE


# -- Outlet --------------------------------------------------------------------------


async def _disable_outlet(writer: AblWriter, turn: Turn) -> None:
    await disable(writer, turn, await reach(writer, turn))


async def _enable_outlet(writer: AblWriter, turn: Turn) -> None:
    status = await reach(writer, turn)
    if state_of(status.state).outlet_enabled is not True:
        if status.state not in (E0, E2):
            raise refuse_in(
                writer, status, "abl_enable_state", "an outlet is enabled in E0 or E2"
            )
        was_allowed = writer.box.paused is False
        await lower_limit(writer, turn, status)
        status = await reach_state(
            writer, turn, StateCode.A1, lambda now: now.state not in (E0, E2)
        )
        if was_allowed and status.duty < limit_duty(writer.setpoint) != PAUSE:
            # Limits raised while the outlet was disabled have only been stored.
            await writer.apply_setpoint(turn, lambda: writer.setpoint)
    writer.pending_cleanup = None


# -- Waking a car --------------------------------------------------------------------


async def _wake(writer: AblWriter, turn: Turn) -> None:
    status = await reach(writer, turn)
    if status.state != B2:
        why = "only a car that may charge can be woken"
        raise refuse_in(writer, status, "abl_wake_state", why)
    if writer.box.paused or writer.setpoint.paused:
        why = "charging is paused, waking would not help"
        raise refuse_in(writer, status, "abl_wake_paused", why)
    writer.pending_cleanup = Cleanup(StateCode.A1, E0)
    try:
        confirmed = await writer.set_state(turn, StateCode.E0)
    except ExchangeRefusedError:
        writer.pending_cleanup = None
        raise
    if not confirmed:
        # If the state cannot be read either, it may be E0.
        with suppress(ReplyTimeoutError):
            if (await writer.read_status(turn)).state != E0:
                writer.pending_cleanup = None
                message = f"{writer.config.name} does not change to E0"
                raise NotConfirmedError(message)
    await rest(writer.pauses.wake)
    await restore(writer, turn)


# -- Reset ---------------------------------------------------------------------------


async def _reset(writer: AblWriter, turn: Turn) -> None:
    before = await reach(writer, turn)
    was_disabled = before.state == E0
    if was_disabled:
        writer.pending_cleanup = Cleanup(StateCode.E0)
    confirmed = await writer.set_state(turn, StateCode.RESET)
    after = await recover(writer, turn, was_disabled=was_disabled)
    if not confirmed and (after.state, after.duty) == (before.state, before.duty):
        message = (
            f"{writer.config.name}: no reply to the reset, and no sign that it "
            "happened; it was not repeated"
        )
        raise NotConfirmedError(message)


# -- Values --------------------------------------------------------------------------


def _on_or_off(command: Command, value: object) -> bool:
    if not isinstance(value, bool):
        message = f"{command} must be on or off, not {value!r}"
        raise RefusedOrderError(message)
    return value
