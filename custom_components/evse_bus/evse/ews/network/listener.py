"""The server that EWS-Boxes dial: who is there, and which bus is theirs.

A box is asked ``id`` and ``rs``, and nothing else before its serial number is one that
is set up; then it belongs to the bus of that number. Nothing here can tell a box from
somebody who gives its number (the protocol has no authentication), so a number that is
connected and answers keeps its connection, and addresses can be restricted.
"""

import asyncio
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
import errno
from ipaddress import IPv4Network, IPv6Network
import logging
from math import inf
from typing import Final

from ...bus import Bus
from ...errors import EvseError, LineError, PortBusyError, PortMissingError
from ...exchange import Turn, Wire
from ...framing import Frame
from ...line import line_error
from ...statistics import ChargerStatistics
from ...throttle import LOSSES, LOSSES_WINDOW, RateLimiter
from ..box import EwsBox, Ports
from ..charger import EwsPort
from ..timing import TCP_TIMING
from ..wire.frames import EwsFrame, EwsFramer, MessageId
from .line import AcceptedLine, Address, Connection

_LOGGER = logging.getLogger(__name__)

type Network = IPv4Network | IPv6Network

IDENTIFY_TIME: Final = 10.0
"""Longest time to say who one is, s."""
MOST_UNIDENTIFIED: Final = 16
"""Connections that have not said yet who they are, at once, beside one for each box
that is set up: after a power cut all of them dial in the same moment."""
GRACE: Final = 1.0
"""One of those that is older may have to go for a newer one, s."""
MOST_STRANGERS: Final = 8
"""Connections of boxes that are not set up, at once."""
STRANGER_TIME: Final = 40.0
"""Such a connection is kept for so long, s: hung up on, it would dial all the time."""
PROOF_TIME: Final = 10.0
"""Longest time for a connected box to show that it is still there, s."""
PROOF_PAUSE: Final = 1.0
"""Shortest time between two such questions to one box, s."""
_MAPPED: Final = 96
"""Length of what stands before an address of IPv4 that is written as one of IPv6."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stranger:
    """A box that has dialled and is not set up."""

    serial: str
    firmware: str
    peer: Address | None


@dataclass(slots=True)
class ListenerStatistics:
    """What became of those who dialled."""

    accepted: int = 0
    not_allowed: int = 0
    """From an address that may not connect."""
    crowded_out: int = 0
    """One too many that had not said who they are."""
    unidentified: int = 0
    """Did not say who they are, or not in time."""
    strangers: int = 0
    seconds: int = 0
    """Gave the number of a box that is connected and answers."""
    replaced: int = 0
    """Took the place of a connection that did not answer any more."""


class Listener:
    """One address and port, and any number of boxes."""

    def __init__(
        self,
        host: str,
        port: int,
        *,
        allowed: Iterable[Network] = (),
        on_stranger: Callable[[Stranger], None] = lambda _stranger: None,
    ) -> None:
        """Listen at an address; port 0: any that is free (see `port`).

        ``allowed``: networks that may connect; none: all may. ``on_stranger`` is
        called each time that a box dials which is not set up.
        """
        self.host = host
        self.port = port
        self.allowed = tuple(map(_plain, allowed))
        self.on_stranger = on_stranger
        self.statistics = ListenerStatistics()
        self._server: asyncio.Server | None = None
        self._buses: dict[str, Bus] = {}
        self._unidentified: dict[Connection, float] = {}
        self._identified: dict[Connection, Stranger] = {}
        """All others that are open, whatever became of them."""
        self._strangers: dict[str, Connection] = {}
        self._bound: dict[str, Connection] = {}
        """Those that belong to the bus of a box."""
        self._timers: dict[Connection, asyncio.TimerHandle] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._asking: set[str] = set()
        self._asked_at: dict[str, float] = {}
        self._warned: set[str] = set()
        self._warnings = RateLimiter(LOSSES, LOSSES_WINDOW)

    # -- Life ------------------------------------------------------------------------

    @property
    def is_listening(self) -> bool:
        """Return whether boxes can dial."""
        return self._server is not None

    async def start(self) -> None:
        """Begin to listen.

        Raises PortBusyError for a port that is taken, PortMissingError for an address
        that is not ours, PortPermissionError, or LineError.
        """
        if self._server is not None:
            return
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(
                lambda: Connection(self._on_connection, self._on_gone),
                self.host,
                self.port,
            )
        except (OSError, OverflowError, ValueError) as error:
            raise _error(error) from error
        self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        """Listen no more; buses keep their connections until they are stopped."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        bound = set(self._bound.values())
        for connection in {*self._unidentified, *self._identified} - bound:
            connection.abort()
        tasks = tuple(self._tasks)
        for task in tasks:
            task.cancel()
        for task in tasks:
            with suppress(asyncio.CancelledError):
                await task

    def allow(self, networks: Iterable[Network]) -> None:
        """Let only these networks connect from now on; none: all may.

        Connections from elsewhere end at once, also those of boxes that are set up.
        """
        self.allowed = tuple(map(_plain, networks))
        for connection in (*self._unidentified, *self._identified):
            if not self._is_allowed(connection.peer):
                self.statistics.not_allowed += 1
                connection.abort()

    # -- Boxes that are set up -------------------------------------------------------

    def expect(self, serial: str, name: str = "") -> Bus:
        """Return the bus of a box; it waits until the box dials.

        Put ports on it and start it. One that has dialled already as a stranger
        begins at once. ``name`` is what the log calls it.
        """
        if (known := self._buses.get(serial)) is not None:
            return known
        framer = EwsFramer()
        line = AcceptedLine(name or f"EWS-Box {serial}", lambda: framer.noise)
        bus = self._buses[serial] = Bus(line, framer, TCP_TIMING, name, group=Ports())
        if (stranger := self._strangers.pop(serial, None)) is not None:
            self._keep_for_good(stranger)
            self._bound[serial] = stranger
            line.attach(stranger)
        return bus

    async def forget(self, serial: str) -> None:
        """Let a box be a stranger from now on; its bus is stopped."""
        bus = self._buses.pop(serial, None)
        if bus is not None:
            await bus.stop()

    # -- Who is there ----------------------------------------------------------------

    @property
    def strangers(self) -> tuple[Stranger, ...]:
        """Return the boxes that are connected now and not set up."""
        return tuple(self._identified[one] for one in self._strangers.values())

    @property
    def peers(self) -> Mapping[str, Address | None]:
        """Return from where the boxes that are set up are connected now, by number."""
        return {serial: one.peer for serial, one in self._bound.items()}

    def _on_gone(self, connection: Connection) -> None:
        self._unidentified.pop(connection, None)
        self._keep_for_good(connection)
        known = self._identified.pop(connection, None)
        if known is None:
            return
        for table in (self._strangers, self._bound):
            if table.get(known.serial) is connection:
                del table[known.serial]

    def _keep_for_good(self, connection: Connection) -> None:
        """Stop the timer that would end a connection."""
        if (timer := self._timers.pop(connection, None)) is not None:
            timer.cancel()

    def _on_connection(self, connection: Connection) -> None:
        if self._server is None or not self._is_allowed(connection.peer):
            self.statistics.not_allowed += 1
            connection.abort()
            return
        if not self._has_room():
            self.statistics.crowded_out += 1
            connection.abort()
            return
        self.statistics.accepted += 1
        self._unidentified[connection] = asyncio.get_running_loop().time()
        task = asyncio.create_task(self._welcome(connection), name="EWS-Box dials")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _is_allowed(self, peer: Address | None) -> bool:
        if not self.allowed:
            return True
        return peer is not None and any(peer in network for network in self.allowed)

    def _has_room(self) -> bool:
        """Return whether one more may say who he is; the slowest goes for him."""
        if len(self._unidentified) < MOST_UNIDENTIFIED + len(self._buses):
            return True
        oldest, since = next(iter(self._unidentified.items()))
        if asyncio.get_running_loop().time() - since < GRACE:
            return False
        self.statistics.crowded_out += 1
        oldest.abort()
        return True

    async def _welcome(self, connection: Connection) -> None:
        try:
            async with asyncio.timeout(IDENTIFY_TIME):
                stranger = await _identify(connection)
        except (TimeoutError, EvseError) as error:
            _LOGGER.debug("Somebody did not say who it is: %s", error)
            self.statistics.unidentified += 1
            connection.abort()
            return
        self._unidentified.pop(connection, None)
        self._identified[connection] = stranger
        if (bus := self._buses.get(stranger.serial)) is None:
            self._keep_stranger(stranger, connection)
        elif await self._may_replace(stranger, bus, connection):
            self._bind(stranger.serial, bus, connection)

    def _keep_stranger(self, stranger: Stranger, connection: Connection) -> None:
        self.statistics.strangers += 1
        serial = stranger.serial
        if (before := self._strangers.get(serial)) is not None:
            before.abort()
        if len(self._strangers) >= MOST_STRANGERS:
            connection.abort()
        else:
            self._strangers[serial] = connection
            self._timers[connection] = asyncio.get_running_loop().call_later(
                STRANGER_TIME, connection.abort
            )
        try:
            self.on_stranger(stranger)
        except Exception:
            _LOGGER.exception("A listener failed")

    async def _may_replace(
        self, stranger: Stranger, bus: Bus, connection: Connection
    ) -> bool:
        """Return whether this connection may be the box's: the old one is asked."""
        line, serial = bus.line, stranger.serial
        if not isinstance(line, AcceptedLine) or not line.is_open:
            return True
        if serial in self._asking:
            self._refuse(stranger, bus, connection)
            return False
        self._asking.add(serial)
        try:
            await self._pause_asking(serial)
            _ask_now(bus)
            alive = await line.answers(PROOF_TIME)
        finally:
            self._asking.discard(serial)
        if alive:
            self._refuse(stranger, bus, connection)
            return False
        self.statistics.replaced += 1
        line.end("another connection has its number, and this one does not answer")
        return connection.is_open

    async def _pause_asking(self, serial: str) -> None:
        """Wait: whoever dials all the time does not keep the box busy with us."""
        loop = asyncio.get_running_loop()
        before = self._asked_at.get(serial, -inf)
        await asyncio.sleep(before + PROOF_PAUSE - loop.time())
        self._asked_at[serial] = loop.time()

    def _refuse(self, stranger: Stranger, bus: Bus, connection: Connection) -> None:
        self.statistics.seconds += 1
        connection.abort()
        now = asyncio.get_running_loop().time()
        if stranger.serial in self._warned or not self._warnings.take(now):
            return
        self._warned.add(stranger.serial)
        message = "%s says that it is %s, which is connected and answers"
        _LOGGER.warning(message, stranger.peer, bus.name)

    def _bind(self, serial: str, bus: Bus, connection: Connection) -> None:
        if self._buses.get(serial) is not bus or not isinstance(bus.line, AcceptedLine):
            connection.abort()
            return
        self._warned.discard(serial)
        self._bound[serial] = connection
        bus.line.attach(connection)
        bus.reschedule()


