"""What an ABL box can be told beside its orders, each as one conversation.

Register 0x0005 is never written twice for one wish: after a lost answer the state is
read, and decides. What a conversation has changed on its way (E0, E2) it changes
back, also when something fails.
"""

from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from ..conversation import Conversation, rest
from ..errors import (
    ExchangeRefusedError,
    NotAvailableError,
    NotConfirmedError,
    RefusedOrderError,
    ReplyTimeoutError,
)
from ..exchange import Turn
from ..model import Command, Persistence
from .dialogue import Dialogue
from .duty import PAUSE
from .reader import AblReader, Debt
from .registers import (
    ADDRESSES,
    StateCode,
    limit_duty,
)
from .setup import Settings, SetUp
from .states import B2, E0, E2, state_of


@dataclass(frozen=True, slots=True, eq=False)
class _Busy:
    """The one command under way."""

    what: str


class CommandSet(Dialogue):
    """The commands of one charger; one at a time."""

    def __init__(self, charger: AblReader) -> None:
        """Take the charger, for its identity, its readings and its limit."""
        super().__init__(charger)
        self._set_up = SetUp(charger)
        self._busy: _Busy | None = None

    def conversation(
        self, command: Command, value: object
    ) -> tuple[Conversation, Persistence]:
        """Return what carries out a command, and how often it may be begun.

        Raises RefusedOrderError for a value that the command cannot have, and
        NotAvailableError for a command that an ABL box does not know.
        """
        turns, persistence = self._turns(command, value)
        return self._one_at_a_time(command, turns), persistence

    def _turns(
        self, command: Command, value: object
    ) -> tuple[Conversation, Persistence]:
        match command:
            case Command.RESET:
                return self._reset, Persistence.ONCE
            case Command.WAKE:
                return self._wake, Persistence.ONCE
            case Command.SET_OUTLET:
                turns = partial(self._set_outlet, _on_or_off(command, value))
                # It begins with a look at the state: twice does what once does.
                return turns, Persistence.REPEATABLE
            case Command.SET_ADDRESS:
                settings = Settings(device_id=_device_id(value))
            case Command.SET_UPSTREAM_TIMEOUT:
                settings = Settings(upstream_timeout=_on_or_off(command, value))
            case Command.SET_ENABLE_AFTER_POWER_CYCLE:
                settings = Settings(needs_enable=not _on_or_off(command, value))
            case _:
                message = f"{self._charger.config.name} knows no command {command}"
                raise NotAvailableError(message)
        return partial(self._set_up.run, settings), Persistence.ONCE

    def release(self) -> None:
        """Forget the command under way: it was cut short."""
        self._busy = None

    def _one_at_a_time(
        self, command: Command | None, turns: Conversation
    ) -> Conversation:
        async def conversation(turn: Turn) -> None:
            if self._busy is not None:
                message = f"{self._charger.config.name} is busy: {self._busy.what}"
                raise NotAvailableError(message)
            self._busy = mine = _Busy(command or "tidying up")
            try:
                with self._charger.conversing():
                    await turns(turn)
            finally:
                if self._busy is mine:
                    self._busy = None
                self._charger.updated()

        return conversation

    # -- Outlet ------------------------------------------------------------------

    async def _set_outlet(self, enabled: bool, turn: Turn) -> None:  # noqa: FBT001
        await self._reach(turn)
        reading = self._state()
        if enabled:
            if state_of(reading.state).outlet_enabled is not True:
                if reading.state not in (E0, E2):
                    raise self._refuse_in(reading, "only E0 and E2 can be left")
                await self._enable(turn)
            self._charger.owes = None
        else:
            await self._disable(turn)

    async def _enable(self, turn: Turn) -> None:
        """Enable the outlet, with the limit that stands."""
        charger = self._charger
        paused = self._state().duty == PAUSE
        await self._limit_first(turn)
        await self._reach_state(
            turn, StateCode.A1, lambda now: now.state not in (E0, E2)
        )
        if not paused and self._state().duty < limit_duty(charger.setpoint) != PAUSE:
            # Limits raised while the outlet was disabled have only been stored.
            await charger.enforce(turn, lambda: charger.setpoint)

    # -- Waking a car ------------------------------------------------------------

    async def _wake(self, turn: Turn) -> None:
        await self._reach(turn)
        charger = self._charger
        reading = self._state()
        if reading.state != B2:
            raise self._refuse_in(reading, "only a car that may charge can be woken")
        if reading.duty == PAUSE or charger.setpoint.paused:
            raise self._refuse_in(reading, "charging is paused, waking would not help")
        charger.owes = Debt(StateCode.A1, E0)
        try:
            confirmed = await self._say(turn, StateCode.E0)
        except ExchangeRefusedError:
            charger.owes = None
            raise
        if not confirmed:
            # If the state is not told either, E0 must be assumed.
            with suppress(ReplyTimeoutError):
                if (await charger.look(turn)).state != E0:
                    charger.owes = None
                    message = f"{charger.config.name} did not take E0"
                    raise NotConfirmedError(message)
        await rest(self.pauses.wake)
        await self._give_back(turn)

    async def give_back(self, turn: Turn) -> None:
        """Finish what a command that was cut short has left undone."""
        await self._one_at_a_time(None, self._give_back)(turn)

    # -- Reset -------------------------------------------------------------------

    async def _reset(self, turn: Turn) -> None:
        await self._reach(turn)
        before = self._state()
        if before.state == E0:
            self._charger.owes = Debt(StateCode.E0)
        self._hold_polls(turn)
        confirmed = await self._say(turn, StateCode.RESET)
        await self._after_reset(turn, was_disabled=before.state == E0)
        after = self._state()
        if not confirmed and (after.state, after.duty) == (before.state, before.duty):
            message = (
                f"{self._charger.config.name}: the answer to the reset was lost, and "
                "nothing shows whether it happened; it was not repeated"
            )
            raise NotConfirmedError(message)


def _on_or_off(command: Command, value: object) -> bool:
    if not isinstance(value, bool):
        message = f"{command} takes on or off, not {value!r}"
        raise RefusedOrderError(message)
    return value


def _device_id(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value not in ADDRESSES:
        message = f"a device-ID is 1 to 16, not {value!r}"
        raise RefusedOrderError(message)
    return value
