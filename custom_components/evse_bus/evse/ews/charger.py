"""One port of an EWS-Box: what to ask, what to check, what to say again.

The box is read first, always, and must be the right one. The limit is said again
whenever ``rd`` tells another one; a car that charges against the orders is paused; but
nothing is ever started by itself. PROTOCOLS.md, 4; docs/ews-protocol.md.
"""

from contextlib import suppress
from math import inf
from typing import override

from ..errors import (
    EvseError,
    ImplausibleReplyError,
    NotAvailableError,
)
from ..exchange import Talk
from ..framing import Frame
from ..jobs import Later
from ..model import (
    ChargerConfig,
    Command,
    OrderChange,
    Orders,
)
from ..safety import clamp
from ..turns import in_turns, rest
from .commanding import conversation
from .config import ews_config
from .frames import EwsFrame
from .info import decode_info
from .reader import EwsReader
from .services import Services
from .session import EwsBox
from .timing import (
    ASSERT_PAUSE,
    FRESH,
    INFO_PAUSE,
)


class EwsPort(EwsReader):
    """One port; all ports of a bus are of one box."""

    def __init__(self, config: ChargerConfig, orders: Orders) -> None:
        """Take the set-up; the box is not known before it answers."""
        super().__init__(config, orders)
        self.services = Services(self)
        self._urgent_at = -inf
        self._urgent_waits = False

    @override
    def on_line_open(self) -> None:
        super().on_line_open()
        self._urgent_waits = False

    @override
    def set_up(self, config: ChargerConfig) -> None:
        zone = ews_config(config).time_zone
        if zone != ews_config(self.config).time_zone:
            self.box.check_clock()
        # A lower limit does not wait because something else has failed just now.
        self._assert_after = -inf
        super().set_up(config)

    # -- The regular exchange ------------------------------------------------------

    @override
    async def poll(self, talk: Talk) -> Later[None] | None:
        box = self.box
        if not box.known or box.installation is None:
            return await in_turns(self._meet)(talk)
        try:
            await box.refresh(talk, talk.now - FRESH * self.config.poll_interval)
        except ImplausibleReplyError:
            self.hold_back()
            raise
        self.take()
        return self._what_now(talk.now)

    async def _meet(self, talk: Talk) -> None:
        await self.ready(talk)
        self.hurry()

    # -- What must be so ---------------------------------------------------------------

    def _what_now(self, now: float) -> Later[None] | None:
        """Return what must be said because of a reading."""
        if self.busy:
            return None
        self.limiter.check()
        # A car that must not charge is never waited for.
        if not self.permission.must_pause(self.setpoint) and (
            now < self._assert_after or not self._must_tend(now)
        ):
            return None
        return Later(0.0, in_turns(self._tend))

    def _must_tend(self, now: float) -> bool:
        box = self.box
        zone = ews_config(self.config).time_zone
        return (
            self.limiter.must_assert()
            or now >= box.parameters_due
            or box.clock_is_wrong(zone, now)
        )

    async def _tend(self, talk: Talk) -> None:
        with self.conversing():
            # Not again at once, whatever comes of it.
            self._assert_after = talk.now + ASSERT_PAUSE
            await self._assert(talk)
        self._assert_after = -inf

    async def _assert(self, talk: Talk) -> None:
        if self.permission.must_pause(self.setpoint):
            ours = self.effective_orders.allowed is not False
            await self.permission.pause(talk, for_current=ours)
            await rest(0.0)
        if self.limiter.must_assert():
            self.limiter.count()
            await self.limiter.enforce(talk, lambda: self.effective_orders)
            await rest(0.0)
        await self.ready(talk)
        box = self.box
        if talk.now >= box.parameters_due:
            await box.read_parameters(talk)
            await self.ready(talk)
        zone = ews_config(self.config).time_zone
        if zone is not None and box.clock_is_wrong(zone, talk.now):
            await box.set_clock(talk, zone)

    # -- Orders ------------------------------------------------------------------------

    @override
    async def impose(self, talk: Talk, orders: Orders, change: OrderChange) -> None:
        with self.conversing():
            await self.ready(talk)
            if clamp(self.sought(change), self.limits).paused:
                ours = self.sought(change).allowed is not False
                await self.permission.pause(talk, for_current=ours)
                self._check_possible(change)
                return
            await self.limiter.enforce(talk, lambda: self.sought(change))
            if not self.permission.may_start(change):
                return

            def still() -> bool:
                # Not where a pause came meanwhile: that one is on its way.
                return not clamp(self.sought(change), self.limits).paused

            await rest(0.0)
            await self.permission.start(
                talk, still, for_current=change.allowed is not True
            )

    def _check_possible(self, change: OrderChange) -> None:
        """Raise NotAvailableError where charging was allowed, and can never begin.

        A household socket has 16 A or nothing (2.2.1).
        """
        limits = self.limits
        if change.allowed is True and limits.ceiling < limits.minimum:
            message = (
                f"{self.config.name} needs {limits.minimum:g} A, "
                f"and no more than {limits.ceiling:g} A may be offered"
            )
            raise NotAvailableError(message)

    @override
    async def command(
        self, command: Command, value: bool | int | str | None = None
    ) -> None:
        talks = conversation(self, command, value)
        if talks is None:
            await super().command(command, value)
            return
        await self.run(in_turns(talks))

    # -- What it says unasked ------------------------------------------------------------

    @override
    def on_unsolicited(self, frame: Frame) -> Later[None] | None:
        if not isinstance(frame, EwsFrame):
            return None
        try:
            info = decode_info(frame)
        except ImplausibleReplyError:
            return None
        if info is None or self.bus is None:
            return None
        # The first port that is asked hears it for both.
        self.box.hear(info)
        if self._urgent_waits:
            return Later(0.0, _nothing)
        self._urgent_waits = True
        now = self.bus.now
        pause = max(0.0, self._urgent_at + INFO_PAUSE - now)
        self._urgent_at = now + pause
        for other in self.bus.chargers.values():
            if isinstance(other, EwsPort):
                other.hurry(self._urgent_at)
        return Later(pause, self._urgent)

    async def _urgent(self, talk: Talk) -> Later[None] | None:
        """Poll out of turn."""
        self._urgent_waits = False
        try:
            later = await self.poll(talk)
        except EvseError:
            # The regular poll is due as well, and finds the same.
            self.box.ports_at = -inf
            raise
        self.heard(talk.now)
        self.plan(talk.now)
        self._tell_others()
        return later

    def _tell_others(self) -> None:
        """Let the other port take what the box told: its own turn may be far away."""
        if self.bus is None or not self.box.known or not self.box.ports:
            return
        for other in self.bus.chargers.values():
            if other is not self and isinstance(other, EwsPort) and other.available:
                with suppress(EvseError):
                    other.take()


async def _nothing(_talk: Talk) -> None:
    """Do nothing: another job has it already."""


__all__ = ["EwsBox", "EwsPort"]
