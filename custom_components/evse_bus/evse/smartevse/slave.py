"""One SmartEVSE that Home Assistant is the load-balancing master of (dialect 2.17).

Its current is a word of the master's broadcast; what is said to it alone is its access
bit and the answers to its requests. A broadcast of 0 A is no stop (it then offers 6 A):
a pause is its access bit, and counts when the box says that it has obeyed.
PROTOCOLS.md, 3.
"""

from contextlib import suppress
from functools import partial
from math import inf
from typing import Final, override

from ..conversation import FollowUp, nothing, rest
from ..errors import EvseError, NotAvailableError, NotConfirmedError
from ..exchange import Turn
from ..framing import Frame
from ..modbus import ModbusFrame
from ..model import Fault, OrderChange, Orders, Persistence
from ..schedule import Kind
from .answers import ANSWER_BYTES, ANSWER_WITHIN, Answer
from .balancing import RequestKind, SlaveRequest, acknowledge, decode_request
from .dialects import Dialect, Status
from .member import Member
from .registers import tenths
from .states import is_stopped
from .timing import LOOK_AGAIN

PROMISE: Final = 10.0
"""A car that was told a current has its share kept until it begins, s."""
BROADCASTS: Final = 4
"""How often a new current is broadcast until it must be read back."""


class SlaveSmartEvse(Member):
    """One slave."""

    # -- Access --------------------------------------------------------------------

    @override
    def must_maintain(self, now: float) -> bool:
        return super().must_maintain(now) or self._access_due() is not None

    @override
    async def maintain(self, turn: Turn) -> None:
        due = self._access_due()
        if due is not None:
            await self._turn(turn, due)
        await super().maintain(turn)

    def _access_due(self) -> bool | None:
        """Return what its access must be set to; ``None``: it may stay as it is.

        On only where we have turned it off ourselves, for want of current.
        """
        if self.status is None:
            return None
        if not is_stopped(self.known_dialect, self.status):
            return False if self._must_be_off() else None
        return True if self._is_ours and self.may_begin() else None

    async def _turn(self, turn: Turn, allowed: bool) -> None:  # noqa: FBT001
        """Set the access bit, and remember whether that was our own doing."""
        if not allowed:
            own = self._standing.allowed is not False
            if own:
                # Somebody at the box may have been first: that is not ours to undo.
                with suppress(EvseError):
                    await self.look(turn)
                await rest(0.0)
            had_access = self.status is None or self.status.access
            self._is_ours = own and (had_access or self._is_ours)
        still = self._may_be_on if allowed else self._must_be_off
        await self.set_access(turn, allowed, still)
        if allowed:
            self._is_ours = False

    def _may_be_on(self) -> bool:
        return not self.wanted.paused

    def _must_be_off(self) -> bool:
        # Somebody's no at the box counts, too: an answer of ours that crossed it on
        # the line has closed the contactor all the same.
        return not self.may_begin() or self._is_refused

    @override
    def take(self, status: Status, now: float) -> None:
        super().take(status, now)
        if status.access and self.may_begin():
            # It is open already: nothing is left to give back.
            self._is_ours = False

    # -- Orders --------------------------------------------------------------------

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        self._confirming = change
        try:
            with self.conversing():
                await self.reach(turn)
                if change.allowed is False:
                    # The user's word: nothing of it is ours to give back.
                    self._withheld_at = None
                if self.wanted.paused:
                    await self._turn(turn, allowed=False)
                    return
                starts = change.allowed is True or self._is_ours
                if starts and not self.withheld:
                    await self._turn(turn, allowed=True)
                    await rest(0.0)
                await self._follow(turn)
        finally:
            self._confirming = None
            self._changed()

    async def _follow(self, turn: Turn) -> None:
        """Broadcast its current until it is read back, at it or below it.

        More than its share is not waited for. Raises NotConfirmedError.
        """
        for _ in range(BROADCASTS):
            await self.master.speak(turn)
            await rest(0.0)
            await self.see(turn)
            if self.status and round(self.status.current * 10) <= tenths(self.wanted):
                self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
                return
            self.statistics.reasserted += 1
            await rest(LOOK_AGAIN)
        self.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        message = f"{self.config.name} does not follow its limit"
        raise NotConfirmedError(message)

    def _changed(self) -> None:
        with suppress(NotAvailableError):
            self.master.changed()

    # -- The end -------------------------------------------------------------------

    @override
    async def on_shutdown(self, *, removed: bool = False) -> None:
        if removed:
            # It would follow the broadcasts to the others, and nobody would count it.
            await self.run(
                partial(self.set_access, allowed=False),
                persistence=Persistence.STANDING,
                kind=Kind.PAUSE,
            )

    # -- Its requests --------------------------------------------------------------

    @override
    def on_unsolicited(self, frame: Frame) -> FollowUp | None:
        if not isinstance(frame, ModbusFrame):
            return None
        request = decode_request(frame)
        if request is None or request.unit != self.unit or self.bus is None:
            return None
        now = self.master.now
        if self.dialect is not Dialect.V2_17:
            # Nothing is said to a box that we have not read.
            self.look_soon(now)
            return FollowUp(nothing)
        if request.kind in (RequestKind.B, RequestKind.C):
            self._own_maximum = request.wanted
            if self.may_begin() and self._is_refused:
                # Opened at the box since, or closed since it asked: to be read first.
                # It asks again in a second.
                self.look_soon(now)
                return FollowUp(nothing)
        else:
            # What it leaves the others need not wait for.
            self._promised_until = -inf
            self.look_soon(now)
        if now < self._answering.get(request.kind, -inf):
            return FollowUp(nothing)
        self._answering[request.kind] = now + ANSWER_WITHIN
        answer = Answer(self, request, now)
        return FollowUp(answer.give, worst_case=self.bus.wire.send_time(ANSWER_BYTES))

    def answered(self, request: SlaveRequest) -> None:
        """Note that a request needs no answer any more."""
        self._answering.pop(request.kind, None)

    def keep(self, until: float) -> None:
        """Keep its share for it, so that the others make room."""
        self._promised_until = until

    def may_begin(self) -> bool:
        """Return whether it may charge, for all that we have to say."""
        return not self.wanted.paused and not self.withheld

    @property
    def _is_refused(self) -> bool:
        """Return whether its access was off when it was read last."""
        return self.status is not None and not self.status.access

    def answer_frame(self, request: SlaveRequest) -> bytes:
        """Return the answer of this moment, which must be sent now.

        Raises NotAvailableError where another master has just spoken.
        """
        return self.master.unless_silent(partial(self._answer, request))

    def _answer(self, request: SlaveRequest) -> bytes:
        if request.kind not in (RequestKind.B, RequestKind.C) or not self.may_begin():
            return acknowledge(request, None)
        now = self.master.now
        setpoint = self.setpoint_within(self.master.grant(self.unit) / 10)
        if setpoint.paused:
            self._promised_until = -inf
            return acknowledge(request, None)
        if request.kind is RequestKind.C:
            self.master.draw(self.unit).granted(tenths(setpoint), now)
        self.came = min(self.came, now)
        self._promised_until = now + PROMISE
        return acknowledge(request, setpoint)
