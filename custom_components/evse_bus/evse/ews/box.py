"""What an EWS-Box tells of itself as a whole: ``rs``, ``rg``.

Source of the tables: manual, 3.2.4. Cards and the box's network are private: no repr
shows them.
"""

from dataclasses import dataclass, field
from datetime import datetime
from enum import KEEP, IntFlag
from ipaddress import IPv4Address
from typing import Final

from .fields import Address, Bits, Flag, Identity, Moment, Number, Raw, Text
from .status import CARD_FIELDS
from .structs import Struct, optional

_SUPPLY: Final = (0, *range(6, 81))
"""A: not told, or from the lowest limit (3.1.8) to what a control pilot can offer."""


# -- rs: the box -------------------------------------------------------------------


class BoxFlags(IntFlag, boundary=KEEP):
    """State of the box as a whole."""

    RESTARTED = 1 << 0
    LOCK_CONFIGURED = 1 << 1
    BACKUP_PRESENT = 1 << 2
    BACKUP_CHARGED = 1 << 3
    BACKUP_TIMEOUT = 1 << 4


@dataclass(frozen=True, slots=True, kw_only=True)
class PresentedCard:
    """A card at the reader."""

    tag: bytes = field(repr=False)
    """Number of the tag, 7 bytes."""
    valid: bool
    """The box's own list knows it. Means nothing over Ethernet: always yes there."""
    decode_error: int
    """0: it could be read."""
    group: int = field(repr=False)
    number: int = field(repr=False)
    """Within its group."""
    user: str = field(repr=False)


PRESENTED_CARD: Final = Struct(
    PresentedCard,
    "3.2.4 rs: card",
    (
        Raw(name="tag", width=7),
        Flag(name="valid"),
        Number(name="decode_error", width=1),
        *CARD_FIELDS,
    ),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class BoxStatus:
    """What ``rs`` tells of the box."""

    firmware: str
    flags: BoxFlags
    serial: str
    website_size: int
    """Bytes."""
    website_crc: int
    website_version: str
    lan_error: int
    """Of the LAN chip when it was started; 0: none."""
    mac: bytes = field(repr=False)
    server_connected: bool
    web_client: IPv4Address = field(repr=False)
    """Who looks at the box's web page."""
    maximum_current: int
    """Highest charging current or fuse of the box, A; 0: not told (yet)."""
    ventilating: bool
    clock: datetime | None
    """In the box's time zone; ``None``: not set."""
    reader_error: int
    """Of the card reader when it was started; 0: found and right."""
    reader_firmware: str
    card: PresentedCard | None = field(repr=False)
    """At the reader now."""


BOX: Final = Struct(
    BoxStatus,
    "3.2.4 rs",
    (
        Text(name="firmware", width=11),
        Bits(name="flags", kind=BoxFlags),
        Identity(name="serial", width=12),
        Number(name="website_size", width=4, unit="bytes"),
        Number(name="website_crc", width=2),
        Text(name="website_version", width=20),
        Number(name="lan_error", width=1),
        Raw(name="mac", width=6),
        Flag(name="server_connected"),
        Address(name="web_client"),
        Number(name="maximum_current", width=1, unit="A", possible=_SUPPLY),
        Flag(name="ventilating"),
        Moment(name="clock"),
        Number(name="reader_error", width=1),
        Text(name="reader_firmware", width=11),
        optional("card", PRESENTED_CARD),
    ),
)


def decode_box(data: bytes) -> BoxStatus:
    """Return what the answer to ``rs`` says; raises ImplausibleReplyError."""
    return BOX.decode(data)


# -- rg: what DHCP gave ------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Dhcp:
    """What ``rg`` tells of a box with DHCP."""

    address: IPv4Address = field(repr=False)
    gateway: IPv4Address = field(repr=False)
    netmask: IPv4Address = field(repr=False)
    server: IPv4Address = field(repr=False)
    """Its "logical" address."""
    server_real: IPv4Address = field(repr=False)
    lease: int
    """s; 0: for ever."""
    lease_left: int
    """s; the connection is dropped at half the lease."""


DHCP: Final = Struct(
    Dhcp,
    "3.2.4 rg",
    (
        Address(name="address"),
        Address(name="gateway"),
        Address(name="netmask"),
        Address(name="server"),
        Address(name="server_real"),
        Number(name="lease", width=4, unit="s"),
        Number(name="lease_left", width=4, unit="s"),
    ),
)


def decode_dhcp(data: bytes) -> Dhcp:
    """Return what the answer to ``rg`` says; raises ImplausibleReplyError."""
    return DHCP.decode(data)
