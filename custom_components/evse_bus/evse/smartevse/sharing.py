"""How slaves of one master share a supply. Pure: times and currents in, currents out.

All currents are whole 0.1 A, as they go to the wire; times are loop times, s.

A slave (dialect 2.17) closes its contactor only when its request for current is
granted. From then on it offers what was granted, or what it last heard in a
broadcast. A broadcast may get lost, so a `Draw` counts every value that a box may
be following, and a value goes up only by what all of these leave free: first others
go down and say so, then one goes up. Then, whatever gets lost and whoever falls
silent, all boxes together never offer more than the limit, as long as two things
hold, which no master can bring about:

- The limit leaves 6 A for every box that charges. Where it does not (it was lowered,
  or a box cannot be reached), a box goes on with 6 A until it has heard the order to
  stop, which is sent at once, or until it has heard no broadcast for 10 s.
- Before our first broadcast the boxes together kept to the limit. Until each of them
  was read, or has had time to stop by itself, nobody goes up.

Source: PROTOCOLS.md, 3, and the manual's registers 0x00* and 0x008*.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Final

from ..errors import RefusedOrderError
from ..model import MAXIMUM_CURRENT, MINIMUM_CURRENT, Supply
from ..safety import number, round_down

LOWEST: Final = 60
"""0.1 A; a box that charges offers no less, whatever it hears."""
HIGHEST: Final = 800
"""0.1 A; a box takes more for nonsense, and offers the lowest."""
STOPS_ALONE: Final = 12.0
"""Time without a broadcast after which a box has stopped by itself, s (10 to 11)."""


_STEP: Final = 0.1
"""A, of the wire."""


def checked(supply: Supply) -> Supply:
    """Return a supply on the step of the wire.

    Raises RefusedOrderError for one that cannot be shared.
    """
    limit = number(supply.limit, "limit of the supply")
    minimum = number(supply.minimum, "minimum of a charger")
    if not MINIMUM_CURRENT <= minimum <= MAXIMUM_CURRENT:
        message = f"{minimum:g} A is no minimum of a charger ({MINIMUM_CURRENT:g} A)"
        raise RefusedOrderError(message)
    return Supply(limit=round_down(limit, _STEP), minimum=round_down(minimum, _STEP))


def offered(value: int) -> int:
    """Return what a charging box offers when it hears this value, 0.1 A."""
    return value if LOWEST <= value <= HIGHEST else LOWEST


class Draw:
    """The most that one box may be offering a car, from all that is known of it."""

    def __init__(self, unknown_until: float = -inf) -> None:
        """Know nothing; what it did before, it has stopped by ``unknown_until``."""
        self.may_draw = True
        """Its contactor may be closed; only a reading can say that it is not."""
        self._unknown_until = unknown_until
        self._read: tuple[float, int] | None = None
        self._said: list[tuple[float, int]] = []
        self._granted: tuple[float, int] | None = None
        self._floor: int | None = None

    def most(self, now: float) -> float:
        """Return the most that it may be offering now, 0.1 A; inf: nobody knows."""
        if not self.may_draw:
            return 0
        if now < self._unknown_until:
            return inf
        # What it follows it has heard less than that ago, or it has stopped.
        recent = now - STOPS_ALONE
        values = [value for when, value in self._said if when > recent]
        others = (one for one in (self._read, self._granted) if one is not None)
        values.extend(value for when, value in others if when > recent)
        return max(values, default=0)

    @property
    def floor(self) -> int:
        """Return the least that it may have heard last, 0.1 A; 0: perhaps nothing."""
        return self._floor or 0

    def said(self, value: int, now: float) -> None:
        """Note a value of a broadcast that goes out now; it may get lost."""
        recent = now - STOPS_ALONE
        self._said = [one for one in self._said if one[0] > recent]
        self._said.append((now, offered(value)))
        if self._floor is not None:
            self._floor = min(self._floor, value)

    def granted(self, value: int, now: float) -> None:
        """Note that a request for current is granted now; that may get lost, too."""
        if not self.may_draw:
            # Nothing of the time before can count: the contactor was open.
            self._said.clear()
            self._read = None
            self._granted = None
        self.may_draw = True
        if self._granted is not None:
            value = max(value, self._granted[1])
        self._granted = (now, offered(value))

    def read(self, value: int, now: float, *, closed: bool) -> None:
        """Note what the box told: the value it heard last, and its contactor."""
        self.may_draw = closed
        self._unknown_until = -inf
        self._read = (now, offered(value))
        self._said.clear()
        self._floor = value
        # It heard no less before the grant: so it has heard a broadcast since. (0 may
        # also be the memory of a box that was switched off and on.)
        grant = self._granted
        if not closed or (grant is not None and 0 < value < grant[1]):
            self._granted = None

    def asked(self, now: float) -> None:
        """Note a request: whoever asks has its contactor open.

        Unless something was granted of late: then it may be an echo of what was
        asked before, and only a reading counts.
        """
        if self._granted is None or now - self._granted[0] > STOPS_ALONE:
            self.may_draw = False
            self._granted = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """What one box asks of the supply."""

    unit: int
    wish: int
    """Most that it could use, 0.1 A; below the lowest: nothing."""
    came: float = 0.0
    """The first come keeps its share when there is not enough."""
    fixed: bool = False
    """It may be charging and nobody can stop it now: it has its 6 A before all."""


def split(limit: int, minimum: int, claims: Iterable[Claim]) -> dict[int, int]:
    """Return each unit's share, 0.1 A: 0, or from the minimum up to its wish.

    Each gets the minimum (its wish, where that is less), first come, first served;
    what is left goes in equal parts to those who can use it.
    """
    ordered = sorted(claims, key=lambda claim: (not claim.fixed, claim.came))
    shares = {claim.unit: 0 for claim in ordered}
    wishes: dict[int, int] = {}
    for claim in ordered:
        if claim.fixed:
            limit -= LOWEST
            shares[claim.unit] = LOWEST if claim.wish >= LOWEST else 0
            continue
        need = min(max(minimum, LOWEST), claim.wish)
        if LOWEST <= need <= limit:
            limit -= need
            shares[claim.unit] = need
            if need < claim.wish:
                wishes[claim.unit] = claim.wish
    while wishes and (part := limit // len(wishes)) > 0:
        for unit, wish in tuple(wishes.items()):
            more = min(part, wish - shares[unit])
            shares[unit] += more
            limit -= more
            if shares[unit] == wish:
                del wishes[unit]
    return shares


def most_of_all(draws: Iterable[Draw], now: float) -> float:
    """Return the most that all boxes together may be offering now, 0.1 A."""
    return sum(draw.most(now) for draw in draws)


def next_values(
    limit: int, shares: Mapping[int, int], draws: Mapping[int, Draw], now: float
) -> dict[int, int]:
    """Return what the next broadcast may tell each unit, 0.1 A.

    Down to its share at once; up only by what nobody can be using.
    """
    free = max(0.0, limit - most_of_all(draws.values(), now))
    values: dict[int, int] = {}
    for unit, share in shares.items():
        draw = draws[unit]
        most = draw.most(now)
        if most == inf:
            share = min(share, LOWEST)  # noqa: PLW2901 - what of it may be said now
        elif draw.may_draw and share > most:
            more = int(min(free, share - most))
            free -= more
            share = int(most) + more  # noqa: PLW2901 - what of it may be said now
        values[unit] = share
    return values


def together(
    limit: int, values: Mapping[int, int], active: Iterable[int]
) -> dict[int, int]:
    """Return the values with which one broadcast keeps to the limit, 0.1 A.

    The ``active`` draw, or are about to. Where they would offer too much, because one
    is still being stopped, the others go down to the lowest meanwhile. What they leave
    goes in equal parts to boxes that draw nothing: nobody who adds up the values of
    a broadcast shall find more than there is.
    """
    active = [unit for unit in values if unit in set(active)]
    said = dict(values)
    left = limit - sum(offered(said[unit]) for unit in active)
    for unit in active:
        less = min(max(-left, 0), max(said[unit] - LOWEST, 0))
        said[unit] -= less
        left += less
    idle = [unit for unit in values if unit not in active]
    part = max(left, 0) // max(len(idle), 1)
    for unit in idle:
        value = min(said[unit], part)
        said[unit] = value if value >= LOWEST else 0
    return said


def grant(
    limit: int, share: int, unit: int, draws: Mapping[int, Draw], now: float
) -> int:
    """Return the current that a request of this unit may be granted, 0.1 A; 0: none.

    ``share`` is what it gets when all have followed. It is granted no more than it
    has surely heard in broadcasts (or the lowest): then a lower value that it reads
    back later shows that it has heard a later broadcast.
    """
    free = limit - most_of_all(
        (draw for other, draw in draws.items() if other != unit), now
    )
    if share < LOWEST or free < LOWEST:
        return 0
    value = int(min(free, share, max(LOWEST, draws[unit].floor)))
    # It may be charging after all: then this must not be more than it has anyway.
    most = draws[unit].most(now)
    return value if most <= free else 0


def in_the_way(
    shares: Mapping[int, int], draws: Mapping[int, Draw], now: float
) -> Sequence[int]:
    """Return the units that may still be offering more than their share."""
    return [
        unit for unit, share in shares.items() if draws[unit].most(now) > offered(share)
    ]
