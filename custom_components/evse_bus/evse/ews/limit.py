"""The limit of one port: sent with ``st``, read back with ``rd``.

The box loses its limit with the power, and 0 switches it off. So the limit sent while
charging is paused is the one that counts when charging goes on, and at least 6 A.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Final

from ..conversation import rest
from ..errors import NotAvailableError, NotConfirmedError, ReplyTimeoutError
from ..exchange import Turn
from ..model import MINIMUM_CURRENT, CurrentLimit, Fault, Orders
from ..safety import Setpoint, clamp
from .port import BoxPort
from .timing import LOOK_AGAIN, READY_PATIENCE, READY_PAUSE
from .wire.answers import EwsRefusedError
from .wire.commands import set_limit
from .wire.frames import CommandId, Request
from .wire.states import STARTING

SENDS: Final = 2
"""How often a limit is sent at most until it must be read back."""
READS: Final = 3
"""How often it is read back at most after each."""
_LOWEST: Final = Orders(limit=CurrentLimit(current=MINIMUM_CURRENT))


class Limiter:
    """Sends the limit of one port, and checks that the box follows it."""

    def __init__(self, port: BoxPort) -> None:
        """Take the port that sends."""
        self._port = port
        self._confirmed: int | None = None
        """The last limit that was sent, and read back at it or below it, A."""
        self._read_instead: tuple[int, int] | None = None
        """A limit, and the lower one that the box reports after it, A."""

    def forget(self) -> None:
        """Take note that the box may have lost its limit."""
        self._confirmed = self._read_instead = None

    # -- State -----------------------------------------------------------------------

    def target(self, orders: Orders) -> Setpoint | None:
        """Return the limit for these orders, paused or not.

        ``None``: no limit can be sent (in mode 1 there is no control pilot; or not
        even 6 A may be offered).
        """
        port = self._port
        installation = port.box.installation
        if installation is None or installation.mode_1[port.number - 1]:
            return None
        limits = port.limits
        for one in (replace(orders, allowed=None), _LOWEST):
            setpoint = clamp(one, limits)
            if not setpoint.paused and setpoint.current > 0:
                return setpoint
        return None

    @property
    def reported(self) -> int | None:
        """Return the limit by the last ``rd``, A; 0: none is set."""
        details = self._port.box.details
        return None if details is None else details.limit[self._port.number - 1]

    def must_reassert(self) -> bool:
        """Return whether the limit has to be sent."""
        setpoint = self.target(self._port.effective_orders)
        reported = self.reported
        if setpoint is None or reported is None or self._port.last_status is None:
            return False
        target = int(setpoint.current)
        if reported == target:
            return False
        return self._read_instead != (target, reported) or not self._is_within(target)

    def _is_within(self, limit: int) -> bool:
        """Return whether the box offers no more than that, by its last readings."""
        reported, status = self.reported, self._port.last_status
        if reported:
            return reported <= limit
        # No limit is set: the current it offers counts.
        offered = status.offered_current if status is not None else None
        return reported == 0 and offered is not None and 0 < offered <= limit

    def count_reassertion(self) -> None:
        """Count it if the box has gone above a limit that it had followed."""
        if self._confirmed is not None and not self._is_within(self._confirmed):
            self._port.statistics.reasserted += 1

    # -- Conversation ----------------------------------------------------------------

    async def enforce(self, turn: Turn, orders: Callable[[], Orders]) -> None:
        """Send the limit until it is read back, at it or below it.

        ``orders`` is called right before each request. Raises NotConfirmedError when
        the box does not follow, EwsRefusedError, and what `BoxPort.read_status` raises.
        """
        port = self._port
        patience = turn.now + READY_PATIENCE
        sends = 0
        while sends < SENDS:
            await port.ready(turn)
            # The cable limits the current too, and is known right now only.
            status = await port.read_status(turn)
            if self.target(orders()) is None:
                return
            try:
                sent, answered = await self._send(turn, orders)
            except EwsRefusedError:
                if status.state == STARTING and turn.now < patience:
                    await rest(READY_PAUSE)
                    continue
                await rest(0.0)
                await self._after_refusal(turn)
                raise
            sends += 1
            await rest(0.0)
            if await self._read_back(turn, sent, answered=answered):
                return
        port.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        message = f"{port.config.name} does not follow its limit"
        raise NotConfirmedError(message)

    async def _send(self, turn: Turn, orders: Callable[[], Orders]) -> tuple[int, bool]:
        """Send the limit; return it, A, and whether it was answered.

        Without a reply it may have been received all the same.
        """
        port = self._port
        sent: list[int] = []

        def request() -> Request:
            setpoint = self.target(orders())
            if setpoint is None:
                message = f"{port.config.name}: no current may be offered"
                raise NotAvailableError(message)
            sent.append(int(setpoint.current))
            return set_limit(port.number, setpoint)

        self.forget()
        try:
            await port.box.send_command(turn, CommandId.SET_LIMIT, request)
        except ReplyTimeoutError:
            return sent[-1], False
        return sent[-1], True

    async def _read_back(self, turn: Turn, sent: int, *, answered: bool) -> bool:
        """Read the limit back, a few times; return whether the box follows it."""
        for _ in range(READS):
            await self._port.ready(turn)
            if await self._is_read_back(turn, sent, answered=answered):
                return True
            await rest(LOOK_AGAIN)
        return False

    async def _is_read_back(self, turn: Turn, sent: int, *, answered: bool) -> bool:
        """Read the limit back; return whether the box offers that, or less.

        Less may be all it can offer; but after a lost reply, it may be the old limit.
        """
        port = self._port
        try:
            await port.read_status(turn)
            await port.read(turn, port.box.read_details)
        except ReplyTimeoutError:
            return False
        port.take_status()
        reported = self.reported
        if reported is None or not self._is_within(sent):
            return False
        if not answered and reported != sent:
            return False
        self._confirmed = sent
        self._read_instead = (sent, reported)
        port.notice(Fault.LIMIT_NOT_TAKEN, present=False)
        return True

    async def _after_refusal(self, turn: Turn) -> None:
        """Leave a box that has refused its limit at no more than that, or at 6 A."""
        port = self._port
        await port.ready(turn)
        setpoint = self.target(port.effective_orders)
        reported = self.reported
        if setpoint is None or reported is None:
            return
        target = int(setpoint.current)
        if self._is_within(target):
            # Its maximum is lower than reported: sent again, it would refuse again.
            self._read_instead = (target, reported)
            return
        port.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        with suppress(EwsRefusedError):
            await self._send(turn, lambda: _LOWEST)
