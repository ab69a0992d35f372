"""One ABL wallbox (EVCC2/3): its orders, and when they are sent.

The status is read before anything is written. A limit above the orders is written
again (Icmax does not survive a power cycle), by the rules of `decisions`; permission
is never given without the user (PROTOCOLS.md, 2).
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Final, override

from ..ceiling import CeilingPause
from ..collisions import Collisions
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
from .decisions import FAILED_AFTER, WRITE_PAUSES, Decision, Standing
from .duty import PAUSE
from .evidence import ICMAX_PROBES
from .registers import Reading, StateCode, limit_duty
from .states import E0, E2, SETUP, is_failure
from .steps import reach_state, refuse_in, restore
from .writer import AblWriter

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


class AblCharger(AblWriter):
    """One ABL wallbox."""

    def __init__(self, config: AblConfig, orders: Orders) -> None:
        """Nothing is known of the box before its first reply."""
        super().__init__(config, orders)
        self._active: _ActiveCommand | None = None
        self._collisions = Collisions()
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
            installation=self.config.installation_limit, reported=self.box.highest
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
            if self._collisions.garbled(turn.now):
                self.notice(Fault.DUPLICATE_ADDRESS, present=True)
            raise
        self._collisions.good(turn.now)
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
            self.box.raised = decision.paused is not True and status.state != E0
            decision = self.decide(now) or decision
        self._note(decision)
        if decision.write and now >= self.box.writes.due(self.code):
            return FollowUp(self._reassert)
        return None

    def _note(self, decision: Decision) -> None:
        """Note whether the box follows its order."""
        if decision.ignored:
            self.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        elif not decision.write and decision.state is not None:
            self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
        if decision.state is OrderState.CONFIRMED:
            self.box.note_confirmed(self.code)
            if not self.box.icmax_misses:
                # Not by what was read before the miss.
                self.box.missed = False

    # -- Orders ------------------------------------------------------------------

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        with self.conversing():
            await self.identify(turn)
            status = self.box.status
            if change.allowed is not False or status is None or self.misses:
                # A pause by the user waits for no other exchange.
                status = await self.read_status(turn)
                await self._require_icmax(turn)
            enables = change.allowed is True and self.may_enable_again
            if change.allowed is True and not enables:
                self._require_startable(status)
            if change.allowed is False:
                await self.note_pause(by_limit=False)
                self.box.allowed_by_user = False
            paused = clamp(orders, self.limits).paused and orders.allowed is not False
            if not self._may_write(turn.now, orders, change):
                if paused and change.allowed is True:
                    await self.note_pause(by_limit=True)
                return
            ends_own_pause = self.paused_by_our_limit
            was_open = self.box.is_open(turn.now)
            self.box.writes.restart(turn.now)
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
                self.box.allowed_by_user = True
                self.box.missed = False
            # By what was written: the ceiling may have changed meanwhile.
            paused = self.box.writes.code == PAUSE
            if not paused or self.order_to_send(change).allowed is False:
                await self.note_pause(by_limit=False)
            elif change.allowed is None and self.governance.pauses:
                await self._note_ceiling_pause(was_open=was_open)
            else:
                await self.note_pause(by_limit=True)

    async def _require_icmax(self, turn: Turn) -> None:
        """Raise ReplyTimeoutError for a box whose Icmax and maximum are not known yet.

        A box that reports them is never sent more than its maximum, and a limit never
        ends a pause.
        """
        for _ in range(ICMAX_PROBES):
            if self.box.reports_icmax is False:
                return
            seen = self.box.seen(turn.now)
            if self.box.highest is not None and seen and seen.icmax:
                return
            await self.read_icmax(turn)
        if self.box.reports_icmax is not False:
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

    def _may_write(self, now: float, orders: Orders, change: OrderChange) -> bool:
        """Return whether the set-point of a change is written in the status just read.

        False: the orders are only stored, and count when the box lets a car charge
        again. A limit change never starts a car. Raises NotAvailableError in set-up
        mode.
        """
        box = self.box
        if box.status is not None and box.status.state in SETUP:
            raise refuse_in(self, box.status, "abl_setup_mode", "set-up mode")
        changes_limit = change.current is not None or any(
            phase is not None for phase in change.phases
        )
        order = self._order_of(orders, now, changes_limit=changes_limit)
        decision = box.decide(order, now)
        if decision is None or decision.state is None:
            # Sent when the failure is over.
            box.raised = True
            return False
        if order.code == PAUSE:
            return decision.write or decision.state is not OrderState.CONFIRMED
        if change.allowed is True:
            return True
        box.raised = changes_limit and not decision.write
        return decision.write

    def _order_of(self, orders: Orders, now: float, *, changes_limit: bool) -> Standing:
        """Return changed orders as one that is about to stand."""
        code = limit_duty(clamp(orders, self.limits))
        ends_pause = (
            changes_limit and self.paused_by_our_limit and orders.allowed is not False
        )
        after_pause = self.setpoint.paused
        return replace(
            self.box.standing(code, now),
            raised=changes_limit or self._fell_back,
            ends_pause=ends_pause,
            after_pause=after_pause,
        )

    async def _reassert(self, turn: Turn) -> None:
        """Write the order again to a box that does not have it (any more)."""
        with self.conversing():
            await self.identify(turn)
            await self.read_status(turn)
            decision = self.decide(turn.now)
            if decision is None or not decision.write:
                # A command of the user came first, or it was only late.
                return
            failed = self.box.writes.failed(self.code, turn.now)
            was_paused = decision.paused is True
            was_open = self.box.is_open(turn.now)
            await self.apply_setpoint(
                turn,
                lambda: self.setpoint,
                patience=WRITE_PAUSES[0] if failed else FAILED_AFTER,
            )
            by_limit = self.effective_orders.allowed is not False
            # The orders may have changed since.
            if self.box.writes.code != PAUSE or not by_limit:
                return
            if self.governance.pauses:
                await self._note_ceiling_pause(was_open=was_open)
            elif not was_paused:
                await self.note_pause(by_limit=True)

    # -- The ceiling ---------------------------------------------------------------

    @override
    async def follow_ceiling(self, turn: Turn) -> None:
        # A limit alone is written: no state that wakes a car or enables the outlet.
        with self.conversing():
            await self.identify(turn)
            await self.read_status(turn)
            await self._require_icmax(turn)
            was_open = self.box.is_open(turn.now)
            ends_pause = self._ends_ceiling_pause
            if not self._may_follow(turn.now, ends_pause=ends_pause):
                return
            await self.apply_setpoint(turn, lambda: self.setpoint, starts=ends_pause)
            # By what was written: the ceiling may have changed meanwhile.
            if self.box.writes.code != PAUSE:
                await self.note_pause(by_limit=False)
            elif self.effective_orders.allowed is not False:
                await self._note_ceiling_pause(was_open=was_open)

    @property
    def _ends_ceiling_pause(self) -> bool:
        """Return whether a higher ceiling ends the pause that stands.

        Expired orders that are a pause by themselves are none of the ceiling's.
        """
        ordered = clamp(self.orders, self.limits)
        return self.paused_by_our_limit and not ordered.paused

    def _may_follow(self, now: float, *, ends_pause: bool) -> bool:
        """Return whether the ceiling is written in the status just read."""
        box = self.box
        order = replace(
            self.standing(now),
            raised=True,
            ends_pause=ends_pause,
            after_pause=box.writes.code == PAUSE,
        )
        decision = box.decide(order, now)
        if decision is None or decision.state is None:
            # Sent when the failure or the set-up is over.
            box.raised = True
            return False
        if order.code == PAUSE:
            return decision.write or decision.state is not OrderState.CONFIRMED
        box.raised = not decision.write
        return decision.write

    async def _note_ceiling_pause(self, *, was_open: bool) -> None:
        """Note a pause that was sent; ours if no other stood before it."""
        if was_open or self.paused_by_our_limit:
            await self.note_pause(by_limit=True)
        elif self.box.paused is None:
            # It may have been paused by another: the user knows.
            self.governance.unproved = CeilingPause(self.serial, None)

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
