"""Conversion between current and duty cycle of the control pilot (0.1 %).

Source: ABL EVCC2/3 manual, annex 3.2 (IEC 61851-1, annex A); PROTOCOLS.md, 2:

=============  ======================  =====================================
duty cycle     current                 remark
=============  ======================  =====================================
0 %            unknown                 pilot at -12 V, not available
5 %            unknown                 set by digital communication
8 to 10 %      6 A                     register 0x0014 accepts 8 % and more
10 to 85 %     0.6 A for each percent  6 to 51 A
85 to 96 %     2.5 A x (percent - 64)  52.5 to 80 A
96 to 97 %     80 A                    as a car decodes it (IEC 61851-1)
100 %          0 A                     no current allowed: the pause
=============  ======================  =====================================

Any other duty cycle has no current. The branches do not meet: a current above 51 A
and below 52.5 A has no code of its own and becomes 51 A.
"""

from decimal import ROUND_FLOOR, Decimal
from functools import lru_cache
from typing import Final

from ..errors import RefusedOrderError
from ..model import MAXIMUM_CURRENT, MINIMUM_CURRENT

PAUSE: Final = 0x3E8
"""100 %: no current allowed; a plugged cable is still detected."""

_LOWEST: Final = 80
_MINIMUM: Final = 100
_LOWER_END: Final = 850
_TOLERATED_END: Final = 970
_UPPER_BEGIN: Final = Decimal("52.5")


@lru_cache
def duty_for(current: float) -> int:
    """Return the duty cycle (0.1 %) that offers at most this current (A).

    0 A is the pause. Rounded down, as the manual does (16 A: 26.6 %). Raises
    RefusedOrderError for a current that no duty cycle can offer.
    """
    if current == 0:
        return PAUSE
    if not current >= MINIMUM_CURRENT:
        message = f"no duty cycle offers {current:g} A"
        raise RefusedOrderError(message)
    amperes = Decimal(repr(min(current, MAXIMUM_CURRENT)))
    if amperes < _UPPER_BEGIN:
        return min(_floor(amperes / Decimal("0.06")), _LOWER_END)
    return _floor((amperes / Decimal("2.5") + 64) * 10)


def current_for(duty: int) -> float | None:
    """Return the current (A) that a duty cycle (0.1 %) offers; ``None``: unknown."""
    if duty == PAUSE:
        return 0.0
    if not _LOWEST <= duty <= _TOLERATED_END:
        return None
    if duty <= _MINIMUM:
        return MINIMUM_CURRENT
    if duty <= _LOWER_END:
        return float(duty * Decimal("0.06"))
    return min(float((Decimal(duty) / 10 - 64) * Decimal("2.5")), MAXIMUM_CURRENT)


@lru_cache
def highest_current(duty: int) -> float | None:
    """Return the highest current (A, in 0.1 A) whose duty cycle is at most this one.

    ``None``: below the minimum, or no limit at all.
    """
    if not _MINIMUM <= duty <= _TOLERATED_END or (current := current_for(duty)) is None:
        return None
    tenths = _floor(Decimal(repr(current)) * 10)
    # 32 A is sent as 53.3 %, which is 31.98 A; above 52.5 A a code spans 0.25 A.
    return max(
        current
        for step in range(tenths, tenths + 4)
        if duty_for(current := min(step / 10, MAXIMUM_CURRENT)) <= duty
    )


def _floor(value: Decimal) -> int:
    return int(value.to_integral_value(ROUND_FLOOR))
