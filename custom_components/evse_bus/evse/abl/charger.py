"""One ABL wallbox (EVCC2/3): what to ask, what to check, what to repeat.

The box is read first, always; its limit is asserted downward whenever it is read
back above the order (Icmax does not survive a power cycle), and permission is never
given by ourselves. PROTOCOLS.md, 2.
"""

from typing import Final, override

from ..conversation import FollowUp
from ..errors import (
    GarbledReplyError,
    NotAvailableError,
)
from ..exchange import Turn
from ..model import Command, Fault, OrderChange, Orders
from ..safety import Setpoint, clamp
from .commands import CommandSet
from .duty import PAUSE, is_within
from .reader import AblConfig, AblReader
from .registers import (
    Reading,
    limit_duty,
)
from .states import E0, SETUP

GARBLED: Final = 3
"""Unreadable answers in a row that look like two boxes with one ID."""


class AblCharger(AblReader):
    """One ABL wallbox."""

    def __init__(self, config: AblConfig, orders: Orders) -> None:
        """Take the set-up; the box is not known before it answers."""
        super().__init__(config, orders)
        self._commands = CommandSet(self)
        self._garbled = 0
        self._limit_paused = False
        self._fell_back = False

    @override
    def on_line_open(self) -> None:
        super().on_line_open()
        self._commands.release()

    @override
    def take(self, raw: Reading, now: float) -> None:
        if raw.duty != PAUSE:
            self._limit_paused = False
        super().take(raw, now)

    # -- The regular exchange ----------------------------------------------------

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        try:
            await self.identify(turn)
            raw = await self.read_once(turn)
        except GarbledReplyError:
            self._garbled += 1
            if self._garbled >= GARBLED:
                self.notice(Fault.DUPLICATE_ADDRESS, present=True)
            raise
        self._garbled = 0
        self.notice(Fault.DUPLICATE_ADDRESS, present=False)
        await self.read_flags_if_due(turn, raw)
        self.take(raw, turn.now)
        return self._next_action(raw)

    def _next_action(self, raw: Reading) -> FollowUp | None:
        """Return what must be said because of a reading."""
        if self.busy:
            return None
        if self.owes is not None:
            if self.owes.is_open(raw.state):
                return FollowUp(self._commands.give_back)
            self.owes = None
        if self._must_reassert(raw):
            return FollowUp(self._reassert)
        if self.tells_icmax is None:
            return FollowUp(self.look_for_icmax)
        return None

    def _must_reassert(self, raw: Reading) -> bool:
        if raw.state in SETUP:
            return False
        duty = limit_duty(self.setpoint)
        if not is_within(raw.duty, duty):
            return True
        self.confirmed = duty
        self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
        if self.orders_expired and not self._fell_back:
            # The fail-safe may be the higher one: raised to once, and never in a box
            # that is paused or disabled.
            if raw.duty < duty != PAUSE and raw.state != E0:
                return True
            self._fell_back = True
        return False

    # -- Orders ------------------------------------------------------------------

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        with self.conversing():
            await self.identify(turn)
            setpoint = clamp(orders, self.limits)
            # The user's pause goes out at once; else the box says what may be sent.
            if change.allowed is not False and not self._may_write(
                await self.look(turn), setpoint, orders, change
            ):
                return
            await self.enforce(
                turn,
                lambda: clamp(self.order_to_send(change), self.limits),
                starts=change.allowed is True,
            )
            self._limit_paused = setpoint.paused and orders.allowed is not False
            self._fell_back = False

    def _may_write(
        self, raw: Reading, setpoint: Setpoint, orders: Orders, change: OrderChange
    ) -> bool:
        """Return whether these orders go to a box in this state now.

        False: they are stored, and count when the box lets a car charge again. No
        change of a limit may start a car; raises NotAvailableError where the user
        wants one started that cannot be.
        """
        if raw.state in SETUP:
            message = f"{self.config.name} is being set up"
            raise NotAvailableError(message)
        if change.allowed is True:
            if raw.state == E0:
                message = f"{self.config.name}: the outlet is disabled, enable it first"
                raise NotAvailableError(message)
            return True
        duty = limit_duty(setpoint)
        lowers = not is_within(raw.duty, duty)
        if setpoint.paused or raw.duty == duty:
            return lowers
        asked = change.current is not None or any(
            phase is not None for phase in change.phases
        )
        if raw.duty == PAUSE:
            # Only what our own limit of 0 A has paused, a limit sets going again.
            ours = self._limit_paused or self.setpoint.paused
            return asked and ours and orders.allowed is not False
        if raw.state == E0:
            return lowers
        return lowers or asked or self._fell_back

    async def _reassert(self, turn: Turn) -> None:
        """Bring a box that stands above its orders down to them."""
        with self.conversing():
            await self.identify(turn)
            raw = self.raw or await self.look(turn)
            if not self._must_reassert(raw):
                # A command of the user came first and did it.
                return
            duty = limit_duty(self.setpoint)
            if duty == self.confirmed and not is_within(raw.duty, duty):
                self.statistics.reasserted += 1
            await self.enforce(turn, lambda: self.setpoint)
            self._fell_back = self.orders_expired
            if self.setpoint.paused and self.effective_orders.allowed is not False:
                self._limit_paused = True

    # -- Commands ----------------------------------------------------------------

    @override
    async def command(
        self,
        command: Command,
        value: bool | int | str | None = None,
    ) -> None:
        conversation, persistence = self._commands.conversation(command, value)
        await self.run(conversation, persistence=persistence)
