"""The outlet of a virtual ABL EVCC2/3: states, limits, meter. No wire.

States and their meaning: manual, annex 3.4. The manual has only some of the transitions
between them; the README lists the assumptions for the others. What only real boxes show
is from abl_field.md (its tags in brackets); what no source settles is an attribute.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from .abl_frames import (
    LOWEST_DUTY,
    LOWEST_PILOT,
    NO_CURRENT,
    SIX_AMPS,
    amps_of,
    duty_of,
)

if TYPE_CHECKING:
    from .car import Car

CONNECTED = frozenset({"B1", "B2", "C2", "C3", "C4"})
CHARGING = frozenset({"C2", "C3", "C4"})
UNREADABLE = 0x3E8
AboveDefault = Literal["clipped", "unchanged", "stored", "refused"]
LOAD_IMBALANCE_DETECTION = 0x3838
# After a meter loss 10 A (annex 3.1, LCM); assumed for BC3 to BC6.
REDUCED_CURRENT = 10.0
OVERCURRENT_STEPS = (
    # Above this share of Ic: flag bits, seconds until F9 (register 0x06, bits 2..0).
    (1.20, 0b111, 10.0),
    (1.10, 0b011, 100.0),
    (1.05, 0b101, 1000.0),
    (1.005, 0b001, float("inf")),
)


class Outlet:
    """One outlet, in device time; plain attributes may be set from any thread.

    - `en1`, `en2`: the inputs; `enable_input`: configuration bits 1..0 of register 0x02
      (0 none, 1 must be closed for B1->B2, 2 closed = outlet enabled)
    - `imbalance` BC3, `meter_failed` BC4, `hot` BC5, `upstream_lost` BC6
    """

    def __init__(
        self,
        car: Car | None = None,
        *,
        default_current: float = 16.0,
        cable_current: float | None = None,
        meter: bool = True,
        upstream_enabled: bool = False,
        upstream_timeout: float = 30.0,
        enable_input: int = 0,
    ) -> None:
        """Make an outlet, its car not plugged in."""
        self.car = car
        self.default_current = default_current
        self.cable_current = cable_current
        # Boxes of 16 A report 10B, not the 10A of the manual's rounding [trace].
        self.default_duty: int | None = None
        # Rated current, w1 of 0x0F; None: Idefault.
        self.rated_duty: int | None = None
        self.meter = meter
        # Bit 5 of 0x02; also set on boxes whose meter reports nothing [same box not
        # certain]. None: as the meter.
        self.meter_bit: bool | None = None
        # The floor of the meter on idle phases, 0.1 A [trace: 1]; 0 by the manual.
        self.idle_floor = 0
        self.enable_input = enable_input
        self.en1 = True
        self.en2 = False
        self.imbalance = self.meter_failed = self.hot = False
        self.imbalance_detection = False
        self.upstream_enabled = upstream_enabled
        self.upstream_timeout = upstream_timeout
        self.upstream_lost = False
        # Register 0x06: bit 15 (F4 or F14), 14, 5, 4, 3.
        self.timeout_triggers_f4 = True
        self.b2_needs_enable_after_power = False
        self.e0_a1_enabled = self.b1_b2_enabled = self.a1_b1_enabled = True
        # Duration of B1, and of F4 after polling has begun again, s.
        self.b1_time = 0.2
        self.f4_time = 1.0
        # Time at 100 % after which it goes to E0 by itself, as some boxes do, s.
        self.e0_after_pause: float | None = None
        self.ignore_limit = False
        self.shows_c3 = False
        # Time from a write of 0x14 to word 3 of 0x0F, and to Ic and the pilot, s: in no
        # trace; programs that read 10 to 30 s later do not complain [inferred].
        self.icmax_delay = 0.0
        self.ic_delay = 0.0
        # A pause as 0x3E8 in the Ic of 0x2E: no box is known to report it there.
        self.pause_in_ic = False
        # A code above Idefault: "internally limited" [manual]; "current stays as it was"
        # [trace]; refused, or stored as written: unknown.
        self.above_default: AboveDefault = "clipped"
        # Codes 50 to 79: refused [manual], or a 5 % pilot [notes].
        self.low_codes_taken = False
        # "Ic does show the lower one in E0" [notes]; nothing else is known.
        self.e0_keeps_icmax = True
        # A car that follows a pause late keeps the box in C; no trace. Without a car's
        # doing the contactor opens after this time, s.
        self.pause_forced_after: float | None = None
        # Word 4 of 0x0F: what is offered, but once 0 with Icmax 14 A [dump].
        self.offered_reads_zero = False
        self.five_percent = 0
        self.icmax = self.default
        self.icmax_shown = self.icmax
        self._effects: list[tuple[float, str, int]] = []
        self.state = "A1"
        self._since = 0.0
        self._last_contact = 0.0
        self._recovers_at: float | None = None
        self._paused_at: float | None = None
        self._over = 0
        self._over_since = 0.0

    @property
    def default(self) -> int:
        """Return Idefault as a duty cycle."""
        if self.default_duty is not None:
            return self.default_duty
        return duty_of(self.default_current)

    @property
    def ic(self) -> int:
        """Return Ic as 0x2E reports it: the lowest of Icmax, Idefault, Ics (annex 3.3).

        Compared as numbers: a pause (0x3E8) lowers nothing [trace: A1 215, B2 10B].
        """
        if self.pause_in_ic and self.icmax == NO_CURRENT:
            return NO_CURRENT
        candidates = [self.icmax, self.default]
        if self.cable_current is not None:
            candidates.append(duty_of(self.cable_current))
        if self.reduced:
            candidates.append(duty_of(REDUCED_CURRENT))
        return min(candidates)

    @property
    def ic_amps(self) -> float:
        """Return the current the car may draw per phase, A."""
        return 0.0 if self.icmax == NO_CURRENT else amps_of(self.ic)

    @property
    def reduced(self) -> bool:
        """Return whether BC3 to BC6 reduce the duty cycle (only in B and C)."""
        return self.state in CONNECTED and (
            self.imbalance or self.meter_failed or self.hot or self.upstream_lost
        )

    @property
    def ev_connected(self) -> bool:
        """Return whether U_CP is at most 10 V (not valid in states E and F)."""
        return self.state in CONNECTED

    @property
    def phase_currents(self) -> tuple[float, float, float]:
        """Return the actual currents, A."""
        return self.car.phase_currents if self.car else (0.0, 0.0, 0.0)

    @property
    def overcurrent(self) -> int:
        """Return bits 2..0 of the flags."""
        return self._over

    # Events at the outlet

    def stop_locally(self) -> None:
        """Disable the outlet, as by a key switch."""
        self.en1 = False
        self.go("E0")

    def start_locally(self) -> None:
        """Enable the outlet again."""
        self.en1 = True
        if self.state == "E0":
            self.go("A1")

    def fail(self, number: int) -> None:
        """Go to one of the failures F1 to F11."""
        self.go(f"F{number}")

    def clear_failure(self) -> None:
        """Leave a failure."""
        if self.state.startswith("F"):
            self.go("A1")

    def set_by_other_master(self, amps: float) -> None:
        """Set Icmax as another master would (A; 0 = no current allowed)."""
        self.icmax = self.icmax_shown = duty_of(amps)

    def write_icmax(self, code: int, now: float) -> bool:
        """Take a write of 0x14; False: refused."""
        taken = self._icmax_for(code)
        if taken is None:
            return False
        if not self.ignore_limit:
            self._effects += [
                (now + self.icmax_delay, "icmax_shown", taken),
                (now + self.ic_delay, "icmax", taken),
            ]
            self._take_effect(now)
        return True

    def _icmax_for(self, code: int) -> int | None:
        """Return the Icmax that a written code leads to; None: refused."""
        if code == NO_CURRENT:
            return code
        if code > NO_CURRENT:
            return None
        if code < LOWEST_DUTY:
            if not self.low_codes_taken or code < LOWEST_PILOT:
                return None
            self.five_percent += 1
            return code
        if code <= self.default:
            return max(code, SIX_AMPS)
        return {
            "refused": None,
            "unchanged": self.icmax,
            "stored": code,
            "clipped": self.default,
        }[self.above_default]

    def _take_effect(self, now: float) -> None:
        due = [effect for effect in self._effects if effect[0] <= now]
        self._effects = [effect for effect in self._effects if effect[0] > now]
        for _, name, code in due:
            setattr(self, name, code)

    def go(self, state: str) -> None:
        """Change the state."""
        if state != self.state:
            self.state = state
            if state == "E0" and not self.e0_keeps_icmax:
                self._forget_icmax()
            self._since = self._now
            self._recovers_at = None

    def execute(self, value: int) -> bool:
        """Execute a value of register 0x05 (not the reset); False: not in this state."""
        allowed = {
            # The manual requires no state for E0; in a failure, E0 would hide it.
            0xE0E0: not self.state.startswith("F"),
            0xF1F1: True,
            0xA1A1: self.state == "E2" or (self.state == "E0" and self.e0_a1_enabled),
            0xE2E2: self.state in ("A1", "E0"),
            0x3838: self.state == "E2",
        }.get(value, False)
        if allowed and value == LOAD_IMBALANCE_DETECTION:
            self.imbalance_detection = True
        elif allowed:
            self.go(f"{value >> 12 & 0xF:X}{value >> 8 & 0xF}")
        return allowed

    # Time

    _now = 0.0

    def restart(self, now: float) -> None:
        """Start as after a power cycle: Icmax is Idefault again."""
        self._now = now
        self._forget_icmax()
        self.upstream_lost = False
        self._last_contact = now
        self._over = 0
        plugged = self.car is not None and self.car.plugged
        self.b1_b2_enabled = not (self.b2_needs_enable_after_power and plugged)
        self.go("A1")

    def _forget_icmax(self) -> None:
        self._effects = []
        self.icmax = self.icmax_shown = self.default

    def contact(self, now: float) -> None:
        """Take note of a request, for the upstream time-out."""
        self._last_contact = now
        self.upstream_lost = False
        if self.state == "F4" and self._recovers_at is None:
            self._recovers_at = now + self.f4_time

    def step(self, now: float) -> None:
        """Advance to this time."""
        self._now = now
        self._take_effect(now)
        self._watch_upstream(now)
        if self.enable_input == 2 and not self.en1 and self.state[0] in "ABC":
            self.go("E0")
        # From A1 to C2 there are three transitions, which may all be due.
        for _ in range(3):
            before = self.state
            self._transition(now)
            if before == self.state:
                break
        offered = self.ic_amps if self.state in CHARGING else None
        if self.car is not None:
            self.car.step(now, offered)
        self._watch_current(now)
        self._watch_pause(now)

    def _watch_upstream(self, now: float) -> None:
        if self._recovers_at is not None and now >= self._recovers_at:
            self.go("A1")
        if not self.upstream_enabled or self.state[0] not in "ABC":
            return
        if now - self._last_contact > self.upstream_timeout:
            self.upstream_lost = True
            if self.timeout_triggers_f4:
                self.go("F4")

    def _transition(self, now: float) -> None:
        plugged = self.car is not None and self.car.plugged
        state = self.state
        if state in CONNECTED and not plugged:
            self.go("A1")
        elif state == "A1" and plugged and self.a1_b1_enabled:
            self.go("B1")
        elif state == "B1":
            allowed = self.b1_b2_enabled and (self.enable_input != 1 or self.en1)
            if allowed and now - self._since >= self.b1_time:
                self.go("B2")
        elif state in CONNECTED:
            wants = self.car is not None and self.car.accepts(self.ic_amps)
            wants = wants and not self._pause_is_forced(now)
            self.go(self._charging_state() if wants else "B2")

    def _pause_is_forced(self, now: float) -> bool:
        if self.pause_forced_after is None or self._paused_at is None:
            return False
        return now - self._paused_at >= self.pause_forced_after

    def _charging_state(self) -> str:
        if self.imbalance:
            return "C4"
        if self.hot or self.meter_failed or self.upstream_lost:
            return "C3"
        if self.shows_c3 and max(self.phase_currents) > 1.0:
            return "C3"
        return "C2"

    def _watch_current(self, now: float) -> None:
        allowed = self.ic_amps
        over, patience = 0, float("inf")
        if self.state in CHARGING and allowed:
            share = max(self.phase_currents) / allowed
            for threshold, bits, seconds in OVERCURRENT_STEPS:
                if share > threshold:
                    over, patience = bits, seconds
                    break
        if over != self._over:
            self._over = over
            self._over_since = now
        elif over and now - self._over_since >= patience:
            self.go("F9")

    def _watch_pause(self, now: float) -> None:
        if self.icmax != NO_CURRENT:
            self._paused_at = None
        elif self._paused_at is None:
            self._paused_at = now
        elif (
            self.e0_after_pause is not None
            and now - self._paused_at >= self.e0_after_pause
            and self.state[0] in "ABC"
        ):
            # By itself, mainly after long pauses [told]; the time is unknown.
            self.go("E0")
