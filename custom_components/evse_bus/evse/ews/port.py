"""The conversation with one port of an EWS-Box, and the box that the ports share.

`BoxPort` identifies the box, reads its own status and sends orders; `BoxPorts` owns the
box of one bus and knows its ports. `reader` and `charger` build on it and decide.
PROTOCOLS.md, 4.
"""

from abc import abstractmethod
import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from math import inf
from typing import ClassVar, Final, override

from ..charger import Charger
from ..conversation import rest
from ..errors import (
    EvseError,
    NotAvailableError,
    ReplyTimeoutError,
    SupersededError,
    WrongChargerError,
)
from ..exchange import Turn
from ..master import ChargerGroup
from ..memory import LineMemory
from ..model import Fault, Orders
from .box import BoxMemory, EwsBox
from .config import EwsPortConfig
from .timing import COMMAND_MARGIN, COMMAND_TIMEOUT, TIMING
from .wire.frames import LONGEST_FRAME, CommandId, Request
from .wire.status import PortStatus

READS: Final = 3
"""Attempts to read in the course of a command."""
_SOONER: Final = 1.0
"""A poll due later than the box's deadline is moved to this time before it, s."""


class BoxPorts(ChargerGroup):
    """One box and its ports: all chargers of one bus."""

    def __init__(self, on_wrong_box: Callable[[], None] = lambda: None) -> None:
        """``on_wrong_box`` is called when another box answers than was set up."""
        self.box = EwsBox()
        self.on_wrong_box = on_wrong_box
        self._ports: list[BoxPort] = []

    @override
    def resume(self, memory: LineMemory) -> None:
        self.box.memory = memory.of(BoxMemory)

    @override
    def added(self, charger: Charger) -> None:
        if not isinstance(charger, BoxPort):
            message = f"{charger.config.name} is no port of an EWS-Box"
            raise TypeError(message)
        self._ports.append(charger)
        charger.group = self

    @override
    def removed(self, charger: Charger) -> None:
        self._ports = [one for one in self._ports if one is not charger]
        if not self._ports:
            # The next one may be the port of another box.
            self.box.forget()

    # -- When they are polled ------------------------------------------------------

    def hurry(self, at: float = -inf) -> None:
        """Poll all ports as soon as the bus is free, but not before a loop time."""
        for port in self._ports:
            port.hurry(at)

    def poll_now(self) -> None:
        """Poll all ports as soon as the bus is free, however recent their status is."""
        self.box.expire_ports()
        self.hurry()

    def port_is_back(self) -> None:
        """Poll the ports that do not answer: one does, so the box is there."""
        for port in self._ports:
            if not port.available:
                port.hurry()

    def set_deadline(self, now: float) -> None:
        """Make the first port's next poll keep the connection alive.

        A box hangs up after `COMMAND_TIMEOUT` without a command to any port. So the
        deadline is the box's: one port has it, and commands to any port move it.
        """
        deadline = self.box.last_answered_at + COMMAND_TIMEOUT - COMMAND_MARGIN
        for port in self._ports:
            port.slot.start_by = inf
        if self._ports and deadline > now:
            slot = self._ports[0].slot
            slot.ready = min(slot.ready, deadline - _SOONER)
            slot.due = min(slot.due, deadline - _SOONER)
            slot.start_by = deadline

    # -- Their status ----------------------------------------------------------------

    def share_status(self, source: BoxPort) -> None:
        """Let the other ports take their status from the reading by ``source``."""
        if not self.box.identified or not self.box.ports:
            return
        for port in self._ports:
            if port is not source and port.available:
                with suppress(EvseError):
                    port.take_status()


