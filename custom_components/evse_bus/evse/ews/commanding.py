"""Orders of ``sl`` that a person gives once, and the reset.

Each is sent right after a look, where `states.RULES` lets it, and the port is looked at
until it has followed. An answer that is lost decides nothing: the next look does.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

from ..errors import NotConfirmedError, RefusedOrderError, ReplyTimeoutError
from ..exchange import Talk
from ..model import Command
from ..turns import Turns
from .answers import decode_reset
from .commands import reset, start_stop
from .frames import CommandId
from .readings import RUNNING
from .states import StartStop
from .status import PortStatus, StartRelease
from .timing import LOOK_AGAIN, SETTLING

if TYPE_CHECKING:
    from .charger import EwsPort

SENDS: Final = 2


@dataclass(frozen=True, slots=True)
class _Order:
    """An order, how it is seen to have worked, and whether it may be said twice."""

    order: StartStop
    done: Callable[[PortStatus], bool]
    repeats: bool = True


def _stopped(seen: PortStatus) -> bool:
    return seen.status not in RUNNING and not seen.locked and not seen.contactor


def _asked(seen: PortStatus) -> bool:
    known = (StartRelease.REQUESTED, StartRelease.RELEASED)
    return seen.start in known or seen.status in RUNNING


_ORDERS: Final[Mapping[Command, _Order]] = {
    Command.STOP_AND_UNLOCK: _Order(StartStop.STOP, _stopped),
    # A second press of a key may mean something else.
    Command.REQUEST_START: _Order(StartStop.REQUEST_START, _asked, repeats=False),
    Command.LOCK: _Order(StartStop.LOCK, lambda seen: bool(seen.locked)),
}
_OPTIMISED: Final[Mapping[bool, _Order]] = {
    True: _Order(StartStop.OPTIMISE, lambda seen: seen.optimised),
    False: _Order(StartStop.DO_NOT_OPTIMISE, lambda seen: not seen.optimised),
}


def conversation(
    port: EwsPort,
    command: Command,
    value: bool | int | str | None,  # noqa: FBT001 - as `Charger.command`
) -> Callable[[Talk], Turns] | None:
    """Return what carries a command out; ``None``: an EWS-Box has no such command.

    Raises RefusedOrderError for a value that cannot be.
    """
    if command is Command.RESET:
        return partial(_reset, port)
    if command is Command.SET_OPTIMISED:
        if not isinstance(value, bool):
            message = f"{command} is true or false, not {value!r}"
            raise RefusedOrderError(message)
        return partial(_give, port, _OPTIMISED[value])
    order = _ORDERS.get(command)
    return None if order is None else partial(_give, port, order)


async def _give(port: EwsPort, order: _Order, talk: Talk) -> Turns:
    """Give an order, and look until it is followed.

    Raises NotAvailableError where it may not be given, EwsRefusedError, and
    NotConfirmedError when the port does not follow.
    """
    async for pause in port.ready(talk):
        yield pause
    seen = await port.look(talk)
    for _ in range(SENDS if order.repeats else 1):
        taken = await _say(port, order.order, seen, talk)
        until = talk.now + SETTLING
        while talk.now < until:
            yield LOOK_AGAIN
            async for pause in port.ready(talk):
                yield pause
            try:
                seen = await port.look(talk)
            except ReplyTimeoutError:
                continue
            if order.done(seen):
                return
            if not taken:
                break
    message = f"{port.config.name} does not follow: {order.order.name.lower()}"
    raise NotConfirmedError(message)


async def _say(port: EwsPort, order: StartStop, seen: PortStatus, talk: Talk) -> bool:
    """Say it; return whether it was answered."""
    try:
        await port.box.tell(
            talk, CommandId.START_STOP, lambda: start_stop(port.port, order, seen)
        )
    except ReplyTimeoutError:
        return False
    if order is StartStop.STOP:
        port.permission.forget()
    return True


async def _reset(port: EwsPort, talk: Talk) -> Turns:
    """Restart the box; both ports forget their limits.

    Raises NotConfirmedError when nobody answers: it may have restarted all the same.
    """
    box = port.box
    async for pause in port.ready(talk):
        yield pause
    try:
        await box.ask(talk, CommandId.RESET, reset, decode_reset)
    except ReplyTimeoutError as error:
        raise NotConfirmedError(str(error)) from error
    box.was_reset()
