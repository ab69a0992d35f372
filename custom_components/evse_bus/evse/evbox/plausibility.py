"""Plausibility of replies: which of their values count, and which are shown.

A reply is shown when it agrees with the one before, or with the one shown last: two
corrupt frames in a row never agree. Of replies that keep changing the third in a row
is shown, and after an absence the first: the next may be 20 s away, and meters, maximum
and serial number wait for it all the same. What must not wait counts at once
(`Plausibility.accept`).

Corrupt frames can pass both checksums (PROTOCOLS.md section 1), so the values of each
decoded reply are checked. An implausible reply is quarantined and changes nothing.
`CONFIRMATIONS` consistent ones in a row are accepted all the same: hiding a real
over-current would be worse than showing an implausible value.

Two implausible replies are consistent when they have the same number of modules, the
same values in them are implausible (same quantity, module and phase; for over-currents
one common phase is enough), and these values agree: equal where a value is constant
while a box runs (maximum, interval, minimum), close where it is measured, and growing
no faster than possible where it is a meter total.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from ..errors import ImplausibleReplyError
from ..meter import CONFIRMATIONS, HIGHEST_PHASE_VOLTAGE, Total
from ..model import MAXIMUM_CURRENT, MINIMUM_CURRENT, Phases
from ..plausibility import (
    CURRENT_AGREEMENT,
    Agreement,
    agree,
    highest_plausible,
)
from .config import UNKNOWN_INTERVAL
from .frames import ModuleReply, Reply
from .meters import Meters, Totals

LARGEST_CONNECTION: Final = 1000.0
"""Highest maximum phase current of a connection, A: 20 modules of 32 A are 640 A."""
LONGEST_INTERVAL: Final = 600
"""Longest minimum interval, s (manual: 20, seen: 1)."""
HIGHEST_VOLTAGE: Final = 300.0
"""Highest voltage of a phase, V; 0 is a phase that is not connected."""


class Quantity(StrEnum):
    """A quantity whose value may be implausible."""

    MAXIMUM = "maximum"
    INTERVAL = "interval"
    MINIMUM = "minimum"
    CURRENT = "current"
    COS_PHI = "cos phi"
    VOLTAGE = "voltage"
    METER = "meter"


_AGREEMENT: Final[Mapping[Quantity, Agreement]] = {
    Quantity.MAXIMUM: (0.0, 0.0),
    Quantity.INTERVAL: (0.0, 0.0),
    Quantity.MINIMUM: (0.0, 0.0),
    Quantity.CURRENT: CURRENT_AGREEMENT,
    Quantity.COS_PHI: (0.1, 0.05),
    Quantity.VOLTAGE: (0.1, 5.0),
}

_STEADY: Final[Mapping[Quantity, float]] = {
    # Largest difference of the same value in two replies that agree.
    Quantity.CURRENT: 0.5,
    Quantity.COS_PHI: 0.05,
    Quantity.VOLTAGE: 5.0,
}
_METER_FACTOR: Final = 1.25
_METER_STEP: Final = 2.0
"""A meter may be ahead of the power in both replies by this share and amount, Wh."""
_SECONDS_PER_HOUR: Final = 3600.0

type Place = tuple[Quantity, int | None, int | None]
"""A quantity, its module and its phase, counted from 0; ``None``: of all."""
type Values = Mapping[Place, float]
"""Implausible values by their place, in the unit of the quantity."""


def implausible_values(
    reply: Reply, highest_current: float | None = None
) -> dict[Place, float]:
    """Return the values of a reply that are out of range.

    ``highest_current``: the highest sum of the used currents of a phase, A.
    """
    found: dict[Place, float] = {}
    if not 0 < reply.maximum_current <= LARGEST_CONNECTION:
        found[Quantity.MAXIMUM, None, None] = reply.maximum_current
    if reply.minimum_interval > LONGEST_INTERVAL:
        found[Quantity.INTERVAL, None, None] = reply.minimum_interval
    for index, module in enumerate(reply.modules):
        if module.minimum_current > MAXIMUM_CURRENT:
            found[Quantity.MINIMUM, index, None] = module.minimum_current
        found |= _implausible_phases(index, module)
    if highest_current is not None:
        for phase, used in enumerate(used_currents(reply)):
            if used > highest_current:
                found[Quantity.CURRENT, None, phase] = used
    return found


def _implausible_phases(index: int, module: ModuleReply) -> dict[Place, float]:
    found: dict[Place, float] = {}
    for phase, value in enumerate(module.cos_phi):
        if abs(value) > 1:
            found[Quantity.COS_PHI, index, phase] = value
    for phase, value in enumerate(module.voltages or ()):
        if value > HIGHEST_VOLTAGE:
            found[Quantity.VOLTAGE, index, phase] = value
    return found


def used_currents(reply: Reply) -> Phases[float]:
    """Return the used currents of L1, L2 and L3, summed over all modules, A."""
    one, two, three = (
        # Summed in tenths, as on the wire: a sum of floats would not be exact.
        sum(round(module.currents[phase] * 10) for module in reply.modules) / 10
        for phase in range(3)
    )
    return one, two, three


class ConfirmedValue:
    """A value that falls at once, and rises as far as two replies in a row agree."""

    def __init__(self, start: float) -> None:
        """Begin with the value that counts before the first reply."""
        self.value = start
        self.reported: float | None = None
        """The value in the last reply."""
        self.agreed: float | None = None
        """The last value that two replies in a row agreed on."""
        self._before = start

    def update(self, reported: float) -> None:
        """Take the value of a reply."""
        if reported == self.reported:
            self.agreed = reported
        self.value = min(self._before, reported)
        self.reported = self._before = reported

    @property
    def rising(self) -> bool:
        """Return whether the last reply reported more than counts yet."""
        return self.reported is not None and self.reported > self.value


def new_interval() -> ConfirmedValue:
    """Return the minimum interval of a ChargePoint that has not reported one, s."""
    return ConfirmedValue(UNKNOWN_INTERVAL)


@dataclass(frozen=True, slots=True, kw_only=True)
class AcceptedReply:
    """A reply that is plausible, or confirmed by others."""

    is_shown: bool
    """Another reply agrees with it."""

    reply: Reply
    totals: tuple[float | None, ...]
    """Meter totals that may be shown, by module, Wh."""
    generations: tuple[int, ...]
    """Of the meters, by module (see `Meters`)."""
    implausible: Values = field(default_factory=dict)
    """Values that were accepted only because other replies confirmed them."""

    @property
    def over_current(self) -> bool:
        """Return whether more current flows than the connection can carry."""
        return any(quantity is Quantity.CURRENT for quantity, _, _ in self.implausible)

    @property
    def out_of_range(self) -> bool:
        """Return whether other values are out of range; a new meter is not."""
        others = {Quantity.CURRENT, Quantity.METER}
        return any(quantity not in others for quantity, _, _ in self.implausible)


@dataclass(frozen=True, slots=True)
class _Checked:
    """A reply and its implausible values."""

    reply: Reply
    implausible: Values
    totals: Totals


class Plausibility:
    """The values of one ChargePoint that are accepted, reply after reply."""

    def __init__(self) -> None:
        """Start without a reply."""
        self.maximum = ConfirmedValue(MINIMUM_CURRENT)
        """Maximum of the connection, A; 6 A until two replies agree on more."""
        self.interval = new_interval()
        """Minimum interval, s; replaced by that of an earlier bus on the line."""
        self.minimum = ConfirmedValue(MINIMUM_CURRENT)
        """Smallest minimum required current of the modules, A."""
        self.meters = Meters()
        self._quarantine: list[_Checked] = []
        self._accepted: _Checked | None = None
        """The last reply, if it was accepted although it was implausible."""
        self._shown: _Checked | None = None
        """The last reply that was shown."""
        self._waiting: list[_Checked] = []
        """Accepted replies since then, which no other agrees with."""

    @property
    def quarantined(self) -> int:
        """Return the number of consistent replies in quarantine."""
        return len(self._quarantine)

    @property
    def unconfirmed(self) -> bool:
        """Return whether another reply is needed soon to confirm a value."""
        return bool(
            self._quarantine
            or self._waiting
            or self.maximum.rising
            or self.minimum.rising
            or self.interval.rising
            or self.meters.unconfirmed
        )

    def reset(self) -> None:
        """Drop the values that differ if another box has taken the place of this one.

        The interval stays: a wrong one costs no more than an unanswered request. The
        meters stay for comparison.
        """
        self.maximum = ConfirmedValue(MINIMUM_CURRENT)
        self.minimum = ConfirmedValue(MINIMUM_CURRENT)
        self.meters.require_confirmation()
        self._quarantine.clear()
        self._accepted = self._shown = None
        self._waiting.clear()

    def accept(self, reply: Reply, now: float) -> AcceptedReply:
        """Accept a reply received at this time (s).

        Its maximum, minimum and interval count from now on, as far as they are lower.
        Raises ImplausibleReplyError for one that is quarantined: no value changes.
        """
        highest = self._highest_current(reply)
        implausible = implausible_values(reply, highest)
        totals = tuple(Total(module.energy, now) for module in reply.modules)
        for index, total in self.meters.jumps(totals, highest).items():
            implausible[Quantity.METER, index, None] = total
        checked = _Checked(reply, implausible, totals)
        if implausible and not self._is_confirmed(checked, highest):
            names = ", ".join(sorted({str(quantity) for quantity, _, _ in implausible}))
            message = f"implausible reply quarantined ({names})"
            raise ImplausibleReplyError(message)
        self._quarantine.clear()
        self._accepted = checked if implausible else None
        self._update(checked.reply)
        return self._show(checked, highest)

    def _highest_current(self, reply: Reply) -> float:
        """Return the highest used current of a phase that is plausible, A.

        From the last maximum that replies agreed on, also while it is being lowered:
        cars need time to follow. That of this reply counts only before the first one,
        since a damaged reply may raise maximum and currents together.
        """
        maximum = self.maximum.value
        if self.maximum.agreed is not None:
            maximum = max(maximum, self.maximum.agreed)
        elif reply.maximum_current <= LARGEST_CONNECTION:
            maximum = max(maximum, reply.maximum_current)
        return highest_plausible(maximum)

    def _is_confirmed(self, checked: _Checked, highest: float) -> bool:
        """Return whether enough replies agree with this one; else quarantine it."""
        if self._accepted is not None and _consistent(self._accepted, checked, highest):
            return True
        if self._quarantine and not _consistent(self._quarantine[-1], checked, highest):
            self._quarantine.clear()
        self._quarantine.append(checked)
        return len(self._quarantine) >= CONFIRMATIONS

    def _show(self, checked: _Checked, highest: float) -> AcceptedReply:
        """Show a reply if another agrees with it; its meters count only then."""
        waiting = self._waiting
        confirmed = [
            one
            for one in (self._shown, *waiting[-1:])
            if one is not None and _is_steady(one, checked)
        ]
        is_shown = (
            self._shown is None
            or bool(confirmed or checked.implausible)
            or len(waiting) + 1 >= CONFIRMATIONS
        )
        count = len(checked.totals)
        totals: Sequence[float | None] = [None] * count
        if is_shown:
            for one in waiting[-1:]:
                if one in confirmed:
                    self.meters.update(one.totals, highest)
            totals = self.meters.update(checked.totals, highest)
            self._shown = checked
            waiting.clear()
        else:
            waiting.append(checked)
        return AcceptedReply(
            reply=checked.reply,
            is_shown=is_shown,
            totals=tuple(totals),
            generations=tuple(map(self.meters.generation, range(count))),
            implausible=checked.implausible,
        )

    def _update(self, reply: Reply) -> None:
        self.maximum.update(reply.maximum_current)
        self.interval.update(reply.minimum_interval)
        smallest = min(
            (module.minimum_current for module in reply.modules),
            default=MINIMUM_CURRENT,
        )
        self.minimum.update(max(smallest, MINIMUM_CURRENT))


def _is_steady(before: _Checked, after: _Checked) -> bool:
    """Return whether two replies agree in all their values."""
    one, two = before.reply, after.reply
    return (
        (one.serial, one.minimum_interval, one.maximum_current)
        == (two.serial, two.minimum_interval, two.maximum_current)
        and len(one.modules) == len(two.modules)
        and all(
            _is_steady_module(first, second)
            for first, second in zip(one.modules, two.modules, strict=True)
        )
        and all(
            0 <= later.energy - total.energy <= _growth(first, second, later, total)
            for first, second, total, later in zip(
                one.modules, two.modules, before.totals, after.totals, strict=True
            )
        )
    )


def _is_steady_module(one: ModuleReply, two: ModuleReply) -> bool:
    pairs = {
        Quantity.CURRENT: zip(one.currents, two.currents, strict=True),
        Quantity.COS_PHI: zip(one.cos_phi, two.cos_phi, strict=True),
        Quantity.VOLTAGE: zip(one.voltages or (), two.voltages or (), strict=True),
    }
    return one.minimum_current == two.minimum_current and all(
        abs(first - second) <= _STEADY[quantity]
        for quantity, values in pairs.items()
        for first, second in values
    )


def _growth(one: ModuleReply, two: ModuleReply, later: Total, total: Total) -> float:
    """Return what a meter may have counted between two replies, Wh."""
    power = max(_most_power(one), _most_power(two))
    passed = later.at - total.at
    return _METER_STEP + _METER_FACTOR * power * passed / _SECONDS_PER_HOUR


def _most_power(module: ModuleReply) -> float:
    voltages = module.voltages or (HIGHEST_PHASE_VOLTAGE,) * 3
    return sum(
        current * (voltage or HIGHEST_PHASE_VOLTAGE)
        for current, voltage in zip(module.currents, voltages, strict=True)
    )


def _consistent(first: _Checked, second: _Checked, highest: float) -> bool:
    if (
        len(first.reply.modules) != len(second.reply.modules)
        or first.reply.serial != second.reply.serial
        or _other_places(first) != _other_places(second)
        or bool(_over_currents(first)) != bool(_over_currents(second))
    ):
        return False
    common = _over_currents(first) & _over_currents(second)
    if _over_currents(first) and not common:
        return False
    return all(
        first.totals[place[1] or 0].can_grow_to(second.totals[place[1] or 0], highest)
        if place[0] is Quantity.METER
        else agree(first.implausible[place], value, _AGREEMENT[place[0]])
        for place, value in second.implausible.items()
        if place in common or place[0] is not Quantity.CURRENT
    )


def _over_currents(checked: _Checked) -> set[Place]:
    return {place for place in checked.implausible if place[0] is Quantity.CURRENT}


def _other_places(checked: _Checked) -> set[Place]:
    return set(checked.implausible) - _over_currents(checked)
