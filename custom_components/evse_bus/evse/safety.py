"""From orders to a set-point: the only way to an encoder. Pure functions.

Every number that reaches a charger's wire as a current comes out of `clamp`.
Encoders take a `Setpoint`, and only this module makes one (a test holds that).
"""

from dataclasses import dataclass
from decimal import ROUND_FLOOR, Decimal
from math import isfinite
from numbers import Real

from .errors import RefusedOrderError
from .model import (
    CurrentLimit,
    Limits,
    OrderChange,
    Orders,
    PauseReason,
    Phases,
)

MAXIMUM_TIMEOUT = 0xFFFF
"""Longest fail-safe time-out that a protocol can encode, s (EVBox: one word)."""
INTERVALS_PER_TIMEOUT = 3
"""A time-out is at least this many intervals: two requests in a row may get lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setpoint:
    """Currents that may go to the wire, A, already clamped and rounded down."""

    currents: Phases[float]
    """For L1, L2, L3: each 0 or from the minimum to the ceiling."""
    fail_safe: Phases[float]
    """For L1, L2, L3 after silence: each from 0 to the ceiling."""
    fail_safe_timeout: int
    """s, at least 1."""

    @property
    def paused(self) -> bool:
        """Return whether no phase may carry current: the protocol's real pause."""
        return not any(self.currents)

    @property
    def current(self) -> float:
        """Return the current of a protocol without phase limits: the smallest, A."""
        return min(self.currents)


def number(value: object, what: str = "value") -> float:
    """Return a requested value as a finite, non-negative float.

    Raises RefusedOrderError for anything else: NaN passes Home Assistant's own
    range check, and a bool or a string is not a current.
    """
    if isinstance(value, bool) or not isinstance(value, (Real, Decimal)):
        message = f"{what} is not a number: {value!r}"
        raise RefusedOrderError(message)
    result = float(value)
    if not isfinite(result):
        message = f"{what} is not a finite number: {value!r}"
        raise RefusedOrderError(message)
    if result < 0:
        message = f"{what} is negative: {value!r}"
        raise RefusedOrderError(message)
    return result


def round_down(value: float, step: float) -> float:
    """Return the highest multiple of ``step`` that is not above ``value``, A.

    Decimal, because ``6.9 // 0.1`` is 68 in binary floating point, and a value
    that is already a multiple of the step must stay what it is.
    """
    grid = Decimal(repr(step))
    steps = (Decimal(repr(value)) / grid).to_integral_value(ROUND_FLOOR)
    return float(steps * grid)


def clamp(orders: Orders, limits: Limits) -> Setpoint:
    """Return the set-point for these orders within these limits.

    A limit below the minimum is a pause, of all phases unless each stands alone: that
    a charger can leave out a single phase is in no manual. A fail-safe current may be
    anything (the manual of the EVBox has 4, 8 and 7 A). Raises RefusedOrderError when
    an order is not a finite number from 0.
    """
    # The limit behind a pause is checked too: a bad one must not wait for the end.
    limit = _clamp_limit(orders.limit, limits)
    return Setpoint(
        currents=_chargeable(
            (0.0, 0.0, 0.0) if orders.allowed is False else limit, limits
        ),
        fail_safe=_clamp_limit(orders.fail_safe, limits),
        fail_safe_timeout=_clamp_timeout(orders.fail_safe_timeout),
    )


def pause_reason(orders: Orders, limits: Limits) -> PauseReason | None:
    """Return why these orders let no car charge; ``None``: at least one phase may.

    Raises RefusedOrderError when a limit is not a finite number from 0.
    """
    if orders.allowed is False:
        return PauseReason.NOT_ALLOWED
    if any(_chargeable(_clamp_limit(orders.limit, limits), limits)):
        return None
    if round_down(limits.ceiling, limits.step) < limits.minimum:
        return PauseReason.MAXIMUM_TOO_LOW
    return PauseReason.LIMIT_TOO_LOW


