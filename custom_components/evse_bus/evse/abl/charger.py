"""One ABL wallbox (EVCC2/3): its orders, and when they are sent.

The status is read before anything is written. A limit above the orders is written
again (Icmax does not survive a power cycle); permission is never given without the
user (PROTOCOLS.md, 2).
"""

from dataclasses import dataclass
from functools import partial
from typing import Final, override

from ..conversation import Conversation, FollowUp
from ..errors import GarbledReplyError, NotAvailableError
from ..exchange import Turn
from ..model import (
    Capability,
    Command,
    FailSafe,
    Fault,
    Limits,
    OrderChange,
    Orders,
)
from ..safety import Setpoint, clamp
from .commands import conversation_for
from .config import AblConfig
from .duty import PAUSE, is_within
from .reader import AblReader
from .registers import Reading, limit_duty
from .states import E0, SETUP
from .steps import restore

GARBLED_REPLIES: Final = 3
"""Unreadable replies in a row that suggest two boxes with one device-ID."""

_CAPABILITIES: Final = frozenset(
    {
        Capability.STATUS,
        Capability.RAW_STATE,
        Capability.PLUGGED,
        Capability.CHARGING,
        Capability.OFFERED_CURRENT,
        Capability.FAULTS,
        Capability.UPSTREAM_TIMEOUT,
        Capability.ENABLE_AFTER_POWER_CYCLE,
        Capability.OUTLET_ENABLED,
        Capability.RESET,
        Capability.WAKE,
        Capability.SET_ADDRESS,
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
        self._paused_by_limit = False
        """Our limit of 0 A has paused it, not the user."""
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
        return Limits(installation=self.config.installation_limit)

    @property
    @override
    def waits_for_current(self) -> bool:
        return self._paused_by_limit

    @override
    def on_line_open(self) -> None:
        super().on_line_open()
        self._active = None

    @override
    def keep_status(self, status: Reading, now: float) -> None:
        if status.duty != PAUSE:
            self._paused_by_limit = False
        super().keep_status(status, now)

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
        return self._next_action(status)

    def _next_action(self, status: Reading) -> FollowUp | None:
        """Return the conversation that a status requires."""
        if self.busy:
            return None
        if self.pending_cleanup is not None:
            if self.pending_cleanup.is_needed(status.state):
                restoring = partial(restore, self)
                return FollowUp(self._exclusive("restoring its state", restoring))
            self.pending_cleanup = None
        if self._must_reassert(status):
            return FollowUp(self._reassert)
        if self.has_icmax is None:
            return FollowUp(self.probe_icmax)
        return None

    def _must_reassert(self, status: Reading) -> bool:
        """Return whether the limit has to be written again; note one that is taken."""
        if status.state in SETUP:
            return False
        duty = limit_duty(self.setpoint)
        if not is_within(status.duty, duty):
            return True
        self.confirmed = duty
        self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
        if self.orders_expired and not self._fell_back:
            # The fail-safe may be above the limit: raised to it once, and never in a
            # box that is paused or disabled.
            if status.duty < duty != PAUSE and status.state != E0:
                return True
            self._fell_back = True
        return False

    # -- Orders ------------------------------------------------------------------

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        with self.conversing():
            await self.identify(turn)
            setpoint = clamp(orders, self.limits)
            # A pause by the user is sent at once; all else depends on the status.
            if change.allowed is not False and not self._may_write(
                await self.read_status(turn), setpoint, orders, change
            ):
                return
            await self.apply_setpoint(
                turn,
                lambda: clamp(self.order_to_send(change), self.limits),
                starts=change.allowed is True,
            )
            self._paused_by_limit = setpoint.paused and orders.allowed is not False
            self._fell_back = False

    def _may_write(
        self, status: Reading, setpoint: Setpoint, orders: Orders, change: OrderChange
    ) -> bool:
        """Return whether the set-point of a change is written in this status.

        False: the orders are only stored, and count when the box lets a car charge
        again. A limit change never starts a car. Raises NotAvailableError where the
        user starts one and the box cannot.
        """
        if status.state in SETUP:
            message = f"{self.config.name} is in set-up mode"
            raise NotAvailableError(message)
        if change.allowed is True:
            if status.state == E0:
                message = f"{self.config.name}: the outlet is disabled, enable it first"
                raise NotAvailableError(message)
            return True
        duty = limit_duty(setpoint)
        lowers = not is_within(status.duty, duty)
        if setpoint.paused or status.duty == duty:
            return lowers
        changes_limit = change.current is not None or any(
            phase is not None for phase in change.phases
        )
        if status.duty == PAUSE:
            # A limit ends only the pause that our own limit has brought about.
            by_limit = changes_limit and self._paused_by_limit
            return by_limit and orders.allowed is not False
        if status.state == E0:
            return lowers
        return lowers or changes_limit or self._fell_back

    async def _reassert(self, turn: Turn) -> None:
        """Bring a box whose limit is above its orders down to them."""
        with self.conversing():
            await self.identify(turn)
            status = self.last_status or await self.read_status(turn)
            if not self._must_reassert(status):
                # A command of the user came first.
                return
            duty = limit_duty(self.setpoint)
            if duty == self.confirmed and not is_within(status.duty, duty):
                self.statistics.reasserted += 1
            await self.apply_setpoint(turn, lambda: self.setpoint)
            self._fell_back = self.orders_expired
            if self.setpoint.paused and self.effective_orders.allowed is not False:
                self._paused_by_limit = True

    # -- Commands ----------------------------------------------------------------

    @override
    async def command(
        self,
        command: Command,
        value: bool | int | str | None = None,
    ) -> None:
        conversation, persistence = conversation_for(self, command, value)
        await self.run(self._exclusive(command, conversation), persistence=persistence)

    def _exclusive(self, name: str, conversation: Conversation) -> Conversation:
        """Return a conversation that is refused while another command is under way."""

        async def exclusive(turn: Turn) -> None:
            if self._active is not None:
                message = f"{self.config.name} is busy: {self._active.name}"
                raise NotAvailableError(message)
            self._active = mine = _ActiveCommand(name)
            try:
                with self.conversing():
                    await conversation(turn)
            finally:
                if self._active is mine:
                    self._active = None
                self.updated()

        return exclusive
