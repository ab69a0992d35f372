"""One port of an EWS-Box: its regular exchange, and its orders.

The box is always read first, and must be the right one. The limit is sent again
whenever ``rd`` reports another one, and a car that charges against the orders is
paused; but nothing is ever started without the user. PROTOCOLS.md, 4;
docs/ews-protocol.md.
"""

from math import inf
from typing import override

from ..conversation import FollowUp, nothing, rest
from ..errors import EvseError, ImplausibleReplyError, NotAvailableError
from ..exchange import Turn
from ..framing import Frame
from ..model import ChargerConfig, Command, Fault, OrderChange, Orders
from ..pause_watch import FOLLOW_TIME, NO_CURRENT
from ..safety import clamp
from .config import EwsPortConfig
from .port_commands import PortCommands
from .reader import EwsReader
from .services import Services
from .timing import FRESH, INFO_PAUSE, REASSERT_PAUSE
from .wire.frames import EwsFrame
from .wire.info import decode_info


class EwsPort(EwsReader):
    """One port; all ports of a bus belong to one box."""

    def __init__(self, config: EwsPortConfig, orders: Orders) -> None:
        """Take the configuration; the box is unknown before it answers."""
        super().__init__(config, orders)
        self.services = Services(self)
        self._commands = PortCommands(self, self.permission)
        self._reassert_after = -inf
        self._urgent_at = -inf
        self._urgent_waits = False

    @override
    def on_line_open(self) -> None:
        super().on_line_open()
        self.permission.on_lost()
        self._reassert_after = -inf
        self._urgent_waits = False

    @override
    def reconfigure(self, config: ChargerConfig) -> None:
        zone = self.config.time_zone
        # A lower limit is sent at once, whatever has failed just now.
        self._reassert_after = -inf
        super().reconfigure(config)
        if self.config.time_zone != zone:
            self.box.check_clock_soon()

    # -- The regular exchange ----------------------------------------------------------

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        box = self.box
        if not box.identified or box.installation is None:
            await self.ready(turn)
            self.hurry()
            return None
        try:
            await box.refresh(turn, turn.now - FRESH * self.config.poll_interval)
        except ImplausibleReplyError:
            self.on_implausible()
            raise
        self.take_status()
        self.watch_pause(
            turn.now,
            shown=self.reading is not None and self.reading.allowed is False,
            patience=FOLLOW_TIME if self._flows else None,
        )
        return self._next_action(turn.now)

    @property
    def _flows(self) -> bool:
        """Return whether a car charges, by the status or by the power of the port."""
        if self.reading is None:
            return False
        connector = self.reading.connectors[self.number]
        power = connector.power or 0.0
        # The sum of the phases: so much on one of them.
        return connector.charging is True or power > NO_CURRENT * self.config.voltage

    # -- Maintenance -------------------------------------------------------------------

    def _next_action(self, now: float) -> FollowUp | None:
        """Return a conversation that the last readings require."""
        if self.busy:
            return None
        must_pause = self.permission.must_pause(self.setpoint)
        if not must_pause and not self.limiter.must_reassert():
            self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
        # A car that must not charge is paused at once.
        if must_pause or (now >= self._reassert_after and self._must_maintain(now)):
            return FollowUp(self._maintain)
        return None

    def _must_maintain(self, now: float) -> bool:
        return (
            self.limiter.must_reassert()
            or now >= self.box.parameters_due
            or self.box.must_set_clock(self.config.time_zone, now)
        )

    async def _maintain(self, turn: Turn) -> None:
        with self.conversing():
            # After a failure, not again at once.
            self._reassert_after = turn.now + REASSERT_PAUSE
            await self._reassert(turn)
        self._reassert_after = -inf

    async def _reassert(self, turn: Turn) -> None:
        if self.permission.must_pause(self.setpoint):
            allowed = self.effective_orders.allowed is not False
            await self.permission.pause(turn, for_current=allowed)
            await rest(0.0)
        if self.limiter.must_reassert():
            self.limiter.count_reassertion()
            await self.limiter.enforce(turn, lambda: self.effective_orders)
            await rest(0.0)
        await self.ready(turn)
        box = self.box
        if turn.now >= box.parameters_due:
            await box.read_parameters(turn)
            await self.ready(turn)
        zone = self.config.time_zone
        if zone is not None and box.must_set_clock(zone, turn.now):
            await box.set_clock(turn, zone)

    # -- Orders ------------------------------------------------------------------------

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        with self.conversing():
            await self.ready(turn)
            if self._is_pause(change):
                allowed = self.order_to_send(change).allowed is not False
                await self.permission.pause(turn, for_current=allowed)
                self._check_possible(change)
                if change.allowed is True and self.order_to_send(change).allowed:
                    self.permission.withhold_start()
                return
            await self.limiter.enforce(turn, lambda: self.order_to_send(change))
            if not self.permission.may_start(change):
                return
            await rest(0.0)
            await self.permission.start(
                turn,
                # Not after a newer pause, which waits for its own turn.
                lambda: not self._is_pause(change),
                for_current=change.allowed is not True,
            )

    @override
    async def follow_ceiling(self, turn: Turn) -> None:
        with self.conversing():
            await self.ready(turn)
            if self.setpoint.paused:
                allowed = self.effective_orders.allowed is not False
                await self.permission.pause(turn, for_current=allowed)
                return
            await self.limiter.enforce(turn, lambda: self.effective_orders)
            if not self._may_resume:
                return
            await rest(0.0)
            await self.permission.start(
                turn, lambda: self._may_resume, for_current=True
            )

    @property
    def _may_resume(self) -> bool:
        """Return whether a higher ceiling ends a pause, or a wait for current.

        Expired orders that are a pause by themselves are none of the ceiling's.
        """
        ordered = clamp(self.orders, self.limits)
        paused = ordered.paused or self.setpoint.paused
        return self.permission.waits_for_current and not paused

    def _is_pause(self, change: OrderChange) -> bool:
        return clamp(self.order_to_send(change), self.limits).paused

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
            raise NotAvailableError(
                message,
                "ews_maximum_too_low",
                minimum=f"{limits.minimum:g}",
                maximum=f"{limits.ceiling:g}",
            )

    @override
    async def command(
        self, command: Command, value: bool | int | str | None = None
    ) -> None:
        conversation = self._commands.conversation(command, value)
        if conversation is None:
            await super().command(command, value)
        else:
            await self.run(conversation)

    # -- Info records ------------------------------------------------------------------

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
        # The bus offers it to one port only, which processes it for the box.
        self.box.on_info(info)
        if self._urgent_waits:
            return FollowUp(nothing)
        self._urgent_waits = True
        now = self.bus.now
        pause = max(0.0, self._urgent_at + INFO_PAUSE - now)
        self._urgent_at = now + pause
        self.group.hurry(self._urgent_at)
        return FollowUp(self._poll_out_of_turn, pause)

    async def _poll_out_of_turn(self, turn: Turn) -> None:
        self._urgent_waits = False
        try:
            follow_up = await self.poll(turn)
        except EvseError:
            # The regular poll is due as well, and finds the same.
            self.box.expire_ports()
            raise
        self.on_reply(turn.now)
        self.plan(turn.now)
        # The turn of the other port may be far away.
        self.group.share_status(self)
        if follow_up is not None:
            await rest()
            await follow_up.conversation(turn)