class BoxPort(Charger[EwsPortConfig]):
    """One port: identity of its box, its status, orders to it, and its polls."""

    timing: ClassVar = TIMING

    def __init__(self, config: EwsPortConfig, orders: Orders) -> None:
        """Take the configuration; the box is unknown before it answers."""
        super().__init__(config, orders)
        self.number: Final = config.port
        """1 or 2."""
        self.group = BoxPorts()
        """The box and its ports; that of the bus, once the port is on one."""
        self.last_status: PortStatus | None = None
        """Status of this port by the last ``rc``; ``None``: not read since the
        connect."""

    @property
    def box(self) -> EwsBox:
        """Return the box, shared with the other port of the bus."""
        return self.group.box

    @property
    def now(self) -> float:
        """Return the loop time, s."""
        return asyncio.get_running_loop().time()

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
            line = self.bus.line
            self.box.on_line_open(line.statistics.opened, checked=line.opened_by_peer)
        self.last_status = None

    # -- Identity --------------------------------------------------------------------

    async def ready(self, turn: Turn) -> None:
        """Identify the box if it is not known, and check that it is the right one.

        Nothing is sent to a port before. Raises WrongChargerError for another box,
        and what `EwsBox.read` raises.
        """
        box = self.box
        while not box.identified or box.installation is None:
            await self.read(turn, box.identify)
        self._check_identity()

    async def read[T](
        self, turn: Turn, conversation: Callable[[Turn], Awaitable[T]]
    ) -> T:
        """Read from the box; a command under way does not fail for one lost reply.

        After a lost reply the box is identified anew. Raises what it raises in the end.
        """
        for _ in range(READS - 1):
            try:
                await self.box.identify(turn)
                return await conversation(turn)
            except ReplyTimeoutError:
                if not self.busy:
                    raise
            await rest(0.0)
        await self.box.identify(turn)
        return await conversation(turn)

    def _check_identity(self) -> None:
        found, expected = self.box.serial, self.config.serial
        is_wrong = self.is_wrong(found, expected)
        self.notice(Fault.WRONG_CHARGER, present=is_wrong)
        if is_wrong and found is not None:
            self.set_unavailable("another box answers")
            self.group.on_wrong_box()
            message = f"{self.config.name}: another box answers"
            raise WrongChargerError(message, expected=expected, found=found)

    # -- Its status ------------------------------------------------------------------

    async def read_status(self, turn: Turn) -> PortStatus:
        """Read the status of the port (``rc``); the box must be `ready`.

        Raises NotAvailableError for a port that the box does not have, and what
        `EwsBox.read` raises.
        """
        await self.read(turn, self.box.read_ports)
        return self.take_status()

    async def read_fresh_status(self, turn: Turn) -> PortStatus:
        """Read the status; once more if an info record came that outdated it."""
        status = await self.read_status(turn)
        if self.box.ports_expired:
            status = await self.read_status(turn)
        return status

    def take_status(self) -> PortStatus:
        """Take the port's status from the last reading of the box.

        Raises NotAvailableError for a port that the box does not have.
        """
        self._check_identity()
        self._check_number()
        before, status = self.last_status, self.box.ports[self.number - 1]
        self.last_status = status
        self.on_status(before, status)
        return status

    @abstractmethod
    def on_status(self, before: PortStatus | None, status: PortStatus) -> None:
        """Draw conclusions from a status that was read.

        ``before``: the status before it; ``None``: first since the connect.
        """

    def _check_number(self) -> None:
        installation = self.box.installation
        missing = installation is not None and installation.ports < self.number
        self.notice(Fault.NO_SUCH_PORT, present=missing)
        if len(self.box.ports) < self.number:
            why = f"the box has no port {self.number}"
            self.set_unavailable(why)
            message = f"{self.config.name}: {why}"
            raise NotAvailableError(message)

    # -- Orders to it ----------------------------------------------------------------

    async def send_order(self, turn: Turn, make: Callable[[], Request]) -> bool:
        """Send an order of ``sl`` that fits the status just read in this turn.

        Returns whether it was answered: a lost reply decides nothing, the next status
        does. Raises SupersededError, and sends nothing, when an info record came since
        the status was read; EwsRefusedError, and what `EwsBox.read` raises.
        """
        infos = self.box.info_count

        def request() -> Request:
            if self.box.info_count != infos:
                message = f"{self.config.name}: its status has just changed"
                raise SupersededError(message)
            return make()

        try:
            await self.box.send_command(turn, CommandId.START_STOP, request)
        except ReplyTimeoutError:
            return False
        return True

    # -- When it is polled -----------------------------------------------------------

    @override
    def plan(self, now: float) -> None:
        super().plan(now)
        self._set_deadline(now)

    @override
    def on_reply(self, now: float) -> None:
        is_back = not self.available
        super().on_reply(now)
        if is_back and self.bus is not None:
            self.group.port_is_back()

    @override
    def on_missed(self, now: float, why: str) -> None:
        super().on_missed(now, why)
        self._set_deadline(now)

    def _set_deadline(self, now: float) -> None:
        if self.bus is None:
            self.slot.start_by = inf
        else:
            self.group.set_deadline(now)

    def hurry(self, at: float = -inf) -> None:
        """Poll as soon as the bus is free, but not before a loop time."""
        self.slot.ready = min(self.slot.ready, at)
        self.slot.due = min(self.slot.due, at)
        if self.bus is not None:
            self.bus.reschedule()

    def poll_now(self) -> None:
        """Poll as soon as the bus is free, however recent the status is."""
        self.box.expire_ports()
        self.hurry()
