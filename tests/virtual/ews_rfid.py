"""The RFID reader of a virtual EWS-Box, and its cards."""

from __future__ import annotations

from dataclasses import dataclass
import struct

from .ews_parameters import OK, REFUSED

NAME_LENGTH = 8
TAG_LENGTH = 7
TO_READER, TO_CARD = 1, 2
FIRMWARE_LENGTH = 11


@dataclass(frozen=True)
class Card:
    """A card: its data, and whether the box can decode it.

    `pin` None: formatted for this box; `foreign`: another format.
    """

    group: int = 1
    number: int = 1
    name: str = "MUSTER"
    tag: bytes = bytes.fromhex("04112233445566")
    pin: bytes | None = None
    foreign: bool = False

    def user(self) -> bytes:
        """Return group, card and name as in `rc`, `rd` and `rs`: 12 bytes."""
        name = self.name.encode("latin-1").ljust(NAME_LENGTH, b"\x00")[:NAME_LENGTH]
        return struct.pack(">HH8s", self.group, self.number, name)


def logged_in(card: Card | None) -> bytes:
    """Return the 13 bytes "RFID logged in" of `rc` and `rd`."""
    return b"\x01" + card.user() if card is not None else bytes(13)


class Reader:
    """The card reader; `fitted` False: 0xA7 and a reader error."""

    def __init__(self) -> None:
        """Begin without a card."""
        self.fitted = True
        self.firmware = b"MCR6241-100"
        self.present: Card | None = None
        self.noted: Card | None = None
        self.accepted = False
        self.decode_error = 0
        self.presented_at = float("-inf")

    def present_card(self, card: Card, pin: bytes, now: float) -> None:
        """Present a card; its data are kept until another one comes."""
        self.present = self.noted = card
        self.presented_at = now
        self.accepted = False
        wrong_pin = card.pin is not None and card.pin != pin
        self.decode_error = 1 if card.foreign else 2 if wrong_pin else 0

    def remove_card(self) -> None:
        """Remove the card; its data are kept."""
        self.present = None

    @property
    def valid(self) -> bool:
        """Return whether the last card was decoded, or accepted by the server."""
        return self.noted is not None and (self.accepted or not self.decode_error)

    def accept(self, parameters: bytes, now: float) -> int:
        """Accept a card by `ma`: group, card, name, and perhaps the tag number."""
        if len(parameters) not in (12, 12 + TAG_LENGTH):
            return REFUSED
        group, number, name = struct.unpack(">HH8s", parameters[:12])
        tag = parameters[12:] or (self.noted.tag if self.noted else bytes(TAG_LENGTH))
        self.noted = Card(group, number, name.rstrip(b"\x00").decode("latin-1"), tag)
        self.accepted = True
        self.presented_at = now
        return OK

    def transparent(self, parameters: bytes) -> bytes:
        """Return the answer to `mc`: RC and data, the firmware id or the tag number."""
        if len(parameters) < 2 or parameters[0] not in (TO_READER, TO_CARD):
            return bytes((REFUSED,))
        data = parameters[2:]
        if not self.fitted:
            return bytes((REFUSED,))
        if parameters[0] == TO_READER:
            if data == b"id":
                return bytes((OK,)) + self.firmware
            return bytes((REFUSED,))
        if self.present is None:
            return bytes((REFUSED,))
        return bytes((OK,)) + self.present.tag + data

    def status(self, *, valid: bool) -> bytes:
        """Return the last 34 bytes of `rs`: the reader and the card.

        Without a card at the reader the rest keeps its last value: "ungueltig".
        """
        found = self.present is not None
        known = self.noted is not None
        card = self.noted or Card(0, 0, "", bytes(TAG_LENGTH))
        return b"".join(
            (
                bytes((not self.fitted,)),
                self.firmware if self.fitted else bytes(FIRMWARE_LENGTH),
                bytes((found,)),
                self.present.tag if self.present else bytes(TAG_LENGTH),
                bytes((known and valid, self.decode_error)),
                card.user() if known else bytes(12),
            )
        )
