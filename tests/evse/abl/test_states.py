"""The state byte: the meaning of each, and any unknown one."""

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.abl.states import STATES, state_of
from custom_components.evse_bus.evse.model import Fault, Status

# (byte, name, status, charging, outlet enabled, bit 63 is valid)
KNOWN = [
    (0xA1, "A1", Status.AVAILABLE, False, True, True),
    (0xB1, "B1", Status.PREPARING, False, True, True),
    (0xB2, "B2", Status.SUSPENDED_EV, False, True, True),
    (0xC2, "C2", Status.CHARGING, True, True, True),
    (0xC3, "C3", Status.CHARGING, True, True, True),
    (0xC4, "C4", Status.CHARGING, True, True, True),
    (0xE0, "E0", Status.OUT_OF_SERVICE, False, False, False),
    (0xE1, "E1", Status.OUT_OF_SERVICE, None, None, False),
    (0xE2, "E2", Status.OUT_OF_SERVICE, None, None, False),
    (0xE3, "E3", Status.OUT_OF_SERVICE, None, None, False),
]
FAULTS = {
    0xF1: ("F1", Fault.CONTACTOR_WELDED),
    0xF2: ("F2", Fault.INTERNAL),
    0xF3: ("F3", Fault.DC_RESIDUAL_CURRENT),
    0xF4: ("F4", Fault.UPSTREAM_TIMEOUT),
    0xF5: ("F5", Fault.SOCKET_LOCK),
    0xF6: ("F6", Fault.CABLE_CODE),
    0xF7: ("F7", Fault.VENTILATION_REQUESTED),
    0xF8: ("F8", Fault.PILOT),
    0xF9: ("F9", Fault.OVERCURRENT),
    0xFA: ("F10", Fault.TEMPERATURE),
    0xFB: ("F11", Fault.CONTACTOR_OPEN),
    0xFE: ("F14", Fault.UPSTREAM_TIMEOUT),
    0xFF: ("F15", Fault.LOAD_IMBALANCE),
}


@pytest.mark.parametrize("expected", KNOWN)
def test_states(expected: tuple[object, ...]) -> None:
    code = expected[0]
    assert isinstance(code, int)
    state = state_of(code)
    assert expected[1:] == (
        state.name,
        state.status,
        state.charging,
        state.outlet_enabled,
        state.plugged_valid,
    )


@pytest.mark.parametrize("code", FAULTS)
def test_failures(code: int) -> None:
    state = state_of(code)
    assert (state.name, state.fault) == FAULTS[code]
    assert state.status is Status.FAULTED
    assert (state.charging, state.outlet_enabled) == (None, None)


def test_the_contactor_is_open_where_no_current_can_flow() -> None:
    assert {state.name for state in STATES.values() if state.no_current} == {
        "A1",
        "B1",
        "B2",
        "E0",
    }


@given(st.integers(0, 255))
def test_an_unknown_state_keeps_its_raw_value(code: int) -> None:
    state = state_of(code)
    if code in STATES:
        return
    assert state.name == f"0x{code:02X}"
    assert (state.charging, state.outlet_enabled) == (None, None)
    assert not state.no_current
    expected = {0xE: Status.OUT_OF_SERVICE, 0xF: Status.FAULTED}.get(code >> 4)
    assert state.status is expected
    assert (state.fault is Fault.UNRECOGNISED) == (code >> 4 == 0xF)


def test_no_f12_and_f13() -> None:
    for code in (0xFC, 0xFD):
        assert state_of(code).fault is Fault.UNRECOGNISED
