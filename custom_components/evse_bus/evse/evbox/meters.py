"""Energy meters of the modules, which have an index and no identity.

A total is shown only while it certainly continues the one before. When the number of
modules changes, or a total jumps and stays, the module at an index may be another one:
the meter of that index gets a new generation, so that no total is carried from one
module to another (PROTOCOLS.md section 1).
"""

from collections.abc import Sequence

from ..meter import CONFIRMATIONS, Meter, Total

type Totals = tuple[Total, ...]
"""The totals of all modules, by index."""


class Meters:
    """The meters of one ChargePoint, reply after reply."""

    def __init__(self) -> None:
        """Start without totals."""
        self._confirmed: Totals | None = None
        self._must_confirm = True
        self._row: list[Totals] = []
        """Consistent totals in a row, while they must be confirmed."""
        self._meters: list[Meter] = []
        """By index, those of modules that are gone included."""

    @property
    def unconfirmed(self) -> bool:
        """Return whether the totals need more replies that agree."""
        return self._must_confirm

    def generation(self, index: int) -> int:
        """Return the generation of the meter at this index."""
        if index >= len(self._meters):
            return 0
        return self._meters[index].reading.generation

    def require_confirmation(self) -> None:
        """Show no total until `CONFIRMATIONS` replies agree: it was away."""
        self._must_confirm = True
        self._row.clear()

    def jumps(self, totals: Totals, current: float) -> dict[int, float]:
        """Return the totals that do not continue the ones before, Wh, by index.

        ``current`` is the most one module can carry, A. A change of the number of
        modules is no jump; `update` deals with it.
        """
        before = self._confirmed
        if self.unconfirmed or before is None or len(before) != len(totals):
            return {}
        return {
            index: total.energy
            for index, total in enumerate(totals)
            if not before[index].can_grow_to(total, current)
        }

    def update(self, totals: Totals, current: float) -> Sequence[float | None]:
        """Accept the totals of a reply; return those that may be shown, Wh."""
        before, row = self._confirmed, self._row
        if before is not None and len(before) != len(totals):
            self._must_confirm = True
        if self._must_confirm:
            if row and not _continue(row[-1], totals, current):
                row.clear()
            row.append(totals)
            if len(row) < CONFIRMATIONS:
                return [None] * len(totals)
            self._must_confirm = False
            row.clear()
        self._take(totals, current)
        self._confirmed = totals
        return [total.energy for total in totals]

    def _take(self, totals: Totals, current: float) -> None:
        """Give each total to the meter of its index, or to a new generation of it."""
        before = self._confirmed or ()
        same_count = len(before) == len(totals)
        for index, total in enumerate(totals):
            if index >= len(self._meters):
                self._meters.append(Meter())
            # Where the number of modules changed, a second match makes it ambiguous,
            # and an index that was gone for a while starts a new generation.
            continues = index < len(before) and before[index].can_grow_to(
                total, current
            )
            ambiguous = any(
                other.can_grow_to(total, current)
                for at, other in enumerate(before)
                if at != index
            )
            if same_count or (continues and not ambiguous):
                self._meters[index].take(total, current)
            else:
                self._meters[index].renew(total)


def _continue(before: Totals, after: Totals, current: float) -> bool:
    return len(before) == len(after) and all(
        one.can_grow_to(other, current)
        for one, other in zip(before, after, strict=True)
    )
