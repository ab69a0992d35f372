"""Commands of a person to one port: the orders of ``sl`` beside 3 and 6, and the reset.

Each is sent right after the status was read, in the states of `states.RULES`; then the
status is read until the port has followed. A lost reply decides nothing: the next
status does.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from math import inf
from typing import Final

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
from .permission import Permission
from .port import BoxPort
from .timing import LOOK_AGAIN, SETTLING
from .wire.answers import decode_reset
from .wire.commands import reset, start_stop, unlock
from .wire.frames import CommandId, Request
from .wire.states import RUNNING, StartStop, unlocks
from .wire.status import PortStatus, StartRelease

TRIES: Final = 10
"""How often an order may be stopped by an info record, or sent, altogether."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Order:
    """An order, and the status that shows it was followed."""

    choose: Callable[[PortStatus], StartStop]
    """Returns the order of ``sl`` for this status."""
    is_done: Callable[[PortStatus], bool]
    sends: int = 2
    """How often it may be sent."""
    unlocks: bool = False
    """Nothing is sent where the plug is free, and nothing again before the lock has had
    its time."""


def _is_stopped(status: PortStatus) -> bool:
    return status.state not in RUNNING and not status.locked and not status.contactor


def _is_requested(status: PortStatus) -> bool:
    requested = (StartRelease.REQUESTED, StartRelease.RELEASED)
    return status.start in requested or status.state in RUNNING


def _always(order: StartStop) -> Callable[[PortStatus], StartStop]:
    return lambda _status: order


def _unlocking(status: PortStatus) -> StartStop:
    # Order 6 leaves a start that was requested as it is.
    return StartStop.PAUSE if unlocks(status) else StartStop.STOP


_ORDERS: Final[Mapping[Command, _Order]] = {
    Command.STOP_AND_UNLOCK: _Order(
        choose=_always(StartStop.STOP), is_done=_is_stopped
    ),
    # A second press of a key may have another meaning.
    Command.REQUEST_START: _Order(
        choose=_always(StartStop.REQUEST_START), is_done=_is_requested, sends=1
    ),
    Command.LOCK: _Order(
        choose=_always(StartStop.LOCK), is_done=lambda status: bool(status.locked)
    ),
    Command.UNLOCK: _Order(
        choose=_unlocking, is_done=lambda status: not status.locked, unlocks=True
    ),
}
_OPTIMISED: Final[Mapping[bool, _Order]] = {
    True: _Order(
        choose=_always(StartStop.OPTIMISE), is_done=lambda status: status.optimised
    ),
    False: _Order(
        choose=_always(StartStop.DO_NOT_OPTIMISE),
        is_done=lambda status: not status.optimised,
    ),
}


class PortCommands:
    """The commands of one port."""

    def __init__(self, port: BoxPort, permission: Permission) -> None:
        """Take the port that sends.

        ``permission`` is informed of a charge that a command stops or unlocks.
        """
        self._port = port
        self._permission = permission

    def conversation(
        self,
        command: Command,
        value: bool | int | str | None,  # noqa: FBT001 - as `Charger.command`
    ) -> Conversation | None:
        """Return a conversation for a command; ``None``: an EWS-Box has no such one.

        Raises RefusedOrderError for an impossible value.
        """
        if command is Command.RESET:
            return self._reset
        if command is Command.SET_OPTIMISED:
            if not isinstance(value, bool):
                message = f"{command} is true or false, not {value!r}"
                raise RefusedOrderError(message)
            return partial(self._carry_out, command, _OPTIMISED[value])
        order = _ORDERS.get(command)
        return None if order is None else partial(self._carry_out, command, order)

    async def _carry_out(self, command: Command, order: _Order, turn: Turn) -> None:
        """Send an order, and read the status until it is followed.

        Raises NotAvailableError where it may not be sent, EwsRefusedError, and
        NotConfirmedError when the port does not follow.
        """
        port = self._port
        tries = sends = 0
        patience = turn.now + SETTLING
        until, answered = -inf, True
        while True:
            await port.ready(turn)
            if order.unlocks and Capability.LOCK not in port.capabilities:
                message = f"{port.config.name} has no lock"
                raise NotAvailableError(message, "ews_no_lock")
            try:
                status = await port.read_fresh_status(turn)
            except ReplyTimeoutError:
                if turn.now >= max(until, patience):
                    raise
                await rest(LOOK_AGAIN)
                continue
            if order.is_done(status) and (sends or order.unlocks):
                break
            if turn.now >= until or not (answered or order.unlocks):
                if sends == order.sends or tries == TRIES:
                    message = f"{port.config.name} does not follow: {command}"
                    raise NotConfirmedError(message)
                tries += 1
                with suppress(SupersededError):
                    answered = await self._send(turn, order.choose(status), status)
                    sends += 1
                    until = turn.now + SETTLING
            await rest(LOOK_AGAIN)
        if order.unlocks and sends:
            self._permission.forget()

    async def _send(self, turn: Turn, order: StartStop, status: PortStatus) -> bool:
        """Send an order for this status; return whether it was answered.

        Raises what `BoxPort.send_order` raises.
        """
        # Order 6 for a charge under way is a pause, and up to `Permission`.
        make = unlock if order is StartStop.PAUSE else partial(start_stop, order=order)

        def request() -> Request:
            return make(self._port.number, status=status)

        answered = await self._port.send_order(turn, request)
        if answered and order is StartStop.STOP:
            self._permission.forget()
        return answered

    async def _reset(self, turn: Turn) -> None:
        """Restart the box; both ports lose their limits.

        Raises NotConfirmedError without a reply: it may have restarted all the same.
        """
        box = self._port.box
        await self._port.ready(turn)
        try:
            await box.exchange(turn, CommandId.RESET, reset, decode_reset)
        except ReplyTimeoutError as error:
            raise NotConfirmedError(str(error)) from error
        box.on_reset()
