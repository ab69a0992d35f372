"""Boxes that dial: the listener of a protocol, as the rest of the project knows it.

A protocol whose boxes dial has a class with these methods, and declares how to make it
(`Protocol.listener`).
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Network, IPv6Address, IPv6Network
from typing import Protocol

from .bus import Bus
from .memory import LineMemory
from .readings import ChargerInfo

type Address = IPv4Address | IPv6Address
type Network = IPv4Network | IPv6Network


@dataclass(frozen=True, slots=True, kw_only=True)
class UnknownBox:
    """A box that has dialled and is not registered."""

    serial: str
    info: ChargerInfo
    """Texts in it come from the network, from any device that can connect."""
    peer: Address | None


type UnknownBoxCallback = Callable[[UnknownBox], None]
type NewAddressCallback = Callable[[str, tuple[Address, ...]], None]
"""Called with a serial number, and the addresses of that box, the last one first."""


@dataclass(slots=True)
class ListenerStatistics:
    """Numbers of connections, by their outcome."""

    accepted: int = 0
    not_allowed: int = 0
    """From an address that may not connect."""
    crowded_out: int = 0
    """Dropped: too many unidentified connections."""
    unidentified: int = 0
    """Dropped: not identified, or not in time."""
    over_budget: int = 0
    """Dropped: sent more bytes than unidentified connections may."""
    unknown: int = 0
    """Of boxes that are not registered."""
    duplicates: int = 0
    """Dropped: gave the number of a box that is connected and answers."""
    replaced: int = 0
    """Took the place of a connection that no longer answered."""


class Listener(Protocol):
    """One address and port, and any number of boxes."""

    host: str
    port: int
    allowed: tuple[Network, ...]
    statistics: ListenerStatistics
    on_new_address: NewAddressCallback
    """Called when a registered box dials from another address than last time."""

    @property
    def unknown_boxes(self) -> tuple[UnknownBox, ...]:
        """Return the boxes that are connected now and not registered."""

    async def start(self) -> None:
        """Begin to listen; raises LineError."""

    async def stop(self) -> None:
        """Stop listening; buses keep their connections until they are stopped."""

    def allow(self, networks: Iterable[Network]) -> None:
        """Let only these networks connect; none: all may."""

    def excluded_by(self, networks: Iterable[Network]) -> Mapping[str, Address]:
        """Return the registered boxes, by serial number, that these would keep out.

        With the address from which each dialled last.
        """

    def register(
        self,
        serial: str,
        name: str = "",
        addresses: Iterable[Address] = (),
        memory: LineMemory | None = None,
    ) -> Bus:
        """Return the bus of a box, which waits until the box dials.

        ``addresses``: from which it has dialled before, the last one first. Places are
        kept for them. ``memory``: what is known of this box; ``None``: nothing.
        """

    async def unregister(self, serial: str) -> None:
        """Stop the bus of a box and forget the box."""


class ListenerFactory(Protocol):
    """Makes a listener; it does not accept connections yet."""

    def __call__(
        self,
        host: str,
        port: int,
        *,
        allowed: Iterable[Network] = (),
        on_unknown_box: UnknownBoxCallback = ...,
    ) -> Listener:
        """Return a listener at an address and port.

        ``allowed``: networks that may connect; none: all may. ``on_unknown_box`` is
        called each time an unregistered box dials.
        """
