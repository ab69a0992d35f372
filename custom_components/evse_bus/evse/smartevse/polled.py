"""How a SmartEVSE that is polled may be spoken to: when, in one go, and alone.

A later box needs quiet: any request on the line, whoever it is for, holds its own 2 s
cycle up for 4 s; without it no new current counts, and after 10 s it stops with
NO_COMM. So all that is to be said goes in one burst, and then there is quiet. Only a
pause does not wait for its end. PROTOCOLS.md, 3.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import ClassVar, Final, override

from ..conversation import FollowUp
from ..errors import LineBusyError, SharedAddressError
from ..exchange import Request, Turn
from ..model import Fault, Orders, Persistence, Range, Setting
from ..schedule import Kind
from .box import SmartEvseBox
from .config import PolledConfig
from .dialects import Dialect
from .timing import QUIET, TIMING

COMMANDS_FIRST: Final = 0.05
"""A poll comes so much later than the end of the quiet, s."""


class PolledBox(SmartEvseBox[PolledConfig]):
    """One SmartEVSE that has no master, or is its own."""

    pauses_hurry: ClassVar = True
    # No other charger has a deadline here, and one burst costs a later box one quiet.
    bursts: ClassVar = True
    # A power failure opens access that was off: a box that is back is soon seen, and
    # one that hears us and is not heard still has its quiet.
    timing: ClassVar = replace(TIMING, backoff=QUIET, backoff_limit=QUIET)

    def __init__(self, config: PolledConfig, orders: Orders) -> None:
        """Take the set-up; the box is not known before it answers."""
        super().__init__(config, orders)
        self._needs_quiet = False
        self._last_request = 0.0
        self.leaves = False
        """It was stopped for good: Home Assistant goes."""

    # -- What it keeps in its memory -------------------------------------------------

    @property
    @override
    def settings(self) -> Mapping[Setting, Range]:
        ranges = dict(super().settings)
        if self.configuration is None or not ranges:
            return ranges
        # With a minimum above the maximum no car could charge at all.
        told = self.configuration.settings
        own = ranges[Setting.MAXIMUM_CURRENT]
        least = min(max(own.minimum, told[Setting.MINIMUM_CURRENT]), own.maximum)
        ranges[Setting.MAXIMUM_CURRENT] = replace(own, minimum=least)
        own = ranges[Setting.MINIMUM_CURRENT]
        most = max(min(own.maximum, told[Setting.MAXIMUM_CURRENT]), own.minimum)
        ranges[Setting.MINIMUM_CURRENT] = replace(own, maximum=most)
        return ranges

    # -- When ------------------------------------------------------------------------

    @property
    @override
    def exchanges_per_turn(self) -> int:
        # Dialect (2), status, settings (2), access and current, both read back.
        return 10

    @override
    def minimum_pause(self, now: float) -> float:
        if self.dialect is not None:
            self._needs_quiet = self.dialect is Dialect.LATER
        if not self._needs_quiet:
            return 0.0
        # Any request counts, whoever it is for and whoever of us has sent it.
        sent_at = self.bus.wire.sent_at if self.bus is not None else None
        self._last_request = max(self._last_request, sent_at or 0.0)
        return max(0.0, self._last_request + QUIET - now)

    @override
    def plan(self, now: float) -> None:
        super().plan(now)
        # A little after the quiet: a command that waited for its end goes first.
        quiet = now + self.minimum_pause(now) + COMMANDS_FIRST
        if self._needs_quiet:
            self.slot.ready = self.slot.due = max(self.slot.ready, quiet)

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        if self.minimum_pause(turn.now) > 0:
            message = f"{self.config.name} is to be left alone: others have asked"
            raise LineBusyError(message)
        return await super().poll(turn)

    # -- Who else is there -------------------------------------------------------------

    @override
    async def write(self, turn: Turn, request: Request, register: int) -> bool | None:
        self._check_alone()
        return await super().write(turn, request, register)

    @property
    @override
    def shares_address(self) -> bool:
        others = self.bus is not None and len(self.bus.chargers) > 1
        return self.config.address == 0 and others

    def _check_alone(self) -> None:
        """Raise SharedAddressError where a write would reach others too.

        2.17 without load balancing has the address at which all others listen.
        """
        if self.shares_address:
            self.notice(Fault.DUPLICATE_ADDRESS, present=True)
            message = (
                f"{self.config.name} has address 0, at which every SmartEVSE listens: "
                "nothing is written while others are on its bus"
            )
            raise SharedAddressError(message)

    # -- The end ---------------------------------------------------------------------

    @override
    async def on_shutdown(self, *, removed: bool = False) -> None:
        if removed or not self.config.stop_on_shutdown:
            return
        # A start half done would come to its end after this.
        self.leaves = True
        await self.run(
            partial(self.set_access, allowed=False),
            persistence=Persistence.STANDING,
            kind=Kind.PAUSE,
        )
