"""Requests that a slave sends by itself, and their answers (2.17).

It repeats a request each second until it is answered; after that second it would close
its contactor on a late answer all the same. PROTOCOLS.md, 3.
"""

from functools import partial
from math import inf
from typing import Final

from ..conversation import FollowUp, nothing, rest
from ..errors import LineBusyError
from ..exchange import Turn
from .balancing import RequestKind, SlaveRequest, acknowledge
from .dialects import Dialect
from .member import Balancer, Member
from .registers import tenths

ANSWER_WITHIN: Final = 0.8
"""Latest answer to a request, s: after 1 s the box has given it up, and would close its
contactor on a late answer all the same. It asks again."""
ROUNDS: Final = 2
"""Attempts to lower the others for one request."""
RESERVED_FOR: Final = 10.0
"""Time for which the share of a car that was granted current waits for it, s."""

_FOR_CURRENT: Final = frozenset({RequestKind.B, RequestKind.C})
"""Requests that are granted a current."""


class RequestHandshake:
    """The answers to the requests of one slave."""

    def __init__(self, slave: Member) -> None:
        """Begin without a request."""
        self._slave = slave
        self.own_maximum: float | None = None
        """The maximum of box and cable, as in its last request, A."""
        self._answering: dict[RequestKind, float] = {}
        """Requests being answered, and until when their repetition is ignored."""

    def reset(self) -> None:
        """Drop all requests: the line was opened anew."""
        self._answering.clear()

    def on_request(self, request: SlaveRequest, master: Balancer) -> FollowUp:
        """Return the conversation that answers a request."""
        slave = self._slave
        now = master.now
        if slave.dialect is not Dialect.V2_17:
            # A box that was not read is not answered.
            slave.read_soon(now)
            return FollowUp(nothing)
        reads_first = False
        if request.kind in _FOR_CURRENT:
            self.own_maximum = request.wanted
            # Its access was turned on since its last status, or off after the request.
            reads_first = slave.may_begin and slave.has_no_access
        else:
            # The others need not wait for what it leaves.
            slave.reserve(-inf)
            slave.read_soon(now)
        if now < self._answering.get(request.kind, -inf):
            return FollowUp(nothing)
        answer_by = now + ANSWER_WITHIN
        self._answering[request.kind] = answer_by
        if reads_first:
            return FollowUp(partial(self._read_and_answer, request, answer_by, master))
        return FollowUp(
            partial(self._answer, request, answer_by, master),
            worst_case=slave.send_time,
        )

    async def _read_and_answer(
        self, request: SlaveRequest, answer_by: float, master: Balancer, turn: Turn
    ) -> None:
        """Answer a request if the box has access: a conversation."""
        slave = self._slave
        try:
            await slave.read_status_once(turn)
        finally:
            if slave.has_no_access or slave.status is None:
                # It asks again in a second.
                self._answering.pop(request.kind, None)
        if not slave.has_no_access:
            await rest(worst_case=slave.send_time)
            await self._answer(request, answer_by, master, turn)

    async def _answer(
        self, request: SlaveRequest, answer_by: float, master: Balancer, turn: Turn
    ) -> None:
        """Answer a request, once the others have made room for it: a conversation."""
        rounds = ROUNDS
        slave = self._slave
        while turn.now <= answer_by:
            others: list[Member] = []
            if rounds and self._needs_room(request, answer_by, master):
                others = list(master.above_share(slave.unit))
                rounds -= 1
            try:
                if not others:
                    answer = partial(self._granted, request, master)
                    await turn.send(partial(master.unless_forbidden, answer))
                    self._answering.pop(request.kind, None)
                    master.update_shares()
                    return
                await master.lower(turn, others)
            except LineBusyError:
                pass
            await rest(worst_case=slave.send_time)
        self._answering.pop(request.kind, None)

    def _needs_room(
        self, request: SlaveRequest, answer_by: float, master: Balancer
    ) -> bool:
        """Return whether others must go down first; reserves its share meanwhile."""
        slave = self._slave
        if request.kind not in _FOR_CURRENT or not slave.may_begin:
            return False
        slave.reserve(answer_by)
        return not master.grant(slave.unit) and bool(master.shares().get(slave.unit))

    def _granted(self, request: SlaveRequest, master: Balancer) -> bytes:
        """Return the answer of this moment, which must be sent now."""
        slave = self._slave
        if request.kind not in _FOR_CURRENT or not slave.may_begin:
            return acknowledge(request, None)
        now = master.now
        setpoint = slave.setpoint_within(master.grant(slave.unit) / 10)
        if setpoint.paused:
            slave.reserve(-inf)
            return acknowledge(request, None)
        if request.kind is RequestKind.C:
            master.draw(slave.unit).granted(tenths(setpoint), now)
        slave.begins(now)
        slave.reserve(now + RESERVED_FOR)
        return acknowledge(request, setpoint)
