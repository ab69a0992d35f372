"""The stored parameters of a virtual EWS-Box: `sp`, `su`, `si`, `sz` and `sf`.

A field's place and width are in its block's table, in the order of the manual's
command reference (3.2.4). All numbers are big-endian.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from ipaddress import IPv4Address
import struct
from typing import Literal

OK, REFUSED = 0, 1
LOWEST_CURRENT = 6
LOCK_TYPES = 4
CARD_ENTRIES = 64
GROUP_BITS, CARD_BITS = 14, 14
Masking = Literal["no", "zeros", "stars"]

SP = struct.Struct(">12sBBIB4sBBBB")
SU = struct.Struct(">12s4sH4s4s4sHBB")
SI = struct.Struct(">30s30s30s20s20s")
SZ = struct.Struct(">IBHHBB53s")


class SystemMode:
    """The bits of the system mode."""

    SERVER = 0x01
    RFID = 0x02
    RS232 = 0x04
    MANUAL_IO = 0x08
    EXCLUSIVE = 0x10
    # "Ueber Netzwerk ... nicht geaendert werden: Servermodus".
    NOT_OVER_NETWORK = SERVER | RS232


class CableMode:
    """The bits of the cable mode."""

    FIXED = 0x01
    PORT_MODE1 = (0x02, 0x04)


def masked(password: bytes, masking: Masking) -> bytes:
    """Return a password as the box sends it."""
    if masking == "no":
        return password
    return (b"\x00" if masking == "zeros" else b"*") * len(password)


def _text(value: str, length: int) -> bytes:
    return value.encode("latin-1").ljust(length, b"\x00")[:length]


@dataclass
class SystemParameters:
    """`rp` and `sp`: 27 bytes."""

    admin_password: bytes = bytes(12)
    ports: int = 2
    mode: int = SystemMode.SERVER | SystemMode.RS232
    pulses_per_kwh: int = 1000
    lock_type: int = 0
    card_pin: bytes = b"0000"
    fan: int = 0
    max_current: int = 0
    restart_after_power: int = 0
    cable_mode: int = 0

    @classmethod
    def of(
        cls,
        *,
        server: bool,
        rfid: bool,
        manual_io: bool,
        exclusive: bool,
        fixed_cable: bool,
        mode1: tuple[bool, bool],
        **others: int,
    ) -> SystemParameters:
        """Make parameters from their flags; the server is on RS-232."""
        return cls(
            mode=SystemMode.RS232
            | SystemMode.SERVER * server
            | SystemMode.RFID * rfid
            | SystemMode.MANUAL_IO * manual_io
            | SystemMode.EXCLUSIVE * exclusive,
            cable_mode=CableMode.FIXED * fixed_cable
            | CableMode.PORT_MODE1[0] * mode1[0]
            | CableMode.PORT_MODE1[1] * mode1[1],
            **others,  # type: ignore[arg-type]
        )

    def pack(self, masking: Masking = "no") -> bytes:
        """Return the block."""
        return SP.pack(
            masked(self.admin_password, masking),
            self.ports,
            self.mode,
            self.pulses_per_kwh,
            self.lock_type,
            masked(self.card_pin, masking),
            self.fan,
            self.max_current,
            self.restart_after_power,
            self.cable_mode,
        )

    def write(self, block: bytes, *, network: bool) -> int:
        """Store a block; over the network the server mode stays as it is."""
        if len(block) != SP.size:
            return REFUSED
        new = SystemParameters(*SP.unpack(block))
        if (
            new.ports not in (1, 2)
            or new.mode & ~0x1F
            or new.lock_type >= LOCK_TYPES
            or new.fan > 1
            or 0 < new.max_current < LOWEST_CURRENT
            or new.restart_after_power > 1
            or new.cable_mode & ~0x07
        ):
            return REFUSED
        if network:
            kept = self.mode & SystemMode.NOT_OVER_NETWORK
            new.mode = new.mode & ~SystemMode.NOT_OVER_NETWORK | kept
        vars(self).update(vars(new))
        return OK

    def has(self, bit: int) -> bool:
        """Return whether a bit of the system mode is set."""
        return bool(self.mode & bit)


@dataclass
class UserParameters:
    """`ru` and `su`: 34 bytes."""

    user_password: bytes = bytes(12)
    own_ip: bytes = IPv4Address("192.168.0.1").packed
    own_port: int = 20000
    gateway: bytes = bytes(4)
    netmask: bytes = IPv4Address("255.255.255.0").packed
    server_ip: bytes = bytes(4)
    server_port: int = 0
    language: int = 0
    time_zone: int = 1

    def pack(self, masking: Masking = "no") -> bytes:
        """Return the block."""
        values = list(vars(self).values())
        values[0] = masked(self.user_password, masking)
        return SU.pack(*values)

    def write(self, block: bytes) -> int:
        """Store a block."""
        if len(block) != SU.size:
            return REFUSED
        new = UserParameters(*SU.unpack(block))
        if new.time_zone > 1:
            return REFUSED
        vars(self).update(vars(new))
        return OK


@dataclass
class UserInfo:
    """`ri` and `si`: 130 bytes."""

    name: bytes = _text("Erika Mustermann", 30)
    street: bytes = _text("Heidestrasse 17", 30)
    town: bytes = _text("51147 Koeln", 30)
    telephone: bytes = _text("0221 123456", 20)
    customer: bytes = _text("4711", 20)

    def pack(self) -> bytes:
        """Return the block."""
        return SI.pack(*vars(self).values())

    def write(self, block: bytes) -> int:
        """Store a block."""
        if len(block) != SI.size:
            return REFUSED
        vars(self).update(vars(UserInfo(*SI.unpack(block))))
        return OK


@dataclass
class ExtraConfiguration:
    """`rz` and `sz`: 64 bytes; the 53 at the end are reserved and all 0."""

    pulses_per_kwh_2: int = 0
    max_current_2: int = 0
    voltage_1: int = 230
    voltage_2: int = 230
    compatible_1: int = 0
    compatible_2: int = 0
    reserved: bytes = bytes(53)

    def pack(self) -> bytes:
        """Return the block."""
        return SZ.pack(*vars(self).values())

    def write(self, block: bytes) -> int:
        """Store a block."""
        if len(block) != SZ.size:
            return REFUSED
        new = ExtraConfiguration(*SZ.unpack(block))
        if (
            0 < new.max_current_2 < LOWEST_CURRENT
            or max(new.compatible_1, new.compatible_2) > 1
            or any(new.reserved)
        ):
            return REFUSED
        vars(self).update(vars(new))
        return OK


@dataclass
class CardList:
    """`rf` and `sf`: 64 entries of kind (4 bits), group and card (14 bits each).

    `kinds`: the meaning of 1 and 2, for which the manual has both: "sf" (1 group, 2
    single) and "3.1.6" (1 single, 2 group); 3 = blocked.
    """

    entries: list[int] = field(default_factory=lambda: [0] * CARD_ENTRIES)
    kinds: Literal["sf", "3.1.6"] = "sf"

    def pack(self) -> bytes:
        """Return the block of 256 bytes."""
        return struct.pack(f">{CARD_ENTRIES}I", *self.entries)

    def write(self, block: bytes) -> int:
        """Store a block."""
        if len(block) != CARD_ENTRIES * 4:
            return REFUSED
        entries = list(struct.unpack(f">{CARD_ENTRIES}I", block))
        if any(entry >> (GROUP_BITS + CARD_BITS) > 3 for entry in entries):
            return REFUSED
        self.entries = entries
        return OK

    def add(self, kind: int, group: int, card: int = 0) -> None:
        """Put an entry into the first free place."""
        value = kind << GROUP_BITS + CARD_BITS | group << CARD_BITS | card
        self.entries[self.entries.index(0)] = value

    def allows(self, group: int, card: int) -> bool:
        """Return whether a card is on the list and not blocked."""
        of_group, single = (1, 2) if self.kinds == "sf" else (2, 1)
        allowed = False
        for entry in self.entries:
            kind = entry >> (GROUP_BITS + CARD_BITS)
            if entry >> CARD_BITS & 0x3FFF != group:
                continue
            same_card = entry & 0x3FFF == card
            if kind == 3 and same_card:
                return False
            allowed |= kind == of_group or (kind == single and same_card)
        return allowed
