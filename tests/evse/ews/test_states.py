"""The status byte, and the orders for each state."""

from dataclasses import replace

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.errors import NotAvailableError
from custom_components.evse_bus.evse.ews.wire.box_status import decode_box
from custom_components.evse_bus.evse.ews.wire.states import (
    RULES,
    STATES,
    StartStop,
    box_faults,
    check_order,
    is_allowed,
    port_state,
    state_of,
)
from custom_components.evse_bus.evse.ews.wire.status import PortStatus, decode_ports
from custom_components.evse_bus.evse.model import Fault, Status

from .wire import BOX, PORTS

IDLE = decode_ports(PORTS)[1]

# Status byte: OCPP status, plugged, charging (contactor open), fault. 3.2.4, rc.
MANUAL: dict[int, tuple[Status, bool | None, bool | None, Fault | None]] = {
    0x00: (Status.AVAILABLE, False, False, None),
    0x10: (Status.PREPARING, None, False, None),
    0x30: (Status.PREPARING, True, False, None),
    0x40: (Status.CHARGING, True, True, None),
    0x41: (Status.CHARGING, True, True, None),
    0x42: (Status.SUSPENDED_EV, True, False, None),
    0x43: (Status.SUSPENDED_EV, True, False, None),
    0x50: (Status.FINISHING, True, False, None),
    0x60: (Status.FINISHING, True, False, Fault.UNRECOGNISED),
    0xA0: (Status.FAULTED, None, False, Fault.CABLE_CODE),
    0xA1: (Status.FAULTED, None, False, Fault.SOCKET_LOCK),
    0xA2: (Status.FAULTED, None, False, Fault.SOCKET_UNLOCK),
    0xA3: (Status.FAULTED, None, False, Fault.CONTACTOR_OPEN),
    0xA4: (Status.FAULTED, None, False, Fault.CONTACTOR_WELDED),
    0xA5: (Status.FAULTED, None, False, Fault.CONFIGURATION),
    0xA7: (Status.FAULTED, None, False, Fault.CARD_READER),
    0xA8: (Status.FAULTED, None, False, Fault.RCD),
    0xA9: (Status.OUT_OF_SERVICE, None, False, None),
    0xF0: (Status.OUT_OF_SERVICE, None, False, None),
    0xFF: (Status.OUT_OF_SERVICE, None, False, None),
}


