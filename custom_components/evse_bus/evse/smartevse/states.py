"""The states of a SmartEVSE v2, and what can be said from them.

Source: README of v2, register 0x00A0 (A to H, T), README of later versions, register
0x0000 (B1, C1), and PROTOCOLS.md, 3. Where access is off, 2.17 and 2.20 say ``A``
whatever is plugged in; later ones say B1, or C1 for the seconds in which the car ends.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from ..model import MAXIMUM_CURRENT, MINIMUM_CURRENT, Fault, Status as Word
from .dialects import Dialect, Status

UNPLUGGED: Final = "A"
CHARGING: Final = frozenset({"C", "D"})
"""The contactor is closed."""
STOPPING: Final = "C1"
"""No current is offered; the contactor opens within 6 s."""

_CLOSED: Final = (UNPLUGGED, "B1", STOPPING)
_STOPPED_BY: Final = frozenset({Fault.NO_COMM, Fault.TEMP_HIGH, Fault.RCD})
"""Faults of box or installation; the others mean that there is no current now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """What a state says by itself; ``None``: not told."""

    status: Word
    plugged: bool | None
    charging: bool | None = False
    offers: bool | None = False
    """The pilot tells the car a current; ``None``: nobody is told one."""


_PREPARING: Final = State(status=Word.PREPARING, plugged=True)
_COMMON: Final[Mapping[str, State]] = {
    "A": State(status=Word.AVAILABLE, plugged=False, offers=None),
    # The car may draw current, and does not: not yet, or not any more.
    "B": State(status=Word.SUSPENDED_EV, plugged=True, offers=True),
    "C": State(status=Word.CHARGING, plugged=True, charging=True, offers=True),
    "D": State(status=Word.CHARGING, plugged=True, charging=True, offers=True),
    # Wakes a car up: for 3 s the pilot says that there is no charger.
    "T": State(status=Word.SUSPENDED_EV, plugged=True),
    "B1": State(status=Word.SUSPENDED_EVSE, plugged=True),
    "C1": State(status=Word.SUSPENDED_EVSE, plugged=True, charging=None),
}
_V2_17: Final[Mapping[str, State]] = {
    **_COMMON,
    # Waiting for the master's word: to A, to B, to C, from C to B.
    "E": State(status=Word.FINISHING, plugged=False),
    "F": _PREPARING,
    "G": State(status=Word.PREPARING, plugged=True, offers=True),
    "H": State(status=Word.FINISHING, plugged=True),
}
_NUMBERED: Final[Mapping[str, State]] = {
    **_COMMON,
    # Asking for B, told to go to B, asking for C, told to go to C.
    "E": _PREPARING,
    "F": _PREPARING,
    "G": State(status=Word.PREPARING, plugged=True, offers=True),
    "H": State(status=Word.PREPARING, plugged=True, offers=True),
}


def state_of(dialect: Dialect, raw_state: str) -> State:
    """Return what a state says; all that `decode_status` tells are known."""
    table = _V2_17 if dialect is Dialect.V2_17 else _NUMBERED
    return table[raw_state]


def tells_plug(dialect: Dialect, status: Status) -> bool:
    """Return whether the state says if a car is plugged in.

    FollowUp boxes keep the pilot in sight (B1); before, ``A`` also stands for "stopped"
    where access is off or an error is set.
    """
    if status.raw_state != UNPLUGGED or dialect is Dialect.LATER:
        return True
    return status.access and not status.faults


def is_stopped(dialect: Dialect, status: Status) -> bool:
    """Return whether a box with access off has also obeyed it."""
    if status.access:
        return False
    # A later one that wakes a car up (T) goes on to B, and from there to C.
    return status.raw_state in (_CLOSED if dialect is Dialect.LATER else (UNPLUGGED,))


def offered(dialect: Dialect, status: Status) -> float | None:
    """Return the current that the pilot offers the car, A; ``None``: to nobody.

    Where the box has no current to say it says 6 A (PROTOCOLS.md, 3).
    """
    offers = state_of(dialect, status.raw_state).offers
    if offers is None:
        return None if status.access else 0.0
    if not offers:
        return 0.0
    if MINIMUM_CURRENT <= status.current <= MAXIMUM_CURRENT:
        return status.current
    return MINIMUM_CURRENT


def word_of(dialect: Dialect, status: Status) -> Word:
    """Return the state in the words of OCPP.

    ``A`` without access is "unavailable": whether a car waits there, the box does not
    say. An error that stops it is a fault; a lack of current or sun only a wait.
    """
    if status.faults & _STOPPED_BY:
        return Word.FAULTED
    if status.raw_state == UNPLUGGED:
        if not status.access:
            return Word.UNAVAILABLE
        if status.faults:
            return Word.SUSPENDED_EVSE
    return state_of(dialect, status.raw_state).status
