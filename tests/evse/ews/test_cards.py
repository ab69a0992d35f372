"""The box's card list, and cards that the server accepts."""

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import (
    ImplausibleReplyError,
    RefusedOrderError,
)
from custom_components.evse_bus.evse.ews.wire.cards import (
    ENTRIES,
    LARGEST,
    AcceptedCard,
    CardEntry,
    CardList,
    EntryKind,
    accept_card,
    card_entry,
    decode_cards,
    write_cards,
)
from custom_components.evse_bus.evse.ews.wire.frames import Bcc, CommandId

from .wire import message

# Kind 1 (31-28), group 7 (27-14), no card; kind 2, group 7, card 42; kind 3.
GROUP = bytes.fromhex("1001c000")
CARD = bytes.fromhex("2001c02a")
BLOCKED = bytes.fromhex("3001c02b")
STRANGE = bytes.fromhex("ffffffff")
LIST = GROUP + CARD + BLOCKED + STRANGE + bytes(240)


def test_rf() -> None:
    cards = decode_cards(LIST)
    assert len(cards.entries) == ENTRIES == 64
    group, card, blocked, strange, free = cards.entries[:5]
    assert (group.kind, group.group, group.card) == (EntryKind.GROUP, 7, 0)
    assert (card.kind, card.group, card.card) == (EntryKind.CARD, 7, 42)
    assert (blocked.kind, blocked.group, blocked.card) == (EntryKind.BLOCKED, 7, 43)
    assert (strange.kind, strange.kind_code) == (None, 15)
    assert (strange.group, strange.card) == (LARGEST, LARGEST)
    assert (free.kind, free.group, free.card) == (EntryKind.FREE, 0, 0)


@pytest.mark.parametrize("length", [0, 252, 255, 257, 260])
def test_rf_of_another_length(length: int) -> None:
    with pytest.raises(ImplausibleReplyError):
        decode_cards(bytes(length))


@given(st.binary(min_size=256, max_size=256))
def test_a_list_is_written_as_it_was_read(data: bytes) -> None:
    request = write_cards(decode_cards(data))
    assert request.command is CommandId.WRITE_CARDS
    assert request.parameters == data


@given(
    st.binary(min_size=256, max_size=256),
    # Each entry is about another card or group: a duplicate is refused.
    st.dictionaries(
        st.integers(0, 63), st.sampled_from(range(0x40000000, 1 << 32)), min_size=1
    ),
)
def test_only_the_entries_that_are_named_are_changed(
    data: bytes, changes: dict[int, int]
) -> None:
    cards = decode_cards(data).with_entries(
        {at: CardEntry(raw=raw) for at, raw in changes.items()}
    )
    after = write_cards(cards).parameters
    for at in range(64):
        wanted = changes[at].to_bytes(4) if at in changes else data[4 * at : 4 * at + 4]
        assert after[4 * at : 4 * at + 4] == wanted


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {64: card_entry(EntryKind.FREE)},
        {-1: card_entry(EntryKind.FREE)},
        # Twice in the changes, or once in the list already; also with another kind.
        {8: card_entry(EntryKind.GROUP, 9), 9: card_entry(EntryKind.GROUP, 9)},
        {8: card_entry(EntryKind.GROUP, 7)},
        {8: card_entry(EntryKind.CARD, 7, 42)},
        {8: card_entry(EntryKind.BLOCKED, 7, 42)},
        {0: card_entry(EntryKind.CARD, 7, 43)},
    ],
)
def test_changes_that_make_no_sense(changes: dict[int, CardEntry]) -> None:
    with pytest.raises(RefusedOrderError) as raised:
        decode_cards(LIST).with_entries(changes)
    assert not any(number in str(raised.value) for number in ("42", "43"))


def test_changes_that_make_sense() -> None:
    cards = decode_cards(LIST)
    moved = cards.with_entries(
        {1: card_entry(EntryKind.FREE), 8: card_entry(EntryKind.CARD, 7, 42)}
    )
    assert moved.entries[8] == cards.entries[1]
    # Blocked instead of allowed, in its own place; a card beside its group.
    moved.with_entries({8: card_entry(EntryKind.BLOCKED, 7, 42)})
    cards.with_entries({9: card_entry(EntryKind.CARD, 7, 1)})
    # Old duplicates do not prevent changes of other entries.
    twice = decode_cards(LIST[:16] + LIST[:16] + LIST[32:])
    assert (
        twice.with_entries({9: card_entry(EntryKind.CARD, 7, 1)}).entries[4:8]
        == (twice.entries[:4])
    )


def test_entries_as_sf_has_them() -> None:
    assert card_entry(EntryKind.GROUP, 7).raw.to_bytes(4) == GROUP
    assert card_entry(EntryKind.CARD, 7, 42).raw.to_bytes(4) == CARD
    assert card_entry(EntryKind.BLOCKED, 7, 43).raw.to_bytes(4) == BLOCKED
    assert card_entry(EntryKind.FREE).raw == 0
    assert card_entry(EntryKind.CARD, LARGEST, LARGEST).raw == 0x2FFFFFFF


@pytest.mark.parametrize(
    ("kind", "group", "card"),
    [
        (EntryKind.GROUP, 0, 0),
        (EntryKind.GROUP, 7, 1),
        (EntryKind.GROUP, LARGEST + 1, 0),
        (EntryKind.CARD, 7, 0),
        (EntryKind.CARD, 0, 7),
        (EntryKind.CARD, 7, LARGEST + 1),
        (EntryKind.CARD, -1, 7),
        (EntryKind.BLOCKED, 7, 0),
        (EntryKind.FREE, 1, 0),
        (EntryKind.FREE, 0, 1),
    ],
)
def test_entries_that_cannot_be(kind: EntryKind, group: int, card: int) -> None:
    with pytest.raises(RefusedOrderError):
        card_entry(kind, group, card)


@pytest.mark.parametrize("at", [-1, 64])
def test_an_entry_that_there_is_not(at: int) -> None:
    with pytest.raises(RefusedOrderError):
        decode_cards(LIST).with_entries({at: CardEntry(raw=0)})


def test_a_list_that_is_not_whole_is_not_written() -> None:
    with pytest.raises(RefusedOrderError):
        write_cards(CardList(entries=63 * (CardEntry(raw=0),)))
    with pytest.raises(RefusedOrderError):
        write_cards(CardList(entries=64 * (CardEntry(raw=1 << 32),)))


def test_ma() -> None:
    card = AcceptedCard(group=7, number=42, user="Max M")
    plain = bytes.fromhex("0007 002a 4d6178204d000000")
    assert accept_card(card).encode(Bcc.ALL) == message("C", b"ma" + plain)
    tag = bytes.fromhex("04112233445566")
    card = AcceptedCard(group=7, number=42, user="Max M", tag=tag)
    assert accept_card(card).parameters == plain + tag
    assert "42" not in repr(card)
    assert "Max" not in repr(card)


@pytest.mark.parametrize(
    "card",
    [
        AcceptedCard(group=LARGEST + 1, number=1),
        AcceptedCard(group=1, number=-1),
        AcceptedCard(group=1, number=1, user="ninesigns"),
        AcceptedCard(group=1, number=1, tag=b"123456"),
        AcceptedCard(group=1, number=1, tag=b"12345678"),
    ],
)
def test_ma_with_values_that_do_not_fit(card: AcceptedCard) -> None:
    with pytest.raises(RefusedOrderError):
        accept_card(card)
