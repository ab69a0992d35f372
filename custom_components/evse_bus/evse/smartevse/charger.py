"""The regular turn and the settings of a SmartEVSE, polled or slave."""

from collections.abc import Mapping
from dataclasses import replace
from typing import override

from ..collisions import Collisions
from ..conversation import FollowUp, rest
from ..errors import GarbledReplyError
from ..exchange import Turn
from ..model import Fault, Orders, Range, Setting
from ..schedule import Kind
from .config import SmartEvseConfig
from .dialects import MAPS
from .reader import SmartEvseReader
from .settings import setting_conversation


class SmartEvseCharger[C: SmartEvseConfig](SmartEvseReader[C]):
    """One SmartEVSE."""

    def __init__(self, config: C, orders: Orders) -> None:
        """Begin with an unknown box."""
        super().__init__(config, orders)
        self._collisions = Collisions()

    # -- The regular turn ----------------------------------------------------------

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        try:
            if self.dialect is None:
                await self.reach(turn)
            else:
                await self.read_status_once(turn)
        except GarbledReplyError:
            if self._collisions.garbled(turn.now):
                self.notice(Fault.DUPLICATE_ADDRESS, present=True)
            raise
        self._collisions.good(turn.now)
        self.notice(Fault.DUPLICATE_ADDRESS, present=self.shares_address)
        return self._next_action(turn.now)

    def _next_action(self, now: float) -> FollowUp | None:
        """Return the conversation that the status calls for, if any."""
        if self.busy or not self.must_maintain(now):
            return None
        return FollowUp(self._maintain)

    async def _maintain(self, turn: Turn) -> None:
        with self.conversing():
            await self.maintain(turn)

    def must_maintain(self, now: float) -> bool:
        """Return whether `maintain` has anything to do."""
        return now >= self.configuration_due or self.must_close_access

    async def maintain(self, turn: Turn) -> None:
        """Read and write all that is due; after a failure a later turn tries again."""
        if self.must_close_access:
            await self.close_access(turn)
            await rest()
        if turn.now >= self.configuration_due:
            await self.read_configuration(turn)

    # -- Settings ------------------------------------------------------------------

    @property
    @override
    def settings(self) -> Mapping[Setting, Range]:
        if self.dialect is None or self.configuration is None:
            return {}
        ranges = {
            setting: Range(*word.kind.span)
            for setting, word in MAPS[self.dialect].settings.items()
            if setting in self.configuration.settings
        }
        # No setting may allow the box more than its wiring carries.
        own = ranges[Setting.MAXIMUM_CURRENT]
        highest = min(own.maximum, int(self.config.installation_limit))
        ranges[Setting.MAXIMUM_CURRENT] = replace(own, maximum=highest)
        return ranges

    @override
    async def configure(
        self, setting: Setting, value: int, *, only_lower: bool = False
    ) -> None:
        conversation = setting_conversation(self, setting, value, only_lower=only_lower)
        # As a pause: where the write opens access, closing it does not wait.
        await self.run(conversation, kind=Kind.PAUSE)