def port(code: int, **changes: object) -> PortStatus:
    return replace(IDLE, state=code, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("code", MANUAL)
def test_the_status_byte(code: int) -> None:
    status, plugged, charging, fault = MANUAL[code]
    state = port_state(port(code))
    assert (state.status, state.plugged, state.charging) == (status, plugged, charging)
    assert state.raw == f"0x{code:02X}"
    assert state.faults == (set() if fault is None else {fault})


def test_no_state_is_left_out() -> None:
    assert STATES.keys() == MANUAL.keys()


def test_a_state_that_the_manual_does_not_know_stays_raw() -> None:
    for code in set(range(256)) - MANUAL.keys():
        state = state_of(code)
        assert state.name == f"0x{code:02X}"
        assert (state.plugged, state.charging) == (None, None)
        if 0xA0 <= code <= 0xAF:
            # 3.1.2: "0xAx: error".
            assert (state.status, state.fault) == (Status.FAULTED, Fault.UNRECOGNISED)
        else:
            assert (state.status, state.fault) == (None, None)


def test_a_fixed_cable_is_no_car() -> None:
    state = port_state(port(0x10), fixed_cable=True)
    assert (state.status, state.plugged) == (Status.AVAILABLE, False)
    state = port_state(port(0x10), fixed_cable=False)
    assert (state.status, state.plugged) == (Status.PREPARING, True)
    assert port_state(port(0x30), fixed_cable=True).plugged is True


@pytest.mark.parametrize("code", MANUAL)
def test_our_own_pause(code: int) -> None:
    paused = port_state(port(code), paused=True).status
    if code in {0x42, 0x43, 0x50}:
        assert paused is Status.SUSPENDED_EVSE
    else:
        assert paused is MANUAL[code][0]


def test_the_contactor_shows_charging_where_the_state_does_not() -> None:
    assert port_state(port(0xA4, contactor=True)).charging is None
    assert port_state(port(0x11, contactor=True)).charging is None
    assert port_state(port(0x11)).charging is False
    # It opens and closes a moment after the state has changed.
    assert port_state(port(0x40)).charging is True
    assert port_state(port(0x50, contactor=True)).charging is False


def test_the_lock_is_handed_on() -> None:
    for locked in (True, False, None):
        assert port_state(port(0x30, locked=locked)).locked is locked


def test_the_rcd_is_a_fault_in_every_state() -> None:
    for code in MANUAL:
        assert Fault.RCD in port_state(port(code, rcd_tripped=True)).faults


@pytest.mark.parametrize(
    ("result", "fault"),
    [
        (0, Fault.UNRECOGNISED),
        (1, Fault.UNRECOGNISED),
        (2, Fault.UNRECOGNISED),
        (3, Fault.UNRECOGNISED),
        (4, Fault.CABLE_LOST),
        (5, Fault.RCD),
        (6, Fault.METER),
        (7, Fault.UPSTREAM_TIMEOUT),
        (8, Fault.VENTILATION_REQUESTED),
        (9, Fault.PILOT),
        (10, Fault.UNRECOGNISED),
    ],
)
def test_why_a_charge_was_aborted(result: int, fault: Fault) -> None:
    assert port_state(port(0x60, result_code=result)).faults == {fault}
    # It stays there after the fault is gone.
    assert port_state(port(0x30, result_code=result)).faults == set()


def test_a_power_backup_that_gets_no_charge() -> None:
    assert box_faults(decode_box(BOX)) == set()
    assert box_faults(decode_box(BOX[:11] + b"\x14" + BOX[12:])) == {Fault.INTERNAL}


# -- Orders --------------------------------------------------------------------------

ALLOWED = {
    StartStop.STOP: set(range(256)) - {0xF0, 0xFF},
    StartStop.REQUEST_START: {0x30},
    StartStop.START: {0x30},
    StartStop.OPTIMISE: {0x00, 0x10, 0x30, 0x40, 0x41, 0x42, 0x43, 0x50},
    StartStop.DO_NOT_OPTIMISE: {0x00, 0x10, 0x30, 0x40, 0x41, 0x42, 0x43, 0x50},
    StartStop.PAUSE: {0x40, 0x41, 0x42, 0x43},
    StartStop.LOCK: {0x30},
}


def test_the_orders_are_the_manuals() -> None:
    assert [int(order) for order in StartStop] == list(range(1, 8))
    assert RULES.keys() == set(StartStop) == ALLOWED.keys()


@given(st.sampled_from(StartStop), st.integers(0, 255), st.booleans())
def test_orders_and_their_states(
    order: StartStop,
    code: int,
    paused: bool,  # noqa: FBT001
) -> None:
    wanted = code in ALLOWED[order]
    if paused and order is StartStop.START:
        wanted = wanted or code in {0x42, 0x43, 0x50}
    assert is_allowed(order, code, paused=paused) is wanted
    if wanted:
        check_order(order, code, paused=paused)
    else:
        with pytest.raises(NotAvailableError, match=f"0x{code:02X}"):
            check_order(order, code, paused=paused)


def test_a_pause_never_unlocks() -> None:
    for code in set(range(256)) - {0x40, 0x41, 0x42, 0x43}:
        for paused in (True, False):
            assert not is_allowed(StartStop.PAUSE, code, paused=paused)


@pytest.mark.parametrize("code", [0x00, 0x10])
def test_nothing_is_started_without_a_car(code: int) -> None:
    for paused in (True, False):
        assert not is_allowed(StartStop.START, code, paused=paused)
    assert not is_allowed(StartStop.REQUEST_START, code)
