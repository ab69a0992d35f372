"""Cars: ramp, limits, getting full, automatic life."""

from __future__ import annotations

import pytest

from .car import Car, CarLife


def test_it_ramps_to_the_offer_and_down_again() -> None:
    car = Car(max_current=16, reaction=1, ramp=4)
    car.step(0, 10)
    car.plug_in()
    car.step(1, 10)
    assert car.current == 0, "it has not reacted yet"
    car.step(2.25, 10)
    assert 0 < car.current < 10
    car.step(10, 10)
    assert car.current == 10
    car.step(20, 32)
    assert car.current == 16, "its own maximum"
    car.step(21.5, 0)
    assert 0 < car.current < 16
    assert car.accepts(0), "it opens only when the current is gone"
    car.step(30, 0)
    assert car.current == 0
    assert not car.accepts(0)
    car.step(31, 5.9)
    assert not car.accepts(5.9), "below its minimum"


def test_an_open_contactor_stops_it_at_once() -> None:
    car = Car(ramp=0, reaction=0)
    car.step(0, 16)
    car.plug_in()
    car.step(1, 16)
    assert car.current == 16
    car.step(1.1, None)
    assert car.current == 0


def test_it_gets_full_and_leaves() -> None:
    car = Car(wanted_wh=1000, ramp=0, reaction=0, cos_phi=1)
    car.step(0, 10)
    car.plug_in()
    wh = car.step(3600 * 1000 / 6900 - 2, 10)
    assert wh == pytest.approx(1000, rel=0.02)
    assert not car.full
    car.step(600, 10)
    assert car.full
    assert car.current == 0
    car.leave()
    assert not car.plugged


@pytest.mark.parametrize(
    ("phases", "first", "expected"),
    [(1, 1, (8, 0, 0)), (1, 3, (0, 0, 8)), (2, 3, (8, 0, 8)), (3, 2, (8, 8, 8))],
)
def test_phases(phases: int, first: int, expected: tuple[float, float, float]) -> None:
    car = Car(phases=phases, first_phase=first, ramp=0, reaction=0)
    car.plug_in()
    car.step(0, 8)
    car.step(1, 8)
    assert car.phase_currents == expected


def test_cars_come_and_go_by_themselves() -> None:
    car = Car(life=CarLife(seed=5))
    arrivals, full, before = 0, 0, False
    for second in range(3600):
        car.step(second, 16)
        arrivals += car.plugged and not before
        full += car.full
        before = car.plugged
    assert arrivals > 5
    assert full
