"""The server that EWS-Boxes dial: it identifies them, and gives each to its bus.

A box is asked for ``id`` and ``rs``, and for nothing else before its serial number is
known to be a registered one; then it belongs to the bus of that number. The protocol
has no authentication: nothing here can tell a box from another device that gives its
number. So a connection that answers keeps its number, and addresses can be restricted.
Addresses of registered boxes are remembered: places are kept for them (`admission`).
"""

import asyncio
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
import errno
from functools import partial
from ipaddress import IPv4Network
import logging
from math import inf
from typing import Final

from ...bus import Bus
from ...dialling import (
    Address,
    ListenerStatistics,
    Network,
    NewAddressCallback,
    UnknownBox,
    UnknownBoxCallback,
)
from ...errors import EvseError, LineError, PortBusyError, PortMissingError
from ...exchange import Turn, Wire
from ...framing import Frame
from ...line import line_error
from ...memory import LineMemory
from ...statistics import ChargerStatistics
from ...throttle import LOSSES, LOSSES_WINDOW, RateLimiter
from ..box import BoxMemory, EwsBox
from ..port import BoxPorts
from ..readings import charger_info
from ..timing import TCP_TIMING
from ..wire.frames import EwsFrame, EwsFramer, MessageId
from .admission import Admission
from .line import AcceptedLine, Connection

_LOGGER = logging.getLogger(__name__)

IDENTIFY_TIME: Final = 10.0
"""Longest time for a connection to be identified, s."""
ACCEPTED_AT_ONCE: Final = 8
"""Connections accepted in one round of the event loop, and one more."""
QUEUE: Final = 128
"""Connections that the system keeps until they are accepted."""
MOST_UNKNOWN: Final = 8
"""Most connections of unknown boxes at once."""
UNKNOWN_TIME: Final = 40.0
"""An unknown box is kept connected for so long, s: dropped, it would dial again at
once."""
PROOF_TIME: Final = 10.0
"""Longest time for a connected box to answer when another gives its number, s."""
PROOF_MARGIN: Final = 0.5
"""Time for the same beside its reply time-out, when the other connection comes from the
same address: then it is the box itself that has lost the first one, s."""
PROOF_PAUSE: Final = 1.0
"""Shortest time between two such requests to one box, s."""
ADDRESSES: Final = 3
"""Addresses remembered of one box: another device may have given its number."""
CROWD_LOGGED: Final = 3600.0
"""Shortest time between two warnings of a crowd, s."""
_MAPPED: Final = 96
"""Length of the prefix of an IPv4 address in the form of an IPv6 one, bits."""


@dataclass(slots=True, eq=False)
class _RegisteredBox:
    """A box with a bus of its own."""

    bus: Bus
    line: AcceptedLine
    ports: BoxPorts
    addresses: tuple[Address, ...]
    """From which it has dialled, the last one first."""


