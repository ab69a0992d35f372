"""One port of an EWS-Box: what to ask, what to check, what to say again.

The box is read first, always, and must be the right one. The limit is said again
whenever ``rd`` tells another one; a car that charges against the orders is paused; but
nothing is ever started by itself. PROTOCOLS.md, 4; docs/ews-protocol.md.
"""

from contextlib import suppress
from math import inf
from typing import override

from ..conversation import FollowUp, nothing, rest
from ..errors import (
    EvseError,
    ImplausibleReplyError,
    NotAvailableError,
)
from ..exchange import Turn
from ..framing import Frame
from ..model import (
    ChargerConfig,
    Command,
    OrderChange,
    Orders,
)
from ..safety import clamp
from .box import EwsBox
from .config import EwsPortConfig
from .port_commands import conversation
from .reader import EwsReader
from .services import Services
from .timing import (
    FRESH,
    INFO_PAUSE,
    REASSERT_PAUSE,
)
from .wire.frames import EwsFrame
from .wire.info import decode_info


class EwsPort(EwsReader):
    """One port; all ports of a bus are of one box."""

    def __init__(self, config: EwsPortConfig, orders: Orders) -> None:
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
    def reconfigure(self, config: ChargerConfig) -> None:
        zone = self.config.time_zone
        # A lower limit does not wait because something else has failed just now.
        self._reassert_after = -inf
        super().reconfigure(config)
        if self.config.time_zone != zone:
            self.box.check_clock()

    # -- The regular exchange ------------------------------------------------------

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        box = self.box
        if not box.known or box.installation is None:
            await self.ready(turn)
            self.hurry()
            return None
        try:
            await box.refresh(turn, turn.now - FRESH * self.config.poll_interval)
        except ImplausibleReplyError:
            self.hold_back()
            raise
        self.take()
        return self._next_action(turn.now)

    # -- What must be so ---------------------------------------------------------------

    def _next_action(self, now: float) -> FollowUp | None:
        """Return what must be said because of a reading."""
        if self.busy:
            return None
        self.limiter.check()
        # A car that must not charge is never waited for.
        if not self.permission.must_pause(self.setpoint) and (
            now < self._reassert_after or not self._must_maintain(now)
        ):
            return None
        return FollowUp(self._maintain)

    def _must_maintain(self, now: float) -> bool:
        box = self.box
        zone = self.config.time_zone
        return (
            self.limiter.must_reassert()
            or now >= box.parameters_due
            or box.clock_is_wrong(zone, now)
        )

    async def _maintain(self, turn: Turn) -> None:
        with self.conversing():
            # Not again at once, whatever comes of it.
            self._reassert_after = turn.now + REASSERT_PAUSE
            await self._reassert(turn)
        self._reassert_after = -inf

    async def _reassert(self, turn: Turn) -> None:
        if self.permission.must_pause(self.setpoint):
            ours = self.effective_orders.allowed is not False
            await self.permission.pause(turn, for_current=ours)
            await rest(0.0)
        if self.limiter.must_reassert():
            self.limiter.count()
            await self.limiter.enforce(turn, lambda: self.effective_orders)
            await rest(0.0)
        await self.ready(turn)
        box = self.box
        if turn.now >= box.parameters_due:
            await box.read_parameters(turn)
            await self.ready(turn)
        zone = self.config.time_zone
        if zone is not None and box.clock_is_wrong(zone, turn.now):
            await box.set_clock(turn, zone)

    # -- Orders ------------------------------------------------------------------------

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        with self.conversing():
            await self.ready(turn)
            if clamp(self.order_to_send(change), self.limits).paused:
                ours = self.order_to_send(change).allowed is not False
                await self.permission.pause(turn, for_current=ours)
                self._check_possible(change)
                return
            await self.limiter.enforce(turn, lambda: self.order_to_send(change))
            if not self.permission.may_start(change):
                return

            def still() -> bool:
                # Not where a pause came meanwhile: that one is on its way.
                return not clamp(self.order_to_send(change), self.limits).paused

            await rest(0.0)
            await self.permission.start(
                turn, still, for_current=change.allowed is not True
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
        commanded = conversation(self, command, value)
        if commanded is None:
            await super().command(command, value)
            return
        await self.run(commanded)

    # -- What it says unasked ------------------------------------------------------------

    @override
    def on_unsolicited(self, frame: Frame) -> FollowUp | None:
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
            return FollowUp(nothing)
        self._urgent_waits = True
        now = self.bus.now
        pause = max(0.0, self._urgent_at + INFO_PAUSE - now)
        self._urgent_at = now + pause
        for other in self.bus.chargers.values():
            if isinstance(other, EwsPort):
                other.hurry(self._urgent_at)
        return FollowUp(self._urgent, pause)

    async def _urgent(self, turn: Turn) -> None:
        """Poll out of turn."""
        self._urgent_waits = False
        try:
            follow_up = await self.poll(turn)
        except EvseError:
            # The regular poll is due as well, and finds the same.
            self.box.ports_at = -inf
            raise
        self.on_reply(turn.now)
        self.plan(turn.now)
        self._tell_others()
        if follow_up is not None:
            await rest()
            await follow_up.conversation(turn)

    def _tell_others(self) -> None:
        """Let the other port take what the box told: its own turn may be far away."""
        if self.bus is None or not self.box.known or not self.box.ports:
            return
        for other in self.bus.chargers.values():
            if other is not self and isinstance(other, EwsPort) and other.available:
                with suppress(EvseError):
                    other.take()


__all__ = ["EwsBox", "EwsPort"]
