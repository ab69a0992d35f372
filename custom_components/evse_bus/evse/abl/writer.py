"""What is written to one ABL wallbox: limits until they are read back, and states.

After a missed reply the identity is checked before anything is written
(PROTOCOLS.md, 2).
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, repeat
from typing import Final

from ..conversation import rest
from ..errors import ExchangeRefusedError, NotConfirmedError, ReplyTimeoutError
from ..exchange import Request, Turn
from ..model import Fault, Orders
from ..safety import Setpoint
from .config import AblConfig
from .decisions import FAILED_AFTER, is_taken
from .duty import PAUSE
from .exchanges import write_once
from .reader import AblReader
from .registers import (
    CONFIGURATION_REGISTER,
    LIMIT_REGISTER,
    STATE_REGISTER,
    Reading,
    StateCode,
    limit_duty,
    write_answer,
    write_configuration,
    write_limit,
    write_state,
)
from .states import E0

SETTLING: Final = (0.25, 0.5, 1.0)
"""Pauses between reads of a limit that does not show at once, s."""


@dataclass(frozen=True, slots=True)
class Cleanup:
    """A state that a command passes through, and the code that ends it."""

    code: StateCode
    state: int | None = None
    """``None``: any but E0 (the reset of a disabled outlet enables it)."""

    def is_needed(self, state: int) -> bool:
        """Return whether a box in this state must still be led out of it."""
        return state != E0 if self.state is None else state == self.state


class AblWriter(AblReader):
    """One ABL wallbox, as far as it is written to."""

    def __init__(self, config: AblConfig, orders: Orders) -> None:
        """Nothing is known of the box before its first reply."""
        super().__init__(config, orders)
        self.pending_cleanup: Cleanup | None = None
        """State that a command brought about and has not ended yet."""

    async def apply_setpoint(
        self,
        turn: Turn,
        setpoint: Callable[[], Setpoint],
        *,
        starts: bool = False,
        patience: float = FAILED_AFTER,
    ) -> Reading:
        """Write a set-point until the register that means it shows it.

        ``setpoint`` is called right before each write: the orders may change.
        ``starts``: a pause that is read back does not count as below. Waits for
        ``patience`` seconds at most. Returns the status that confirms it.

        Raises NotConfirmedError when the box does not follow, ExchangeRefusedError
        when it refuses.
        """
        until = turn.now + patience
        pauses = chain(SETTLING, repeat(SETTLING[-1]))
        refused: ExchangeRefusedError | None = None
        has_rested = False
        while True:
            over = turn.now >= until
            try:
                if turn.now >= self.box.writes.due(limit_duty(setpoint())) and not over:
                    await self._write_limit(turn, setpoint)
                status = await self.read_status(turn)
            except ExchangeRefusedError as error:
                # It may have been taken all the same: read first, then repeat.
                refused = error
                status = await self.read_status(turn)
            except ReplyTimeoutError:
                # Before a rest the bus repeats the whole conversation.
                if not has_rested or over:
                    raise
                await rest(next(pauses))
                continue
            code = limit_duty(setpoint())
            seen = self.box.seen(turn.now)
            order = self.box.standing(code, turn.now)
            if seen and is_taken(seen, order, starts=starts, is_last=over):
                self.box.note_confirmed(code)
                self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
                return status
            if over:
                break
            await rest(min(next(pauses), max(until - turn.now, 0.0)))
            has_rested = True
        # Where the pause is taken, the car alone is the problem (`watch_pause`).
        taken = code == PAUSE and self.box.writes.acknowledged is not None
        not_taken = not taken or self.box.paused is False
        self.notice(Fault.LIMIT_NOT_TAKEN, present=not_taken)
        if refused is not None:
            raise refused
        message = f"{self.config.name} does not follow its limit"
        raise NotConfirmedError(message)

    async def _write_limit(self, turn: Turn, setpoint: Callable[[], Setpoint]) -> None:
        def request() -> bytes:
            wanted = setpoint()
            code = limit_duty(wanted)
            self.statistics.reasserted += self.box.writes.is_repeat(code, turn.now)
            self.box.on_write(code, turn.now)
            return write_limit(self.config.address, wanted)

        await self.identify(turn)
        try:
            await self._write(turn, request, LIMIT_REGISTER)
        except ReplyTimeoutError:
            self.box.writes.unanswered()
            raise
        self.box.on_acknowledged(turn.now)

    async def _write(self, turn: Turn, request: Request, register: int) -> None:
        """Write one register of the box, which was identified."""
        await turn.exchange(request, write_answer(self.config.address, register))

    async def set_state(self, turn: Turn, code: StateCode) -> bool:
        """Write a state code once; return whether the box has confirmed it.

        A reply that stays away decides nothing: the state has to be read.
        """
        await self.identify(turn)
        if code is StateCode.E0:
            self.on_e0_sent(turn.now)
        address = self.config.address
        answer = write_answer(address, STATE_REGISTER)
        return await write_once(turn, write_state(address, code), answer)

    async def set_configuration(
        self,
        turn: Turn,
        *,
        upstream_timeout: bool | None = None,
        needs_enable: bool | None = None,
    ) -> None:
        """Write settings (in E2); ``None``: no change."""
        await self.identify(turn)
        request = write_configuration(
            self.config.address,
            self.config.address,
            upstream_timeout=upstream_timeout,
            needs_enable=needs_enable,
        )
        await self._write(turn, request, CONFIGURATION_REGISTER)
