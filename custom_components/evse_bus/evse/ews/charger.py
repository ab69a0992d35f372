"""One port of an EWS-Box: what to ask, what to check, what to say again.

The box is read first, always, and must be the right one. The limit is said again
whenever ``rd`` tells another one; a car that charges against the orders is paused; but
nothing is ever started by itself. PROTOCOLS.md, 4; docs/ews.md.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from math import inf
from typing import ClassVar, Final, override

from ..charger import Charger
from ..errors import (
    EvseError,
    ImplausibleReplyError,
    NotAvailableError,
    WrongChargerError,
)
from ..exchange import Talk
from ..framing import Frame
from ..jobs import Later
from ..model import (
    Capability,
    ChargerConfig,
    Command,
    Fault,
    Limits,
    OrderChange,
    Orders,
)
from ..safety import clamp
from ..turns import Turns, in_turns
from .commanding import conversation
from .config import ews_config
from .events import (
    ChargeEnded,
    ChargeStarted,
    Event,
    Listener,
    StartRequested,
    port_of,
)
from .frames import LONGEST_FRAME, EwsFrame
from .info import decode_info
from .limiting import Limiter
from .permission import Permission
from .readings import capabilities_of, charger_info, charger_reading, limits_of
from .services import Services
from .session import EwsBox
from .status import PortStatus, StartRelease
from .timing import (
    ASSERT_PAUSE,
    COMMAND_MARGIN,
    COMMAND_TIMEOUT,
    FRESH,
    INFO_PAUSE,
    TIMING,
)

_SOONER: Final = 1.0
"""A slow poll comes so much before the deadline, s."""
NOT_UNDERSTOOD: Final = 3
"""Answers in a row that cannot be, until nothing said before counts any more."""


class EwsPort(Charger):
    """One port; all ports of a bus are of one box."""

    timing: ClassVar = TIMING

    def __init__(self, config: ChargerConfig, orders: Orders) -> None:
        """Take the set-up; the box is not known before it answers."""
        super().__init__(config, orders)
        self.port: Final = ews_config(config).port
        self.seen: PortStatus | None = None
        """What ``rc`` told last of this port."""
        self._own_box = EwsBox()
        self.permission = Permission(self)
        self.limiter = Limiter(self)
        self.services = Services(self)
        self._conversations: set[object] = set()
        self._assert_after = -inf
        self._charges = False
        self._not_understood = 0
        self._restarts = 0
        self._urgent_at = -inf
        self._urgent_waits = False

    # -- What it is and has --------------------------------------------------------

    @property
    def box(self) -> EwsBox:
        """Return the box, shared with the other port of this bus."""
        bus = self.bus
        if bus is None:
            return self._own_box
        if not isinstance(bus.shared, EwsBox):
            bus.shared = EwsBox()
        return bus.shared

    @property
    @override
    def capabilities(self) -> frozenset[Capability]:
        known = capabilities_of(self.port, self.box.installation)
        if self.config.order_lifetime is not None:
            # The box has no such value; it counts when orders are not renewed.
            known |= {Capability.FAIL_SAFE_CURRENT}
        return known

    @property
    @override
    def limits(self) -> Limits:
        box = self.box
        own = self.config.installation_limit
        return limits_of(self.port, own, box.status, box.installation, self.seen)

    @property
    @override
    def waits_for_current(self) -> bool:
        return self.permission.waits_for_current

    @property
    @override
    def told(self) -> tuple[object, ...]:
        status = self.box.status
        # Its clock runs: that is no news.
        without = None if status is None else replace(status, clock=None)
        return (*super().told, self.seen, self.more, without)

    @property
    def more(self) -> tuple[object, ...]:
        """Return what ``rd`` told last of this port, in the order of `Details`."""
        details = self.box.details
        if details is None:
            return ()
        pairs = (getattr(details, one.name) for one in fields(details))
        return tuple(pair[self.port - 1] for pair in pairs)

    @property
    @override
    def longest_request(self) -> int:
        return LONGEST_FRAME

    @property
    @override
    def exchanges_per_turn(self) -> int:
        # rc, rd, rs; or rc, st, rd; or rc and sl.
        return 3

    @override
    def on_line_open(self) -> None:
        if self.bus is not None:
            self.box.line_opened(self.bus.line.statistics.opened)
        self.seen = None
        self.limiter.forget()
        # A conversation that was cut short with the line does not come to its end.
        self._conversations.clear()
        self._assert_after = -inf
        self._urgent_waits = False

    # -- When ------------------------------------------------------------------------

    @override
    def plan(self, now: float) -> None:
        super().plan(now)
        self._meet_deadline(now)

    @override
    def missed(self, now: float) -> None:
        super().missed(now)
        self._meet_deadline(now)

    def _meet_deadline(self, now: float) -> None:
        """Let the box never wait for 30 s: one port's deadline is the box's."""
        slot = self.slot
        deadline = self.box.heard_at + COMMAND_TIMEOUT - COMMAND_MARGIN
        slot.start_by = inf
        if self._leads and deadline > now:
            slot.ready = min(slot.ready, deadline - _SOONER)
            slot.due = min(slot.due, deadline - _SOONER)
            slot.start_by = deadline

    @property
    def _leads(self) -> bool:
        bus = self.bus
        return bus is not None and next(iter(bus.chargers.values()), None) is self

    def hurry(self, at: float = -inf) -> None:
        """Poll as soon as the bus is free, but not before a loop time."""
        self.slot.ready = min(self.slot.ready, at)
        self.slot.due = min(self.slot.due, at)
        if self.bus is not None:
            self.bus.look_again()

    def ask_now(self) -> None:
        """Poll as soon as the bus is free, however fresh what is known may be."""
        self.box.ports_at = -inf
        self.hurry()

    # -- The regular exchange ------------------------------------------------------

    @override
    async def poll(self, talk: Talk) -> Later[None] | None:
        box = self.box
        if not box.known or box.installation is None:
            return await in_turns(self._meet)(talk)
        try:
            await box.refresh(talk, talk.now - FRESH * self.config.poll_interval)
        except ImplausibleReplyError:
            self._hold_back()
            raise
        self.take()
        return self._what_now(talk.now)

    async def _meet(self, talk: Talk) -> Turns:
        async for pause in self.ready(talk):
            yield pause
        self.hurry()

    async def ready(self, talk: Talk) -> Turns:
        """Make sure that we know whom we talk to.

        Raises WrongChargerError for another box, and what `EwsBox.read` raises.
        """
        box = self.box
        while not box.known or box.installation is None:
            async for pause in box.meet(talk):
                yield pause
        self._check_identity()

    def _check_identity(self) -> None:
        found, expected = self.box.serial, self.config.serial
        self.tell(
            Fault.WRONG_CHARGER, present=expected is not None and found != expected
        )
        if expected is not None and found is not None and found != expected:
            self.set_unavailable()
            message = f"{self.config.name}: {found} answers, not {expected}"
            raise WrongChargerError(message, expected=expected, found=found)

    def _hold_back(self) -> None:
        """Note an answer that cannot be; too many in a row are no reading."""
        self._not_understood += 1
        if self._not_understood >= NOT_UNDERSTOOD:
            self._not_understood = 0
            self.notice(Fault.IMPLAUSIBLE, present=True)
            self.set_unavailable()

    async def look(self, talk: Talk) -> PortStatus:
        """Read how the port is right now; the box must be `ready`.

        Raises NotAvailableError for a port that there is not.
        """
        await self.box.look(talk)
        return self.take()

    def take(self) -> PortStatus:
        """Make a reading of what the box told last.

        Raises NotAvailableError for a port that there is not.
        """
        self._check_identity()
        box = self.box
        if len(box.ports) < self.port:
            message = f"{self.config.name}: the box has no port {self.port}"
            raise NotAvailableError(message)
        before, seen = self.seen, box.ports[self.port - 1]
        if box.restarts != self._restarts:
            self._restarts = box.restarts
            self.limiter.forget()
            self.permission.forget()
        self.permission.watch(seen)
        self.seen = seen
        self._tell_events(before, seen)
        self._not_understood = 0
        self.notice(Fault.IMPLAUSIBLE, present=False)
        if box.status is not None and (self.info is None or self._is_news(box.serial)):
            self.info = charger_info(box.status)
        if (told := box.told) is not None:
            paused = self.permission.is_paused(seen)
            self.reading = charger_reading(self.port, told, paused=paused)
        if self.told != self.last_told:
            self.updated()
        return seen

    def _is_news(self, serial: str | None) -> bool:
        info = self.info
        return info is None or (info.serial, info.firmware) != (
            serial,
            self.box.status.firmware if self.box.status else None,
        )

    # -- What must be so ---------------------------------------------------------------

    def _what_now(self, now: float) -> Later[None] | None:
        """Return what must be said because of a reading."""
        if self._conversations:
            return None
        self.limiter.check()
        if now < self._assert_after or not self._must_tend(now):
            return None
        return Later(0.0, in_turns(self._tend))

    def _must_tend(self, now: float) -> bool:
        box = self.box
        zone = ews_config(self.config).time_zone
        return (
            self.permission.must_pause(self.setpoint)
            or self.limiter.must_assert()
            or now >= box.parameters_due
            or box.clock_is_wrong(zone, now)
        )

    async def _tend(self, talk: Talk) -> Turns:
        token = self.begin()
        # Not again at once, whatever comes of it.
        self._assert_after = talk.now + ASSERT_PAUSE
        try:
            async for pause in self._assert(talk):
                yield pause
        finally:
            self.end(token)
        self._assert_after = -inf

    async def _assert(self, talk: Talk) -> Turns:
        if self.permission.must_pause(self.setpoint):
            ours = self.effective_orders.allowed is not False
            async for pause in self.permission.pause(talk, for_current=ours):
                yield pause
            yield 0.0
        if self.limiter.must_assert():
            self.limiter.count()
            async for pause in self.limiter.enforce(
                talk, lambda: self.effective_orders
            ):
                yield pause
            yield 0.0
        async for pause in self.ready(talk):
            yield pause
        box = self.box
        if talk.now >= box.parameters_due:
            async for pause in box.read_parameters(talk):
                yield pause
            async for pause in self.ready(talk):
                yield pause
        zone = ews_config(self.config).time_zone
        if zone is not None and box.clock_is_wrong(zone, talk.now):
            await box.set_clock(talk, zone)

    # -- Orders ------------------------------------------------------------------------

    @override
    async def impose(
        self, talk: Talk, orders: Orders, change: OrderChange
    ) -> Later[None] | None:
        return await in_turns(partial(self._impose, change))(talk)

    async def _impose(self, change: OrderChange, talk: Talk) -> Turns:
        token = self.begin()
        try:
            async for pause in self.ready(talk):
                yield pause
            if clamp(self.sought(change), self.limits).paused:
                ours = self.sought(change).allowed is not False
                async for pause in self.permission.pause(talk, for_current=ours):
                    yield pause
                return
            async for pause in self.limiter.enforce(talk, lambda: self.sought(change)):
                yield pause
            if not self.permission.may_start(change):
                return

            def still() -> bool:
                # Not where a pause came meanwhile: that one is on its way.
                return not clamp(self.sought(change), self.limits).paused

            yield 0.0
            async for pause in self.permission.start(talk, still):
                yield pause
        finally:
            self.end(token)

    @override
    async def command(
        self, command: Command, value: bool | int | str | None = None
    ) -> None:
        talks = conversation(self, command, value)
        if talks is None:
            await super().command(command, value)
            return
        await self.run(in_turns(talks))

    def begin(self) -> object:
        """Note that a conversation began: until it ends, polls only read."""
        token = object()
        self._conversations.add(token)
        return token

    def end(self, token: object) -> None:
        """Note that a conversation is over."""
        self._conversations.discard(token)

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
        return later

    def subscribe_events(self, listener: Listener) -> Callable[[], None]:
        """Call back for each event at this port or at its box; return how to stop."""

        def mine(event: Event) -> None:
            if port_of(event) in (None, self.port):
                listener(event)

        return self.box.events.subscribe(mine)

    def _tell_events(self, before: PortStatus | None, seen: PortStatus) -> None:
        was_on = self._charges
        is_on = self._charges = self.permission.is_session(seen, was=was_on)
        events = self.box.events
        asked = StartRelease.REQUESTED
        if seen.start is asked and (before is None or before.start is not asked):
            events.tell(StartRequested(port=self.port))
        if before is None:
            return
        if is_on and not was_on:
            events.tell(ChargeStarted(port=self.port))
        elif was_on and not is_on:
            events.tell(ChargeEnded(port=self.port, result=seen.result))

    # -- Faults of our own finding ---------------------------------------------------------

    def tell(self, fault: Fault, *, present: bool) -> None:
        """Note a fault, and tell the listeners of a change."""
        if present != (fault in self.noticed):
            self.notice(fault, present=present)
            self.updated()


async def _nothing(_talk: Talk) -> None:
    """Do nothing: another job has it already."""


__all__ = ["EwsBox", "EwsPort"]