class Listener:
    """One address and port, and any number of boxes."""

    def __init__(
        self,
        host: str,
        port: int,
        *,
        allowed: Iterable[Network] = (),
        on_unknown_box: UnknownBoxCallback = lambda _box: None,
    ) -> None:
        """Take the address; port 0: any free one (see `port`).

        ``allowed``: networks that may connect; none: all may. ``on_unknown_box`` is
        called each time an unregistered box dials.
        """
        self.on_new_address: NewAddressCallback = lambda _serial, _addresses: None
        self.host = host
        self.port = port
        self.allowed = tuple(map(_plain, allowed))
        self.on_unknown_box = on_unknown_box
        self.statistics = ListenerStatistics()
        self._server: asyncio.Server | None = None
        self._registered: dict[str, _RegisteredBox] = {}
        self._unidentified: set[Connection] = set()
        self._admission = Admission[Connection](lambda: len(self._registered))
        self._identified: dict[Connection, UnknownBox] = {}
        """All other open connections."""
        self._unknown: dict[str, Connection] = {}
        """Those of unknown boxes."""
        self._bound: dict[str, Connection] = {}
        """Those that belong to the bus of a registered box."""
        self._timers: dict[Connection, asyncio.TimerHandle] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._proving: set[str] = set()
        """Boxes that are asked whether they still answer."""
        self._proved_at: dict[str, float] = {}
        self._warned: set[str] = set()
        self._warnings = RateLimiter(LOSSES, LOSSES_WINDOW)
        self._crowds = RateLimiter(1, CROWD_LOGGED)

    # -- Life ------------------------------------------------------------------------

    @property
    def is_listening(self) -> bool:
        """Return whether boxes can dial."""
        return self._server is not None

    async def start(self) -> None:
        """Begin to listen.

        Raises PortBusyError for a port in use, PortMissingError for an address that is
        not of this host, PortPermissionError, or LineError.
        """
        if self._server is not None:
            return
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(
                lambda: Connection(
                    self._on_connection, self._on_gone, self._may_receive
                ),
                self.host,
                self.port,
                backlog=ACCEPTED_AT_ONCE,
            )
            for one in self._server.sockets:
                # asyncio takes one number for both.
                with one.dup() as same:
                    same.listen(QUEUE)
        except (OSError, OverflowError, ValueError) as error:
            raise _error(error) from error
        self.port = self._server.sockets[0].getsockname()[1]

    async def stop(self) -> None:
        """Stop listening; buses keep their connections until they are stopped."""
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

        Connections from elsewhere end at once, also those of registered boxes.
        """
        self.allowed = tuple(map(_plain, networks))
        for connection in (*self._unidentified, *self._identified):
            if not _is_allowed(connection.peer, self.allowed):
                self.statistics.not_allowed += 1
                connection.abort()

    # -- Registered boxes ------------------------------------------------------------

    def register(
        self,
        serial: str,
        name: str = "",
        addresses: Iterable[Address] = (),
        memory: LineMemory | None = None,
    ) -> Bus:
        """Return the bus of a box; it waits until the box dials.

        The caller adds the ports and starts it. An unknown box of this number that is
        connected already is used at once. ``name`` is for log messages;
        ``addresses``: from which it has dialled before, the last one first;
        ``memory``: what is known of this box.
        """
        if (known := self._registered.get(serial)) is not None:
            return known.bus
        framer = EwsFramer()
        line = AcceptedLine(name or f"EWS-Box {serial}", lambda: framer.noise)
        if memory is not None:
            line.memory = memory
        # Otherwise it would keep out the box whose number it gave when it dialled.
        ports = BoxPorts(on_wrong_box=partial(line.end, "another box answers"))
        bus = Bus(line, framer, TCP_TIMING, name, group=ports)
        box = _RegisteredBox(bus, line, ports, tuple(addresses)[:ADDRESSES])
        self._registered[serial] = box
        self._keep_places()
        if (connection := self._unknown.pop(serial, None)) is not None:
            self._cancel_timer(connection)
            self._bound[serial] = connection
            self._note_address(serial, box, connection.peer)
            _hand_over(connection, line)
        return bus

    async def unregister(self, serial: str) -> None:
        """Stop the bus of a box; the box is an unknown one from now on."""
        box = self._registered.pop(serial, None)
        if box is not None:
            self._keep_places()
            await box.bus.stop()

    def excluded_by(self, networks: Iterable[Network]) -> Mapping[str, Address]:
        """Return the registered boxes that could not connect if only these may.

        By serial number, with the address; that of a box that is not connected is the
        last one known.
        """
        allowed = tuple(map(_plain, networks))
        last = {
            serial: box.line.peer or next(iter(box.addresses), None)
            for serial, box in self._registered.items()
        }
        return {
            serial: address
            for serial, address in last.items()
            if address is not None and not _is_allowed(address, allowed)
        }

    def _keep_places(self) -> None:
        boxes = self._registered.values()
        self._admission.keep_for({one for box in boxes for one in box.addresses})

    def _note_address(
        self, serial: str, box: _RegisteredBox, address: Address | None
    ) -> None:
        """Remember the address from which a box has dialled."""
        if address is None or box.addresses[:1] == (address,):
            return
        others = [one for one in box.addresses if one != address]
        box.addresses = (address, *others)[:ADDRESSES]
        self._keep_places()
        self.on_new_address(serial, box.addresses)

    @property
    def unknown_boxes(self) -> tuple[UnknownBox, ...]:
        """Return the boxes that are connected now and not registered."""
        return tuple(self._identified[one] for one in self._unknown.values())

    # -- Connections -----------------------------------------------------------------

    def _on_connection(self, connection: Connection) -> None:
        if self._server is None or not _is_allowed(connection.peer, self.allowed):
            self.statistics.not_allowed += 1
            connection.abort()
            return
        now = asyncio.get_running_loop().time()
        admitted, leaves = self._admission.enter(connection, connection.peer, now)
        if leaves is not None:
            leaves.abort()
        if leaves is not None or not admitted:
            self.statistics.crowded_out += 1
            self._warn_of_crowd(now)
        if not admitted:
            connection.abort()
            return
        self.statistics.accepted += 1
        self._unidentified.add(connection)
        task = asyncio.create_task(self._identify(connection), name="EWS-Box dials")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _on_gone(self, connection: Connection) -> None:
        self._no_longer_unidentified(connection)
        self._cancel_timer(connection)
        known = self._identified.pop(connection, None)
        if known is None:
            return
        for table in (self._unknown, self._bound):
            if table.get(known.serial) is connection:
                del table[known.serial]

    def _cancel_timer(self, connection: Connection) -> None:
        if (timer := self._timers.pop(connection, None)) is not None:
            timer.cancel()

    def _no_longer_unidentified(self, connection: Connection) -> None:
        self._unidentified.discard(connection)
        self._admission.leave(connection)

    def _may_receive(self, connection: Connection, count: int) -> bool:
        """Return whether bytes of a connection may be looked at."""
        now = asyncio.get_running_loop().time()
        if self._admission.may_receive(connection, count, now):
            return True
        self.statistics.over_budget += 1
        self._warn_of_crowd(now)
        return False

    def _warn_of_crowd(self, now: float) -> None:
        if self._crowds.take(now):
            _LOGGER.warning(
                "Port %s: connections of devices that are no known box were ended; "
                "there are too many, or they send too much",
                self.port,
            )

    async def _identify(self, connection: Connection) -> None:
        """Find out which box has dialled, and give the connection to its bus."""
        try:
            async with asyncio.timeout(IDENTIFY_TIME):
                found = await _read_identity(
                    connection, partial(self._note_answer, connection)
                )
        except (TimeoutError, EvseError) as error:
            _LOGGER.debug("A connection was not identified: %s", error)
            self.statistics.unidentified += 1
            connection.abort()
            return
        self._no_longer_unidentified(connection)
        self._identified[connection] = found
        if (box := self._registered.get(found.serial)) is None:
            self._keep_unknown(found, connection)
        elif await self._may_replace(found, box, connection):
            self._bind(found.serial, box, connection)

    def _note_answer(self, connection: Connection) -> None:
        now = asyncio.get_running_loop().time()
        self._admission.progressed(connection, now)

    def _keep_unknown(self, found: UnknownBox, connection: Connection) -> None:
        self.statistics.unknown += 1
        serial = found.serial
        if (before := self._unknown.get(serial)) is not None:
            before.abort()
        if len(self._unknown) >= MOST_UNKNOWN:
            connection.abort()
        else:
            self._unknown[serial] = connection
            self._timers[connection] = asyncio.get_running_loop().call_later(
                UNKNOWN_TIME, connection.abort
            )
        try:
            self.on_unknown_box(found)
        except Exception:
            _LOGGER.exception("A listener failed")

    def _bind(self, serial: str, box: _RegisteredBox, connection: Connection) -> None:
        if self._registered.get(serial) is not box:
            connection.abort()
            return
        self._warned.discard(serial)
        self._bound[serial] = connection
        self._note_address(serial, box, connection.peer)
        _hand_over(connection, box.line)
        box.bus.reschedule()

    # -- Two connections with one number -----------------------------------------------

    async def _may_replace(
        self, found: UnknownBox, box: _RegisteredBox, connection: Connection
    ) -> bool:
        """Return whether this connection may be the box's; checks the old one."""
        line, serial = box.line, found.serial
        if not line.is_open:
            return True
        if serial in self._proving:
            self._refuse(found, box.bus, connection)
            return False
        self._proving.add(serial)
        try:
            await self._wait_for_proof_pause(serial)
            box.ports.poll_now()
            answers = await line.answers(_proof_time(box, connection))
        finally:
            self._proving.discard(serial)
        if answers:
            self._refuse(found, box.bus, connection)
            return False
        self.statistics.replaced += 1
        line.end("another connection has its number, and this one does not answer")
        return connection.is_open

    async def _wait_for_proof_pause(self, serial: str) -> None:
        """Wait: a device that dials all the time must not keep the box busy."""
        loop = asyncio.get_running_loop()
        before = self._proved_at.get(serial, -inf)
        await asyncio.sleep(before + PROOF_PAUSE - loop.time())
        self._proved_at[serial] = loop.time()

    def _refuse(self, found: UnknownBox, bus: Bus, connection: Connection) -> None:
        self.statistics.duplicates += 1
        connection.abort()
        now = asyncio.get_running_loop().time()
        if found.serial in self._warned or not self._warnings.take(now):
            return
        self._warned.add(found.serial)
        message = "%s gives the number of %s, which is connected and answers"
        _LOGGER.warning(message, found.peer, bus.name)


