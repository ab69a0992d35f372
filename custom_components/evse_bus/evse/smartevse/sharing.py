"""Sharing a circuit limit among the boxes of one master. Pure: no clock, no line.

All currents are whole 0.1 A, as they go to the wire; times are loop times, s.

A box closes its contactor only when its request for current is granted. From then on it
offers the current that was granted (2.17), or that of the last broadcast it received. A
broadcast may get lost, so a `Draw` counts every value that a box may be following, and a
value goes up only by the current that all of these leave free: first the others go down
and confirm it, then one goes up. Then, whatever gets lost and whichever box falls
silent, all boxes together never offer more than the limit, as long as two conditions
hold, which no master can bring about:

- The limit leaves 6 A for every box that charges and goes on with 6 A after a value of 0
  (2.17). Where it does not (it was lowered, or a box cannot be reached), a box goes on
  with 6 A until it has received the command to stop, which is sent at once, or until it
  has missed all broadcasts for long enough.
- Before our first broadcast the boxes together kept to the limit. Until each of them
  was read, or has had time to stop by itself, none goes up.

What a box does with a 0, and when it stops by itself, differs by its dialect
(`dialects.Balancing`). Source: PROTOCOLS.md, 3, and the manual's registers 0x00* and
0x008*.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from math import inf
from typing import Final

from ..errors import RefusedOrderError
from ..model import MAXIMUM_CURRENT, MINIMUM_CURRENT, Circuit
from ..safety import number, round_down
from .dialects import Balancing, Handshake

LOWEST: Final = 60
"""0.1 A; a box that charges offers no less, whatever it receives."""
HIGHEST: Final = 800
"""0.1 A; a box ignores a higher value, and offers the lowest."""

_STEP: Final = 0.1
"""A, on the wire."""


def checked(circuit: Circuit) -> Circuit:
    """Return a circuit, its values rounded down to the step of the wire.

    Raises RefusedOrderError for values out of range.
    """
    limit = number(circuit.limit, "limit of the supply")
    minimum = number(circuit.minimum, "minimum of a charger")
    if not MINIMUM_CURRENT <= minimum <= MAXIMUM_CURRENT:
        message = f"{minimum:g} A is no minimum of a charger ({MINIMUM_CURRENT:g} A)"
        raise RefusedOrderError(message)
    return Circuit(limit=round_down(limit, _STEP), minimum=round_down(minimum, _STEP))


def offered(value: int) -> int:
    """Return the current a charging box offers after this broadcast value, 0.1 A."""
    return value if LOWEST <= value <= HIGHEST else LOWEST


class Contactor(Enum):
    """What a state says of the current of a box."""

    OPEN = auto()
    ASKED = auto()
    """Open, and it asks for current: its pilot may not follow a broadcast."""
    CLOSED = auto()
    ENDING = auto()
    """It offers nothing any more (C1), but the car may not have followed."""


class Draw:
    """The most that one box may be offering a car, from all that is known of it."""

    def __init__(self, row: Balancing, unknown_since: float | None = None) -> None:
        """Take the habits of its dialect.

        ``unknown_since``: an earlier charge may be going on, and nothing was broadcast
        since then; ``None``: there was none.
        """
        self.row = row
        """The habits of its dialect."""
        self.may_draw = True
        """Its contactor may be closed; only a reading can show that it is not."""
        self._unknown_since = unknown_since
        self._read: tuple[float, int] | None = None
        self._sent: dict[int, float] = {}
        """Values since the last reading, and when each was sent last."""
        self._granted: tuple[float, int] | None = None
        self._before_grant: frozenset[int] = frozenset()
        """Values that it may have received last when its request was granted."""
        self._floor: int | None = None

    def most(self, now: float) -> float:
        """Return the most that it may be offering now, 0.1 A; inf: unknown."""
        if not self.may_draw:
            return 0
        stops_after = self.row.stops_after
        if self._unknown_since is not None and now < self._unknown_since + stops_after:
            return inf
        # The value it follows is younger than that, or it has stopped.
        recent = now - stops_after
        values = [
            self.follows(value) for value, when in self._sent.items() if when > recent
        ]
        others = (one for one in (self._read, self._granted) if one is not None)
        values.extend(value for when, value in others if when > recent)
        return max(values, default=0)

    def follows(self, value: int) -> int:
        """Return the current it offers after a value while it charges, 0.1 A."""
        return 0 if self.row.zero_stops and not value else offered(value)

    def may_charge(self, now: float) -> bool:
        """Return whether it may be charging, or go on with it after a value above 0."""
        # A value of 0 stops 2.17 in no case, so it may charge until it was read.
        return self.may_draw and not (self.row.zero_stops and self.most(now) == 0)

    @property
    def at_grant(self) -> int:
        """Return the most that it may offer if its request is granted now, 0.1 A.

        From 2.20 on. While it asks for current, its pilot may stay as it was before.
        """
        return max((offered(value) for value in self._possible), default=LOWEST)

    @property
    def _possible(self) -> frozenset[int]:
        """Return the values that its pilot may follow."""
        values = set(self._sent)
        if self._read is not None:
            values.add(self._read[1])
        return frozenset(values)

    @property
    def was_read(self) -> bool:
        """Return whether a reading has shown what it offers."""
        return self._read is not None

    @property
    def floor(self) -> int:
        """Return the least value it may have received last, 0.1 A; 0: maybe none."""
        return self._floor or 0

    def sent(self, value: int, now: float) -> None:
        """Note a value of a broadcast that is sent now; it may get lost."""
        self._sent[value] = now
        if self._floor is not None:
            self._floor = min(self._floor, value)

    def granted(self, value: int, now: float) -> None:
        """Note that a request for current is granted now; that may get lost, too."""
        if not self.may_draw:
            # The contactor was open: earlier values no longer count.
            self._sent.clear()
            self._read = None
            self._granted = None
        self.may_draw = True
        if self._granted is not None:
            value = max(value, self._granted[1])
        self._granted = (now, offered(value))

    def granted_as_broadcast(self, now: float) -> None:
        """Note that a request is granted now which needs no value (from 2.20 on)."""
        self._granted = (now, self.at_grant)
        self._before_grant = self._possible
        self.may_draw = True

    def read(self, value: int, now: float, contactor: Contactor) -> None:
        """Note a reading: the value the box received last, and its contactor."""
        if contactor is Contactor.ASKED:
            self._sent[value] = now
            self._unknown_since = self._granted = None
            self.may_draw = False
            return
        if contactor is Contactor.ENDING:
            most = self.most(now)
            self.may_draw = True
            if most < inf:
                self._unknown_since = None
                self._read = (now, max(int(most), offered(value)))
            return
        closed = contactor is Contactor.CLOSED
        self.may_draw = closed
        self._unknown_since = None
        self._read = (now, offered(value))
        self._sent.clear()
        self._floor = value
        if not closed or self._has_received_since_grant(value):
            self._granted = None

    def _has_received_since_grant(self, value: int) -> bool:
        """Return whether the value it has received shows what it offers."""
        if self.row.handshake is Handshake.POLLED:
            return value not in self._before_grant
        # No lower value was sent before the grant: so it has received a broadcast
        # since. (0 may also be the memory of a box that was switched off and on.)
        return self._granted is not None and 0 < value < self._granted[1]

    def requested(self, now: float) -> None:
        """Note a request: a box that requests current has its contactor open.

        Unless a request was granted of late: then this one may be an echo of it, and
        only a reading counts.
        """
        if self._granted is None or now - self._granted[0] > self.row.stops_after:
            self.may_draw = False
            self._granted = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """The claim of one box to a share of the circuit limit."""

    unit: int
    demand: int
    """Most that it could use, 0.1 A; below the lowest: nothing."""
    since: float = 0.0
    """Loop time at which its charge began, s: the earliest goes first."""
    fixed: bool = False
    """It may be charging and cannot be stopped now: 6 A is reserved for it first."""


def split(limit: int, minimum: int, claims: Iterable[Claim]) -> dict[int, int]:
    """Return each unit's share, 0.1 A: 0, or from the minimum up to its demand.

    Each gets the minimum (its demand, where that is less), first come, first served;
    the rest goes in equal parts to those that can use it.
    """
    ordered = sorted(claims, key=lambda claim: (not claim.fixed, claim.since))
    shares = {claim.unit: 0 for claim in ordered}
    demands: dict[int, int] = {}
    for claim in ordered:
        if claim.fixed:
            limit -= LOWEST
            shares[claim.unit] = LOWEST if claim.demand >= LOWEST else 0
            continue
        need = min(max(minimum, LOWEST), claim.demand)
        if LOWEST <= need <= limit:
            limit -= need
            shares[claim.unit] = need
            if need < claim.demand:
                demands[claim.unit] = claim.demand
    while demands and (part := limit // len(demands)) > 0:
        for unit, demand in tuple(demands.items()):
            more = min(part, demand - shares[unit])
            shares[unit] += more
            limit -= more
            if shares[unit] == demand:
                del demands[unit]
    return shares


def most_of_all(draws: Iterable[Draw], now: float) -> float:
    """Return the most that all boxes together may be offering now, 0.1 A."""
    return sum(draw.most(now) for draw in draws)


def next_values(
    limit: int, shares: Mapping[int, int], draws: Mapping[int, Draw], now: float
) -> dict[int, int]:
    """Return the value of the next broadcast for each unit, 0.1 A.

    Down to its share at once; up only by current that no box can be using.
    """
    free = max(0.0, limit - most_of_all(draws.values(), now))
    values: dict[int, int] = {}
    for unit, share in shares.items():
        draw = draws[unit]
        most = draw.most(now)
        value = share
        if most == inf:
            value = min(share, LOWEST)
        elif draw.may_charge(now) and share > most:
            more = int(min(free, share - most))
            free -= more
            value = int(most) + more
        values[unit] = value
    return values


def fit_to_limit(
    limit: int,
    values: Mapping[int, int],
    active: Iterable[int],
    stopped_by_zero: Collection[int] = (),
) -> dict[int, int]:
    """Return the values with which one broadcast keeps to the limit, 0.1 A.

    The ``active`` units draw current, or are about to; a 0 stops ``stopped_by_zero``,
    and takes nothing. Where they would offer too
    much, because one is still being stopped, the others go down to the lowest
    meanwhile. The rest goes in equal parts to boxes that draw nothing, so that the sum
    of all values of a broadcast is never above the limit.
    """
    active = [unit for unit in values if unit in set(active)]
    fitted = dict(values)
    left = limit - sum(
        offered(fitted[unit])
        for unit in active
        if fitted[unit] or unit not in stopped_by_zero
    )
    for unit in active:
        less = min(max(-left, 0), max(fitted[unit] - LOWEST, 0))
        fitted[unit] -= less
        left += less
    idle = [unit for unit in values if unit not in active]
    part = max(left, 0) // max(len(idle), 1)
    for unit in idle:
        value = min(fitted[unit], part)
        fitted[unit] = value if value >= LOWEST else 0
    return fitted


def room(unit: int, limit: int, draws: Mapping[int, Draw], now: float) -> float:
    """Return the current that the others leave for a unit now, 0.1 A; may be -inf."""
    return limit - most_of_all(
        (draw for other, draw in draws.items() if other != unit), now
    )


def grant(
    limit: int, share: int, unit: int, draws: Mapping[int, Draw], now: float
) -> int:
    """Return the current to grant to a request of this unit, 0.1 A; 0: none.

    ``share`` is its share once all have followed. It is granted no more than it has
    surely received in broadcasts (or the lowest): then a lower value in a later
    reading shows that it has received a later broadcast.
    """
    free = room(unit, limit, draws, now)
    if share < LOWEST or free < LOWEST:
        return 0
    value = int(min(free, share, max(LOWEST, draws[unit].floor)))
    # It may be charging after all: then this must not be more than it has anyway.
    most = draws[unit].most(now)
    return value if most <= free else 0


def above_share(
    shares: Mapping[int, int], draws: Mapping[int, Draw], now: float
) -> Sequence[int]:
    """Return the units that may still be offering more than their share."""
    return [
        unit
        for unit, share in shares.items()
        if draws[unit].most(now) > draws[unit].follows(share)
    ]
