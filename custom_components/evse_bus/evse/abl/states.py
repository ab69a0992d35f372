"""The states of an EVCC2/3 and their meaning.

Source: ABL EVCC2/3 manual, annex 3.4. The state byte in hex is the state's name: 0xA1
is A1, 0xF9 is F9, 0xFB is F11. F14 to F17 are only mentioned (register 0x0006 bit 15,
C3, C4): F14 and F15 are taken as 0xFE and 0xFF; F16 and F17 do not fit a byte and
show as C3. F12 and F13 do not exist.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from ..model import Fault, Status

A1: Final = 0xA1
B1: Final = 0xB1
B2: Final = 0xB2
C2: Final = 0xC2
C3: Final = 0xC3
C4: Final = 0xC4
E0: Final = 0xE0
E1: Final = 0xE1
E2: Final = 0xE2
E3: Final = 0xE3


@dataclass(frozen=True, slots=True)
class State:
    """Properties of a state; ``None``: not known from the state alone."""

    name: str
    """As in the manual; of an unknown state its byte in hex."""
    status: Status | None = None
    charging: bool | None = None
    outlet_enabled: bool | None = None
    plugged_valid: bool = False
    """Bit 63 of register 0x002E is valid (not in Ex and Fx)."""
    no_current: bool = False
    """The contactor is open: no current can flow (PROTOCOLS.md, 2)."""
    fault: Fault | None = None


def _waiting(name: str, status: Status) -> State:
    return State(
        name,
        status=status,
        charging=False,
        outlet_enabled=True,
        plugged_valid=True,
        no_current=True,
    )


def _charging(name: str, fault: Fault | None = None) -> State:
    return State(
        name,
        status=Status.CHARGING,
        charging=True,
        outlet_enabled=True,
        plugged_valid=True,
        fault=fault,
    )


def _failure(name: str, fault: Fault) -> State:
    return State(name, status=Status.FAULTED, fault=fault)


STATES: Final[Mapping[int, State]] = {
    A1: _waiting("A1", Status.AVAILABLE),
    # The car requests power and has no permission yet.
    B1: _waiting("B1", Status.PREPARING),
    # The car has the permission and draws nothing. The moment between plugging in
    # and the first current looks the same.
    B2: _waiting("B2", Status.SUSPENDED_EV),
    C2: _charging("C2"),
    # An example in 1.3 has C3 for "C2, I > 1 A": bit 62 shows whether the current is
    # reduced.
    C3: _charging("C3"),
    C4: _charging("C4", Fault.LOAD_IMBALANCE),
    E0: State(
        "E0",
        status=Status.OUT_OF_SERVICE,
        charging=False,
        outlet_enabled=False,
        no_current=True,
    ),
    E1: State("E1", status=Status.OUT_OF_SERVICE),
    E2: State("E2", status=Status.OUT_OF_SERVICE),
    E3: State("E3", status=Status.OUT_OF_SERVICE),
    0xF1: _failure("F1", Fault.CONTACTOR_WELDED),
    0xF2: _failure("F2", Fault.INTERNAL),
    0xF3: _failure("F3", Fault.DC_RESIDUAL_CURRENT),
    0xF4: _failure("F4", Fault.UPSTREAM_TIMEOUT),
    0xF5: _failure("F5", Fault.SOCKET_LOCK),
    0xF6: _failure("F6", Fault.CABLE_CODE),
    0xF7: _failure("F7", Fault.VENTILATION_REQUESTED),
    0xF8: _failure("F8", Fault.PILOT),
    0xF9: _failure("F9", Fault.OVERCURRENT),
    0xFA: _failure("F10", Fault.TEMPERATURE),
    0xFB: _failure("F11", Fault.CONTACTOR_OPEN),
    0xFE: _failure("F14", Fault.UPSTREAM_TIMEOUT),
    0xFF: _failure("F15", Fault.LOAD_IMBALANCE),
}

SETUP: Final = frozenset({E1, E2, E3})
"""Production test, set-up, idle bus: no limit is written in these."""

_FAILURES: Final = 0xF0
_OUT_OF_ORDER: Final = 0xE0


def is_failure(code: int) -> bool:
    """Return whether a state byte is one of Fx."""
    return code & 0xF0 == _FAILURES


def state_of(code: int) -> State:
    """Return the state of a state byte; an unknown one is named by its value."""
    if (known := STATES.get(code)) is not None:
        return known
    name = f"0x{code:02X}"
    group = code & 0xF0
    if group == _FAILURES:
        return State(name, status=Status.FAULTED, fault=Fault.UNRECOGNISED)
    if group == _OUT_OF_ORDER:
        return State(name, status=Status.OUT_OF_SERVICE)
    return State(name)
