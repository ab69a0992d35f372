"""The status byte of a port of an EWS-Box: its meaning, and the orders for it.

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
    """The meaning of a status byte by itself; ``None``: it has none."""

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
    # The contactor shows whether current still flows.
    return State(f"0x{code:02X}", Status.FAULTED, fault=fault)


STATES: Final[Mapping[int, State]] = {
    FREE: _state(FREE, Status.AVAILABLE, plugged=False),
    # A plug is in the socket; but with a fixed cable there may be no car (`state_of`).
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
    # The result of the charge has the reason.
    ABORTED: _state(ABORTED, Status.FINISHING, plugged=True),
    0xA0: _error(0xA0, Fault.CABLE_CODE),
    0xA1: _error(0xA1, Fault.SOCKET_LOCK),
    0xA2: _error(0xA2, Fault.SOCKET_UNLOCK),
    0xA3: _error(0xA3, Fault.CONTACTOR_OPEN),
    0xA4: _error(0xA4, Fault.CONTACTOR_WELDED),
    0xA5: _error(0xA5, Fault.CONFIGURATION),
    0xA7: _error(0xA7, Fault.CARD_READER),
    0xA8: _error(0xA8, Fault.RCD),
    BLOCKED: _state(BLOCKED, Status.OUT_OF_SERVICE, plugged=None),
    STARTING: State("0xF0", Status.OUT_OF_SERVICE),
    TEST: State("0xFF", Status.OUT_OF_SERVICE),
}

RESULT_FAULTS: Final[Mapping[ChargeResult, Fault]] = {
    ChargeResult.CABLE_LOST: Fault.CABLE_LOST,
    ChargeResult.RCD: Fault.RCD,
    ChargeResult.METER: Fault.METER,
    ChargeResult.SERVER_TIMEOUT: Fault.UPSTREAM_TIMEOUT,
    ChargeResult.VENTILATION: Fault.VENTILATION_REQUESTED,
    ChargeResult.PILOT_UNSTABLE: Fault.PILOT,
}
"""Results of a charge that are errors by the manual."""

RUNNING: Final = frozenset({CHARGING, CHARGING_OPTIMISED, PAUSED, PAUSED_OPTIMISED})
"""A charge is under way, pauses included."""
AFTER_OUR_PAUSE: Final = frozenset({PAUSED, PAUSED_OPTIMISED, ENDED})
"""A pause of ours may be the reason for these (`StartStop.PAUSE`)."""


def state_of(code: int, *, fixed_cable: bool | None = None) -> State:
    """Return the meaning of a status byte; an unknown one has its raw value only.

    ``fixed_cable``: whether the port has one; ``None``: not known.
    """
    known = STATES.get(code)
    if known is None:
        name = f"0x{code:02X}"
        if code & _GROUP == _ERRORS:
            return State(name, Status.FAULTED, fault=Fault.UNRECOGNISED)
        return State(name)
    if code == SEARCHING and fixed_cable is not None:
        if fixed_cable:
            return replace(known, status=Status.AVAILABLE, plugged=False)
        return replace(known, plugged=True)
    return known


@dataclass(frozen=True, slots=True, kw_only=True)
class PortState:
    """The state of a port in terms of the model."""

    status: Status | None
    raw: str
    plugged: bool | None
    charging: bool | None
    locked: bool | None
    faults: frozenset[Fault]


def port_state(
    status: PortStatus, *, fixed_cable: bool | None = None, paused: bool = False
) -> PortState:
    """Return the state of a port from its status (``rc``).

    ``paused``: it is in a pause of ours.
    """
    state = state_of(status.state, fixed_cable=fixed_cable)
    charging = state.charging
    is_our_pause = paused and status.state in AFTER_OUR_PAUSE
    if charging is None and not status.contactor:
        charging = False
    faults = set() if state.fault is None else {state.fault}
    if status.rcd_tripped:
        faults.add(Fault.RCD)
    if status.state == ABORTED:
        faults.add(_reason(status.result))
    return PortState(
        status=Status.SUSPENDED_EVSE if is_our_pause else state.status,
        raw=state.name,
        plugged=state.plugged,
        charging=charging,
        locked=status.locked,
        faults=frozenset(faults),
    )


def _reason(result: ChargeResult | None) -> Fault:
    # Aborted, but the result is no error, or there is none.
    if result is None:
        return Fault.UNRECOGNISED
    return RESULT_FAULTS.get(result, Fault.UNRECOGNISED)


def box_faults(box: BoxStatus) -> frozenset[Fault]:
    """Return the faults of the box as a whole, from ``rs``.

    A power backup that is never charged could not unlock in a power failure.
    """
    failed = BoxFlags.BACKUP_TIMEOUT in box.flags
    return frozenset({Fault.INTERNAL} if failed else ())


# -- Orders, and the states for them -----------------------------------------------


class StartStop(IntEnum):
    """Orders of ``sl``."""

    STOP = 1
    """Stop, and unlock."""
    REQUEST_START = 2
    """As if key 1 were pressed."""
    START = 3
    """Allow the start that was requested, or start, or continue."""
    OPTIMISE = 4
    DO_NOT_OPTIMISE = 5
    PAUSE = 6
    """Stop, and keep the plug locked; without a charge, unlock (`commands.unlock`)."""
    LOCK = 7


@dataclass(frozen=True, slots=True)
class Rule:
    """The states in which an order is sent."""

    states: frozenset[int]
    why: str
    """Its effect in other states, or its purpose."""
    text_key: str
    """Key of the message for other states."""
    after_our_pause: frozenset[int] = frozenset()
    """More states, if the charge is in a pause of ours."""


_OPTIMISABLE: Final = Rule(
    RUNNING | {FREE, SEARCHING, WAITING, ENDED},
    "a port out of order has no next start",
    "ews_optimise_state",
)

UNLOCKED_BY_6: Final = frozenset({WAITING, ENDED})
"""Order 6 does not pause here, but unlocks."""

RULES: Final[Mapping[StartStop, Rule]] = {
    # A stop may be sent in unknown states too.
    StartStop.STOP: Rule(
        frozenset(range(0x100)) - {STARTING, TEST},
        "the box is not ready",
        "ews_not_ready",
    ),
    # In 0x10 there may be no car: a fixed cable is always plugged (see `state_of`).
    StartStop.REQUEST_START: Rule(
        frozenset({WAITING}),
        "it would start the next car that comes",
        "ews_request_start_state",
    ),
    StartStop.START: Rule(
        frozenset({WAITING}),
        "it would start the next car, or a charge that was stopped at the box",
        "ews_start_state",
        AFTER_OUR_PAUSE,
    ),
    StartStop.OPTIMISE: _OPTIMISABLE,
    StartStop.DO_NOT_OPTIMISE: _OPTIMISABLE,
    StartStop.PAUSE: Rule(
        RUNNING, "where nothing charges it unlocks the plug", "ews_pause_state"
    ),
    # 3.1.8 locks while a start waits; firmware M165300100 fixed it "while charging".
    StartStop.LOCK: Rule(
        frozenset({WAITING}),
        "it locks the plug of a car that waits for its start",
        "ews_lock_state",
    ),
}


def is_allowed(order: StartStop, state: int, *, paused: bool = False) -> bool:
    """Return whether an order may be sent to a port with this status byte.

    ``paused``: it is in a pause of ours, or may be.
    """
    rule = RULES[order]
    return state in rule.states or (paused and state in rule.after_our_pause)


def check_order(order: StartStop, state: int, *, paused: bool = False) -> None:
    """Raise NotAvailableError where an order may not be sent (see `is_allowed`)."""
    if not is_allowed(order, state, paused=paused):
        name = state_of(state).name
        message = (
            f"not in state {name}: "
            f"{order.name.lower().replace('_', ' ')}: {RULES[order].why}"
        )
        raise NotAvailableError(message, RULES[order].text_key, state=name)


def unlocks(status: PortStatus) -> bool:
    """Return whether order 6 would unlock a locked plug here, and not pause (3.1.8).

    With a released start the charge is about to begin: then it might do either.
    """
    starts = status.state == WAITING and status.start is StartRelease.RELEASED
    return status.state in UNLOCKED_BY_6 and not starts


def check_unlock(status: PortStatus) -> None:
    """Raise NotAvailableError where order 6 would not unlock (see `unlocks`)."""
    if not (status.locked and unlocks(status)):
        name = state_of(status.state).name
        message = (
            f"not in state {name}: unlock: it is for a locked "
            "plug, and pauses a charge under way"
        )
        raise NotAvailableError(message, "ews_unlock_state", state=name)
