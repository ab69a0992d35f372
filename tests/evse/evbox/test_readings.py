"""Conversion of replies to the neutral model."""

import pytest

from custom_components.evse_bus.evse.evbox.plausibility import AcceptedReply
from custom_components.evse_bus.evse.evbox.readings import (
    connectors,
    same_serial,
    serial_number,
)
from custom_components.evse_bus.evse.readings import ConnectorReading

from .replies import module, reply


def connector(**values: object) -> ConnectorReading:
    one = reply(module(**values))  # type: ignore[arg-type]
    accepted = AcceptedReply(reply=one, is_shown=True, totals=(1000,), generations=(2,))
    return connectors(accepted, 240.0)[1]


def test_every_value_of_a_module() -> None:
    one = connector(
        currents=(10.0, 0.0, 5.0), cos_phi=-0.5, voltages=(230, 0, 220), minimum=8.0
    )
    assert one == ConnectorReading(
        charging=True,
        current=(10.0, 0.0, 5.0),
        voltage=(230, 0, 220),
        cos_phi=(-0.5, -0.5, -0.5),
        power=10.0 * 230 * 0.5 + 5.0 * 220 * 0.5,
        energy=1000,
        meter_generation=2,
        minimum_current=8.0,
    )


def test_without_voltages_power_is_an_estimate() -> None:
    one = connector(amperes=10.0, cos_phi=0.9, voltages=None)
    assert one.power is None
    assert one.voltage == (None, None, None)
    assert one.estimated_power == pytest.approx(3 * 10 * 240 * 0.9)


@pytest.mark.parametrize(("amperes", "charging"), [(0.4, False), (0.5, True)])
def test_charging(amperes: float, *, charging: bool) -> None:
    assert connector(currents=(0.0, amperes, 0.0)).charging is charging


def test_0_v_on_a_phase_in_use_is_not_measured() -> None:
    none = connector(amperes=10.0, voltages=(0, 0, 0))
    assert (none.voltage, none.power) == ((None, None, None), None)
    one = connector(amperes=10.0, voltages=(230, 0, 230))
    assert (one.voltage, one.power) == ((230, None, 230), None)
    # A box on one phase: no current flows on the other two.
    single = connector(currents=(10.0, 0.0, 0.0), voltages=(230, 0, 0))
    assert (single.voltage, single.power) == ((230, 0, 0), 2300)


def test_serial_numbers_without_padding() -> None:
    assert serial_number(reply(serial="00001234")) == "1234"
    assert serial_number(reply(serial="00000000")) is None
    assert serial_number(reply(serial=None)) is None
    assert same_serial("01923054", " 1923054")
    assert not same_serial("1923054", "19230540")
