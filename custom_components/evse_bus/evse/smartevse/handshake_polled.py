"""Requests that a slave shows when it is polled, and their answers (from 2.20 on).

A box that wants current waits in a state until its master writes another one. A state
that grants would close the contactor also where the car has left meanwhile, so it is
written right after the status that asks for it, and never twice for one status. A box
that was refused asks again 60 s after that was cleared. PROTOCOLS.md, 3.
"""

from functools import partial
import logging
from math import inf
from typing import Final

from ..conversation import FollowUp, rest
from ..errors import EvseError, SupersededError
from ..exchange import Turn
from ..model import Fault
from .balancing import asks, clear_refusal, grant_current, is_refused, refuse_current
from .dialects import ASKS_FOR_C, MAPS, Balancing, Dialect, Status
from .member import Balancer, Member
from .registers import tenths
from .sharing import LOWEST
from .states import faults_of

_LOGGER: Final = logging.getLogger(__name__)

ANSWER_WITHIN: Final = 0.6
"""Latest answer to a status, s; the recorded masters took up to 0.53 s."""
ROUNDS: Final = 2
"""Attempts to lower currents for one request."""
RESERVED_FOR: Final = 10.0
"""Time for which the share of a car that was granted B waits for it, s."""


class PolledHandshake:
    """The answers to one slave, by its status."""

    def __init__(self, slave: Member) -> None:
        """Begin without a status."""
        self._slave = slave
        self._status: Status | None = None
        """The status that may be answered; ``None``: there is none, or it was."""
        self._read_at = -inf
        self._is_answering = False

    def on_status(self, status: Status, now: float) -> None:
        """Take note of a status that was just read."""
        self._status = status
        self._read_at = now
        if self._calls_for_answer(status) and not self._is_answering:
            # Only a poll is followed by an answer; after one, the next is planned anew.
            self._slave.read_soon(now)

    def after_poll(self, master: Balancer) -> FollowUp | None:
        """Return the conversation that the status calls for, if any."""
        status = self._fresh(master.now)
        if status is None:
            return None
        worst_case = self._slave.worst_case
        if self._calls_for_answer(status):
            return FollowUp(partial(self._answer, master), worst_case=worst_case)
        if self._may_clear(status, master):
            return FollowUp(partial(self._clear, master), worst_case=worst_case)
        return None

    def _calls_for_answer(self, status: Status) -> bool:
        return asks(status) and (self._may_grant or self._must_refuse)

    def _fresh(self, now: float) -> Status | None:
        """Return the status that may be answered now."""
        return self._status if now - self._read_at <= ANSWER_WITHIN else None

    def _take(self, now: float) -> Status:
        """Return the status that is answered now; raises SupersededError without one."""
        status = self._fresh(now)
        if status is None and self._status is not None:
            # It has waited for others for too long, but no longer for its next poll.
            self._slave.read_soon(now)
        self._status = None
        if status is None:
            message = "a status that is no longer new is not answered"
            raise SupersededError(message)
        return status

    @property
    def _dialect(self) -> Dialect:
        """Return the dialect; raises SupersededError where it is no longer known."""
        if self._slave.dialect is None:
            message = "the box was lost meanwhile"
            raise SupersededError(message)
        return self._slave.dialect

    @property
    def _habits(self) -> Balancing:
        return MAPS[self._dialect].balancing

    @property
    def _may_grant(self) -> bool:
        """Return whether neither its orders nor its share nor its access forbid it."""
        return self._slave.may_begin and not self._slave.has_no_access

    @property
    def _must_refuse(self) -> bool:
        """Return whether a box that may not begin is refused.

        Where its access ends the request, that is turned off instead: after a refusal
        it needs a minute to come back.
        """
        return self._slave.withheld or not self._habits.access_ends_request

    # -- Answers -------------------------------------------------------------------

    async def _answer(self, master: Balancer, turn: Turn) -> None:
        """Grant or refuse, once there is room for it: a conversation."""
        slave = self._slave
        rounds = ROUNDS
        self._is_answering = True
        try:
            while rounds and self._needs_room(master):
                rounds -= 1
                await master.lower(turn, master.above_share(slave.unit))
                await rest(worst_case=slave.worst_case)
                await slave.read_status_once(turn)
                await rest(worst_case=slave.worst_case)
            await slave.write_state(turn, partial(self._answer_frame, master))
        except EvseError as error:
            self._log(error)
        finally:
            self._is_answering = False
        master.update_shares()

    def _needs_room(self, master: Balancer) -> bool:
        """Return whether currents must go down first; reserves its share meanwhile."""
        slave = self._slave
        status = self._fresh(master.now)
        if status is None or not asks(status) or not self._may_grant:
            return False
        slave.reserve(master.now + RESERVED_FOR)
        if master.shares().get(slave.unit, 0) < LOWEST:
            return False
        return not master.grant(slave.unit) or not self._fits(master)

    def _fits(self, master: Balancer) -> bool:
        """Return whether all that it may offer right after a grant is allowed."""
        slave = self._slave
        allowed = min(master.room(slave.unit), tenths(slave.wanted))
        return master.draw(slave.unit).at_grant <= allowed

    def _answer_frame(self, master: Balancer) -> bytes:
        """Return the answer of this moment, which must be sent now.

        Raises SupersededError where nothing is to be sent.
        """
        slave = self._slave
        now = master.now
        status = self._take(now)
        if self._may_grant and master.room(slave.unit) == -inf:
            raise SupersededError("it waits until all were read")
        if (
            not self._may_grant
            or not master.grant(slave.unit)
            or not self._fits(master)
        ):
            slave.reserve(-inf)
            if self._may_grant or self._must_refuse:
                return refuse_current(slave.unit, self._dialect, status)
            raise SupersededError("it is stopped by its access")
        if status.raw_state == ASKS_FOR_C:
            master.draw(slave.unit).granted_as_broadcast(now)
        slave.begins(now)
        slave.reserve(now + RESERVED_FOR)
        return grant_current(slave.unit, self._dialect, status)

    def _log(self, error: EvseError) -> None:
        """Log why nothing was sent. The box asks again: it is answered after a poll."""
        _LOGGER.debug("Slave %s: %s", self._slave.unit, error)

    # -- The end of a refusal --------------------------------------------------------

    def _may_clear(self, status: Status, master: Balancer) -> bool:
        """Return whether there is current again for a box that was refused."""
        slave = self._slave
        return (
            is_refused(status)
            and self._may_grant
            # Another error would keep it from asking, and begin its 60 s anew.
            and faults_of(self._dialect, status) == {Fault.LESS_6A}
            and master.shares().get(slave.unit, 0) >= LOWEST
        )

    async def _clear(self, master: Balancer, turn: Turn) -> None:
        """Let a refused box ask again: a conversation."""
        try:
            await self._slave.write_state(turn, partial(self._clear_frame, master))
        except EvseError as error:
            self._log(error)

    def _clear_frame(self, master: Balancer) -> bytes:
        status = self._take(master.now)
        if not self._may_clear(status, master):
            raise SupersededError("there is no current again")
        return clear_refusal(self._slave.unit, self._dialect, status)
