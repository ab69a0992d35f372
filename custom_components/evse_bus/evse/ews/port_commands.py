"""Orders of ``sl`` that a person gives once, and the reset.

Each is sent right after a look, where `states.RULES` lets it, and the port is looked at
until it has followed. An answer that is lost decides nothing: the next look does.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Final

from ..conversation import Conversation, rest
from ..errors import (
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
    ReplyTimeoutError,
    SupersededError,
)
from ..exchange import Turn
from ..model import Capability, Command
from .readings import RUNNING
from .timing import LOOK_AGAIN, SETTLING
from .wire.answers import decode_reset
from .wire.commands import reset, start_stop, unlock
from .wire.frames import CommandId, Request
from .wire.states import StartStop, unlocks
from .wire.status import PortStatus, StartRelease

if TYPE_CHECKING:
    from .reader import EwsReader

TRIES: Final = 10
"""How often an order is about to be said, and something happens at the box then."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Order:
    """An order, and how it is seen to have worked."""

    pick: Callable[[PortStatus], StartStop]
    """Which order of ``sl`` it is, by how the port is."""
    done: Callable[[PortStatus], bool]
    sends: int = 2
    """How often it may be said."""
    unlocks: bool = False
    """Nothing is said where the plug is free, and nothing twice before the lock had its
    time."""


def _stopped(seen: PortStatus) -> bool:
    return seen.status not in RUNNING and not seen.locked and not seen.contactor


def _asked(seen: PortStatus) -> bool:
    known = (StartRelease.REQUESTED, StartRelease.RELEASED)
    return seen.start in known or seen.status in RUNNING


def _always(order: StartStop) -> Callable[[PortStatus], StartStop]:
    return lambda _seen: order


def _how_to_unlock(seen: PortStatus) -> StartStop:
    # 6 leaves a start that was asked for as it is.
    return StartStop.PAUSE if unlocks(seen) else StartStop.STOP


_ORDERS: Final[Mapping[Command, _Order]] = {
    Command.STOP_AND_UNLOCK: _Order(pick=_always(StartStop.STOP), done=_stopped),
    # A second press of a key may mean something else.
    Command.REQUEST_START: _Order(
        pick=_always(StartStop.REQUEST_START), done=_asked, sends=1
    ),
    Command.LOCK: _Order(
        pick=_always(StartStop.LOCK), done=lambda seen: bool(seen.locked)
    ),
    Command.UNLOCK: _Order(
        pick=_how_to_unlock, done=lambda seen: not seen.locked, unlocks=True
    ),
}
_OPTIMISED: Final[Mapping[bool, _Order]] = {
    True: _Order(pick=_always(StartStop.OPTIMISE), done=lambda seen: seen.optimised),
    False: _Order(
        pick=_always(StartStop.DO_NOT_OPTIMISE), done=lambda seen: not seen.optimised
    ),
}


def conversation(
    port: EwsReader,
    command: Command,
    value: bool | int | str | None,  # noqa: FBT001 - as `Charger.command`
) -> Conversation | None:
    """Return what carries a command out; ``None``: an EWS-Box has no such command.

    Raises RefusedOrderError for a value that cannot be.
    """
    if command is Command.RESET:
        return partial(_reset, port)
    if command is Command.SET_OPTIMISED:
        if not isinstance(value, bool):
            message = f"{command} is true or false, not {value!r}"
            raise RefusedOrderError(message)
        return partial(_give, port, command, _OPTIMISED[value])
    order = _ORDERS.get(command)
    return None if order is None else partial(_give, port, command, order)


async def _give(port: EwsReader, command: Command, order: _Order, turn: Turn) -> None:
    """Give an order, and look until it is followed.

    Raises NotAvailableError where it may not be given, EwsRefusedError, and
    NotConfirmedError when the port does not follow.
    """
    tries = sends = 0
    patience = turn.now + SETTLING
    until, answered = -inf, True
    while True:
        await port.ready(turn)
        if order.unlocks and Capability.LOCK not in port.capabilities:
            message = f"{port.config.name} has no lock"
            raise NotAvailableError(message)
        try:
            seen = await port.look_now(turn)
        except ReplyTimeoutError:
            if turn.now >= max(until, patience):
                raise
            await rest(LOOK_AGAIN)
            continue
        if order.done(seen) and (sends or order.unlocks):
            break
        if turn.now >= until or not (answered or order.unlocks):
            if sends == order.sends or tries == TRIES:
                message = f"{port.config.name} does not follow: {command}"
                raise NotConfirmedError(message)
            tries += 1
            with suppress(SupersededError):
                answered = await _say(port, order.pick(seen), seen, turn)
                sends += 1
                until = turn.now + SETTLING
        await rest(LOOK_AGAIN)
    if order.unlocks and sends:
        port.permission.forget()


async def _say(port: EwsReader, order: StartStop, seen: PortStatus, turn: Turn) -> bool:
    """Say it; return whether it was answered.

    Raises SupersededError, and says nothing, when a record has come since the look.
    """
    changes = port.box.changes
    # What 6 does while something charges is a pause, and no business of this module.
    make = unlock if order is StartStop.PAUSE else partial(start_stop, order=order)

    def request() -> Request:
        if port.box.changes != changes:
            message = f"{port.config.name}: something happens there right now"
            raise SupersededError(message)
        return make(port.port, seen=seen)

    try:
        await port.box.tell(turn, CommandId.START_STOP, request)
    except ReplyTimeoutError:
        return False
    if order is StartStop.STOP:
        port.permission.forget()
    return True


async def _reset(port: EwsReader, turn: Turn) -> None:
    """Restart the box; both ports forget their limits.

    Raises NotConfirmedError when nobody answers: it may have restarted all the same.
    """
    box = port.box
    await port.ready(turn)
    try:
        await box.ask(turn, CommandId.RESET, reset, decode_reset)
    except ReplyTimeoutError as error:
        raise NotConfirmedError(str(error)) from error
    box.was_reset()
