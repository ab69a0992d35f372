"""A driver at the start key: requests a start, again if the server does not start."""

from __future__ import annotations

from .car import Car
from .ews_box import EwsBox
from .ews_driver import STEP_BACK, Driver
from .ews_states import Status


class Afternoon:
    """A box without a wire, and its time."""

    def __init__(self, driver: Driver, box: EwsBox) -> None:
        self.time = 0.0
        self.box = box
        self.port = driver.port
        box.drivers = [driver]
        box.now = lambda: self.time  # type: ignore[method-assign]

    def live(self, seconds: float) -> int:
        """Advance the time; return the start mode of the port."""
        end = self.time + seconds
        while self.time < end:
            self.time += 0.05
            self.box.step()
        return self.port.start_mode


def _afternoon(mode: str = "server") -> tuple[Afternoon, Car]:
    car = Car()
    box = EwsBox(cars=(car, Car()), mode=mode)  # type: ignore[arg-type]
    driver = Driver(box.ports[0], hesitates=(2.0, 2.0), patience=20.0)
    return Afternoon(driver, box), car


def test_a_start_is_requested_when_the_car_requests_charge() -> None:
    afternoon, car = _afternoon()
    car.plug_in(request=False)
    assert afternoon.live(10) == 0
    car.request()
    assert afternoon.live(1.8) == 0
    assert afternoon.live(1) == 1
    assert afternoon.port.status == Status.WAITING


def test_a_request_without_a_start_is_repeated() -> None:
    afternoon, car = _afternoon()
    car.plug_in()
    assert afternoon.live(10) == 1
    assert afternoon.live(13) == 0
    assert afternoon.live(STEP_BACK) == 1
    # Started at last: no more key is pressed.
    afternoon.port.release_start("sl 3")
    afternoon.live(60)
    assert afternoon.port.status == Status.CHARGING
    assert len(afternoon.port.history.starts) == 1


def test_without_a_server_the_key_starts() -> None:
    afternoon, car = _afternoon("standalone")
    car.plug_in()
    afternoon.live(10)
    assert afternoon.port.status == Status.CHARGING
    car.leave()
    afternoon.live(60)
    assert len(afternoon.port.history.starts) == 1
