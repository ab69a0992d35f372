"""The sun account of one charger: when it starts, follows the sun, and pauses.

While it is paused it counts the sun that was missed, and starts when that is enough.
While it charges it follows the sun, and may buy a little so that a cloud is no pause.
Each further start of a visit needs more sun than the one before.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from math import floor, inf
from typing import Final

from .meter import Silence
from .readings import Mode

BETWEEN_CHANGES: Final = 10.0
"""Time between two changes of a current that follows the sun, s."""
MOST_COUNTED: Final = 3.0
"""More sun than so many times the least counts as that: a short peak starts nothing."""
_TINY: Final = 1e-6
"""Of a step: what binary fractions leave."""


class Rounding(StrEnum):
    """To which whole step a current is rounded."""

    DOWN = "down"
    """The car takes no more than the sun."""
    NEAREST = "nearest"


@dataclass(frozen=True, slots=True, kw_only=True)
class Preset:
    """The numbers of a mode; shares and seconds are of the least power of the car."""

    start_share: float = 0.0
    """Only sun above this share counts as missed."""
    stop_share: float = 0.0
    """Only sun below this share counts as bought."""
    missed: float = 0.0
    """Start when so much was missed, s of the least power."""
    bought: float = inf
    """Pause when so much was bought, s of the least power."""
    patience: float = 0.0
    """Each start of the visit raises `missed` by this share."""
    between: float = 600.0
    """From start to start, s."""
    off: float = 120.0
    on: float = 180.0
    steady: float = 60.0
    """The sun must have been enough for so long, without a break, before a start, s."""
    confirm: float = 0.0
    """Up only to the least of so long, s."""
    reserve: float = 0.0
    """W of the sun that is not used."""
    rounding: Rounding = Rounding.DOWN
    pauses: bool = True
    """False: it is paused only when the meter is dead."""


PRESETS: Final[Mapping[Mode, Preset]] = {
    Mode.SUN: Preset(
        start_share=0.9,
        stop_share=0.9,
        missed=20,
        bought=40,
        patience=0.2,
        confirm=15,
    ),
    Mode.MOST_SUN: Preset(
        start_share=0.55,
        stop_share=0.5,
        missed=20,
        bought=60,
        patience=0.1,
        rounding=Rounding.NEAREST,
    ),
    Mode.SUN_ONLY: Preset(
        start_share=1.1,
        stop_share=1.0,
        missed=20,
        bought=8,
        patience=0.2,
        on=60,
        confirm=25,
        reserve=100,
    ),
    Mode.MINIMUM_AND_SUN: Preset(
        steady=0,
        rounding=Rounding.NEAREST,
        pauses=False,
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Need:
    """What the car and its charger can take."""

    minimum: float
    """A."""
    maximum: float
    """A; below the minimum nothing can be charged."""
    step: float
    """A."""
    volts: float
    phases: int

    @property
    def per_ampere(self) -> float:
        """Return the power of each ampere, W."""
        return self.volts * self.phases

    @property
    def least(self) -> float:
        """Return the least power with which it charges, W."""
        return self.minimum * self.per_ampere

    @property
    def most(self) -> float:
        """Return the most that it can take, W."""
        return self.maximum * self.per_ampere

    @property
    def possible(self) -> bool:
        """Return whether it may charge at all."""
        return self.maximum >= self.minimum

    def current(self, power: float, rounding: Rounding) -> float:
        """Return the current for a power, from the minimum to the maximum, A."""
        power = max(self.least, min(self.most, power))
        steps = power / self.per_ampere / self.step
        whole = floor(steps + (_TINY if rounding is Rounding.DOWN else 0.5))
        return max(self.minimum, min(self.maximum, round(whole * self.step, 3)))


class Waiting(StrEnum):
    """What keeps a charger where it is."""

    NOTHING = "nothing"
    """It follows the sun."""
    SUN = "sun"
    """Paused: not enough sun was missed yet."""
    STEADY = "steady"
    """Paused: enough was missed, but the sun must be enough for a while."""
    PAUSE = "pause"
    """Paused: the time from pause to start, or from start to start, is not over."""
    BUYING = "buying"
    """Charging with the minimum: the sun is less than that."""
    METER = "meter"
    """The meter is silent, or not known yet."""
    METER_DEAD = "meter_dead"
    CHARGER = "charger"
    """Order, charger or cable allow less than the minimum."""
    CAR = "car"
    """There is no car, or it takes nothing."""
    FUSE = "fuse"
    """The main fuse leaves less than the minimum."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """What the account of a charger has come to."""

    current: float
    """A; 0: pause."""
    waiting: Waiting
    short: float = 0.0
    """W of sun that are missing."""
    counted: float = 0.0
    """Wh missed, while it is paused; Wh bought, while it charges."""
    needed: float = 0.0
    """Wh at which it starts, or pauses."""
    seconds: float = 0.0
    """Time for which it must still wait, where that is known."""


class SunAccount:
    """The account of one charger in one mode."""

    def __init__(self, preset: Preset, *, charging: bool = False) -> None:
        """Begin with nothing missed or bought."""
        self.preset = preset
        self.charging = charging
        self.current = 0.0
        """A that were decided last."""
        self._counted = 0.0
        """Ws missed or bought."""
        self._started = -inf
        self._started_before = -inf
        self._paused = -inf
        self._changed = -inf
        self._steady: float | None = None
        """Time since when the sun is enough for a start."""
        self._targets: deque[tuple[float, float]] = deque()

    def hold_back(self, now: float) -> None:
        """Count from now on the times that pass between starts, as after a restart."""
        self._started = now
        self._paused = now

    def wait_left(self, now: float) -> float:
        """Return the time that must pass before a start, s; 0: it may start."""
        return max(
            0.0,
            self._paused + self.preset.off - now,
            self._started + self.preset.between - now,
        )

    def held(self, now: float) -> bool:
        """Return whether the current was changed so lately that it stays."""
        return now - self._changed < BETWEEN_CHANGES

    def enough(self, sun: float, need: Need) -> bool:
        """Return whether this sun counts as missed, W."""
        return sun - self.preset.reserve >= self.preset.start_share * need.least

    def park(self, now: float, waiting: Waiting) -> Decision:
        """Pause at once, without an account: there is nothing to charge."""
        if self.charging:
            self._pause(now)
        self._steady = None
        return Decision(current=0.0, waiting=waiting)

    def refuse(self) -> Decision:
        """Take back a start of just now, which the fuse does not permit."""
        self.charging = False
        self.current = 0.0
        self._started = self._started_before
        return Decision(current=0.0, waiting=Waiting.FUSE)

    def rest(self, need: Need) -> Decision:
        """Go on with the minimum for a car that takes nothing; nothing is bought."""
        self._targets.clear()
        self._counted = 0.0
        self.current = need.minimum
        return Decision(current=self.current, waiting=Waiting.CAR)

    def blind(self, now: float, need: Need, silence: Silence) -> Decision:
        """Decide without a meter: what charges goes down, what is paused stays so."""
        self._steady = None
        self._targets.clear()
        if silence is Silence.DEAD:
            if self.charging:
                self._pause(now)
            return Decision(current=0.0, waiting=Waiting.METER_DEAD)
        if self.charging:
            self.current = need.minimum
        return Decision(current=self.current, waiting=Waiting.METER)

    def decide(
        self, now: float, sun: float, elapsed: float, need: Need, starts: int
    ) -> Decision:
        """Start, go on or pause; `follow` has the current of one that charges.

        ``sun`` is the sun for this charger, W, during the time ``elapsed``, s, that a
        fresh report of the meter stands for (0: nothing new); ``starts`` are those of
        this visit so far.
        """
        power = sun - self.preset.reserve
        if self.charging:
            return self._charge(now, power, elapsed, need)
        return self._wait(now, power, elapsed, need, starts)

    def follow(self, now: float, sun: float, need: Need, *, fresh: bool) -> float:
        """Return the current: down at once, up to the least of the time to confirm.

        ``sun`` is what this charger may take, W.
        """
        target = need.current(sun - self.preset.reserve, self.preset.rounding)
        targets = self._targets
        if fresh or not targets or target < targets[-1][1]:
            while targets and targets[-1][1] >= target:
                targets.pop()
            targets.append((now, target))
        if fresh:
            while targets[0][0] < now - self.preset.confirm:
                targets.popleft()
        lowest = targets[0][1]
        wanted = target if target < self.current else max(self.current, lowest)
        if wanted != self.current and not self.held(now):
            self.current = wanted
            self._changed = now
        # What the charger can take may have changed at any time.
        self.current = max(need.minimum, min(need.maximum, self.current))
        return self.current

    def _wait(
        self, now: float, power: float, elapsed: float, need: Need, starts: int
    ) -> Decision:
        preset = self.preset
        wanted = preset.start_share * need.least
        surplus = min(power, MOST_COUNTED * need.least) - wanted
        enough = preset.missed * need.least * (1 + preset.patience * starts)
        # More than is needed would not fade in the time of a cloud.
        self._counted = min(max(0.0, self._counted + surplus * elapsed), enough)
        if power < wanted and preset.pauses:
            self._steady = None
        elif self._steady is None:
            self._steady = now
        left = self.wait_left(now)
        if left > 0:
            waiting = Waiting.PAUSE
        elif self._counted < enough or self._steady is None:
            waiting = Waiting.SUN
        elif (steady := now - self._steady) < preset.steady:
            waiting, left = Waiting.STEADY, preset.steady - steady
        else:
            self._start(now, need)
            return Decision(current=self.current, waiting=Waiting.NOTHING)
        return Decision(
            current=0.0,
            waiting=waiting,
            short=max(0.0, wanted - power) if preset.pauses else 0.0,
            counted=self._counted / 3600,
            needed=enough / 3600,
            seconds=left,
        )

    def _charge(self, now: float, power: float, elapsed: float, need: Need) -> Decision:
        preset = self.preset
        short = max(0.0, need.least - power)
        waiting = Waiting.BUYING if short else Waiting.NOTHING
        if not preset.pauses:
            return Decision(current=self.current, waiting=waiting, short=short)
        # What the house itself takes from the grid is not bought for the car.
        missing = preset.stop_share * need.least - max(power, 0.0)
        allowed = preset.bought * need.least
        self._counted = max(0.0, self._counted + missing * elapsed)
        if self._counted >= allowed and now - self._started >= preset.on:
            self._pause(now)
            short = max(0.0, preset.start_share * need.least - power)
            return Decision(current=0.0, waiting=Waiting.SUN, short=short)
        return Decision(
            current=self.current,
            waiting=waiting,
            short=short,
            counted=self._counted / 3600,
            needed=allowed / 3600,
        )

    def _start(self, now: float, need: Need) -> None:
        self.charging = True
        self.current = need.minimum
        self._counted = 0.0
        self._steady = None
        self._targets.clear()
        self._started_before = self._started
        self._started = self._changed = now

    def _pause(self, now: float) -> None:
        self.charging = False
        self.current = 0.0
        self._counted = 0.0
        self._targets.clear()
        self._paused = now
