"""Actions for the cards of an EWS-Box: accept one, read and write its card list."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from ..errors import ActionError, wrong_action
from ..evse.errors import RefusedOrderError
from ..evse.ews.wire.cards import (
    ENTRIES,
    LARGEST,
    AcceptedCard,
    CardEntry,
    EntryKind,
    card_entry,
)
from .fields import Check, option, tag, text, whole

if TYPE_CHECKING:
    from homeassistant.util.json import JsonObjectType

    from ..evse.ews import EwsPort

CONF_GROUP: Final = "group"
CONF_NUMBER: Final = "number"
CONF_USER: Final = "user"
CONF_TAG: Final = "tag"
CONF_ENTRIES: Final = "entries"
CONF_ENTRY: Final = "entry"
CONF_KIND: Final = "kind"

USER_LENGTH: Final = 8
KINDS: Final = {kind.name.lower(): kind for kind in EntryKind}
UNKNOWN_KIND: Final = "unknown"
"""Kind of an entry whose code is not in the manual."""

_NUMBER: Final[Check[int]] = whole(1, LARGEST)
"""Number of a group or card; 0 is not valid."""
_ENTRY_FIELDS: Final = (CONF_ENTRY, CONF_KIND, CONF_GROUP, CONF_NUMBER)


async def accept_card(port: EwsPort, given: Mapping[str, object]) -> None:
    """Accept a card for the next start, or log in a user."""
    card = AcceptedCard(
        group=_NUMBER(CONF_GROUP, given[CONF_GROUP]),
        number=_NUMBER(CONF_NUMBER, given[CONF_NUMBER]),
        user=text(USER_LENGTH)(CONF_USER, given.get(CONF_USER, "")),
        tag=tag(CONF_TAG, given[CONF_TAG]) if CONF_TAG in given else None,
    )
    await port.services.accept_card(card)


async def read_card_list(port: EwsPort, _given: Mapping[str, object]) -> JsonObjectType:
    """Return the entries in use of the box's card list."""
    cards = await port.services.read_cards()
    return {
        CONF_ENTRIES: [
            _show(at, entry) for at, entry in enumerate(cards.entries) if entry.raw
        ],
        "free": sum(entry.kind is EntryKind.FREE for entry in cards.entries),
    }


def _show(at: int, entry: CardEntry) -> JsonObjectType:
    """Return an entry; also the code of its kind, which the manual leaves unclear."""
    kind = entry.kind
    return {
        CONF_ENTRY: at,
        CONF_KIND: UNKNOWN_KIND if kind is None else kind.name.lower(),
        "kind_code": entry.kind_code,
        CONF_GROUP: entry.group,
        CONF_NUMBER: entry.card,
    }


async def write_card_list(port: EwsPort, given: Mapping[str, object]) -> None:
    """Replace some entries of the box's card list; the others stay unchanged."""
    changes = _entries(given[CONF_ENTRIES])
    try:
        await port.services.write_cards(changes)
    except RefusedOrderError as error:
        # Each entry is valid in itself: another one has the same card.
        raise wrong_action(ActionError.CARD_TWICE) from error


def _entries(given: object) -> dict[int, CardEntry]:
    """Return the checked entries; raises ServiceValidationError."""
    # A single entry needs no list around it.
    listed = given if isinstance(given, list) else [given]
    if not listed:
        raise wrong_action(ActionError.NOTHING_TO_CHANGE)
    changes: dict[int, CardEntry] = {}
    for index, one in enumerate(listed):
        path = f"{CONF_ENTRIES}[{index}]"
        if not isinstance(one, Mapping) or not {
            CONF_ENTRY,
            CONF_KIND,
        } <= one.keys() <= set(_ENTRY_FIELDS):
            raise wrong_action(
                ActionError.CARD_ENTRIES, field=path, fields=", ".join(_ENTRY_FIELDS)
            )
        at = whole(0, ENTRIES - 1)(f"{path}.{CONF_ENTRY}", one[CONF_ENTRY])
        if at in changes:
            raise wrong_action(ActionError.CARD_ENTRY_TWICE, entry=at)
        changes[at] = _entry(path, one)
    return changes


def _entry(path: str, given: Mapping[str, object]) -> CardEntry:
    kind = option(KINDS)(f"{path}.{CONF_KIND}", given[CONF_KIND])
    numbers = [
        # An unused number may be left out, or 0 as in `read_card_list`.
        whole(0, LARGEST)(f"{path}.{name}", given.get(name, 0))
        for name in (CONF_GROUP, CONF_NUMBER)
    ]
    try:
        return card_entry(kind, *numbers)
    except RefusedOrderError as error:
        raise wrong_action(
            ActionError.CARD_ENTRY_NUMBERS, field=path, maximum=LARGEST
        ) from error
