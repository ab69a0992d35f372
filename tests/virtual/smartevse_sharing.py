"""Load balancing by a virtual SmartEVSE that is the master of its circuit.

As the 2.17 in mode normal: equal shares of the circuit's maximum for the boxes that
charge, none more than it requested, and none is added if that would leave less than the
minimum for each.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .smartevse_registers import NORMAL

if TYPE_CHECKING:
    from .smartevse_states import SmartEvseStates


class Sharing:
    """The boxes that charge (0 is the master itself), and their currents, 0.1 A."""

    def __init__(self, outlet: SmartEvseStates, units: int) -> None:
        """Begin with no box that charges."""
        self._outlet = outlet
        self.charging = [False] * units
        self.maxima = [0] * units
        self.currents = [0] * units

    def available(self) -> bool:
        """Return whether one more can have the minimum."""
        minimum = self._outlet.settings["min_current"]
        after = min(self.charging.count(True) + 1, len(self.charging))
        return after == 1 or after * minimum <= self._limit() // 10

    def split(self, own: int) -> int:
        """Share among the boxes that charge; `own`: the master's own maximum, 0.1 A."""
        out = self._outlet
        self.charging[0] = out.state == "C"
        self.maxima[0] = own
        left = [n for n, charging in enumerate(self.charging) if charging]
        least = 10 * out.settings["min_current"] * len(left)
        total = max(self._limit(), least)
        # A box that requests less than an equal share gets that; the others share the rest.
        for done, unit in enumerate(sorted(left, key=lambda n: self.maxima[n])):
            share = total // (len(left) - done)
            self.currents[unit] = min(self.maxima[unit], share)
            total -= self.currents[unit]
        return self.currents[0]

    def answer(self, unit: int, register: int, value: int) -> int:
        """Take a slave's request 01 to 04; return the value of the acknowledgement."""
        index = unit - 1
        if register in (0x01, 0x04):
            self.charging[index] = False
            return 0
        if not self.available() and not self.charging[index]:
            self.currents[index] = 0
            return 0
        self.maxima[index] = value
        if register == 0x02:
            self.currents[index] = 10 * self._outlet.settings["min_current"]
        else:
            self.charging[index] = True
            self.split(self.maxima[0])
        return self.currents[index]

    def _limit(self) -> int:
        out = self._outlet
        limit = 10 * out.settings["circuit"]
        if out.settings["mode"] != NORMAL:
            limit = min(limit, int(out.meter_leaves * 10))
        return limit
