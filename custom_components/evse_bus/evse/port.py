"""The port of one bus: opened, lost, opened again; the one owner of its state.

`recovery.py` decides when it is opened again; the bus decides what follows from that
for its chargers and commands.
"""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from enum import Enum, auto
import logging
from math import inf
from typing import Final

from .errors import LineError, LineLostError, PortMissingError
from .exchange import Wire
from .gateway import STEADY
from .throttle import LogThrottle
from .timer import WakeTimer

_LOGGER = logging.getLogger(__name__)


class PortState(Enum):
    """State of a port; what it means for the chargers."""

    CLOSED = auto()
    """Not open yet, or not any more: nothing is known of them."""
    OPEN = auto()
    INTERRUPTED = auto()
    """Closed, and opened again at once: they are as they were until that fails."""
    LOST = auto()
    """Cannot be opened: they are unavailable."""


_CONNECTED: Final = (PortState.OPEN, PortState.INTERRUPTED)


class Port:
    """The port of one bus."""

    def __init__(self, wire: Wire, name: str, timer: WakeTimer) -> None:
        """Take over a closed line; ``timer`` is woken when its state has changed."""
        self.name = name
        """For the log."""
        self.state = PortState.CLOSED
        self.on_open: Callable[[bool], None] = lambda _is_new: None
        """Called when it is open; the argument: it was not `connected` before."""
        self.on_closed: Callable[[LineLostError], None] = lambda _error: None
        """Called when it is closed: no exchange under way can end."""
        self.on_lost: Callable[[LineLostError], None] = lambda _error: None
        """Called when it cannot be opened again at once."""
        self._wire = wire
        self._timer = timer
        self._why = LineLostError("")
        """Why it was interrupted."""
        self._given_up = False
        self._is_silent = False
        """It was renewed because no byte came."""
        self._log = LogThrottle(opened_by_peer=wire.line.opened_by_peer)
        wire.line.on_lost = self.line_lost

    @property
    def connected(self) -> bool:
        """Return whether it is open, as far as the chargers are concerned."""
        return self.state in _CONNECTED

    @property
    def renew_at(self) -> float:
        """Return when a silent line is to be opened anew, loop time; inf: never."""
        # A box that dials finds out by itself, and dials again.
        if self._given_up or self._wire.line.opened_by_peer:
            return inf
        return self._wire.recovery.renew_at

    async def open(self) -> None:
        """Open it for the first time; raises LineError.

        A line that the other end opens may be opened later.
        """
        self._given_up = False
        line = self._wire.line
        try:
            await self._open_line()
        except PortMissingError:
            if not line.opened_by_peer:
                raise
        if line.is_open:
            self._opened()

    async def reopen(self) -> bool:
        """Open it again, however long it takes; False after `give_up`.

        At once where its connection has worked until now.
        """
        wire = self._wire
        while True:
            if self.state is not PortState.INTERRUPTED and not self._given_up:
                now = asyncio.get_running_loop().time()
                await self._timer.sleep_until(now + wire.recovery.next_pause())
            if self._given_up:
                return False
            try:
                await self._open_line()
            except LineError as error:
                _LOGGER.debug("%s: the port is still missing: %s", self.name, error)
                if self.state is PortState.INTERRUPTED:
                    self._lost(self._why)
                continue
            self._opened()
            await self._ask_gateway()
            return True

    async def _ask_gateway(self) -> None:
        """Ask a network adapter that has never passed on a frame what it speaks."""
        wire = self._wire
        if not (self._is_silent and wire.line.is_network):
            return
        self._is_silent = False
        if not wire.gateway.ever_understood:
            with suppress(LineError):
                await wire.ask_gateway()

    async def renew(self) -> None:
        """Close a line on which no byte comes any more; it is opened anew at once."""
        _LOGGER.debug("%s: no reply any more, the port is opened anew", self.name)
        wire = self._wire
        wire.recovery.renewed()
        self._is_silent = True
        wire.statistics.renewed += 1
        error = LineLostError("no reply any more, the port is opened anew")
        self._interrupted(error)
        await wire.line.close()

    def give_up(self) -> None:
        """Do not open it again: the bus stops."""
        self._given_up = True
        self._timer.wake()

    async def close(self) -> None:
        """Close it for good."""
        self.state = PortState.CLOSED
        await self._wire.line.close()

    def line_lost(self, error: LineLostError) -> None:
        """Take note that the line is gone, by no act of ours."""
        now = asyncio.get_running_loop().time()
        self._wire.gateway.lost(now)
        if self.state is not PortState.OPEN:
            # While it was being opened: that attempt has failed.
            return
        if self._wire.recovery.works(now) and not self._wire.line.opened_by_peer:
            # Some adapters close an idle connection: it is opened again at once, and
            # a charger that then answers was never unavailable.
            self._interrupted(error)
        else:
            self._wire.fail(error)
            self.on_closed(error)
            self._lost(error)
        self._timer.wake()

    async def _open_line(self) -> None:
        """Open the line; raises LineError."""
        wire, loop = self._wire, asyncio.get_running_loop()
        await wire.line.open()
        wire.gateway.opened(loop.time())
        if wire.gateway.suspected:
            await asyncio.sleep(STEADY)
            if not wire.line.is_open:
                message = f"{self.name} was closed as soon as it was open"
                raise LineLostError(message)

    def _opened(self) -> None:
        before = self.state
        self.state = PortState.OPEN
        self._wire.reset()
        if before is not PortState.CLOSED:
            self._wire.statistics.reopened += 1
        if before is PortState.LOST:
            self._log.back(self.name)
        self.on_open(before not in _CONNECTED)

    def _interrupted(self, error: LineLostError) -> None:
        self.state = PortState.INTERRUPTED
        self._why = error
        self._wire.fail(error)
        self.on_closed(error)

    def _lost(self, error: LineLostError) -> None:
        self.state = PortState.LOST
        self._log.lost(self.name, error, asyncio.get_running_loop().time())
        self.on_lost(error)
