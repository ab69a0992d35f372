"""What a polled SmartEVSE and a load-balancing slave share: access, settings, turns.

Every turn has one exchange at most, so that a master's broadcast never waits for
more. PROTOCOLS.md, 3.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final, override

from ..conversation import FollowUp, rest
from ..errors import GarbledReplyError, NotConfirmedError, SupersededError
from ..exchange import Request, Turn
from ..model import Fault, Orders, Range, Setting
from .config import SmartEvseConfig
from .dialects import MAPS
from .exchanges import write
from .reader import SmartEvseReader
from .registers import write_access
from .setup import SetUp
from .states import is_stopped
from .timing import LOOK_AGAIN

WRITES: Final = 2
"""How often something is written until it must be read back."""
GARBLED: Final = 3
"""Unreadable answers in a row that look like two boxes with one address."""


class SmartEvseBox[C: SmartEvseConfig](SmartEvseReader[C]):
    """One SmartEVSE."""

    def __init__(self, config: C, orders: Orders) -> None:
        """Take the set-up; the box is not known before it answers."""
        super().__init__(config, orders)
        self.must_close = False
        """A setting may have opened the access that was off: to be closed again."""
        self._garbled = 0
        self._set_up = SetUp(self)

    # -- The regular exchange ------------------------------------------------------

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        try:
            if self.dialect is None:
                await self.reach(turn)
            else:
                await self.look(turn)
        except GarbledReplyError:
            self._garbled += 1
            if self._garbled >= GARBLED:
                self.notice(Fault.DUPLICATE_ADDRESS, present=True)
            raise
        self._garbled = 0
        self.notice(Fault.DUPLICATE_ADDRESS, present=self.shares_address)
        return self.next_action(turn.now)

    def next_action(self, now: float) -> FollowUp | None:
        """Return what must be asked or said because of a status."""
        if self.busy or not self.must_maintain(now):
            return None
        return FollowUp(self._maintain)

    async def _maintain(self, turn: Turn) -> None:
        with self.conversing():
            await self.maintain(turn)

    def must_maintain(self, now: float) -> bool:
        """Return whether something is to be asked or said beside the status."""
        return now >= self.configuration_due or self.must_close

    async def maintain(self, turn: Turn) -> None:
        """Ask and say what is due; what is not answered is for another time."""
        if self.must_close:
            await self.close_again(turn)
            await rest(0.0)
        if turn.now >= self.configuration_due:
            await self.read_configuration(turn)

    # -- What it keeps in its memory -------------------------------------------------

    @property
    @override
    def settings(self) -> Mapping[Setting, Range]:
        if self.dialect is None or self.configuration is None:
            return {}
        ranges = {
            setting: Range(*word.kind.span)
            for setting, word in MAPS[self.dialect].settings.items()
        }
        # No setting may promise the box more than its wiring carries.
        own = ranges[Setting.MAXIMUM_CURRENT]
        highest = min(own.maximum, int(self.config.installation_limit))
        ranges[Setting.MAXIMUM_CURRENT] = replace(own, maximum=highest)
        return ranges

    @override
    async def configure(self, setting: Setting, value: int) -> None:
        conversation = self._set_up.conversation(setting, value)
        await self.run(conversation)

    # -- Access ----------------------------------------------------------------------

    async def set_access(
        self,
        turn: Turn,
        allowed: bool,  # noqa: FBT001
        still: Callable[[], bool] = lambda: True,
    ) -> None:
        """Set the access bit until the box is read back to have obeyed.

        Off counts when no car can charge any more (`states.is_stopped`). ``still`` is
        asked right before each write: a pause said meanwhile must not be overtaken.
        Raises SupersededError where it says no, NotConfirmedError when the box does
        not follow.
        """
        await self.reach(turn)
        dialect = self.known_dialect

        def request() -> bytes:
            if not still():
                message = "a newer command came first"
                raise SupersededError(message)
            return write_access(self.config.address, dialect, allowed)

        for _ in range(WRITES):
            await self.write(turn, request, MAPS[dialect].access_register)
            if allowed:
                # The user's word, or a limit that gives back: open it may be.
                self.must_close = False
            for pause in (0.0, LOOK_AGAIN):
                await rest(pause)
                await self.see(turn)
                if self._has_access(allowed):
                    return
            await rest(0.0)
        what = "on" if allowed else "off"
        message = f"{self.config.name} does not turn its access {what}"
        raise NotConfirmedError(message)

    async def close_again(self, turn: Turn) -> None:
        """Turn access off where a setting has opened it, until it is certain."""
        await self.see(turn)
        if self.status is None or self.status.access:
            await rest(0.0)
            await self.set_access(turn, allowed=False)
        self.must_close = False

    def _has_access(self, allowed: bool) -> bool:  # noqa: FBT001
        if self.status is None:
            return False
        if allowed:
            return self.status.access
        return is_stopped(self.known_dialect, self.status)

    async def write(self, turn: Turn, request: Request, register: int) -> bool | None:
        """Write a register (see `exchanges.write`)."""
        return await write(turn, self.config.address, request, register)

    # -- Conversations -----------------------------------------------------------------
