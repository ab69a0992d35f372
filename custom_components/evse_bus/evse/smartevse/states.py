"""The states of a SmartEVSE and their meaning. Pure.

Source: README of v2, register 0x00A0 (A to H, T), README of later versions, register
0x0000 (B1, C1), and PROTOCOLS.md, 3. With access off, 2.17 to 2.30 report ``A`` also
for a plugged car; later ones report B1, or C1 for the seconds until the car has ended.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from ..model import MAXIMUM_CURRENT, MINIMUM_CURRENT, Fault, Status as OcppStatus
from .dialects import ASKS_FOR_B, ASKS_FOR_C, MAPS, Dialect, Status

UNPLUGGED: Final = "A"
CHARGING: Final = frozenset({"C", "D"})
"""The contactor is closed."""
WAITING: Final = frozenset("EFGH")
"""It waits for its master's answer."""
STOPPING: Final = "C1"
"""No current is offered; the contactor opens within 7 s."""

_STOPPED: Final = (UNPLUGGED, "B1", STOPPING, ASKS_FOR_B, ASKS_FOR_C)
"""States of a box without access. One that asks goes on asking, and is refused."""
_STOPPED_BY: Final = frozenset({Fault.NO_COMM, Fault.TEMP_HIGH, Fault.RCD})
"""Faults of box or installation; the others mean that there is no current now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """The meaning of a state by itself; ``None``: unknown."""

    status: OcppStatus | None
    plugged: bool | None
    charging: bool | None = False
    offers: bool | None = False
    """The pilot offers a current, or may; ``None``: there is no car to offer it to."""


UNKNOWN: Final = State(status=None, plugged=None, charging=None, offers=True)
"""A state without a name: a modem's in 3.x, or one of newer firmware."""

_PREPARING: Final = State(status=OcppStatus.PREPARING, plugged=True)
_COMMON: Final[Mapping[str, State]] = {
    "A": State(status=OcppStatus.AVAILABLE, plugged=False, offers=None),
    # The car may draw current and does not: not yet, or no longer.
    "B": State(status=OcppStatus.SUSPENDED_EV, plugged=True, offers=True),
    "C": State(status=OcppStatus.CHARGING, plugged=True, charging=True, offers=True),
    "D": State(status=OcppStatus.CHARGING, plugged=True, charging=True, offers=True),
    # Wakes a car up: for 3 s the pilot is as if there were no charger.
    "T": State(status=OcppStatus.SUSPENDED_EV, plugged=True),
    "B1": State(status=OcppStatus.SUSPENDED_EVSE, plugged=True),
    "C1": State(status=OcppStatus.SUSPENDED_EVSE, plugged=True, charging=None),
}
_V2_17: Final[Mapping[str, State]] = {
    **_COMMON,
    # Waiting for the master's answer: to A, to B, to C, from C to B.
    "E": State(status=OcppStatus.FINISHING, plugged=False),
    "F": _PREPARING,
    "G": State(status=OcppStatus.PREPARING, plugged=True, offers=True),
    "H": State(status=OcppStatus.FINISHING, plugged=True),
}
_NUMBERED: Final[Mapping[str, State]] = {
    **_COMMON,
    # B requested, B granted, C requested, C granted.
    "E": _PREPARING,
    "F": _PREPARING,
    "G": State(status=OcppStatus.PREPARING, plugged=True, offers=True),
    "H": State(status=OcppStatus.PREPARING, plugged=True, offers=True),
}


def state_of(dialect: Dialect, raw_state: str) -> State:
    """Return the meaning of a state, which may be `UNKNOWN`."""
    table = _V2_17 if dialect is Dialect.V2_17 else _NUMBERED
    return table.get(raw_state, UNKNOWN)


def faults_of(dialect: Dialect, status: Status) -> frozenset[Fault]:
    """Return the error bits by name."""
    names = MAPS[dialect].faults
    return frozenset(fault for bit, fault in names.items() if status.error & bit)


def shows_plug(status: Status) -> bool:
    """Return whether the state shows if a car is plugged in.

    Without access, and while an error stands, all dialects report ``A`` for a car that
    comes then, and some for one that was there before (`Map.shows_plug`).
    """
    is_unplugged = status.raw_state == UNPLUGGED
    return not is_unplugged or (status.access is True and not status.error)


def is_stopped(dialect: Dialect, status: Status) -> bool:
    """Return whether access is off and the box has obeyed it."""
    if status.access is not False:
        return False
    # One that wakes a car up (T) goes on to B, and from there to C.
    stopped = _STOPPED if MAPS[dialect].shows_plug else (UNPLUGGED,)
    return status.raw_state in stopped


def offered(
    dialect: Dialect, status: Status, *, has_master: bool = False
) -> float | None:
    """Return the current that the pilot offers, or may, A; ``None``: there is no car.

    A box whose current is out of range offers 6 A; but one without a master that begins
    a charge at its maximum may report 0 then (`Map.begins_at_0`; PROTOCOLS.md, 3).
    """
    offers = state_of(dialect, status.raw_state).offers
    if offers is None:
        return 0.0 if status.access is False else None
    if not offers:
        return 0.0
    if MINIMUM_CURRENT <= status.current <= MAXIMUM_CURRENT:
        return status.current
    may_begin_at_0 = MAPS[dialect].begins_at_0 and not has_master
    if may_begin_at_0 and status.current == 0 and status.maximum is not None:
        return float(max(status.maximum, MINIMUM_CURRENT))
    return MINIMUM_CURRENT


def ocpp_status(dialect: Dialect, status: Status) -> OcppStatus | None:
    """Return the state as a status of OCPP; ``None``: it has no known meaning.

    ``A`` without access is out of service: a car may be plugged in or not. An error
    that stops the box is a fault; a lack of current or sun is a pause.
    """
    faults = faults_of(dialect, status)
    if faults & _STOPPED_BY:
        return OcppStatus.FAULTED
    if status.raw_state == UNPLUGGED:
        if status.access is False:
            return OcppStatus.OUT_OF_SERVICE
        if faults:
            return OcppStatus.SUSPENDED_EVSE
    return state_of(dialect, status.raw_state).status
