"""Steps that the commands of an ABL wallbox have in common.

A write to register 0x0005 whose reply is lost is never simply repeated: the state is
read first, and decides.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Final

from ..conversation import rest
from ..errors import (
    ExchangeError,
    NotAvailableError,
    NotConfirmedError,
    ReplyTimeoutError,
)
from ..exchange import Turn
from .duty import PAUSE
from .registers import Reading, StateCode, limit_duty
from .states import E0, E2, SETUP, state_of
from .writer import AblWriter

REACH_ATTEMPTS: Final = 3
"""Attempts to reach a box that may be asleep."""
BOOT_ATTEMPTS: Final = 10
"""Attempts to reach a box after a reset."""
STATE_READS: Final = 4
"""Reads of a state before it counts as not reached."""


async def reach(writer: AblWriter, turn: Turn) -> Reading:
    """Wake the box and return its status; repeats are safe: nothing is written yet."""
    for _ in range(REACH_ATTEMPTS - 1):
        with suppress(ReplyTimeoutError):
            return await _contact(writer, turn)
        await rest(writer.pauses.retry)
    return await _contact(writer, turn)


async def _contact(writer: AblWriter, turn: Turn) -> Reading:
    await writer.identify(turn)
    return await writer.read_status(turn)


def hold_polls(writer: AblWriter, turn: Turn) -> None:
    """Postpone the next poll: the box restarts or is being set up."""
    slot = writer.slot
    slot.ready = max(slot.ready, turn.now + 2 * writer.pauses.boot)


async def rest_without_polls(writer: AblWriter, turn: Turn, pause: float) -> None:
    """Rest for a time, s, in which the box is not polled."""
    hold_polls(writer, turn)
    await rest(pause)
    hold_polls(writer, turn)


def refuse_in(
    writer: AblWriter, status: Reading, text_key: str, why: str
) -> NotAvailableError:
    """Return the error for a command that is not possible in a state."""
    state = state_of(status.state).name
    message = f"{writer.config.name} is in state {state}: {why}"
    return NotAvailableError(message, text_key, state=state)


async def reach_state(
    writer: AblWriter, turn: Turn, code: StateCode, reached: Callable[[Reading], bool]
) -> Reading:
    """Write a state code; return the status that shows its effect.

    Written again only while the state is not reached and no reply has come. Raises
    NotConfirmedError, and ExchangeRefusedError.
    """
    confirmed = await writer.set_state(turn, code)
    for _ in range(STATE_READS):
        if reached(status := await writer.read_status(turn)):
            return status
        if not confirmed:
            confirmed = await writer.set_state(turn, code)
        await rest(writer.pauses.verify)
    if reached(status := await writer.read_status(turn)):
        return status
    message = f"{writer.config.name} does not change to {code.name}"
    raise NotConfirmedError(message)


async def recover(writer: AblWriter, turn: Turn, *, was_disabled: bool) -> Reading:
    """Wait for a box after a reset, bring back limit and E0, and return its status.

    A reset ends in A1 with Idefault: neither the limit nor E0 has survived it.
    """
    status = await _wait_for_boot(writer, turn)
    # It allows charging now: no pause is left that could be ended.
    status = await lower_limit(writer, turn, status, is_reset=True)
    if was_disabled:
        return await disable(writer, turn, status)
    if status.state != E2:
        writer.pending_cleanup = None
    return status


async def _wait_for_boot(writer: AblWriter, turn: Turn) -> Reading:
    writer.invalidate()
    for _ in range(BOOT_ATTEMPTS - 1):
        await rest_without_polls(writer, turn, writer.pauses.boot)
        with suppress(ReplyTimeoutError):
            return await _contact(writer, turn)
    await rest_without_polls(writer, turn, writer.pauses.boot)
    return await _contact(writer, turn)


async def lower_limit(
    writer: AblWriter, turn: Turn, status: Reading, *, is_reset: bool = False
) -> Reading:
    """Lower the limit to the set-point before a car can start; return the status.

    A limit above it that may hide the pause of another is left alone, but after a
    reset.
    """
    code = limit_duty(writer.setpoint)
    if writer.box.paused is True or status.state in SETUP:
        return status
    decision = writer.decide(turn.now)
    lost = decision is not None and decision.write and not writer.box.raised
    if lost or code == PAUSE or (is_reset and status.duty > code):
        return await writer.apply_setpoint(turn, lambda: writer.setpoint)
    return status


async def disable(writer: AblWriter, turn: Turn, status: Reading) -> Reading:
    """Disable the outlet, which ends any cleanup; return the status."""
    if status.state != E0:
        status = await reach_state(
            writer, turn, StateCode.E0, lambda now: now.state == E0
        )
    writer.pending_cleanup = None
    return status


async def restore(writer: AblWriter, turn: Turn) -> None:
    """Carry out the pending cleanup, if there is one; repeat a lost exchange.

    Raises NotConfirmedError.
    """
    cleanup = writer.pending_cleanup
    if cleanup is None:
        return
    for _ in range(STATE_READS):
        with suppress(ExchangeError):
            status = await writer.read_status(turn)
            if cleanup.is_needed(status.state):
                if status.state == E0:
                    await lower_limit(writer, turn, status)
                await writer.set_state(turn, cleanup.code)
                status = await writer.read_status(turn)
            if not cleanup.is_needed(status.state):
                writer.pending_cleanup = None
                return
        await rest(writer.pauses.verify)
    message = f"{writer.config.name} does not leave its state"
    raise NotConfirmedError(message)
