"""When a measured value counts: the rules that the protocols share.

Damage can pass a weak checksum. So a value that cannot be true, or that nothing else
explains, counts only when further replies agree with it.

That is for checksums of 8 bits: EVBox (sum and XOR), Modbus ASCII (sum), EWS (XOR).
SmartEVSE has a CRC of 16 bits, which finds all damages of up to 3 bits, and lets one of
65,536 others pass: at byte errors of 1e-3 one reply in months. There one is enough.
"""

from typing import Final

type Agreement = tuple[float, float]
"""Largest difference of two values: a share of the larger one, plus an amount."""

CURRENT_AGREEMENT: Final[Agreement] = (0.5, 1.0)
"""Of two implausible currents, A: what is measured varies."""

_CURRENT_FACTOR: Final = 1.1
_CURRENT_OFFSET: Final = 1.0


def highest_plausible(maximum: float) -> float:
    """Return the highest current (A) that a meter shows at a maximum (A)."""
    return maximum * _CURRENT_FACTOR + _CURRENT_OFFSET


def agree(one: float, two: float, agreement: Agreement) -> bool:
    """Return whether two values agree."""
    share, amount = agreement
    return abs(one - two) <= amount + share * max(abs(one), abs(two))
