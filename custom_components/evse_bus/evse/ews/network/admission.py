"""Who may be connected without having said who he is, and how much work he may make.

Any device can connect, and only its address is known before it has been identified. So
places and work are shared out by address, and some are kept for the addresses from
which registered boxes have dialled. No time passes here: callers give the loop time.
"""

from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Hashable
from dataclasses import dataclass
from ipaddress import IPv6Address
from typing import Final

from ...dialling import Address

PLACES: Final = 128
"""Unidentified connections at once, beside one for each registered box: after a power
failure all of them dial in the same moment. So many again are kept for the addresses of
registered boxes, which other devices may share with them: behind a router that
translates addresses. A crowd of 100 a second is never more, with `GRACE`."""
GRACE: Final = 1.0
"""An unidentified connection that is older may be dropped for a newer one, s."""

READ_COST: Final = 16
"""Bytes that cost as much as one read, whatever its length."""
MOST_BYTES: Final = 4096
"""Most bytes of one unidentified connection, reads included; an identification takes
about 200."""
ADDRESS_BYTES: Final = 4096
"""Most bytes of all unidentified connections of one address at once, with more for
registered boxes: it may be that of all of them."""
ALL_BYTES: Final = 16384
"""The same of all addresses that are not of registered boxes."""
BOX_BYTES: Final = 512
"""Bytes more for each registered box."""
RECOVERY: Final = 8.0
"""Time after which all these bytes may be received again, s."""
MOST_ADDRESSES: Final = 256
"""Addresses whose bytes are counted."""

_INTERFACE: Final = 64
"""Bits of an IPv6 address that a device may choose itself."""

type Group = int | None
"""Addresses that one device may have."""


def group_of(address: Address | None) -> Group:
    """Return the group of an address: IPv6 addresses of one network belong together."""
    if isinstance(address, IPv6Address):
        return int(address) >> _INTERFACE << _INTERFACE
    return None if address is None else int(address)


class Budget:
    """An amount that comes back with time, all of it within `RECOVERY`."""

    def __init__(self, now: float) -> None:
        """Start with all of it; ``now``: loop time, s."""
        self._spent = 0.0
        self._since = now

    def take(self, amount: float, most: float, now: float) -> bool:
        """Take an amount; return whether it was left, of ``most``."""
        back = (now - self._since) * most / RECOVERY
        self._since = now
        self._spent = max(self._spent - back, 0.0)
        if self._spent + amount > most:
            return False
        self._spent += amount
        return True


@dataclass(slots=True)
class _Visit:
    """One unidentified connection."""

    group: Group
    since: float
    bytes: int = 0


class _Room[V: Hashable]:
    """Unidentified connections that compete for the same places."""

    def __init__(self) -> None:
        self.visits: dict[V, _Visit] = {}
        """Oldest first."""

    def place_for(self, group: Group, places: int, now: float) -> tuple[bool, V | None]:
        """Return whether there is a place, and who has to leave for it.

        It is the oldest connection of the address that has most of them: at once, if
        the other has fewer even with the new one, else if it had its time.
        """
        if len(self.visits) < places:
            return True, None
        counts = Counter(visit.group for visit in self.visits.values())
        most = max(counts.values())
        oldest, visit = next(
            (one, visit)
            for one, visit in self.visits.items()
            if counts[visit.group] == most
        )
        leaves = counts[group] + 1 < most or now - visit.since >= GRACE
        return (True, oldest) if leaves else (False, None)


class Admission[V: Hashable]:
    """Unidentified connections ``V``: their places, and the bytes that they send."""

    def __init__(self, boxes: Callable[[], int]) -> None:
        """``boxes`` returns how many are registered."""
        self._boxes = boxes
        self._known: frozenset[Group] = frozenset()
        self._strangers = _Room[V]()
        self._kept = _Room[V]()
        self._all = Budget(0.0)
        self._budgets: OrderedDict[Group, Budget] = OrderedDict()

    def keep_for(self, addresses: Collection[Address]) -> None:
        """Keep places for these addresses."""
        self._known = frozenset(map(group_of, addresses))

    def enter(
        self, one: V, address: Address | None, now: float
    ) -> tuple[bool, V | None]:
        """Return whether a new connection may stay, and which one leaves for it.

        The caller ends that one, which is no longer counted.
        """
        group = group_of(address)
        is_kept = group in self._known
        room = self._kept if is_kept else self._strangers
        admitted, leaves = room.place_for(group, PLACES + self._boxes(), now)
        if leaves is not None:
            del room.visits[leaves]
        if admitted:
            room.visits[one] = _Visit(group, now)
        return admitted, leaves

    def leave(self, one: V) -> None:
        """Take note that it has ended, or is identified."""
        for room in (self._strangers, self._kept):
            room.visits.pop(one, None)

    def progressed(self, one: V, now: float) -> None:
        """Take note that it has answered: it is given time for the next answer."""
        for room in (self._strangers, self._kept):
            if (visit := room.visits.pop(one, None)) is not None:
                visit.since = now
                room.visits[one] = visit

    def may_receive(self, one: V, count: int, now: float) -> bool:
        """Take note of bytes received at once; return whether they may be looked at."""
        kept = self._kept.visits.get(one)
        visit = kept or self._strangers.visits.get(one)
        if visit is None:
            return True
        cost = count + READ_COST
        visit.bytes += cost
        if visit.bytes > MOST_BYTES:
            return False
        more = BOX_BYTES * self._boxes()
        if not self._budget(visit.group, now).take(cost, ADDRESS_BYTES + more, now):
            return False
        return kept is not None or self._all.take(cost, ALL_BYTES + more, now)

    def _budget(self, group: Group, now: float) -> Budget:
        budget = self._budgets.pop(group, None) or Budget(now)
        self._budgets[group] = budget
        while len(self._budgets) > MOST_ADDRESSES:
            self._budgets.popitem(last=False)
        return budget

    def __len__(self) -> int:
        """Return the number of unidentified connections."""
        return len(self._strangers.visits) + len(self._kept.visits)
