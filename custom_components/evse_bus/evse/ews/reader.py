"""What is known of one port of an EWS-Box, and how it is asked.

The box must be the right one before anything is believed or said. PROTOCOLS.md, 4.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from math import inf
from typing import ClassVar, Final, override

from ..charger import Charger
from ..errors import NotAvailableError, WrongChargerError
from ..exchange import Turn
from ..model import Capability, Fault, Limits, Orders
from .box import EwsBox
from .config import EwsPortConfig
from .events import (
    ChargeStarted,
    Event,
    Listener,
    charge_ended,
    port_of,
    start_requested,
)
from .limit import Limiter
from .network.line import AcceptedLine
from .permission import Permission
from .readings import (
    RUNNING,
    asks_for_start,
    capabilities_of,
    charger_info,
    charger_reading,
    limits_of,
)
from .timing import COMMAND_MARGIN, COMMAND_TIMEOUT, TIMING
from .wire.frames import LONGEST_FRAME
from .wire.parameters import SystemMode
from .wire.status import PortStatus

_SOONER: Final = 1.0
"""A slow poll comes so much before the deadline, s."""
NOT_UNDERSTOOD: Final = 3
"""Answers in a row that cannot be, until nothing said before counts any more."""


class EwsReader(Charger[EwsPortConfig]):
    """One port, as far as it is asked and not told."""

    timing: ClassVar = TIMING

    def __init__(self, config: EwsPortConfig, orders: Orders) -> None:
        """Take the set-up; the box is not known before it answers."""
        super().__init__(config, orders)
        self.port: Final = config.port
        self.seen: PortStatus | None = None
        """What ``rc`` told last of this port."""
        self.box = EwsBox()
        """The box, shared with the other port of this bus."""
        self.permission = Permission(self)
        self.limiter = Limiter(self)
        self._reassert_after = -inf
        self._charges = False
        self._running: PortStatus | None = None
        """How the port was when a charge was last seen under way."""
        self._not_understood = 0
        self._restarts = 0

    # -- What it is and has --------------------------------------------------------

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
    def ends_in_silence(self) -> bool | None:
        installation = self.box.installation
        if installation is None or installation.mode is None:
            return None
        return SystemMode.SERVER in installation.mode

    @property
    @override
    def fingerprint(self) -> tuple[object, ...]:
        status = self.box.status
        # Its clock runs: that is no news.
        without = None if status is None else replace(status, clock=None)
        return (*super().fingerprint, self.seen, self.more, without)

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
        self._reassert_after = -inf

    # -- When ------------------------------------------------------------------------

    @override
    def plan(self, now: float) -> None:
        super().plan(now)
        self._meet_deadline(now)

    @override
    def on_reply(self, now: float) -> None:
        is_back = not self.available
        super().on_reply(now)
        if is_back and self.bus is not None:
            # It is there for its other port, too: that one waits for no next try.
            for other in self.bus.chargers.values():
                if isinstance(other, EwsReader) and not other.available:
                    other.hurry()

    @override
    def on_missed(self, now: float) -> None:
        super().on_missed(now)
        self._meet_deadline(now)

    def _meet_deadline(self, now: float) -> None:
        """Let the box never wait for 30 s: the first port's deadline is the box's.

        It moves with what any port says, or the others would wait for it in vain.
        """
        self.slot.start_by = inf
        if self.bus is None:
            return
        slot = next(iter(self.bus.chargers.values()), self).slot
        deadline = self.box.heard_at + COMMAND_TIMEOUT - COMMAND_MARGIN
        if deadline > now:
            slot.ready = min(slot.ready, deadline - _SOONER)
            slot.due = min(slot.due, deadline - _SOONER)
            slot.start_by = deadline
        else:
            slot.start_by = inf

    def hurry(self, at: float = -inf) -> None:
        """Poll as soon as the bus is free, but not before a loop time."""
        self.slot.ready = min(self.slot.ready, at)
        self.slot.due = min(self.slot.due, at)
        if self.bus is not None:
            self.bus.reschedule()

    def ask_now(self) -> None:
        """Poll as soon as the bus is free, however fresh what is known may be."""
        self.box.ports_at = -inf
        self.hurry()

    # -- Who it is, and what it says -------------------------------------------------

    async def ready(self, turn: Turn) -> None:
        """Make sure that we know whom we talk to.

        Raises WrongChargerError for another box, and what `EwsBox.read` raises.
        """
        box = self.box
        while not box.known or box.installation is None:
            await box.meet(turn)
        self._check_identity()

    def _check_identity(self) -> None:
        found, expected = self.box.serial, self.config.serial
        self.notice(
            Fault.WRONG_CHARGER, present=expected is not None and found != expected
        )
        if expected is not None and found is not None and found != expected:
            self.set_unavailable()
            if self.bus is not None and isinstance(self.bus.line, AcceptedLine):
                # It would keep out the one whose number it gave when it dialled.
                self.bus.line.end("another box answers")
            message = f"{self.config.name}: another box answers"
            raise WrongChargerError(message, expected=expected, found=found)

    def hold_back(self) -> None:
        """Note an answer that cannot be; too many in a row are no reading."""
        self._not_understood += 1
        if self._not_understood >= NOT_UNDERSTOOD:
            self._not_understood = 0
            self.notice(Fault.IMPLAUSIBLE, present=True)
            self.set_unavailable()

    async def look(self, turn: Turn) -> PortStatus:
        """Read how the port is right now; the box must be `ready`.

        Raises NotAvailableError for a port that there is not.
        """
        await self.box.look(turn)
        return self.take()

    async def look_now(self, turn: Turn) -> PortStatus:
        """Look; once more if a record came that says it is not so any more."""
        seen = await self.look(turn)
        if self.box.ports_at == -inf:
            seen = await self.look(turn)
        return seen

    def take(self) -> PortStatus:
        """Make a reading of what the box told last.

        Raises NotAvailableError for a port that there is not.
        """
        self._check_identity()
        box = self.box
        installed = box.installation.ports if box.installation else self.port
        self.notice(Fault.NO_SUCH_PORT, present=installed < self.port)
        if len(box.ports) < self.port:
            self.set_unavailable()
            message = f"{self.config.name}: the box has no port {self.port}"
            raise NotAvailableError(message)
        before, seen = self.seen, box.ports[self.port - 1]
        if box.restarts != self._restarts:
            self._restarts = box.restarts
            self.limiter.forget()
            # Flags may stay for long: what follows from a restart is seen.
            self.permission.doubt()
        self.permission.watch(seen)
        self.seen = seen
        self._tell_events(before, seen)
        self._not_understood = 0
        self.notice(Fault.IMPLAUSIBLE, present=False)
        if box.status is not None and (self.info is None or self._is_news(box.serial)):
            self.info = charger_info(box.status)
        if (told := box.told) is not None:
            known = self.permission.paused
            paused = None if known is None else self.permission.is_paused(seen)
            self.reading = charger_reading(self.port, told, paused=paused)
        if self.fingerprint != self.last_fingerprint:
            self.updated()
        return seen

    def _is_news(self, serial: str | None) -> bool:
        info = self.info
        return info is None or (info.serial, info.firmware) != (
            serial,
            self.box.status.firmware if self.box.status else None,
        )

    # -- Conversations -----------------------------------------------------------------

    # -- Events and faults -------------------------------------------------------------

    def subscribe_events(self, listener: Listener) -> Callable[[], None]:
        """Call back for each event at this port or at its box; return how to stop."""

        def mine(event: Event) -> None:
            if port_of(event) in (None, self.port):
                listener(event)

        return self.box.events.subscribe(mine)

    def _tell_events(self, before: PortStatus | None, seen: PortStatus) -> None:
        was_on = self._charges
        is_on = self._charges = self.permission.is_session(seen, was=was_on)
        if seen.status in RUNNING:
            self._running = seen
        events = self.box.events
        asked = before is not None and asks_for_start(before)
        if asks_for_start(seen) and not asked:
            events.tell(start_requested(self.port, seen))
        if was_on and not is_on:
            events.tell(charge_ended(self.port, self._running, seen))
        elif is_on and not was_on and before is not None:
            # Else it may have begun before our time.
            events.tell(ChargeStarted(port=self.port))
