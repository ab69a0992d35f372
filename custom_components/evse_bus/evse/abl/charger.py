"""One ABL wallbox (EVCC2/3): its orders, and when they are sent.

The status is read before anything is written. A limit above the orders is written
again (Icmax does not survive a power cycle), by the rules of `decisions`; permission
is never given without the user (PROTOCOLS.md, 2).
"""

from dataclasses import dataclass
from functools import partial
from typing import Final, override

from ..conversation import Conversation, FollowUp
from ..errors import GarbledReplyError, NotAvailableError, ReplyTimeoutError
from ..exchange import Turn
from ..model import (
    Capability,
    Command,
    FailSafe,
    Fault,
    Limits,
    OrderChange,
    Orders,
    OrderState,
)
from ..safety import clamp
from .commands import conversation_for
from .config import AblConfig
from .decisions import FAILED_AFTER, WRITE_PAUSES, Decision, believed_paused
from .duty import PAUSE
from .reader import ICMAX_PROBES, AblReader
from .registers import Reading, StateCode, limit_duty
from .states import E0, E2, SETUP, is_failure
from .steps import reach_state, refuse_in, restore

GARBLED_REPLIES: Final = 3
"""Unreadable replies in a row that suggest two boxes with one device-ID."""

_CAPABILITIES: Final = frozenset(
    {
        Capability.STATUS,
        Capability.RAW_STATE,
        Capability.PLUGGED,
        Capability.CHARGING,
        Capability.OFFERED_CURRENT,
        Capability.ORDER_STATE,
        Capability.FAULTS,
        Capability.UPSTREAM_TIMEOUT,
        Capability.ENABLE_AFTER_POWER_CYCLE,
        Capability.OUTLET_ENABLED,
        Capability.RESET,
        Capability.WAKE,
    }
)
_WITH_METER: Final = frozenset(
    {Capability.CURRENT, Capability.ESTIMATED_POWER, Capability.ESTIMATED_ENERGY}
)


@dataclass(frozen=True, slots=True, eq=False)
class _ActiveCommand:
    """The one command under way."""

    name: str


