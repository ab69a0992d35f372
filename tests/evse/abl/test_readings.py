"""Readings made of register contents: no value without a measurement."""

from dataclasses import replace
from math import isclose
from typing import TYPE_CHECKING

from hypothesis import given, strategies as st
import pytest

from custom_components.evse_bus.evse.abl.decisions import Evidence, Standing, decide
from custom_components.evse_bus.evse.abl.readings import (
    EnergyEstimate,
    Snapshot,
    charger_info,
    charger_reading,
    phase_currents,
    power_of,
)
from custom_components.evse_bus.evse.abl.registers import (
    FLAGS,
    INFO,
    READING,
    Flags,
    Reading,
)
from custom_components.evse_bus.evse.model import UNKNOWN_PHASES, Fault, Status
from custom_components.evse_bus.evse.readings import ChargerReading, ConnectorReading

if TYPE_CHECKING:
    from custom_components.evse_bus.evse.model import Phases

WITH_METER = INFO.decode(bytes.fromhex("014150BE"))
WITHOUT_METER = replace(WITH_METER, meter=False)
CLEAR = FLAGS.decode(bytes.fromhex("06000000"))
FULL = Reading(
    state=0xC2,
    plugged=True,
    reduced=False,
    en1=True,
    en2=False,
    duty=266,
    currents=(10.0, 9.9, 0.0),
)
NOT_MEASURED = (None, None, None)


def snapshot(
    state: int = 0xC2,
    *,
    duty: int = 266,
    currents: Phases[float | None] = (10.0, 9.9, 0.0),
    reduced: bool = False,
    plugged: bool = True,
    meter: bool = True,
    flags: Flags | None = CLEAR,
) -> Snapshot:
    reading = replace(
        FULL,
        state=state,
        duty=duty,
        currents=currents,
        reduced=reduced,
        plugged=plugged,
    )
    info = WITH_METER if meter else WITHOUT_METER
    known = decide(
        Evidence(state=state, ic=duty, reports_icmax=True, icmax=duty),
        Standing(code=duty),
    )
    return Snapshot(
        reading=reading,
        info=info,
        flags=flags,
        paused=known.paused,
        offered=known.offered,
    )


def read(box: Snapshot) -> tuple[ChargerReading, ConnectorReading]:
    reading = charger_reading(box, phase_currents(box, (1, 2, 3)), None, None)
    return reading, reading.connectors[1]


def test_charging() -> None:
    reading, connector = read(snapshot())
    assert (connector.status, connector.raw_state) == (Status.CHARGING, "C2")
    assert (connector.plugged, connector.charging) == (True, True)
    assert connector.current == (10.0, 9.9, 0.0)
    assert connector.voltage == UNKNOWN_PHASES
    assert (connector.power, connector.energy) == (None, None)
    assert (reading.allowed, reading.outlet_enabled) == (True, True)
    assert reading.offered_current == 15.96
    assert reading.faults == frozenset()


@pytest.mark.parametrize(
    ("state", "duty", "status", "allowed", "offered"),
    [
        (0xA1, 266, Status.AVAILABLE, True, 15.96),
        (0xA1, 1000, Status.AVAILABLE, False, 0),
        (0xB1, 266, Status.PREPARING, True, 15.96),
        (0xB1, 1000, Status.SUSPENDED_EVSE, False, 0),
        (0xB2, 266, Status.SUSPENDED_EV, True, 15.96),
        (0xB2, 1000, Status.SUSPENDED_EVSE, False, 0),
        (0xC2, 1000, Status.CHARGING, False, 0),
        (0xC4, 100, Status.CHARGING, True, 6),
        (0xB2, 50, Status.SUSPENDED_EV, None, None),
        (0xE0, 266, Status.OUT_OF_SERVICE, False, None),
        (0xE2, 266, Status.OUT_OF_SERVICE, None, None),
        (0xF4, 100, Status.FAULTED, None, None),
        (0x77, 266, None, None, None),
    ],
)
def test_status_and_permission(
    state: int,
    duty: int,
    status: Status | None,
    allowed: bool | None,  # noqa: FBT001
    offered: float | None,
) -> None:
    reading, connector = read(snapshot(state, duty=duty))
    assert connector.status is status
    assert reading.allowed is allowed
    assert reading.offered_current == offered