async def _identify(connection: Connection) -> Stranger:
    """Ask ``id`` and ``rs``; raises EvseError when that comes to nothing."""
    framer = EwsFramer()
    line = AcceptedLine("somebody", lambda: framer.noise)
    wire = Wire(line, framer, TCP_TIMING)
    line.on_lost = wire.fail
    early: list[bytes] = []

    def unasked(frame: Frame) -> bool:
        told = isinstance(frame, EwsFrame) and frame.message_id is MessageId.INFO
        if told:
            # What has happened at the box meanwhile is for its bus.
            early.append(frame.raw)
        return told

    wire.on_unsolicited = unasked
    line.attach(connection)
    await line.open()
    box = EwsBox()
    await box.identify(Turn(wire, ChargerStatistics()))
    status = box.status
    if status is None or not connection.is_open:
        raise LineError("the connection has ended")
    connection.line = None
    line.release()
    connection.keep(b"".join(early))
    return Stranger(
        serial=status.serial, firmware=status.firmware, peer=connection.peer
    )


def _plain(network: Network) -> Network:
    """Return a network of IPv4 as one, also if it is written in the way of IPv6."""
    mapped = getattr(network.network_address, "ipv4_mapped", None)
    if mapped is None or network.prefixlen < _MAPPED:
        return network
    return IPv4Network((mapped, network.prefixlen - _MAPPED))


def _ask_now(bus: Bus) -> None:
    for charger in bus.chargers.values():
        if isinstance(charger, EwsPort):
            charger.ask_now()


def _error(error: Exception) -> LineError:
    code = getattr(error, "errno", None)
    if code == errno.EADDRINUSE:
        return PortBusyError(str(error))
    # None of a host's addresses being ours comes without a code, as does what is no
    # host; a link-local address without its interface (fe80::1%eth0) is invalid.
    if code in (errno.EADDRNOTAVAIL, errno.EINVAL, None):
        return PortMissingError(str(error))
    return line_error(error)
