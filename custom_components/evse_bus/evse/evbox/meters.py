"""Energy meters of the modules, which have an index and no identity.

A total is shown only while it certainly continues the one before. When the number of
modules changes, or a total jumps and stays, the module at an index may be another one:
the meter of that index gets a new generation, so that no total is carried from one
module to another (PROTOCOLS.md section 1).
"""

from collections.abc import Sequence

from ..meter import Meter, Total

type Totals = tuple[Total, ...]
"""The totals of all modules, by index."""


class Meters:
    """The meters of one ChargePoint, reply after reply."""

    def __init__(self) -> None:
        """Start without totals."""
        self._confirmed: Totals | None = None
        self._unconfirmed: Totals | None = None
        self._meters: list[Meter] = []
        """By index, those of modules that are gone included."""

    @property
    def unconfirmed(self) -> bool:
        """Return whether the totals need a second reply that agrees."""
        return self._unconfirmed is not None

    def generation(self, index: int) -> int:
        """Return the generation of the meter at this index."""
        if index >= len(self._meters):
            return 0
        return self._meters[index].reading.generation

    def require_confirmation(self) -> None:
        """Show no total until two replies agree: the ChargePoint was away."""
        if self._confirmed is not None and self._unconfirmed is None:
            # Totals of no module: none can grow from them, so two more are needed.
            self._unconfirmed = ()

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
        known = self._confirmed if self._unconfirmed is None else self._unconfirmed
        if known is None or len(known) != len(totals):
            self._unconfirmed = totals
            return [None] * len(totals)
        if self._unconfirmed is not None:
            agrees = all(
                before.can_grow_to(total, current)
                for before, total in zip(self._unconfirmed, totals, strict=True)
            )
            if not agrees:
                self._unconfirmed = totals
                return [None] * len(totals)
            self._unconfirmed = None
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