@pytest.mark.parametrize(
    ("state", "expected"),
    [(0xA1, True), (0xB2, True), (0xC2, True), (0xE0, None), (0xF9, None), (0, None)],
)
def test_plugged_is_known_only_where_its_bit_is_valid(
    state: int,
    expected: bool | None,  # noqa: FBT001
) -> None:
    assert read(snapshot(state))[1].plugged is expected
    unplugged = read(snapshot(state, plugged=False))[1].plugged
    assert unplugged is (None if expected is None else False)


@pytest.mark.parametrize("state", [0xA1, 0xB1, 0xB2, 0xE0])
def test_a_missing_current_is_zero_where_the_contactor_is_open(state: int) -> None:
    box = snapshot(state, currents=NOT_MEASURED)
    assert read(box)[1].current == (0, 0, 0)


@pytest.mark.parametrize(
    "box",
    [
        pytest.param(snapshot(0xC2, currents=NOT_MEASURED), id="charging"),
        pytest.param(snapshot(0xC3, currents=NOT_MEASURED), id="charging, reduced"),
        pytest.param(snapshot(0xF1, currents=NOT_MEASURED), id="welded"),
        pytest.param(snapshot(0xA1, currents=NOT_MEASURED, meter=False), id="no meter"),
        pytest.param(snapshot(0xA1, meter=False), id="values without a meter"),
        pytest.param(snapshot(0xA1, currents=NOT_MEASURED, flags=None), id="no flags"),
        pytest.param(
            snapshot(0xA1, flags=replace(CLEAR, meter_failed=True)), id="meter failed"
        ),
    ],
)
def test_a_missing_current_is_unknown_elsewhere(box: Snapshot) -> None:
    assert read(box)[1].current == UNKNOWN_PHASES


def test_the_floor_of_the_meter_is_no_current() -> None:
    # Seen on idle phases, and in B2 on all three.
    _, connector = read(snapshot(currents=(0.1, 0.1, 15.1)))
    assert connector.current == (0, 0, 15.1)
    _, connector = read(snapshot(0xB2, currents=(0.1, 0.1, 0.1)))
    assert connector.current == (0, 0, 0)


def test_phase_order() -> None:
    box = snapshot(currents=(1.0, 2.0, 3.0))
    assert phase_currents(box, (1, 2, 3)) == (1, 2, 3)
    # Ict1 measures L3, Ict2 L1, Ict3 L2.
    assert phase_currents(box, (3, 1, 2)) == (2, 3, 1)
    assert phase_currents(box, (3, 2, 1)) == (3, 2, 1)


@pytest.mark.parametrize(
    ("box", "faults", "codes"),
    [
        (snapshot(0xF9), {Fault.OVERCURRENT}, ("F9",)),
        (snapshot(0xFB), {Fault.CONTACTOR_OPEN}, ("F11",)),
        (snapshot(0xF0), {Fault.UNRECOGNISED}, ("0xF0",)),
        (snapshot(0xC3), set(), ()),
        (snapshot(0xC3, reduced=True), {Fault.REDUCED_CURRENT}, ("F16/F17",)),
        (snapshot(0xB2, reduced=True), {Fault.REDUCED_CURRENT}, ("BC3-BC6",)),
        (snapshot(0xC4), {Fault.LOAD_IMBALANCE}, ("F15",)),
        (snapshot(flags=None), set(), ()),
    ],
)
def test_faults(box: Snapshot, faults: set[Fault], codes: tuple[str, ...]) -> None:
    reading, _ = read(box)
    assert reading.faults == faults
    assert reading.fault_codes == codes


