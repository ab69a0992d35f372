"""From orders to a request, through the clamp."""

from dataclasses import replace
from math import ceil

from ..model import Limits, Orders
from ..safety import INTERVALS_PER_TIMEOUT, MAXIMUM_TIMEOUT, Setpoint, clamp, number
from .config import EvboxConfig
from .frames import encode_68, encode_69
from .timing import SHORTEST_INTERVAL


def effective_timeout(asked: int, interval: float) -> int:
    """Return the time-out that is sent, s: at least three minimum intervals.

    A shorter one would make the box fall back whenever one request gets lost.
    """
    shortest = ceil(INTERVALS_PER_TIMEOUT * max(interval, SHORTEST_INTERVAL))
    return min(max(asked, shortest), MAXIMUM_TIMEOUT)


def wire_setpoint(orders: Orders, limits: Limits, interval: float) -> Setpoint:
    """Return what is sent for these orders.

    Raises RefusedOrderError when an order is not a usable number.
    """
    asked = int(number(orders.fail_safe_timeout, "fail-safe time-out"))
    timeout = effective_timeout(asked, interval)
    return clamp(replace(orders, fail_safe_timeout=timeout), limits)


def encode(config: EvboxConfig, setpoint: Setpoint) -> bytes:
    """Return the request that imposes a set-point on this ChargePoint."""
    if config.command == 68:  # noqa: PLR2004 - the command's number
        return encode_68(
            setpoint, serial=config.address, information=config.information
        )
    return encode_69(setpoint)
