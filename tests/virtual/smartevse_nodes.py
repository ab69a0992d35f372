"""The nodes of a virtual SmartEVSE that is the master of a later dialect.

As the makers' masters did in the traces, section `makers_master`: it polls them, then
grants or refuses, one write after the other, then broadcasts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .smartevse_registers import LESS_6A
from .smartevse_states import MEASUREMENT

if TYPE_CHECKING:
    from .smartevse_outlet import SmartEvseOutlet
    from .smartevse_registers import Dialect

# Polls without a reply until a node counts as absent: five in the source of 3.x (v2 asks
# all each round).
MISSES = 5


@dataclass
class _Node:
    """A node as its last reply had it; `fresh`: in this round."""

    state: str = "A"
    code: int = 0
    error: int = 0
    fresh: bool = False
    misses: int = MISSES
    charging_since: float | None = None


class Nodes:
    """The nodes at units 2 to 8 of a master."""

    def __init__(self, dialect: Dialect, outlet: SmartEvseOutlet) -> None:
        """Begin without a node."""
        self._dialect = dialect
        self._outlet = outlet
        self._nodes = {unit: _Node() for unit in range(2, dialect.units + 1)}
        self._names = {code: name for name, code in dialect.states.items()}
        self._absent = 0
        self.granted: list[tuple[float, int, str]] = []

    def due(self) -> list[int]:
        """Return the units to poll this round: 3.x asks one absent one only."""
        for node in self._nodes.values():
            node.fresh = False
            node.misses = min(MISSES, node.misses + 1)
        if not self._dialect.version3:
            return list(self._nodes)
        absent = [unit for unit, node in self._nodes.items() if node.misses >= MISSES]
        self._absent += 1
        one = absent[self._absent % len(absent)] if absent else None
        return [u for u in self._nodes if u not in absent or u == one]

    def replied(self, unit: int, words: tuple[int, ...], now: float) -> None:
        """Take the reply to a poll."""
        if unit not in self._nodes or len(words) < len(("state", "error", "cable")):
            return
        node, sharing = self._nodes[unit], self._outlet.sharing
        node.code, node.error = words[:2]
        node.state = self._names.get(node.code, "A")
        node.fresh, node.misses = True, 0
        has_word_7 = self._dialect.register_of("state") == 0
        maximum = words[7 if has_word_7 else 2] if len(words) > 7 else 0
        sharing.maxima[unit - 1] = 10 * maximum
        self._charge(unit, now, charging=node.state == "C")
        # The value of one that has left stays as it was.

    def _charge(self, unit: int, now: float, *, charging: bool) -> None:
        node = self._nodes[unit]
        self._outlet.sharing.charging[unit - 1] = charging
        if not charging:
            node.charging_since = None
        elif node.charging_since is None:
            node.charging_since = now

    def next_write(self, now: float) -> tuple[int, int, int] | None:
        """Return the next unit, state and error to write, if any."""
        sharing = self._outlet.sharing
        codes = self._dialect.states
        for unit, node in self._nodes.items():
            if not node.fresh:
                continue
            asks = node.state in ("F", "G")
            if not asks and not node.error & LESS_6A:
                continue
            available = sharing.available()
            if not asks and not available:
                continue
            node.fresh = False
            if not asks:
                return unit, node.code, node.error & ~LESS_6A
            if not available:
                return unit, node.code, node.error | LESS_6A
            self.granted.append((now, unit, node.state))
            if node.state == "F":
                least = 10 * self._outlet.settings["min_current"]
                sharing.currents[unit - 1] = least
                return unit, codes["F+"], node.error & ~LESS_6A
            self._charge(unit, now, charging=True)
            return unit, codes["G+"], node.error & ~LESS_6A
        return None

    def measure(self, now: float) -> None:
        """Give each node the currents of its measurement (HEAD, `makers_master`)."""
        sharing = self._outlet.sharing
        for unit, node in self._nodes.items():
            if node.charging_since is None:
                continue
            since = now - node.charging_since
            fixed = next((one for until, one in MEASUREMENT if since < until), None)
            if fixed is not None:
                current = min(fixed, sharing.currents[unit - 1])
                sharing.currents[unit - 1] = current
