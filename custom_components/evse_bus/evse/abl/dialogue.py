"""What the commands of an ABL box are made of.

Register 0x0005 is never written twice for one wish: after a lost answer the state is
read, and decides.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar, Final

from ..conversation import rest
from ..errors import (
    ExchangeError,
    NotAvailableError,
    NotConfirmedError,
    ReplyTimeoutError,
)
from ..exchange import Turn
from .duty import is_within
from .exchanges import set_state
from .reader import AblReader
from .registers import Reading, StateCode, limit_duty
from .states import E0, E2, state_of

BOOT_LOOKS: Final = 10
"""How often a box that has been reset is looked for."""
LOOKS: Final = 4
"""How often a state is looked at until it must have been reached."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pauses:
    """Pauses between the turns of a command, s."""

    wake: float = 3.0
    """Without a pilot signal: wakes a car (PROTOCOLS.md, 2)."""
    setup: float = 0.5
    """Between the writes of a set-up (PROTOCOLS.md, 2)."""
    boot: float = 0.6
    """Between two looks for a box that has been reset."""
    retry: float = 0.4
    """After a first request that a sleeping box has lost."""
    verify: float = 0.3
    """Between two looks at a state that is to be reached."""


class Dialogue:
    """Steps that several commands share."""

    pauses: ClassVar = Pauses()

    def __init__(self, charger: AblReader) -> None:
        """Take the charger, for its identity, its readings and its limit."""
        self._charger = charger

    async def _reach(self, turn: Turn) -> None:
        """Wake the box itself: nothing has been written, so asking again is safe."""
        for last in (False, False, True):
            try:
                await self._charger.identify(turn)
                await self._charger.look(turn)
            except ReplyTimeoutError:
                if last:
                    raise
            else:
                return
            await rest(self.pauses.retry)

    def _state(self) -> Reading:
        """Return the last reading."""
        if self._charger.raw is None:
            message = f"{self._charger.config.name} has told no state"
            raise NotAvailableError(message)
        return self._charger.raw

    async def _say(self, turn: Turn, code: StateCode) -> bool:
        """Write a state code, once; return whether it was confirmed."""
        try:
            await set_state(turn, self._charger.config.address, code)
        except ReplyTimeoutError:
            return False
        return True

    def _hold_polls(self, turn: Turn) -> None:
        """Let no regular exchange come between: the box is off or moving."""
        slot = self._charger.slot
        slot.ready = max(slot.ready, turn.now + 2 * self.pauses.boot)

    def _refuse_in(self, reading: Reading, what: str) -> NotAvailableError:
        name = self._charger.config.name
        state = state_of(reading.state).name
        return NotAvailableError(f"{name} is in state {state}: {what}")

    async def _reach_state(
        self, turn: Turn, code: StateCode, reached: Callable[[Reading], bool]
    ) -> None:
        """Write a state code and see that it works; again only if it was lost."""
        confirmed = await self._say(turn, code)
        for _ in range(LOOKS):
            if reached(await self._charger.look(turn)):
                return
            if not confirmed:
                confirmed = await self._say(turn, code)
            await rest(self.pauses.verify)
        if reached(await self._charger.look(turn)):
            return
        message = f"{self._charger.config.name} does not follow {code.name}"
        raise NotConfirmedError(message)

    async def _after_reset(self, turn: Turn, *, was_disabled: bool) -> None:
        """Wait for a box to come back; then nothing may be open that was closed.

        A reset ends in A1 with Idefault: neither the limit nor E0 has survived it.
        """
        charger = self._charger
        charger.forget()
        for look in range(BOOT_LOOKS):
            self._hold_polls(turn)
            await rest(self.pauses.boot)
            self._hold_polls(turn)
            try:
                await charger.identify(turn)
                await charger.look(turn)
                break
            except ReplyTimeoutError:
                if look == BOOT_LOOKS - 1:
                    raise
        await self._limit_first(turn)
        if was_disabled:
            await self._disable(turn)
        elif self._state().state != E2:
            charger.owes = None

    async def _limit_first(self, turn: Turn) -> None:
        """Bring the limit down: enabled, a car may begin at once."""
        charger = self._charger
        if not is_within(self._state().duty, limit_duty(charger.setpoint)):
            await charger.enforce(turn, lambda: charger.setpoint)

    async def _disable(self, turn: Turn) -> None:
        """Disable the outlet; from then on it is to be so."""
        if self._state().state != E0:
            await self._reach_state(turn, StateCode.E0, lambda now: now.state == E0)
        self._charger.owes = None

    async def _give_back(self, turn: Turn) -> None:
        """End the state that we brought about; a lost exchange is tried again."""
        charger = self._charger
        debt = charger.owes
        for _ in range(LOOKS):
            if debt is None:
                return
            with suppress(ExchangeError):
                if debt.is_open((await charger.look(turn)).state):
                    if self._state().state == E0:
                        await self._limit_first(turn)
                    await self._say(turn, debt.end)
                    await charger.look(turn)
                if not debt.is_open(self._state().state):
                    charger.owes = None
                    return
            await rest(self.pauses.verify)
        raise NotConfirmedError(f"{charger.config.name} does not leave its state")
