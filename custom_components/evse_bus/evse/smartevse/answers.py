"""The answer of a load-balancing master to the request of one slave.

A request is answered at once, or after others have made room for it: they are told to
go down, and read back, before one that begins may use what they leave.
PROTOCOLS.md, 3.
"""

from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Final

from ..conversation import rest
from ..errors import ExchangeError, LineBusyError, NotAvailableError
from ..exchange import Turn
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

    async def give(self, turn: Turn) -> None:
        """Answer, once the others have made room: a conversation."""
        slave = self._slave
        while turn.now <= self._too_late:
            try:
                if not self._others_can_make_room():
                    await turn.send(partial(slave.answer_frame, self._request))
                    slave.answered(self._request)
                    slave.master.changed()
                    return
                await slave.master.speak(turn)
                await self._read_others(turn)
            except LineBusyError:
                pass
            await rest(worst_case=self._send_time())
        slave.answered(self._request)

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

    async def _read_others(self, turn: Turn) -> None:
        """Read back the others: they may have missed the broadcast."""
        while self._others:
            await rest(worst_case=self._worst_case(self._others[-1]))
            other = self._others.pop()
            with suppress(ExchangeError, LineBusyError, NotAvailableError):
                await other.look(turn)

    def _worst_case(self, other: Member) -> float | None:
        return other.bus.worst_case(other) if other.bus is not None else None

    def _send_time(self) -> float | None:
        bus = self._slave.bus
        return bus.wire.send_time(ANSWER_BYTES) if bus is not None else None
