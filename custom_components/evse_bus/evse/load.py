"""Whether the deadlines of a bus can be kept at the speed of its line. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

ENDS_AT: Final = 0.9
"""An overload is over only below this share of the deadline: no report that flaps."""


@dataclass(frozen=True, slots=True)
class Overload:
    """A deadline that cannot be kept."""

    needed: float
    """Time that all turns take which are due within the deadline, s."""
    within: float
    """The deadline: time within which a turn must come again, s."""


@dataclass(frozen=True, slots=True)
class Recurring:
    """A turn that must come again and again."""

    takes: float
    """Time it usually takes, s."""
    within: float
    """Time within which it must come again, s."""


def find_overload(
    turns: Sequence[Recurring], lost: float, *, share: float = 1.0
) -> Overload | None:
    """Return the deadline that is exceeded most; ``None``: all can be kept.

    ``lost``: time of the longest turn whose reply does not come, s: one of them must
    fit as well. ``share``: the part of each deadline that may be used.
    """
    worst: Overload | None = None
    for within in {turn.within for turn in turns}:
        needed = lost + sum(
            turn.takes * max(within / turn.within, 1.0) for turn in turns
        )
        if needed <= share * within:
            continue
        if worst is None or needed / within > worst.needed / worst.within:
            worst = Overload(needed, within)
    return worst
