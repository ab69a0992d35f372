"""What is shown of a charger, compared with the truth of the virtual one.

The truth is sampled whenever the virtual charger takes a step (several times a
second, and before each reply). What is shown is what the library has published last: an entity of Home
Assistant has the same. A value is wrong if the box had it at no time in the window that
a reading may need; unknown (``None``) is never wrong.
"""

import asyncio
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from custom_components.evse_bus.energy import Clocks, MeterTotal, SummedTotal
from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.model import Fault

type Values = Mapping[str, object]
"""Values by name; numbers are compared with a tolerance, others exactly."""

FRESH: Final = 6.0
"""A value that changes must have been true within this time, s."""
TOLERANCE: Final = 0.051
"""Of a number: half a step of 0.1, and rounding."""
_LOOK: Final = 1.0
"""Time between two looks at availability and limits, s."""
_NUMBERS: Final = (int, float)
_KEPT: Final = 20
"""Descriptions kept of what was wrong."""
ESTIMATE_SHARE: Final = 0.01
ESTIMATE_STEP: Final = 100.0
"""An estimate between two readings may be too high by so much, Wh, and that share."""
IDENTITY_FAULTS: Final = frozenset({Fault.WRONG_CHARGER, Fault.DUPLICATE_ADDRESS})


class History:
    """The values that one thing has had, for a while."""

    def __init__(self, keep: float) -> None:
        """Keep what was true within so many seconds."""
        self._keep = keep
        self._times: list[float] = []
        self._values: list[object] = []

    def add(self, at: float, value: object) -> None:
        """Take note of the value at a time."""
        if self._values and self._values[-1] == value:
            return
        self._times.append(at)
        self._values.append(value)
        if len(self._times) > 2 and self._times[1] < at - 2 * self._keep:  # noqa: PLR2004
            first = max(bisect_right(self._times, at - self._keep) - 1, 0)
            del self._times[:first]
            del self._values[:first]

    def had(self, shown: object, since: float, tolerance: float = TOLERANCE) -> bool:
        """Return whether it had this value at any time since then."""
        if self._values and self._values[-1] == shown:
            return True
        first = max(bisect_right(self._times, since) - 1, 0)
        values = self._values[first:]
        if not _is_number(shown):
            return shown in values
        numbers: list[Any] = [value for value in values if _is_number(value)]
        if not numbers:
            return False
        # A measured value passes through all between.
        return min(numbers) - tolerance <= shown <= max(numbers) + tolerance  # type: ignore[operator] # a number

    def __str__(self) -> str:
        """Return the last values."""
        return ", ".join(map(str, self._values[-3:]))


def _is_number(value: object) -> bool:
    return isinstance(value, _NUMBERS) and not isinstance(value, bool)


class Box(Protocol):
    """A virtual charger, as a witness knows it; one charger of the library."""

    name: str
    charger: Charger
    disturbed: bool
    """It need not be available, nor follow: the port was away."""
    windows: Mapping[str, float]
    """Values that are read less often: their window, s."""
    tolerances: Mapping[str, float]
    """Values that are shown less exactly."""
    stale: float
    """A value that is still shown must have been true within this time, s."""

    def truth(self) -> Values:
        """Return its state now."""

    def shown(self) -> Values:
        """Return the same of what the library shows."""

    def meters(self) -> Mapping[int, float]:
        """Return the truth of each meter, by connector, Wh."""

    def estimates(self) -> Mapping[int, float]:
        """Return the truth of estimated energies, by connector, Wh."""

    def offered(self) -> float:
        """Return the current that a car may draw now, A."""

    def ordered(self) -> float:
        """Return the highest current that the orders allow, A."""

    def missed(self) -> int:
        """Return how often the box has missed a keep-alive."""