def _chargeable(currents: Phases[float], limits: Limits) -> Phases[float]:
    """Return the currents with which a car may charge: 0 or at least the minimum."""
    one, two, three = (value if value >= limits.minimum else 0.0 for value in currents)
    if not limits.phases_alone and not (one and two and three):
        return (0.0, 0.0, 0.0)
    return one, two, three


def _clamp_limit(limit: CurrentLimit, limits: Limits) -> Phases[float]:
    ceiling = number(limits.ceiling, "ceiling")
    # Each value on its own first: min() passes a NaN or not, depending on its place.
    for value in (limit.current, *limit.phases):
        if value is not None:
            number(value, "current")
    one, two, three = (
        round_down(min(value, ceiling), limits.step) for value in limit.effective()
    )
    return one, two, three


def _clamp_timeout(value: int) -> int:
    seconds = number(value, "fail-safe time-out")
    return int(min(max(seconds, 1), MAXIMUM_TIMEOUT))


def check_change(change: OrderChange, limits: Limits) -> OrderChange:
    """Return a change as it will be stored: finite and on the protocol's step.

    A current may be anything from 0 to the installation limit. What charger and cable
    can do counts in `clamp` only: an order outlasts both, and a request to lower the
    current is never refused. Raises RefusedOrderError for anything else.
    """
    return OrderChange(
        allowed=change.allowed,
        current=_check(change.current, limits, "current"),
        phases=_check_phases(change.phases, limits, "phase"),
        fail_safe_current=_check(change.fail_safe_current, limits, "fail-safe"),
        fail_safe_phases=_check_phases(
            change.fail_safe_phases, limits, "fail-safe phase"
        ),
        fail_safe_timeout=_check_timeout(change.fail_safe_timeout),
    )


def _check_phases(
    phases: Phases[float | None], limits: Limits, what: str
) -> Phases[float | None]:
    one, two, three = (_check(value, limits, what) for value in phases)
    return one, two, three


def _check(value: float | None, limits: Limits, what: str) -> float | None:
    if value is None:
        return None
    checked = number(value, what)
    if checked > limits.installation:
        message = f"{what} {checked:g} A is above the {limits.installation:g} A limit"
        raise RefusedOrderError(message)
    return round_down(checked, limits.step)


def _check_timeout(value: int | None) -> int | None:
    if value is None:
        return None
    seconds = number(value, "fail-safe time-out")
    if not 1 <= seconds <= MAXIMUM_TIMEOUT:
        message = f"fail-safe time-out {seconds:g} s is not within 1..{MAXIMUM_TIMEOUT}"
        raise RefusedOrderError(message)
    return int(seconds)


def cautious(old: Orders, new: Orders) -> Orders:
    """Return the lower of two sets of orders, field by field.

    It is stored before a change is sent: a lowering counts at once, a raise only when
    the charger has confirmed it. A longer time-out is neither safer nor less safe in
    general, so a new one waits for the confirmation.
    """
    return Orders(
        allowed=_less_allowed(old.allowed, new.allowed),
        limit=_lower_limit(old.limit, new.limit),
        fail_safe=_lower_limit(old.fail_safe, new.fail_safe),
        fail_safe_timeout=old.fail_safe_timeout,
        remembered=old.remembered,
    )


def _less_allowed(old: bool | None, new: bool | None) -> bool | None:  # noqa: FBT001
    if old is False or new is False:
        return False
    return old


def _lower_limit(old: CurrentLimit, new: CurrentLimit) -> CurrentLimit:
    one, two, three = (
        second if first is None else first if second is None else min(first, second)
        for first, second in zip(old.phases, new.phases, strict=True)
    )
    return CurrentLimit(current=min(old.current, new.current), phases=(one, two, three))


def expired(orders: Orders) -> Orders:
    """Return the orders that follow after their lifetime: the fail-safe is the limit.

    Permission stays what it is: no passing of time starts a stopped car.
    """
    return Orders(
        allowed=orders.allowed,
        limit=orders.fail_safe,
        fail_safe=orders.fail_safe,
        fail_safe_timeout=orders.fail_safe_timeout,
        remembered=orders.remembered,
    )
