"""Which meter is behind which number: modules have an index and no identity.

A meter total is shown only while it is certain that it goes on where it was.
When the number of modules changes, or a meter jumps and stays there, what is
behind a number may be another module: its generation counts up, so that nobody
carries a total from one module to another (PROTOCOLS.md section 1).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

SLACK: Final = 100
"""Steps in which a coarse meter may count, Wh."""
HIGHEST_PHASE_VOLTAGE: Final = 265.0
"""230 V + 15 %, V: what a meter may have counted with at most."""
_PHASES: Final = 3
_SECONDS_PER_HOUR: Final = 3600.0


def most_energy(seconds: float, current: float) -> float:
    """Return the most a meter can count in a time at a current on 3 phases, Wh."""
    power = current * _PHASES * HIGHEST_PHASE_VOLTAGE
    return SLACK + power * max(seconds, 0.0) / _SECONDS_PER_HOUR


@dataclass(frozen=True, slots=True)
class Totals:
    """The meters of all modules at one time."""

    totals: tuple[int, ...]
    """Wh, by module."""
    at: float
    """s"""

    def goes_on(self, index: int, later: int, at: float, current: float) -> bool:
        """Return whether a later total may be of the same meter."""
        if index >= len(self.totals):
            return False
        grown = later - self.totals[index]
        return 0 <= grown <= most_energy(at - self.at, current)


class Meters:
    """Follows the meters of one ChargePoint."""

    def __init__(self) -> None:
        """Know no meter yet."""
        self._certain: Totals | None = None
        self._settling: Totals | None = None
        self._generations: dict[int, int] = {}

    @property
    def settling(self) -> bool:
        """Return whether the totals wait for a second reply that agrees."""
        return self._settling is not None

    def generation(self, index: int) -> int:
        """Return how often the meter at this index has been another one."""
        return self._generations.get(index, 0)

    def unsettle(self) -> None:
        """Show no total before two replies agree: the ChargePoint was away."""
        if self._certain is not None and self._settling is None:
            # Totals of no reply: none can go on from here, so two more are needed.
            self._settling = Totals((), self._certain.at)

    def jumps(
        self, totals: Sequence[int], now: float, current: float
    ) -> dict[int, float]:
        """Return the modules whose total cannot be, with that total, Wh.

        ``current`` is what one module may carry, A. A change of the number of
        modules is no jump: it is settled by `take`.
        """
        before = self._certain
        if self.settling or before is None or len(before.totals) != len(totals):
            return {}
        return {
            index: total
            for index, total in enumerate(totals)
            if not before.goes_on(index, total, now, current)
        }

    def take(
        self, totals: Sequence[int], now: float, current: float
    ) -> tuple[float | None, ...]:
        """Take the totals of a reply as true; return what may be shown, Wh."""
        new = Totals(tuple(totals), now)
        unknown = (None,) * len(new.totals)
        known = self._settling or self._certain
        if known is None or len(known.totals) != len(new.totals):
            self._settling = new
            return unknown
        if self._settling is not None:
            settled = all(
                self._settling.goes_on(index, total, now, current)
                for index, total in enumerate(new.totals)
            )
            if not settled:
                self._settling = new
                return unknown
            self._settling = None
        self._identify(new, current)
        self._certain = new
        return new.totals

    def _identify(self, new: Totals, current: float) -> None:
        """Count up the generation of each number that may be another meter now."""
        before = self._certain or Totals((), new.at)
        same_number = len(before.totals) == len(new.totals)
        for index, total in enumerate(new.totals):
            if index >= len(before.totals):
                # A number not seen lately: whatever it was, it starts anew.
                if index in self._generations:
                    self._generations[index] += 1
                continue
            its_own = before.goes_on(index, total, new.at, current)
            # Where modules came or went, another meter that fits makes it doubtful.
            doubtful = not same_number and any(
                before.goes_on(other, total, new.at, current)
                for other in range(len(before.totals))
                if other != index
            )
            if not its_own or doubtful:
                self._generations[index] = self.generation(index) + 1
        for index in range(len(new.totals)):
            self._generations.setdefault(index, 0)
