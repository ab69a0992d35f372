"""The status byte of an EWS-Box's port, what it says, and what may be ordered in it.

Source: manual, 3.2.4 (``rc``, ``sl``), 3.1.2 (0xAx, 0xFF), 3.1.5, 3.1.8; PROTOCOLS.md,
section 4.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final

from ...errors import NotAvailableError
from ...model import Fault, Status
from .box_status import BoxFlags, BoxStatus
from .status import ChargeResult, PortStatus, StartRelease

FREE: Final = 0x00
SEARCHING: Final = 0x10
WAITING: Final = 0x30
CHARGING: Final = 0x40
CHARGING_OPTIMISED: Final = 0x41
PAUSED: Final = 0x42
PAUSED_OPTIMISED: Final = 0x43
ENDED: Final = 0x50
ABORTED: Final = 0x60
BLOCKED: Final = 0xA9
STARTING: Final = 0xF0
TEST: Final = 0xFF

_ERRORS: Final = 0xA0
_GROUP: Final = 0xF0


@dataclass(frozen=True, slots=True)
class State:
    """What a status byte says by itself; ``None``: not told."""

    name: str
    """The byte in hex, as the manual writes it."""
    status: Status | None = None
    plugged: bool | None = None
    """A cable is in the socket; with a fixed cable: a car is on it."""
    charging: bool | None = None
    fault: Fault | None = None


def _state(
    code: int, status: Status, *, plugged: bool | None, charging: bool = False
) -> State:
    return State(f"0x{code:02X}", status, plugged, charging)


def _error(code: int, fault: Fault) -> State:
    # Whether current still flows is for the contactor to say.
    return State(f"0x{code:02X}", Status.FAULTED, fault=fault)


STATES: Final[Mapping[int, State]] = {
    FREE: _state(FREE, Status.AVAILABLE, plugged=False),
    # A cable that can be pulled is in the socket; a fixed one always is.
    SEARCHING: _state(SEARCHING, Status.PREPARING, plugged=None),
    WAITING: _state(WAITING, Status.PREPARING, plugged=True),
    CHARGING: _state(CHARGING, Status.CHARGING, plugged=True, charging=True),
    CHARGING_OPTIMISED: _state(
        CHARGING_OPTIMISED, Status.CHARGING, plugged=True, charging=True
    ),
    # The car is not ready (3.1.5).
    PAUSED: _state(PAUSED, Status.SUSPENDED_EV, plugged=True),
    PAUSED_OPTIMISED: _state(PAUSED_OPTIMISED, Status.SUSPENDED_EV, plugged=True),
    ENDED: _state(ENDED, Status.FINISHING, plugged=True),
    # Why, the result of the charge says.
    ABORTED: _state(ABORTED, Status.FINISHING, plugged=True),
    0xA0: _error(0xA0, Fault.CABLE_CODE),
    0xA1: _error(0xA1, Fault.SOCKET_LOCK),
    0xA2: _error(0xA2, Fault.SOCKET_UNLOCK),
    0xA3: _error(0xA3, Fault.CONTACTOR_OPEN),
    0xA4: _error(0xA4, Fault.CONTACTOR_WELDED),
    0xA5: _error(0xA5, Fault.CONFIGURATION),
    0xA7: _error(0xA7, Fault.CARD_READER),
    0xA8: _error(0xA8, Fault.RCD),
    BLOCKED: _state(BLOCKED, Status.UNAVAILABLE, plugged=None),
    STARTING: State("0xF0", Status.UNAVAILABLE),
    TEST: State("0xFF", Status.UNAVAILABLE),
}

RESULT_FAULTS: Final[Mapping[ChargeResult, Fault]] = {
    ChargeResult.CABLE_LOST: Fault.CABLE_LOST,
    ChargeResult.RCD: Fault.RCD,
    ChargeResult.METER: Fault.METER,
    ChargeResult.SERVER_TIMEOUT: Fault.UPSTREAM_TIMEOUT,
    ChargeResult.VENTILATION: Fault.VENTILATION_REQUESTED,
    ChargeResult.PILOT_UNSTABLE: Fault.PILOT,
}
"""Ends of a charge that the manual calls an error."""

AFTER_OUR_PAUSE: Final = frozenset({PAUSED, PAUSED_OPTIMISED, ENDED})
"""Where a port may be found after `StartStop.PAUSE`."""


def state_of(code: int, *, fixed_cable: bool | None = None) -> State:
    """Return what a status byte says; an unknown one keeps its raw value.

    ``fixed_cable``: how the port is configured; ``None``: not known.
    """
    known = STATES.get(code)
    if known is None:
        name = f"0x{code:02X}"
        if code & _GROUP == _ERRORS:
            return State(name, Status.FAULTED, fault=Fault.UNKNOWN)
        return State(name)
    if code == SEARCHING and fixed_cable is not None:
        if fixed_cable:
            return replace(known, status=Status.AVAILABLE, plugged=False)
        return replace(known, plugged=True)
    return known


@dataclass(frozen=True, slots=True, kw_only=True)
class PortState:
    """What is to be shown of a port."""

    status: Status | None
    raw: str
    plugged: bool | None
    charging: bool | None
    locked: bool | None
    faults: frozenset[Fault]


def port_state(
    port: PortStatus, *, fixed_cable: bool | None = None, paused: bool = False
) -> PortState:
    """Return what ``rc`` says of a port, in the words of everybody.

    ``paused``: we have paused this charge, and nobody has ended it since.
    """
    state = state_of(port.status, fixed_cable=fixed_cable)
    status, charging = state.status, state.charging
    if paused and port.status in AFTER_OUR_PAUSE:
        status = Status.SUSPENDED_EVSE
    if charging is None and not port.contactor:
        charging = False
    faults = set() if state.fault is None else {state.fault}
    if port.rcd_tripped:
        faults.add(Fault.RCD)
    if port.status == ABORTED:
        faults.add(_reason(port.result))
    return PortState(
        status=status,
        raw=state.name,
        plugged=state.plugged,
        charging=charging,
        locked=port.locked,
        faults=frozenset(faults),
    )


def _reason(result: ChargeResult | None) -> Fault:
    # Aborted, and yet a result that is no error, or none: nobody says why.
    if result is None:
        return Fault.UNKNOWN
    return RESULT_FAULTS.get(result, Fault.UNKNOWN)


def box_faults(box: BoxStatus) -> frozenset[Fault]:
    """Return the faults of the box as a whole, by ``rs``.

    A power backup that never gets its charge could not unlock in a power failure.
    """
    failed = BoxFlags.BACKUP_TIMEOUT in box.flags
    return frozenset({Fault.INTERNAL} if failed else ())


# -- What may be ordered, and when -------------------------------------------------


class StartStop(IntEnum):
    """Orders of ``sl``."""

    STOP = 1
    """Stop, and unlock."""
    REQUEST_START = 2
    """As if key 1 was pressed."""
    START = 3
    """Allow the start that was asked for, or start, or go on."""
    OPTIMISE = 4
    DO_NOT_OPTIMISE = 5
    PAUSE = 6
    """Stop and stay locked. Where nothing charges it unlocks: sent there only by
    `commands.unlock`."""
    LOCK = 7


@dataclass(frozen=True, slots=True)
class Rule:
    """In which states an order is sent."""

    states: frozenset[int]
    why: str
    """What it would do elsewhere, or what it is for."""
    after_our_pause: frozenset[int] = frozenset()
    """More states, if it was us who paused this charge."""


_RUNNING: Final = frozenset({CHARGING, CHARGING_OPTIMISED, PAUSED, PAUSED_OPTIMISED})
_OPTIMISABLE: Final = Rule(
    _RUNNING | {FREE, SEARCHING, WAITING, ENDED},
    "a port out of order has no next start",
)

UNLOCKED_BY_6: Final = frozenset({WAITING, ENDED})
"""Where order 6 does not pause but unlocks."""

RULES: Final[Mapping[StartStop, Rule]] = {
    # A stop is sent wherever it may be heard, also in states nobody knows.
    StartStop.STOP: Rule(
        frozenset(range(0x100)) - {STARTING, TEST}, "the box is not ready"
    ),
    # In 0x10 nobody may be there either: a fixed cable always is (see `state_of`).
    StartStop.REQUEST_START: Rule(
        frozenset({WAITING}), "it would start whoever comes next"
    ),
    StartStop.START: Rule(
        frozenset({WAITING}),
        "it would start whoever comes next, or what somebody else has stopped",
        AFTER_OUR_PAUSE,
    ),
    StartStop.OPTIMISE: _OPTIMISABLE,
    StartStop.DO_NOT_OPTIMISE: _OPTIMISABLE,
    StartStop.PAUSE: Rule(_RUNNING, "where nothing charges it unlocks the plug"),
    # 3.1.8 locks while a start waits; M165300100 mended it "while charging".
    StartStop.LOCK: Rule(
        frozenset({WAITING}), "it locks the plug of a car that waits for its start"
    ),
}


def is_allowed(order: StartStop, status: int, *, paused: bool = False) -> bool:
    """Return whether an order may be sent to a port with this status byte.

    ``paused``: we have paused this charge, and nobody has ended it since.
    """
    rule = RULES[order]
    return status in rule.states or (paused and status in rule.after_our_pause)


def check_order(order: StartStop, status: int, *, paused: bool = False) -> None:
    """Raise NotAvailableError where an order may not be sent (see `is_allowed`)."""
    if not is_allowed(order, status, paused=paused):
        message = (
            f"not in state {state_of(status).name}: "
            f"{order.name.lower().replace('_', ' ')}: {RULES[order].why}"
        )
        raise NotAvailableError(message)


def unlocks(seen: PortStatus) -> bool:
    """Return whether order 6 would unlock a locked plug here, and not pause (3.1.8).

    A start that is released is about to charge: then it might do either.
    """
    starts = seen.status == WAITING and seen.start is StartRelease.RELEASED
    return seen.status in UNLOCKED_BY_6 and not starts


def check_unlock(seen: PortStatus) -> None:
    """Raise NotAvailableError where order 6 would not unlock (see `unlocks`)."""
    if not (seen.locked and unlocks(seen)):
        message = (
            f"not in state {state_of(seen.status).name}: unlock: it is for a locked "
            "plug, and pauses where something charges"
        )
        raise NotAvailableError(message)
