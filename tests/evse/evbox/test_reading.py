"""From a reply to the neutral model; limits that are not kept."""

import pytest

from custom_components.evse_bus.evse.evbox.over_limit import LimitWatch
from custom_components.evse_bus.evse.evbox.plausibility import Taken
from custom_components.evse_bus.evse.evbox.reading import (
    connectors,
    same_serial,
    serial_number,
)
from custom_components.evse_bus.evse.readings import ConnectorReading

from .replies import module, reply


def connector(**values: object) -> ConnectorReading:
    one = reply(module(**values))  # type: ignore[arg-type]
    taken = Taken(reply=one, totals=(1000,), generations=(2,))
    return connectors(taken, 240.0)[1]


def test_all_that_a_module_tells() -> None:
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


def test_no_volts_on_a_phase_in_use_are_no_measurement() -> None:
    none = connector(amperes=10.0, voltages=(0, 0, 0))
    assert (none.voltage, none.power) == ((None, None, None), None)
    one = connector(amperes=10.0, voltages=(230, 0, 230))
    assert (one.voltage, one.power) == ((230, None, 230), None)
    # A box on one phase: nothing flows on the other two.
    single = connector(currents=(10.0, 0.0, 0.0), voltages=(230, 0, 0))
    assert (single.voltage, single.power) == ((230, 0, 0), 2300)


def test_serial_numbers_as_people_write_them() -> None:
    assert serial_number(reply(serial="00001234")) == "1234"
    assert serial_number(reply(serial="00000000")) is None
    assert serial_number(reply(serial=None)) is None
    assert same_serial("01923054", " 1923054")
    assert not same_serial("1923054", "19230540")


# -- The limit watch -----------------------------------------------------------------


def exceeds(watch: LimitWatch, now: float, *used: float) -> bool:
    one, two, three = used if len(used) == 3 else 3 * used
    return watch.exceeded(now, (one, two, three), 15.0)


def test_nothing_is_exceeded_before_a_limit_has_stood_long_enough() -> None:
    watch = LimitWatch()
    watch.sent(100.0, (6.0, 6.0, 6.0), answered=True)
    assert not any(exceeds(watch, 100.0 + second, 32.0) for second in range(15))
    assert not exceeds(watch, 115.0, 32.0)
    assert exceeds(watch, 116.0, 32.0)


def test_a_single_reading_is_no_fault_and_it_ends_when_it_ends() -> None:
    watch = LimitWatch()
    watch.sent(0.0, (10.0, 16.0, 10.0), answered=True)
    assert not exceeds(watch, 20.0, 12.0)
    assert not exceeds(watch, 21.0, 11.5)
    assert not exceeds(watch, 22.0, 0.0, 0.0, 11.6)
    assert exceeds(watch, 23.0, 0.0, 0.0, 11.6)
    assert not exceeds(watch, 24.0, 11.5, 17.8, 11.5)


def test_a_car_that_follows_a_falling_limit_late_is_no_fault() -> None:
    watch = LimitWatch()
    for second in range(60):
        watch.sent(second, 3 * (40.0 - second / 2,), answered=True)  # type: ignore[arg-type]
        assert not exceeds(watch, second, 40.0 - (second - 14) / 2)


def test_an_unanswered_raise_may_stand_an_unanswered_lowering_may_not() -> None:
    watch = LimitWatch()
    watch.sent(0.0, (10.0, 10.0, 10.0), answered=True)
    watch.sent(50.0, (16.0, 6.0, 10.0), answered=False)
    for second in range(51, 80):
        assert not exceeds(watch, second, 16.0, 10.0, 10.0)
    watch.sent(80.0, (10.0, 10.0, 10.0), answered=True)
    assert not exceeds(watch, 94.0, 16.0)
    exceeds(watch, 96.0, 16.0)
    assert exceeds(watch, 97.0, 16.0)
