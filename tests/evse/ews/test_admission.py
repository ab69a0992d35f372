"""Places and bytes of connections that have not said which box they are."""

from ipaddress import IPv4Address, IPv6Address, ip_address

from hypothesis import given, strategies as st

from custom_components.evse_bus.evse.ews.network.admission import (
    ADDRESS_BYTES,
    ALL_BYTES,
    BOX_BYTES,
    GRACE,
    MOST_ADDRESSES,
    MOST_BYTES,
    PLACES,
    READ_COST,
    RECOVERY,
    Admission,
    group_of,
)

BOX = ip_address("192.0.2.1")
ONE, OTHER = ip_address("192.0.2.66"), ip_address("192.0.2.67")


def admission(boxes: int = 0, *known: IPv4Address | IPv6Address) -> Admission[int]:
    made = Admission[int](lambda: boxes)
    made.keep_for(known)
    return made


def fill(made: Admission[int], address: IPv4Address, count: int, now: float) -> int:
    """Let so many connections come, 1 ms apart; return how many have a place."""
    admitted = 0
    for number in range(count):
        got_in, leaves = made.enter(id(object()) + number, address, now + number / 1000)
        admitted += got_in and leaves is None
    return admitted


def test_one_address_gives_way_to_another_at_once() -> None:
    made = admission()
    assert fill(made, ONE, 200, 0.0) == PLACES
    admitted, leaves = made.enter(-1, OTHER, 0.5)
    assert admitted
    assert leaves is not None
    # Nor does the next of the crowd take the place from it.
    for number in range(100):
        _, leaves = made.enter(number, ONE, 0.5 + number / 10)
        assert leaves != -1


def test_a_crowd_of_many_addresses_gives_way_in_time() -> None:
    made = admission()
    for number in range(PLACES):
        assert made.enter(number, IPv4Address(number), 0.0) == (True, None)
    assert made.enter(-1, BOX, GRACE - 0.1) == (False, None)
    assert made.enter(-1, BOX, GRACE) == (True, 0)


def test_one_that_has_answered_is_not_the_next_to_leave() -> None:
    made = admission()
    for number in range(PLACES):
        made.enter(number, IPv4Address(number), 0.0)
    made.progressed(0, 0.5)
    assert made.enter(-1, BOX, GRACE) == (True, 1)


def test_strangers_take_no_place_kept_for_a_box() -> None:
    made = admission(1, BOX)
    for number in range(1000):
        made.enter(number, IPv4Address(number), 0.0)
    assert made.enter(-1, BOX, 0.0) == (True, None)
    assert len(made) == PLACES + 1 + 1


def test_a_box_that_shares_its_address_with_a_crowd_finds_a_place() -> None:
    made = admission(1, BOX)
    assert fill(made, BOX, 200, 0.0) == PLACES + 1
    # The other addresses are not crowded.
    assert made.enter(-1, OTHER, 0.2) == (True, None)
    assert made.enter(-2, BOX, GRACE)[0]


def test_addresses_of_one_ipv6_network_are_one() -> None:
    one, same, other = map(
        ip_address, ("2001:db8:0:1::1", "2001:db8:0:1:ffff::2", "2001:db8:0:2::1")
    )
    assert group_of(one) == group_of(same) != group_of(other)


def test_each_box_has_a_place_more() -> None:
    assert fill(admission(50), ONE, 200, 0.0) == PLACES + 50


def test_the_bytes_of_one_connection_are_limited() -> None:
    made = admission()
    made.enter(1, ONE, 0.0)
    assert made.may_receive(1, MOST_BYTES // 2, 0.0)
    assert not made.may_receive(1, MOST_BYTES // 2, 1000.0)
    made.leave(1)
    # It is identified.
    assert made.may_receive(1, 10 * MOST_BYTES, 1000.0)


@given(
    st.lists(
        st.tuples(
            st.integers(0, 5), st.integers(0, 3000), st.floats(0, 3), st.booleans()
        ),
        max_size=80,
    ),
    st.integers(0, 3),
)
def test_the_bytes_of_all_are_limited(
    reads: list[tuple[int, int, float, bool]], boxes: int
) -> None:
    """In any sequence: by address and together, but for addresses of boxes."""
    made = admission(boxes, BOX)
    now = 0.0
    used: dict[str, float] = {}
    begun: float | None = None
    for number, (source, count, pause, anew) in enumerate(reads):
        now += pause
        address = BOX if source == 0 else IPv4Address(source)
        if anew or number == 0:
            connection = number
            made.enter(connection, address, now)
            current = address
        begun = now if begun is None else begun
        if made.may_receive(connection, count, now):
            key = str(current)
            used[key] = used.get(key, 0) + count + READ_COST
    if begun is None:
        return
    share = 1 + (now - begun) / RECOVERY
    more = BOX_BYTES * boxes
    for one in used.values():
        assert one <= (ADDRESS_BYTES + more) * share + MOST_BYTES
    strangers = sum(one for key, one in used.items() if key != str(BOX))
    assert strangers <= (ALL_BYTES + more) * share + MOST_BYTES


def test_a_flood_leaves_the_budget_of_a_box_alone() -> None:
    made = admission(1, BOX)
    refused = 0
    for number in range(2000):
        made.enter(number, IPv4Address(number), 0.0)
        refused += not made.may_receive(number, 1000, 0.0)
    assert refused
    made.enter(-1, BOX, 0.0)
    assert made.may_receive(-1, 200, 0.0)
    assert len(made._budgets) <= MOST_ADDRESSES


def test_a_budget_comes_back() -> None:
    made = admission()
    for number in range(5):
        made.enter(number, ONE, 0.0)
        made.may_receive(number, 2000, 0.0)
    made.enter(9, ONE, 0.0)
    assert not made.may_receive(9, 1500, 0.0)
    made.enter(10, ONE, 0.0)
    assert made.may_receive(10, 1500, RECOVERY / 2)