class LimitWatch:
    """Watches that a current comes down to its limit, in the time allowed."""

    def __init__(
        self,
        offered: Callable[[], float],
        limit: Callable[[], float],
        allowed: float,
    ) -> None:
        """Compare an offer with its limit, A; ``allowed``: time for it, s."""
        self.times = 0
        """Times at which it stood above the limit for longer."""
        self.longest = 0.0
        """Longest time of it, s."""
        self._offered = offered
        self._limit = limit
        self._allowed = allowed
        self._loop = asyncio.get_running_loop()
        self._since: float | None = None
        self._counted = False

    def look(self, *, disturbed: bool) -> bool:
        """Look now; return whether the time allowed has just passed.

        While ``disturbed`` nothing is expected.
        """
        now = self._loop.time()
        if disturbed or self._offered() <= self._limit() + TOLERANCE:
            self._since, self._counted = None, False
            return False
        if self._since is None:
            self._since = now
        lasted = now - self._since
        self.longest = max(self.longest, lasted)
        if lasted <= self._allowed or self._counted:
            return False
        self._counted = True
        self.times += 1
        return True


@dataclass(slots=True)
class Findings:
    """What a witness has found; sums over a run."""

    wrong: int = 0
    """Values that the box did not have."""
    wrong_totals: int = 0
    """Totals beyond the truth, or that fell."""
    wrong_identities: int = 0
    """Identities of another box, and boxes taken for a wrong one."""
    lost: float = 0.0
    """Energy that is missing in the totals at the end, Wh; negative: too much."""
    counted: float = 0.0
    """Sum of the totals at the end, Wh."""
    over: int = 0
    """Times at which a limit was above its order for too long."""
    longest_over: float = 0.0
    """Longest time of a limit above its order, s."""
    missed: int = 0
    away: float = 0.0
    """Time not available, s."""
    absences: int = 0
    watched: float = 0.0
    """Time in which it should have been available, s."""
    published: int = 0
    problems: Counter[str] = field(default_factory=Counter)
    """Faults that the library has noticed."""
    notes: list[str] = field(default_factory=list)

    def note(self, text: str) -> None:
        """Keep the first descriptions."""
        if len(self.notes) < _KEPT:
            self.notes.append(text)


