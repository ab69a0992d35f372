"""The answer of a load-balancing master to the request of one slave.

A request is answered at once, or after others have made room for it: they are told to
go down, and read back, before one that begins may use what they leave.
PROTOCOLS.md, 3.
"""

from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final

from ..errors import ExchangeError, LineBusyError, NotAvailableError
from ..exchange import Talk
from ..jobs import Later
from .balancing import RequestKind, SlaveRequest
from .registers import LONGEST_REQUEST

if TYPE_CHECKING:
    from .member import Member
    from .slave import SlaveSmartEvse

ANSWER_WITHIN: Final = 0.8
"""Later than this a request is not answered, s: after 1 s the box has given it up, and
would close its contactor on a late word all the same. It asks again."""
ANSWER_BYTES: Final = LONGEST_REQUEST
"""A broadcast may go in its place."""
ROUNDS: Final = 2
"""How often the others are asked to make room for one request."""


class Answer:
    """The answer to one request: at once, or after others have made room."""

    def __init__(
        self, slave: SlaveSmartEvse, request: SlaveRequest, heard_at: float
    ) -> None:
        self._slave = slave
        self._request = request
        self._too_late = heard_at + ANSWER_WITHIN
        self._rounds = ROUNDS
        self._others: list[Member] = []

    async def give(self, talk: Talk) -> Later[None] | None:
        """Answer, or let the others make room first."""
        if talk.now > self._too_late:
            self._slave.answered(self._request)
            return None
        try:
            if self._others_can_make_room():
                await self._slave.master.speak(talk)
                return self._look_next()
            await talk.send(partial(self._slave.answer_frame, self._request))
        except LineBusyError:
            return self._go_on()
        self._slave.answered(self._request)
        self._slave.master.changed()
        return None

    def _others_can_make_room(self) -> bool:
        slave = self._slave
        asks = self._request.kind in (RequestKind.B, RequestKind.C)
        if not asks or not slave.may_begin() or not self._rounds:
            return False
        slave.keep(self._too_late)
        master = slave.master
        if master.grant(slave.unit) or not master.shares().get(slave.unit):
            return False
        self._others = [
            other for other in master.in_the_way(slave.unit) if other.available
        ]
        self._rounds -= 1
        return bool(self._others)

    async def _look(self, talk: Talk) -> Later[None] | None:
        """Read back one of the others: it may have missed the broadcast."""
        other = self._others.pop()
        with suppress(ExchangeError, LineBusyError, NotAvailableError):
            await other.look(talk)
        return self._look_next() if self._others else self._go_on()

    def _look_next(self) -> Later[None]:
        other = self._others[-1]
        worst = other.bus.worst_case(other) if other.bus is not None else None
        return Later(0.0, self._look, worst)

    def _go_on(self) -> Later[None]:
        bus = self._slave.bus
        worst = bus.wire.send_time(ANSWER_BYTES) if bus is not None else None
        return Later(0.0, self.give, worst)