class AblCharger(AblReader):
    """One ABL wallbox."""

    def __init__(self, config: AblConfig, orders: Orders) -> None:
        """Nothing is known of the box before its first reply."""
        super().__init__(config, orders)
        self._active: _ActiveCommand | None = None
        self._garbled = 0
        self._fell_back = False
        """The fail-safe of expired orders has been applied."""

    @property
    @override
    def capabilities(self) -> frozenset[Capability]:
        known = _CAPABILITIES
        if self.has_meter:
            known |= _WITH_METER
        if self.config.order_lifetime is not None:
            # Not a value of the box: it counts when orders are not renewed.
            known |= {Capability.FAIL_SAFE_CURRENT}
        return known

    @property
    @override
    def fail_safe(self) -> FailSafe | None:
        own = self.info.options.get("upstream_timeout") if self.info else None
        if own is None:
            return None
        return FailSafe.STOPS if own else FailSafe.NOTHING

    @property
    @override
    def limits(self) -> Limits:
        return Limits(
            installation=self.config.installation_limit, reported=self.highest
        )

    @property
    @override
    def waits_for_current(self) -> bool:
        return self.paused_by_our_limit

    @override
    def on_line_open(self) -> None:
        super().on_line_open()
        self._active = None

    # -- The regular exchange ----------------------------------------------------

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        try:
            await self.identify(turn)
            status = await self.poll_status(turn)
        except GarbledReplyError:
            self._garbled += 1
            if self._garbled >= GARBLED_REPLIES:
                self.notice(Fault.DUPLICATE_ADDRESS, present=True)
            raise
        self._garbled = 0
        self.notice(Fault.DUPLICATE_ADDRESS, present=False)
        return self._next_action(status, turn.now)

    def _next_action(self, status: Reading, now: float) -> FollowUp | None:
        """Return the conversation that a status requires."""
        if self.busy:
            return None
        if self.pending_cleanup is not None:
            if self.pending_cleanup.is_needed(status.state):
                restoring = partial(restore, self)
                return FollowUp(self.exclusive("restoring its state", restoring))
            self.pending_cleanup = None
        if (decision := self.decide(now)) is None:
            return None
        if self.orders_expired and not self._fell_back:
            # The fail-safe may be above the limit: raised to it once, and never in a
            # box that is paused or disabled.
            self._fell_back = True
            self.raise_pending = decision.paused is not True and status.state != E0
            decision = self.decide(now) or decision
        self._note(decision)
        if decision.write and now >= self.writes.due(self.code):
            return FollowUp(self._reassert)
        return None

    def _note(self, decision: Decision) -> None:
        """Note whether the box follows its order."""
        if decision.ignored:
            self.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        elif not decision.write and decision.state is not None:
            self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
        if decision.state is OrderState.CONFIRMED:
            if self.code != PAUSE:
                self.confirmed = self.code
            self.missed = False

    # -- Orders ------------------------------------------------------------------

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        with self.conversing():
            await self.identify(turn)
            status = self.last_status
            if change.allowed is not False or status is None or self.misses:
                # A pause by the user waits for no other exchange.
                status = await self.read_status(turn)
                await self._require_icmax(turn, status)
            enables = change.allowed is True and self.may_enable_again
            if change.allowed is True and not enables:
                self._require_startable(status)
            if change.allowed is False:
                await self.note_pause(by_limit=False)
                self.allowed_by_user = False
            paused = clamp(orders, self.limits).paused and orders.allowed is not False
            if not self._may_write(status, turn.now, orders, change):
                if paused and change.allowed is True:
                    await self.note_pause(by_limit=True)
                return
            ends_own_pause = self.paused_by_our_limit
            self.writes.restart(turn.now)
            await self.apply_setpoint(
                turn,
                lambda: clamp(self.order_to_send(change), self.limits),
                starts=change.allowed is True or ends_own_pause,
            )
            if enables and not clamp(self.order_to_send(change), self.limits).paused:
                await reach_state(
                    self, turn, StateCode.A1, lambda now: now.state not in (E0, E2)
                )
            self._fell_back = False
            if change.allowed is True:
                self.allowed_by_user = True
                self.missed = False
            await self.note_pause(by_limit=paused)

    async def _require_icmax(self, turn: Turn, status: Reading) -> None:
        """Raise ReplyTimeoutError for a box whose Icmax and maximum are not known yet.

        A box that reports them is never sent more than its maximum, and a limit never
        ends a pause.
        """
        for _ in range(ICMAX_PROBES):
            if self.reports_icmax is False:
                return
            if self.highest is not None and self.evidence(status, turn.now).icmax:
                return
            await self.read_icmax(turn)
        if self.reports_icmax is not False:
            message = f"{self.config.name} does not answer a read of its Icmax"
            raise ReplyTimeoutError(message)

    def _require_startable(self, status: Reading) -> None:
        """Raise NotAvailableError in a state in which charging cannot be allowed."""
        if status.state in SETUP:
            raise refuse_in(self, status, "abl_setup_mode", "set-up mode")
        if is_failure(status.state):
            raise refuse_in(self, status, "abl_failure", "a failure")
        if status.state == E0:
            why = "the outlet is disabled, enable it first"
            raise refuse_in(self, status, "abl_outlet_disabled", why)

    def _may_write(
        self, status: Reading, now: float, orders: Orders, change: OrderChange
    ) -> bool:
        """Return whether the set-point of a change is written in this status.

        False: the orders are only stored, and count when the box lets a car charge
        again. A limit change never starts a car. Raises NotAvailableError in set-up
        mode.
        """
        if status.state in SETUP:
            raise refuse_in(self, status, "abl_setup_mode", "set-up mode")
        if is_failure(status.state):
            # Sent when the failure is over.
            self.raise_pending = True
            return False
        code = limit_duty(clamp(orders, self.limits))
        seen = self.evidence(status, now)
        paused = believed_paused(seen)
        if code == PAUSE:
            return paused is not True or not self.writes.settled(code, now)
        if change.allowed is True:
            return True
        changes_limit = change.current is not None or any(
            phase is not None for phase in change.phases
        )
        if paused is True or (paused is None and self.setpoint.paused):
            # A limit ends only the pause of our own limit of 0 A.
            writes = (
                changes_limit
                and self.paused_by_our_limit
                and orders.allowed is not False
            )
        elif paused is None:
            # Perhaps paused by another, but not in C.
            writes = not seen.idle and seen.ic != code
        else:
            raises = seen.icmax is not None and seen.icmax < code
            writes = seen.icmax != code and not (
                raises
                and (status.state == E0 or not (changes_limit or self._fell_back))
            )
        self.raise_pending = changes_limit and not writes
        return writes

    async def _reassert(self, turn: Turn) -> None:
        """Write the order again to a box that does not have it (any more)."""
        with self.conversing():
            await self.identify(turn)
            await self.read_status(turn)
            decision = self.decide(turn.now)
            if decision is None or not decision.write:
                # A command of the user came first, or it was only late.
                return
            failed = self.writes.failed(self.code, turn.now)
            was_paused = decision.paused is True
            await self.apply_setpoint(
                turn,
                lambda: self.setpoint,
                patience=WRITE_PAUSES[0] if failed else FAILED_AFTER,
            )
            by_limit = self.effective_orders.allowed is not False
            # The orders may have changed since.
            if self.writes.code == PAUSE and by_limit and not was_paused:
                await self.note_pause(by_limit=True)

    # -- Commands ----------------------------------------------------------------

    @override
    async def command(
        self,
        command: Command,
        value: bool | int | str | None = None,
    ) -> None:
        conversation, persistence = conversation_for(self, command, value)
        await self.run(self.exclusive(command, conversation), persistence=persistence)

    def exclusive[T](self, name: str, conversation: Conversation[T]) -> Conversation[T]:
        """Return a conversation that is refused while another command is under way."""

        async def exclusive(turn: Turn) -> T:
            if self._active is not None:
                message = f"{self.config.name} is busy: {self._active.name}"
                raise NotAvailableError(message)
            self._active = mine = _ActiveCommand(name)
            try:
                with self.conversing():
                    return await conversation(turn)
            finally:
                if self._active is mine:
                    self._active = None
                self.updated()

        return exclusive