def _proof_time(box: _RegisteredBox, connection: Connection) -> float:
    """Return the time in which a connected box has to answer, s."""
    if connection.peer is None or connection.peer != box.line.peer:
        return PROOF_TIME
    return min(box.bus.wire.round_trip.timeout + PROOF_MARGIN, PROOF_TIME)


def _hand_over(connection: Connection, line: AcceptedLine) -> None:
    """Give an identified connection, and the box's checksum, to the bus of a line."""
    learnt = connection.memory.of(BoxMemory)
    line.memory.of(BoxMemory).bcc = learnt.bcc
    line.attach(connection)


async def _read_identity(
    connection: Connection, on_answered: Callable[[], None]
) -> UnknownBox:
    """Read ``id`` and ``rs``; raises EvseError when the connection ends meanwhile.

    ``on_answered`` is called with each reply.
    """
    framer = EwsFramer()
    line = AcceptedLine("unidentified", lambda: framer.noise)
    line.on_answered = on_answered
    wire = Wire(line, framer, TCP_TIMING)
    line.on_lost = wire.fail
    infos: list[bytes] = []

    def keep_info(frame: Frame) -> bool:
        is_info = isinstance(frame, EwsFrame) and frame.message_id is MessageId.INFO
        if is_info:
            # An event at the box, for its bus.
            infos.append(frame.raw)
        return is_info

    wire.on_unsolicited = keep_info
    line.attach(connection)
    await line.open()
    box = EwsBox()
    box.memory = connection.memory.of(BoxMemory)
    status = await box.wait_for_status(Turn(wire, ChargerStatistics()))
    if not connection.is_open:
        raise LineError("the connection has ended")
    connection.line = None
    line.release()
    connection.keep(b"".join(infos))
    return UnknownBox(
        serial=status.serial, info=charger_info(status), peer=connection.peer
    )


def _is_allowed(peer: Address | None, allowed: Collection[Network]) -> bool:
    """Return whether an address may connect; ``allowed``: none: all may."""
    if not allowed:
        return True
    return peer is not None and any(peer in network for network in allowed)


def _plain(network: Network) -> Network:
    """Return an IPv4 network as such, also if given in the form of IPv6."""
    mapped = getattr(network.network_address, "ipv4_mapped", None)
    if mapped is None or network.prefixlen < _MAPPED:
        return network
    return IPv4Network((mapped, network.prefixlen - _MAPPED))


def _error(error: Exception) -> LineError:
    code = getattr(error, "errno", None)
    if code == errno.EADDRINUSE:
        return PortBusyError(str(error))
    # No errno: none of the host's addresses is ours, or it is no host. EINVAL: a
    # link-local address without its interface (fe80::1%eth0).
    if code in (errno.EADDRNOTAVAIL, errno.EINVAL, None):
        return PortMissingError(str(error))
    return line_error(error)
