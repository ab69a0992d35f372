"""One ABL wallbox (EVCC2/3): what to ask, what to check, what to repeat.

The box is read first, always; its limit is asserted downward whenever it is read
back above the order (Icmax does not survive a power cycle), and permission is never
given by ourselves. PROTOCOLS.md, 2.
"""

from typing import Final, override

from ..errors import (
    GarbledReplyError,
    NotAvailableError,
)
from ..exchange import Talk
from ..jobs import Later
from ..model import ChargerConfig, Command, Fault, OrderChange, Orders
from ..safety import Setpoint, clamp
from ..turns import in_turns
from .commands import CommandSet
from .duty import PAUSE, is_within
from .reader import AblReader
from .registers import (
    Reading,
    limit_duty,
)
from .states import E0, SETUP

GARBLED: Final = 3
"""Unreadable answers in a row that look like two boxes with one ID."""


class AblCharger(AblReader):
    """One ABL wallbox."""

    def __init__(self, config: ChargerConfig, orders: Orders) -> None:
        """Take the set-up; the box is not known before it answers."""
        super().__init__(config, orders)
        self._commands = CommandSet(self)
        self._garbled = 0
        self._limit_paused = False
        self._fell_back = False

    @override
    def on_line_open(self) -> None:
        super().on_line_open()
        # A conversation that was cut short with the line does not come to its end.
        self._conversations.clear()
        self._commands.release()

    @override
    def take(self, raw: Reading, now: float) -> None:
        if raw.duty != PAUSE:
            self._limit_paused = False
        super().take(raw, now)

    # -- The regular exchange ----------------------------------------------------

    @override
    async def poll(self, talk: Talk) -> Later[None] | None:
        try:
            await self.identify(talk)
            raw = await self.read_once(talk)
        except GarbledReplyError:
            self._garbled += 1
            if self._garbled >= GARBLED:
                self.notice(Fault.DUPLICATE_ADDRESS, present=True)
            raise
        self._garbled = 0
        self.notice(Fault.DUPLICATE_ADDRESS, present=False)
        await self.read_flags_if_due(talk, raw)
        self.take(raw, talk.now)
        return self._what_now(raw)

    def _what_now(self, raw: Reading) -> Later[None] | None:
        """Return what must be said because of a reading."""
        if self.busy:
            return None
        if self.owes is not None:
            if self.owes.is_open(raw.state):
                return Later(0.0, in_turns(self._commands.give_back))
            self.owes = None
        if self._must_assert(raw):
            return Later(0.0, in_turns(self._assert))
        if self.tells_icmax is None:
            return Later(0.0, self.look_for_icmax)
        return None

    def _must_assert(self, raw: Reading) -> bool:
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
    async def impose(self, talk: Talk, orders: Orders, change: OrderChange) -> None:
        with self.conversing():
            await self.identify(talk)
            setpoint = clamp(orders, self.limits)
            # The user's pause goes out at once; else the box says what may be sent.
            if change.allowed is not False and not self._may_write(
                await self.look(talk), setpoint, orders, change
            ):
                return
            await self.enforce(
                talk,
                lambda: clamp(self.sought(change), self.limits),
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

    async def _assert(self, talk: Talk) -> None:
        """Bring a box that stands above its orders down to them."""
        with self.conversing():
            await self.identify(talk)
            raw = self.raw or await self.look(talk)
            if not self._must_assert(raw):
                # A command of the user came first and did it.
                return
            duty = limit_duty(self.setpoint)
            if duty == self.confirmed and not is_within(raw.duty, duty):
                self.statistics.reasserted += 1
            await self.enforce(talk, lambda: self.setpoint)
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
        await self.run(in_turns(conversation), persistence=persistence)
