"""The limit of a port: ``st`` until ``rd`` tells it, and whenever it tells another.

The limit is lost when the box is switched off, and 0 takes it away: so what is said
while charging is paused is the limit that counts when it goes on, and at least 6 A.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from ..conversation import rest
from ..errors import NotAvailableError, NotConfirmedError, ReplyTimeoutError
from ..exchange import Turn
from ..model import MINIMUM_CURRENT, CurrentLimit, Fault, Orders
from ..safety import Setpoint, clamp
from .timing import LOOK_AGAIN, READY_PATIENCE, READY_PAUSE
from .wire.answers import EwsRefusedError
from .wire.commands import set_limit
from .wire.frames import CommandId, Request
from .wire.states import STARTING

if TYPE_CHECKING:
    from .reader import EwsReader

SENDS: Final = 2
"""How often a limit is said until it must be read back."""
LOOKS: Final = 3
"""How often it is looked for after each."""
_LOWEST: Final = Orders(limit=CurrentLimit(current=MINIMUM_CURRENT))


class Limiter:
    """The limit of one port."""

    def __init__(self, port: EwsReader) -> None:
        """Take the port."""
        self._port = port
        self._confirmed: int | None = None
        """What was said and read back, or something lower, A."""
        self._other: tuple[int, int] | None = None
        """What was said, and what ``rd`` told and was taken for it, A."""

    def forget(self) -> None:
        """Note that the box may have forgotten its limit."""
        self._confirmed = self._other = None

    # -- What is to be so ----------------------------------------------------------

    def wanted(self, orders: Orders) -> Setpoint | None:
        """Return what the limit is to be for these orders, paused or not.

        ``None``: it cannot be said (no pilot in mode 1; not even 6 A are left).
        """
        port = self._port
        installation = port.box.installation
        if installation is None or installation.mode_1[port.port - 1]:
            return None
        limits = port.limits
        for one in (replace(orders, allowed=None), _LOWEST):
            setpoint = clamp(one, limits)
            if not setpoint.paused and setpoint.current > 0:
                return setpoint
        return None

    @property
    def told(self) -> int | None:
        """Return the limit that ``rd`` told last, A; 0: none."""
        details = self._port.box.details
        return None if details is None else details.limit[self._port.port - 1]

    def _is_taken(self, wanted: int) -> bool:
        """Return whether the box offers no more than that, by what it told last."""
        told, seen = self.told, self._port.seen
        if told:
            return told <= wanted
        # Without a word of ours in it, what it offers must do.
        offered = seen.offered_current if seen is not None else None
        return told == 0 and bool(offered) and offered is not None and offered <= wanted

    def must_reassert(self) -> bool:
        """Return whether the limit is to be said."""
        setpoint = self.wanted(self._port.effective_orders)
        told = self.told
        if setpoint is None or told is None or self._port.seen is None:
            return False
        wanted = int(setpoint.current)
        if told == wanted:
            return False
        return self._other != (wanted, told) or not self._is_taken(wanted)

    def check(self) -> None:
        """Take the fault away when all is well again."""
        port = self._port
        if self.must_reassert() or port.permission.must_pause(port.setpoint):
            return
        port.notice(Fault.LIMIT_NOT_TAKEN, present=False)

    def count(self) -> None:
        """Count a limit that stood, and is said again because the box is above it."""
        if self._confirmed is not None and not self._is_taken(self._confirmed):
            self._port.statistics.reasserted += 1

    # -- Saying it -----------------------------------------------------------------

    async def enforce(self, turn: Turn, orders: Callable[[], Orders]) -> None:
        """Say the limit until it is read back, at it or below it.

        Raises NotConfirmedError when the box does not follow, EwsRefusedError when it
        says so, and what `EwsReader.look` raises.
        """
        port = self._port
        patience = turn.now + READY_PATIENCE
        sends = 0
        while sends < SENDS:
            await port.ready(turn)
            # The cable counts as well, and is seen right now only.
            seen = await port.look(turn)
            if self.wanted(orders()) is None:
                return
            sends += 1
            try:
                said, answered = await self._say(turn, orders)
            except EwsRefusedError:
                if seen.status == STARTING and turn.now < patience:
                    sends -= 1
                    await rest(READY_PAUSE)
                    continue
                await rest(0.0)
                await self._after_refusal(turn)
                raise
            await rest(0.0)
            for _ in range(LOOKS):
                await port.ready(turn)
                if await self._is_read_back(turn, said, answered=answered):
                    return
                await rest(LOOK_AGAIN)
        port.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        message = f"{port.config.name} does not follow its limit"
        raise NotConfirmedError(message)

    async def _say(self, turn: Turn, orders: Callable[[], Orders]) -> tuple[int, bool]:
        """Say it; return what was said, A, and whether that was answered.

        What was not may have been heard all the same.
        """
        port = self._port
        said: list[int] = []

        def request() -> Request:
            setpoint = self.wanted(orders())
            if setpoint is None:
                message = f"{port.config.name}: no current may be offered"
                raise NotAvailableError(message)
            said.append(int(setpoint.current))
            return set_limit(port.port, setpoint)

        self._confirmed = self._other = None
        try:
            await port.box.tell(turn, CommandId.SET_LIMIT, request)
        except ReplyTimeoutError:
            return said[-1], False
        return said[-1], True

    async def _is_read_back(self, turn: Turn, said: int, *, answered: bool) -> bool:
        """Return whether the box offers that, or less because it cannot offer more.

        A lower one after a lost answer is the one before: to be said again.
        """
        port = self._port
        try:
            await port.box.look(turn)
            port.take()
            await port.box.look_closer(turn)
        except ReplyTimeoutError:
            return False
        port.take()
        told = self.told
        if told is None or not self._is_taken(said):
            return False
        if not answered and told != said:
            return False
        self._confirmed = said
        self._other = (said, told)
        port.notice(Fault.LIMIT_NOT_TAKEN, present=False)
        return True

    async def _after_refusal(self, turn: Turn) -> None:
        """Leave a box that refused at no more than was ordered: at 6 A, if need be."""
        port = self._port
        await port.ready(turn)
        wanted = self.wanted(port.effective_orders)
        told = self.told
        if wanted is None or told is None:
            return
        if self._is_taken(int(wanted.current)):
            # It has a lower maximum than it tells: said again, it would refuse again.
            self._other = (int(wanted.current), told)
            return
        port.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        with suppress(EwsRefusedError):
            await self._say(turn, lambda: _LOWEST)
