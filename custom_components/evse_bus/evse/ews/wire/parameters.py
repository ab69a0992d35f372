"""Parameters of an EWS-Box: ``rp ru ri rz`` read them, ``sp su si sz`` write them.

A block is changed in the bytes that were read: only the named fields change, so that
unknown ones are kept. Source: manual, 3.2.4 (``sp``, ``su``, ``si``, ``sz``) and the
table of 3.1.1.

Two of the blocks contain secrets (passwords, the PIN of the cards). The manual does not
state whether they can be read. A block that was read without its secret is not written
unless the secret is given as well: it would be erased.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import KEEP, Enum, IntEnum, IntFlag
from ipaddress import IPv4Address
from typing import Final, override

from ...errors import RefusedOrderError
from ...fields import Flag, Flags, Number, Raw, Text
from ...structs import Struct, coded, record
from .fields import Address, Ascii
from .frames import CommandId, Request

_ANY_BYTE: Final = range(256)
_LIMIT: Final = (0, *range(6, 81))
"""A: none, or from the lowest limit (3.1.8) to the most a control pilot offers."""


# -- rp, sp: the installation ------------------------------------------------------


class SystemMode(IntFlag, boundary=KEEP):
    """Operating mode of the box."""

    SERVER = 1 << 0
    """A server allows each start; else standalone."""
    CARDS = 1 << 1
    """A start needs a card."""
    RS232 = 1 << 2
    """The server is on RS-232; else on Ethernet. Not to be changed over Ethernet."""
    MANUAL_IO = 1 << 3
    """The server has the keys and LEDs."""
    EXCLUSIVE = 1 << 4
    """One port at a time."""


class CableMode(IntFlag, boundary=KEEP):
    """Cables of the ports."""

    FIXED_CABLE = 1 << 0
    """The mode 3 cable is a fixed one."""
    PORT_1_MODE_1 = 1 << 1
    PORT_2_MODE_1 = 1 << 2


class LockType(IntEnum):
    """How the plug is locked (3.1.1), by manufacturer."""

    BALS_MENNEKES = 0
    WALTHER = 1
    FCT_HIGH = 2
    """FCT: locked is high."""
    FCT_LOW = 3
    """FCT: locked is low."""


@record
class SystemParameters:
    """System parameters (``rp``)."""

    admin_password: str = coded(Text(width=12), secret=True)
    ports: int = coded(Number(width=1, possible=range(1, 3)))
    mode: SystemMode = coded(Flags(kind=SystemMode))
    pulses_per_kwh: int = coded(Number(width=4, unit="1/kWh"))
    """Of the meter; of port 1's where port 2 has its own."""
    lock_type: int = coded(Number(width=1, valid=tuple(LockType)))
    """See `LockType`; of a plugged cable."""
    card_pin: str = coded(Ascii(width=4), secret=True)
    """Only cards with this are read."""
    ventilation: bool = coded(Flag())
    """The installation can ventilate."""
    maximum_current: int = coded(Number(width=1, unit="A", valid=_LIMIT))
    """A; 0: set by the jumper. With a fixed cable, also the maximum of the cable."""
    restart_after_power_failure: bool = coded(Flag())
    cable_mode: CableMode = coded(Flags(kind=CableMode))

    @property
    def mode_1(self) -> tuple[bool, bool]:
        """Return which of the two ports are in mode 1."""
        return (
            CableMode.PORT_1_MODE_1 in self.cable_mode,
            CableMode.PORT_2_MODE_1 in self.cable_mode,
        )

    @property
    def fixed_cable(self) -> bool:
        """Return whether the cable of mode 3 is a fixed one."""
        return CableMode.FIXED_CABLE in self.cable_mode


SYSTEM: Final = Struct(SystemParameters, "3.2.4 sp")


# -- ru, su: the network -----------------------------------------------------------


class TimeZone(IntEnum):
    """Zone of the box's clock."""

    GMT = 0
    CET = 1
    """"MEZ (Deutschland)"; the manual does not mention summer time."""


SOURCE_PORTS: Final = 10
"""The box dials from so many TCP ports, one after the other."""


@record
class UserParameters:
    """Network parameters (``ru``). Wrong ones cut the box off the network."""

    user_password: str = coded(Text(width=12), secret=True)
    address: IPv4Address = coded(Address(), secret=True)
    """0.0.0.0: by DHCP, and gateway and netmask are ignored."""
    source_port: int = coded(Number(width=2, valid=range(0x10001 - SOURCE_PORTS)))
    """First of `SOURCE_PORTS` from which it dials the server."""
    gateway: IPv4Address = coded(Address(), secret=True)
    netmask: IPv4Address = coded(Address(), secret=True)
    server: IPv4Address = coded(Address(), secret=True)
    server_port: int = coded(Number(width=2))
    language: int = coded(Number(width=1, valid=_ANY_BYTE))
    zone_code: int = coded(Number(width=1, valid=tuple(TimeZone)))
    """See `TimeZone`."""


USER: Final = Struct(UserParameters, "3.2.4 su")


# -- ri, si: the owner -------------------------------------------------------------