class Witness:
    """Watches one charger, from `begin` on."""

    def __init__(self, box: Box, allowed_over: float) -> None:
        """Prepare; ``allowed_over``: time in which a lower limit must arrive, s."""
        self.box = box
        self.found = Findings()
        self._limit = LimitWatch(box.offered, box.ordered, allowed_over)
        self._loop = asyncio.get_running_loop()
        self._history: dict[str, History] = {}
        self._published: dict[str, object] = {}
        self._totals: dict[int, MeterTotal] = {}
        self._sums: dict[int, SummedTotal] = {}
        self._shown_totals: dict[int, float] = {}
        self._available = True
        self._noticed: frozenset[Fault] = frozenset()
        self._stop: Callable[[], None] = lambda: None
        self._looking: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """Begin to watch."""
        self._stop = self.box.charger.subscribe(self.publish)
        self._look()
        self.publish()

    def end(self) -> Findings:
        """End, and return what was found."""
        self._stop()
        if self._looking is not None:
            self._looking.cancel()
        self.found.missed = self.box.missed()
        self.found.over, self.found.longest_over = (
            self._limit.times,
            self._limit.longest,
        )
        truth = {**self.box.estimates(), **self.box.meters()}
        for number, total in self._shown_totals.items():
            self.found.counted += total
            self.found.lost += truth[number] - total
        return self.found

    def sample(self) -> None:
        """Take note of the truth now, and look at the limit."""
        now = self._loop.time()
        for name, value in self.box.truth().items():
            history = self._history.get(name)
            if history is None:
                keep = max(self.box.stale, self.box.windows.get(name, 0.0))
                history = self._history[name] = History(keep)
            history.add(now, value)
        if self._limit.look(disturbed=self.box.disturbed):
            self.found.note(
                f"{self._at(now)} offers {self.box.offered():g} A,"
                f" ordered {self.box.ordered():g} A"
            )

    def publish(self) -> None:
        """Compare what is shown from now on."""
        now = self._loop.time()
        self.found.published += 1
        shown = self.box.shown()
        for name, value in shown.items():
            before = self._published.get(name)
            if value is None or (before is not None and value == before):
                continue
            window = self.box.windows.get(name, FRESH)
            self._compare(name, value, now - window, "shown")
        self._published = dict(shown)
        self._watch_totals(now)
        noticed = self.box.charger.noticed
        for fault in noticed - self._noticed:
            self.found.problems[str(fault)] += 1
            if fault in IDENTITY_FAULTS:
                self.found.wrong_identities += 1
                self.found.note(f"{self._at(now)} {fault} noticed")
        self._noticed = noticed

    def _compare(self, name: str, value: object, since: float, what: str) -> None:
        history = self._history.get(name)
        tolerance = self.box.tolerances.get(name, TOLERANCE)
        if history is not None and history.had(value, since, tolerance):
            return
        now = self._loop.time()
        if name.startswith("info."):
            self.found.wrong_identities += 1
        else:
            self.found.wrong += 1
        self.found.note(
            f"{self._at(now)} {name} {what} {value!r}, true {history}; {self._frames()}"
        )

    def _frames(self) -> str:
        """Return the last frames on the line, for whoever looks for the cause."""
        bus = self.box.charger.bus
        frames = list(bus.wire.frames)[-6:] if bus is not None else []
        return " ".join(f"{one.direction[0]}:{one.data.hex()}" for one in frames)

    def _watch_totals(self, now: float) -> None:
        """Compare the totals, as the entities make them of the readings."""
        charger = self.box.charger
        if charger.reading is None:
            return
        meters, estimates = self.box.meters(), self.box.estimates()
        for number, connector in charger.reading.connectors.items():
            if connector.energy is not None and number in meters:
                total = self._totals.setdefault(number, MeterTotal())
                shown = total.update(
                    connector.energy,
                    connector.meter_generation,
                    Clocks(monotonic=now, wall=now),
                )
                self._compare_total(number, shown, meters[number] + 1.0)
            elif connector.estimated_energy is not None and number in estimates:
                summed = self._sums.setdefault(number, SummedTotal())
                shown = summed.update(connector.estimated_energy, charger)
                most = estimates[number] * (1 + ESTIMATE_SHARE) + ESTIMATE_STEP
                self._compare_total(number, shown, most)

    def _compare_total(self, number: int, shown: float, most: float) -> None:
        before = self._shown_totals.get(number)
        self._shown_totals[number] = shown
        if shown == before or (before or 0.0) <= shown <= most:
            return
        self.found.wrong_totals += 1
        now = self._loop.time()
        self.found.note(
            f"{self._at(now)} total {number} is {shown:.0f} Wh after {before},"
            f" at most {most:.0f}; {self._frames()}"
        )

    def _look(self) -> None:
        """Look once a second: availability, and values that have grown stale."""
        now = self._loop.time()
        self._looking = self._loop.call_later(_LOOK, self._look)
        if self.box.disturbed:
            self._available = True
            return
        self.found.watched += _LOOK
        available = self.box.charger.available
        if not available:
            self.found.away += _LOOK
            self.found.absences += self._available
        self._available = available
        for name, value in self._published.items():
            if value is None or name.startswith("info."):
                continue
            window = max(self.box.stale, self.box.windows.get(name, 0.0))
            history = self._history.get(name)
            tolerance = self.box.tolerances.get(name, TOLERANCE)
            if history is None or not history.had(value, now - window, tolerance):
                self._compare(name, value, now - window, "still shown")
                # Counted once, until it is shown anew.
                self._published[name] = None

    def _at(self, now: float) -> str:
        return f"[{now:.2f} s, {self.box.name}]"
