"""Records of an EWS-Box about itself as a whole: ``rs``, ``rg``.

Source of the tables: manual, 3.2.4. Cards and the box's network are private: no repr
shows them.
"""

from datetime import datetime
from enum import KEEP, IntFlag
from ipaddress import IPv4Address
from typing import Final

from ...fields import Flag, Flags, Number, Raw, Text
from ...structs import Struct, coded, optional, record
from .fields import Address, Identity, Moment

_SUPPLY: Final = (0, *range(6, 81))
"""A: not known, or from the lowest limit (3.1.8) to the most a control pilot offers."""


# -- rs: the box -------------------------------------------------------------------


class BoxFlags(IntFlag, boundary=KEEP):
    """Flags of the box as a whole."""

    RESTARTED = 1 << 0
    LOCK_CONFIGURED = 1 << 1
    BACKUP_PRESENT = 1 << 2
    BACKUP_CHARGED = 1 << 3
    BACKUP_TIMEOUT = 1 << 4


@record
class PresentedCard:
    """A card at the reader."""

    tag: bytes = coded(Raw(width=7), secret=True)
    """Number of the tag, 7 bytes."""
    valid: bool = coded(Flag())
    """It is in the box's own list. Without meaning over Ethernet: always set there."""
    decode_error: int = coded(Number(width=1))
    """0: the card could be read."""
    group: int = coded(Number(width=2), secret=True)
    number: int = coded(Number(width=2), secret=True)
    """Within its group."""
    user: str = coded(Text(width=8), secret=True)


PRESENTED_CARD: Final = Struct(PresentedCard, "3.2.4 rs: card")


@record
class BoxStatus:
    """Status of the box (``rs``)."""

    firmware: str = coded(Text(width=11))
    flags: BoxFlags = coded(Flags(kind=BoxFlags))
    serial: str = coded(Identity(width=12))
    website_size: int = coded(Number(width=4, unit="bytes"))
    """Bytes."""
    website_crc: int = coded(Number(width=2))
    website_version: str = coded(Text(width=20))
    lan_error: int = coded(Number(width=1))
    """Of the LAN chip at start-up; 0: none."""
    mac: bytes = coded(Raw(width=6), secret=True)
    server_connected: bool = coded(Flag())
    web_client: IPv4Address = coded(Address(), secret=True)
    """Client of the box's web page."""
    maximum_current: int = coded(Number(width=1, unit="A", possible=_SUPPLY))
    """Highest charging current or fuse of the box, A; 0: not known (yet)."""
    ventilating: bool = coded(Flag())
    clock: datetime | None = coded(Moment())
    """In the box's time zone; ``None``: not set."""
    reader_error: int = coded(Number(width=1))
    """Of the card reader at start-up; 0: found, and correct."""
    reader_firmware: str = coded(Text(width=11))
    card: PresentedCard | None = coded(optional(PRESENTED_CARD), secret=True)
    """At the reader now."""


BOX: Final = Struct(BoxStatus, "3.2.4 rs")


def decode_box(data: bytes) -> BoxStatus:
    """Decode the answer to ``rs``; raises ImplausibleReplyError."""
    return BOX.decode(data)


# -- rg: DHCP ----------------------------------------------------------------------


@record
class Dhcp:
    """Network settings that the box got by DHCP (``rg``)."""

    address: IPv4Address = coded(Address(), secret=True)
    gateway: IPv4Address = coded(Address(), secret=True)
    netmask: IPv4Address = coded(Address(), secret=True)
    server: IPv4Address = coded(Address(), secret=True)
    """Its "logical" address."""
    server_real: IPv4Address = coded(Address(), secret=True)
    lease: int = coded(Number(width=4, unit="s"))
    """s; 0: without end."""
    lease_left: int = coded(Number(width=4, unit="s"))
    """s; the box drops the connection at half the lease."""


DHCP: Final = Struct(Dhcp, "3.2.4 rg")


def decode_dhcp(data: bytes) -> Dhcp:
    """Decode the answer to ``rg``; raises ImplausibleReplyError."""
    return DHCP.decode(data)
