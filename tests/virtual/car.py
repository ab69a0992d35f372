"""Virtual cars: they arrive, request charge, draw current, get full, and leave."""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from random import Random

STEP = 0.25
MAX_STEPS = 400
SECONDS_PER_HOUR = 3600.0
PHASES = 3


@dataclass
class CarLife:
    """A car that comes and goes by itself, at random; times in s, energy in Wh.

    Away, plugged in, requesting until it has the wanted energy, full, away.
    """

    seed: int = 0
    away: tuple[float, float] = (5.0, 40.0)
    hesitates: tuple[float, float] = (0.0, 8.0)
    wants_wh: tuple[float, float] = (150.0, 1500.0)
    stays: tuple[float, float] = (5.0, 30.0)
    rng: Random = field(init=False)
    _next: float | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        """Seed the random numbers."""
        self.rng = Random(self.seed)  # noqa: S311 - repeatable on purpose

    def step(self, car: Car, now: float) -> None:
        """Do the next step if it is due."""
        if car.requesting:
            return
        if self._next is None:
            due = self.away if not car.plugged else self.stays
            self._next = now + self.rng.uniform(*due)
        if now < self._next:
            return
        if not car.plugged:
            car.wanted_wh = self.rng.uniform(*self.wants_wh)
            car.plug_in(request=False)
            self._next = now + self.rng.uniform(*self.hesitates)
        elif not car.full:
            car.request()
            self._next = None
        else:
            car.leave()
            self._next = None


class Car:
    """One car: draws min(offered current, its maximum) on one to three phases.

    It follows a changed offer after `reaction` seconds, at `max_current` per `ramp`
    seconds. Below its minimum it stops. `greedy`: factor by which it draws more than
    offered (1.1 = 10 % too much). `wanted_wh` = None: never full. `requests_without_pwm`:
    requests (6 V) even when the PWM has stopped; a real car does not. `drawn_anyway`:
    current that it draws while plugged in, whatever is offered and even if the
    contactor was opened (A; a welded contactor, or another supply of the car).
    The methods may be called from any thread at any time.
    """

    def __init__(
        self,
        *,
        max_current: float = 16.0,
        min_current: float = 6.0,
        phases: int = 3,
        first_phase: int = 1,
        reaction: float = 0.5,
        ramp: float = 3.0,
        wanted_wh: float | None = None,
        cos_phi: float = 0.98,
        greedy: float = 1.0,
        requests_without_pwm: bool = False,
        drawn_anyway: float = 0.0,
        life: CarLife | None = None,
    ) -> None:
        """Make a car that is away."""
        self.max_current = max_current
        self.min_current = min_current
        self.phases = phases
        self.first_phase = first_phase
        self.reaction = reaction
        self.ramp = ramp
        self.wanted_wh = wanted_wh
        self.cos_phi = cos_phi
        self.greedy = greedy
        self.requests_without_pwm = requests_without_pwm
        self.drawn_anyway = drawn_anyway
        self.life = life
        self.plugged = False
        self.requesting = False
        self.full = False
        self.session_wh = 0.0
        self.current = 0.0
        self._last: float | None = None
        self._target = 0.0
        self._new_target = 0.0
        self._new_target_at = 0.0

    def plug_in(self, *, request: bool = True) -> None:
        """Arrive and plug in; request charge at once unless `request` is False."""
        self.session_wh = 0.0
        self.full = False
        self.plugged = True
        self.requesting = request

    def request(self) -> None:
        """Request charge."""
        self.full = False
        self.requesting = self.plugged

    def finish(self) -> None:
        """Be full: end the request, stay plugged in."""
        self.requesting = False
        self.full = True

    def leave(self) -> None:
        """Unplug and leave."""
        self.plugged = False
        self.requesting = False
        self.current = 0.0

    @property
    def phase_currents(self) -> tuple[float, float, float]:
        """Return the currents of L1, L2, L3 at its socket, A."""
        result = [0.0] * PHASES
        for index in range(self.phases):
            result[(self.first_phase - 1 + index) % PHASES] = self.current
        return (result[0], result[1], result[2])

    @property
    def uses(self) -> tuple[int, ...]:
        """Return the indexes of the phases it uses."""
        return tuple(
            sorted((self.first_phase - 1 + i) % PHASES for i in range(self.phases))
        )

    def accepts(self, offered: float) -> bool:
        """Return whether it would close the circuit, or still keeps it closed."""
        if not self.plugged or not self.requesting:
            return False
        return offered >= self.min_current or self.current > 0.0

    def step(self, now: float, offered: float | None, voltage: float = 230.0) -> float:
        """Advance to `now` with this offer, A (None: contactor open); return Wh drawn."""
        if self._last is None:
            self._last = now
            self._new_target_at = now
        if self.life is not None:
            self.life.step(self, now)
        elapsed = now - self._last
        if elapsed <= 0.0:
            return 0.0
        drawn = 0.0
        steps = min(MAX_STEPS, math.ceil(elapsed / STEP))
        begin = self._last
        for index in range(1, steps + 1):
            at = begin + elapsed * index / steps
            drawn += self._step(at, elapsed / steps, offered, voltage)
        self._last = now
        return drawn

    def _step(
        self, now: float, seconds: float, offered: float | None, voltage: float
    ) -> float:
        if (offered is None and not self.drawn_anyway) or not self.plugged:
            # The contactor is open: no current at once, and a new start later.
            self.current = self._target = self._new_target = 0.0
            self._new_target_at = now
            return 0.0
        target = 0.0
        if self.requesting and offered is not None and offered >= self.min_current:
            target = min(offered * self.greedy, self.max_current)
        target = max(target, self.drawn_anyway)
        if target != self._new_target:
            self._new_target = target
            self._new_target_at = now
        if now - self._new_target_at >= self.reaction:
            self._target = self._new_target
        before = self.current
        reach = self.max_current * seconds / self.ramp if self.ramp else math.inf
        change = max(-reach, min(reach, self._target - before))
        self.current = before + change
        mean = (before + self.current) / 2
        wh = mean * voltage * self.phases * self.cos_phi * seconds / SECONDS_PER_HOUR
        self.session_wh += wh
        if self.wanted_wh is not None and self.session_wh >= self.wanted_wh:
            self.finish()
        return wh
