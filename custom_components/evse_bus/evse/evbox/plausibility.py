"""What a reply may say: held back when it cannot be, taken when it insists.

Corrupt frames can pass both checksums (PROTOCOLS.md section 1), so a decoded
reply is checked for what can be. An implausible one is held back and changes
nothing. `INSISTENCE` consistent ones in a row are the truth: hiding a real
over-current would be worse than showing a strange value.

Two replies are consistent when they are strange in the same places (the same
value of the same module and phase; of an over-current one common phase will do),
have the same number of modules, and the strange values agree: equal where a
value does not change while a box runs (maximum, interval, minimum), near where
it is measured, going on where it is a meter.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from ..errors import ImplausibleReplyError
from ..model import MAXIMUM_CURRENT, MINIMUM_CURRENT
from .frames import ModuleReply, Reply
from .meters import Meters, Totals
from .timing import UNKNOWN_INTERVAL

INSISTENCE: Final = 3
"""Consistent replies in a row that are believed whatever they say."""
LARGEST_CONNECTION: Final = 1000.0
"""Highest maximum phase current of a connection, A: 20 modules of 32 A are 640 A."""
LONGEST_INTERVAL: Final = 600
"""Longest minimum interval, s (manual: 20, seen: 1)."""
HIGHEST_VOLTAGE: Final = 300.0
"""Highest voltage of a phase, V; 0 is a phase that is not connected."""
CURRENT_FACTOR: Final = 1.1
CURRENT_OFFSET: Final = 1.0
"""Used currents may stand this much above the maximum of the connection, A."""


class Oddity(StrEnum):
    """A kind of value that cannot be."""

    MAXIMUM = "maximum"
    INTERVAL = "interval"
    MINIMUM = "minimum"
    CURRENT = "current"
    COS_PHI = "cos phi"
    VOLTAGE = "voltage"
    METER = "meter"


_AGREEMENT: Final[Mapping[Oddity, tuple[float, float]]] = {
    # How far two values may be apart: a share of the larger, and an amount.
    Oddity.MAXIMUM: (0.0, 0.0),
    Oddity.INTERVAL: (0.0, 0.0),
    Oddity.MINIMUM: (0.0, 0.0),
    Oddity.CURRENT: (0.5, 1.0),
    Oddity.COS_PHI: (0.1, 0.05),
    Oddity.VOLTAGE: (0.1, 5.0),
}

type Place = tuple[Oddity, int | None, int | None]
"""What is odd, at which module and phase (from 0; ``None``: of all)."""
type Oddities = Mapping[Place, float]


def range_oddities(reply: Reply, bound: float | None = None) -> dict[Place, float]:
    """Return the values of a reply that cannot be, seen by itself.

    ``bound``: the highest sum of used currents of a phase, A.
    """
    odd: dict[Place, float] = {}
    if not 0 < reply.maximum_current <= LARGEST_CONNECTION:
        odd[Oddity.MAXIMUM, None, None] = reply.maximum_current
    if reply.minimum_interval > LONGEST_INTERVAL:
        odd[Oddity.INTERVAL, None, None] = reply.minimum_interval
    for index, module in enumerate(reply.modules):
        if module.minimum_current > MAXIMUM_CURRENT:
            odd[Oddity.MINIMUM, index, None] = module.minimum_current
        odd |= _phase_oddities(index, module)
    if bound is not None:
        for phase, used in enumerate(used_currents(reply)):
            if used > bound:
                odd[Oddity.CURRENT, None, phase] = used
    return odd


def _phase_oddities(index: int, module: ModuleReply) -> dict[Place, float]:
    odd: dict[Place, float] = {}
    for phase, value in enumerate(module.cos_phi):
        if abs(value) > 1:
            odd[Oddity.COS_PHI, index, phase] = value
    for phase, value in enumerate(module.voltages or ()):
        if value > HIGHEST_VOLTAGE:
            odd[Oddity.VOLTAGE, index, phase] = value
    return odd


def used_currents(reply: Reply) -> tuple[float, float, float]:
    """Return the used currents of L1, L2, L3, all modules together, A."""
    one, two, three = (
        # In tenths, as they came: a sum of floats would be a little beside.
        sum(round(module.currents[phase] * 10) for module in reply.modules) / 10
        for phase in range(3)
    )
    return one, two, three


class Confirmed:
    """A number that falls at once, and rises as far as two replies in a row agree."""

    def __init__(self, start: float) -> None:
        """Begin with what counts before a reply tells."""
        self.value = start
        self.told: float | None = None
        """What the last reply said."""
        self.sure = False
        """Two replies have told it."""
        self._before = start

    def tell(self, value: float) -> None:
        """Take what a reply said."""
        self.sure = self.told is not None
        self.value = min(self._before, value)
        self.told = self._before = value

    @property
    def rising(self) -> bool:
        """Return whether the last reply said more than counts yet."""
        return self.told is not None and self.told > self.value


@dataclass(frozen=True, slots=True, kw_only=True)
class Taken:
    """A reply that is believed."""

    reply: Reply
    totals: tuple[float | None, ...]
    """Meter totals that may be shown, by module, Wh."""
    generations: tuple[int, ...]
    oddities: Oddities = field(default_factory=dict)
    """What cannot be in it, and was believed because it insisted."""

    @property
    def over_current(self) -> bool:
        """Return whether more flows than the connection can carry."""
        return any(oddity is Oddity.CURRENT for oddity, _, _ in self.oddities)

    @property
    def strange(self) -> bool:
        """Return whether other values are out of their range."""
        kept = {Oddity.CURRENT, Oddity.METER}
        return any(oddity not in kept for oddity, _, _ in self.oddities)


@dataclass(frozen=True, slots=True)
class _Seen:
    """A strange reply, with what is strange in it."""

    reply: Reply
    oddities: Oddities
    totals: Totals


class Plausibility:
    """What is believed of one ChargePoint, reply after reply."""

    def __init__(self) -> None:
        """Believe nothing yet."""
        self.maximum = Confirmed(MINIMUM_CURRENT)
        """Maximum of the connection, A; 6 A until two replies agree on more."""
        self.interval = Confirmed(UNKNOWN_INTERVAL)
        """Minimum interval, s."""
        self.minimum = Confirmed(MINIMUM_CURRENT)
        """Smallest minimum required current of the modules, A."""
        self.meters = Meters()
        self._held: list[_Seen] = []
        self._believed: _Seen | None = None

    @property
    def held(self) -> int:
        """Return how many consistent strange replies are held back."""
        return len(self._held)

    @property
    def unsettled(self) -> bool:
        """Return whether another reply is wanted soon to be sure."""
        return bool(
            self._held
            or self.maximum.rising
            or self.minimum.rising
            or self.interval.rising
            or self.meters.settling
        )

    def forget(self) -> None:
        """Forget what another box in this one's place would tell otherwise.

        The interval stays: a wrong one costs an unanswered request, no more. The
        meters stay to be compared with.
        """
        self.maximum = Confirmed(MINIMUM_CURRENT)
        self.minimum = Confirmed(MINIMUM_CURRENT)
        self.meters.unsettle()
        self._held.clear()
        self._believed = None

    def take(self, reply: Reply, now: float) -> Taken:
        """Believe a reply, or raise ImplausibleReplyError and change nothing."""
        carried = self._carried(reply)
        odd: dict[Place, float] = range_oddities(reply, carried)
        totals = tuple(module.energy for module in reply.modules)
        for index, total in self.meters.jumps(totals, now, carried).items():
            odd[Oddity.METER, index, None] = total
        seen = _Seen(reply, odd, Totals(totals, now))
        if odd and not self._insists(seen, carried):
            places = ", ".join(sorted({str(oddity) for oddity, _, _ in odd}))
            message = f"a reply that cannot be ({places}) is held back"
            raise ImplausibleReplyError(message)
        self._held.clear()
        self._believed = seen if odd else None
        return self._believe(seen, carried)

    def _carried(self, reply: Reply) -> float:
        """Return the highest used current of a phase that can be, A.

        The higher of what is confirmed and what this reply says: cars need their
        time to follow a maximum that was lowered.
        """
        maximum = self.maximum.value
        if reply.maximum_current <= LARGEST_CONNECTION:
            maximum = max(maximum, reply.maximum_current)
        return maximum * CURRENT_FACTOR + CURRENT_OFFSET

    def _insists(self, seen: _Seen, carried: float) -> bool:
        if self._believed is not None and _consistent(self._believed, seen, carried):
            return True
        if self._held and not _consistent(self._held[-1], seen, carried):
            self._held.clear()
        self._held.append(seen)
        return len(self._held) >= INSISTENCE

    def _believe(self, seen: _Seen, carried: float) -> Taken:
        reply = seen.reply
        self.maximum.tell(reply.maximum_current)
        self.interval.tell(reply.minimum_interval)
        needed = min(
            (module.minimum_current for module in reply.modules),
            default=MINIMUM_CURRENT,
        )
        self.minimum.tell(max(needed, MINIMUM_CURRENT))
        shown = self.meters.take(seen.totals.totals, seen.totals.at, carried)
        return Taken(
            reply=reply,
            totals=shown,
            generations=tuple(map(self.meters.generation, range(len(shown)))),
            oddities=seen.oddities,
        )


def _consistent(first: _Seen, second: _Seen, carried: float) -> bool:
    if (
        len(first.reply.modules) != len(second.reply.modules)
        or first.reply.serial != second.reply.serial
        or _fixed(first) != _fixed(second)
        or bool(_over(first)) != bool(_over(second))
    ):
        return False
    common = _over(first) & _over(second)
    if _over(first) and not common:
        return False
    return all(
        first.totals.goes_on(place[1] or 0, int(value), second.totals.at, carried)
        if place[0] is Oddity.METER
        else _near(place[0], first.oddities[place], value)
        for place, value in second.oddities.items()
        if place in common or place[0] is not Oddity.CURRENT
    )


def _over(seen: _Seen) -> set[Place]:
    return {place for place in seen.oddities if place[0] is Oddity.CURRENT}


def _fixed(seen: _Seen) -> set[Place]:
    return set(seen.oddities) - _over(seen)


def _near(oddity: Oddity, one: float, two: float) -> bool:
    share, amount = _AGREEMENT[oddity]
    return abs(one - two) <= amount + share * max(abs(one), abs(two))