@record
class InstallationInfo:
    """Texts about the owner (``ri``)."""

    name: str = coded(Text(width=30), secret=True)
    street: str = coded(Text(width=30), secret=True)
    town: str = coded(Text(width=30), secret=True)
    telephone: str = coded(Text(width=20), secret=True)
    customer_number: str = coded(Text(width=20), secret=True)


INSTALLATION: Final = Struct(InstallationInfo, "3.2.4 si")


# -- rz, sz: more of the installation ----------------------------------------------


@record
class ExtraParameters:
    """Additional parameters (``rz``)."""

    pulses_per_kwh_2: int = coded(Number(width=4, unit="1/kWh"))
    """Of port 2's meter; 0: as port 1."""
    maximum_current_2: int = coded(Number(width=1, unit="A", valid=_LIMIT))
    """Of port 2, A; 0: as port 1."""
    voltage_1: int = coded(Number(width=2, unit="V"))
    """V. The manual names no unit."""
    voltage_2: int = coded(Number(width=2, unit="V"))
    compatible_1: bool = coded(Flag())
    """The port wakes cars that are asleep (3.1.1)."""
    compatible_2: bool = coded(Flag())
    reserved: bytes = coded(Raw(width=53), secret=True)
    """All 0 in the manual; kept as read."""


EXTRA: Final = Struct(ExtraParameters, "3.2.4 sz")


# -- Changing ----------------------------------------------------------------------


class HiddenSecretError(RefusedOrderError):
    """A block that was not written: that would erase a secret that the box hides."""

    text_key: str | None = "ews_secret_hidden"

    def __init__(self, source: str, names: tuple[str, ...]) -> None:
        """Keep the names of the secrets."""
        super().__init__(
            f"{source}: the box hides {', '.join(names)}; writing would erase any that "
            "is not given as well"
        )
        self.names = names

    @property
    @override
    def details(self) -> dict[str, str]:
        return {"secrets": ", ".join(self.names)}


class Shown(Enum):
    """How a secret was read."""

    SHOWN = "shown"
    EMPTY = "empty"
    """None is set, or the box hides it."""
    MASKED = "masked"
    """The same character throughout, or no readable text."""


def shown(secret: bytes) -> Shown:
    """Return whether a password or PIN could be read."""
    text = secret.split(b"\0", 1)[0].rstrip(b" ")
    if not text:
        return Shown.EMPTY
    readable = text.isascii() and text.decode("latin-1").isprintable()
    # 0000 is a possible PIN; stars and the like are a mask.
    mask = len(set(text)) == 1 and not text.isdigit()
    return Shown.MASKED if mask or not readable else Shown.SHOWN


@dataclass(frozen=True, slots=True, kw_only=True)
class Block[T]:
    """Parameters that are read and written together."""

    read: CommandId
    write: CommandId
    struct: Struct[T]
    secrets: frozenset[str] = frozenset()
    """Names of the fields that the box may hide."""

    def decode(self, data: bytes) -> T:
        """Decode the answer to the reading command; raises ImplausibleReplyError."""
        return self.struct.decode(data)

    def shown_secrets(self, block: T) -> dict[str, Shown]:
        """Return for each secret of a block how it was read."""
        # UTF-8 leaves unreadable characters unreadable: none becomes ASCII.
        return {
            name: shown(getattr(block, name).encode()) for name in sorted(self.secrets)
        }

    def change(self, data: bytes, changes: Mapping[str, object]) -> Request:
        """Return the command that writes a block just read, with these changes.

        Raises RefusedOrderError without changes and for an impossible field or value,
        HiddenSecretError where a secret would be erased, ImplausibleReplyError for
        data that are no such block.
        """
        if not changes:
            message = f"{self.struct.source}: no changes"
            raise RefusedOrderError(message)
        changed = self.struct.changed(data, changes)
        hidden = []
        at = 0
        for known in self.struct.fields:
            secret = data[at : at + known.width]
            at += known.width
            if (
                known.name in self.secrets - changes.keys()
                and shown(secret) is not Shown.SHOWN
            ):
                hidden.append(known.name)
        if hidden:
            raise HiddenSecretError(self.struct.source, tuple(hidden))
        return Request(self.write, changed)


SYSTEM_BLOCK: Final = Block(
    read=CommandId.READ_SYSTEM,
    write=CommandId.WRITE_SYSTEM,
    struct=SYSTEM,
    secrets=frozenset({"admin_password", "card_pin"}),
)
"""Not written while the box starts or a car charges; the box restarts afterwards."""
USER_BLOCK: Final = Block(
    read=CommandId.READ_USER,
    write=CommandId.WRITE_USER,
    struct=USER,
    secrets=frozenset({"user_password"}),
)
INSTALLATION_BLOCK: Final = Block(
    read=CommandId.READ_INSTALLATION,
    write=CommandId.WRITE_INSTALLATION,
    struct=INSTALLATION,
)
EXTRA_BLOCK: Final = Block(
    read=CommandId.READ_EXTRA, write=CommandId.WRITE_EXTRA, struct=EXTRA
)
BLOCKS: Final = (SYSTEM_BLOCK, USER_BLOCK, INSTALLATION_BLOCK, EXTRA_BLOCK)
