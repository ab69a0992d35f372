"""RFID cards: the box's own list (``rf``, ``sf``) and accepting one (``ma``).

Source: manual, 3.2.4 (``sf``, ``ma``) and 3.1.6, which contradict each other: in 3.1.6
1 is a single card and 2 a group, in ``sf`` the other way round, and ``sf`` has no 3, a
blocked card. Used here are 1 and 2 of ``sf``, and 3 of 3.1.6.
"""

from collections.abc import Mapping
from dataclasses import field
from enum import IntEnum
from typing import Final

from ...errors import RefusedOrderError
from ...fields import Number, Raw, Text
from ...structs import Struct, coded, many, part, record
from .frames import CommandId, Request

ENTRIES: Final = 64
LARGEST: Final = 0x3FFF
"""Largest number of a group, and of a card within it: 14 bits."""
_GROUP_SHIFT: Final = 14
_KIND_SHIFT: Final = 28
TAG_LENGTH: Final = 7


class EntryKind(IntEnum):
    """Kinds of entries, by ``sf``."""

    FREE = 0
    GROUP = 1
    """All cards of the group may charge."""
    CARD = 2
    """This card may charge."""
    BLOCKED = 3
    """This card may not charge, even if its group may (3.1.6)."""


@record
class CardEntry:
    """One entry of the list, 32 bits."""

    raw: int = coded(Number(width=4), secret=True)

    @property
    def kind_code(self) -> int:
        """Return the upper four bits."""
        return self.raw >> _KIND_SHIFT

    @property
    def kind(self) -> EntryKind | None:
        """Return its kind; ``None``: one that is not in the manual."""
        return EntryKind(self.kind_code) if self.kind_code in EntryKind else None

    @property
    def group(self) -> int:
        """Return the number of the group."""
        return self.raw >> _GROUP_SHIFT & LARGEST

    @property
    def card(self) -> int:
        """Return the number of the card within its group."""
        return self.raw & LARGEST


_ENTRY: Final = Struct(CardEntry, "3.2.4 sf: entry")


def card_entry(kind: EntryKind, group: int = 0, card: int = 0) -> CardEntry:
    """Return an entry for the list.

    0 is no number of a group or card (3.1.6); a whole group has no card. Raises
    RefusedOrderError for numbers that do not fit.
    """
    numbered = kind is not EntryKind.FREE
    single = kind in (EntryKind.CARD, EntryKind.BLOCKED)
    if group not in (range(1, LARGEST + 1) if numbered else range(1)):
        message = f"a group is 1 to {LARGEST}, and 0 in a free entry"
        raise RefusedOrderError(message)
    if card not in (range(1, LARGEST + 1) if single else range(1)):
        message = f"a card is 1 to {LARGEST}, and 0 in an entry without a card"
        raise RefusedOrderError(message)
    return CardEntry(raw=kind << _KIND_SHIFT | group << _GROUP_SHIFT | card)


@record
class CardList:
    """The whole list: it is read and written at once."""

    entries: tuple[CardEntry, ...] = coded(many(part(_ENTRY), ENTRIES), secret=True)

    def with_entries(self, changes: Mapping[int, CardEntry]) -> CardList:
        """Return the list with some entries (0 to 63) replaced, and nothing else.

        Raises RefusedOrderError without changes, for an entry that does not exist,
        and for a card or group that has another entry.
        """
        if not changes:
            raise RefusedOrderError("no entry of the list is replaced")
        if not changes.keys() <= set(range(len(self.entries))):
            message = f"the list has entries 0 to {len(self.entries) - 1}"
            raise RefusedOrderError(message)
        after = tuple(changes.get(at, entry) for at, entry in enumerate(self.entries))
        about: dict[tuple[bool, int, int], int] = {}
        for at, entry in enumerate(after):
            if entry.kind in (None, EntryKind.FREE):
                continue
            key = (entry.kind is EntryKind.GROUP, entry.group, entry.card)
            other = about.setdefault(key, at)
            # Duplicates that were in the list before are left alone.
            if other != at and {at, other} & changes.keys():
                message = f"entries {other} and {at} are about the same card or group"
                raise RefusedOrderError(message)
        return CardList(entries=after)


CARD_LIST: Final = Struct(CardList, "3.2.4 sf")


def decode_cards(data: bytes) -> CardList:
    """Decode the answer to ``rf``; raises ImplausibleReplyError."""
    return CARD_LIST.decode(data)


def write_cards(cards: CardList) -> Request:
    """Return the command that writes the list (``sf``)."""
    return Request(CommandId.WRITE_CARDS, CARD_LIST.encode(cards))


# -- ma: accepting a card that is not in the list ----------------------------------


@record
class AcceptedCard:
    """A card that the server accepts for the next start."""

    group: int = coded(Number(width=2, valid=range(LARGEST + 1)), secret=True)
    number: int = coded(Number(width=2, valid=range(LARGEST + 1)), secret=True)
    user: str = coded(Text(width=8), default="", secret=True)
    tag: bytes | None = field(default=None, repr=False)
    """7 bytes, for the box's history."""


ACCEPTED_CARD: Final = Struct(AcceptedCard, "3.2.4 ma")
_TAG: Final = Raw(name="tag", width=TAG_LENGTH)


def accept_card(card: AcceptedCard) -> Request:
    """Return the command that accepts a card (``ma``).

    Raises RefusedOrderError for numbers and texts that do not fit.
    """
    tag = b"" if card.tag is None else _TAG.encode(card.tag)
    return Request(CommandId.ACCEPT_CARD, ACCEPTED_CARD.encode(card) + tag)