@pytest.mark.parametrize(
    ("bits", "fault", "code"),
    [
        (0x0100, Fault.LOAD_IMBALANCE, "BC3"),
        (0x0040, Fault.METER, "BC4"),
        (0x0080, Fault.TEMPERATURE, "BC5"),
        (0x0200, Fault.UPSTREAM_TIMEOUT, "BC6"),
        (0b101, Fault.OVERCURRENT, ">Ic"),
        (0b011, Fault.OVERCURRENT, ">Ic"),
        (0b111, Fault.OVERCURRENT, ">Ic"),
    ],
)
def test_faults_in_flags(bits: int, fault: Fault, code: str) -> None:
    reading, _ = read(snapshot(flags=FLAGS.decode(b"\x06\x00" + bits.to_bytes(2))))
    assert reading.faults == {fault}
    assert reading.fault_codes == (code,)


def test_five_percent_too_much_is_no_fault() -> None:
    assert not read(snapshot(flags=FLAGS.decode(b"\x06\x00\x00\x01")))[0].faults


def test_info() -> None:
    info = charger_info(WITH_METER, "2W22xy01234567", CLEAR)
    assert (info.manufacturer, info.serial) == ("ABL", "2W22xy01234567")
    assert (info.firmware, info.hardware) == ("5.0", "pcba 160307")
    assert info.options["upstream_timeout"] is False
    assert info.options["enable_after_power_cycle"] is True
    assert (
        "enable_after_power_cycle" not in charger_info(WITH_METER, None, None).options
    )


def test_power() -> None:
    assert power_of((10.0, 9.9, 0.0), 230) == 4577
    assert power_of((10.0, None, 0.0), 230) is None


def test_energy_is_summed_over_measured_time() -> None:
    estimate = EnergyEstimate(poll_interval=5)
    estimate.add(1000, 0)
    assert estimate.energy == 0
    estimate.add(3000, 9)
    assert isclose(estimate.energy, 5)
    estimate.add(None, 10)
    estimate.add(3000, 11)
    assert isclose(estimate.energy, 5)
    # Longer than three intervals: a gap, in which the power is unknown.
    estimate.add(3000, 27)
    assert isclose(estimate.energy, 5)
    estimate.add(3000, 28)
    assert isclose(estimate.energy, 5 + 3000 / 3600)
    estimate.interrupt()
    estimate.add(3000, 29)
    assert isclose(estimate.energy, 5 + 3000 / 3600)


@given(st.lists(st.tuples(st.floats(0, 60000) | st.none(), st.floats(0, 1e6))))
def test_energy_never_falls(steps: list[tuple[float | None, float]]) -> None:
    estimate = EnergyEstimate(poll_interval=5)
    before = 0.0
    for power, now in steps:
        estimate.add(power, now)
        assert before <= estimate.energy <= before + 60000 * 15 / 3600
        before = estimate.energy


@given(
    st.binary(min_size=9, max_size=9),
    st.binary(min_size=3, max_size=3),
    st.binary(min_size=3, max_size=3) | st.none(),
    st.permutations((1, 2, 3)),
)
def test_any_registers_make_a_reading(
    reading: bytes, info: bytes, flags: bytes | None, order: list[int]
) -> None:
    box = Snapshot(
        reading=READING.decode(b"\x2e" + reading),
        info=INFO.decode(b"\x01" + info),
        flags=None if flags is None else FLAGS.decode(b"\x06" + flags),
    )
    one, two, three = order
    currents = phase_currents(box, (one, two, three))
    result = charger_reading(box, currents, power_of(currents, 230), 0.0)
    assert result.connectors[1].raw_state
    for current in currents:
        assert current is None or 0 <= current <= 80
    assert result.offered_current is None or 0 <= result.offered_current <= 80
    if result.allowed:
        assert result.outlet_enabled
        assert result.offered_current
