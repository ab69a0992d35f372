"""A charging port in its own time: its status and transitions."""

from __future__ import annotations

import pytest

from .car import Car
from .ews_orders import Code, execute
from .ews_port import EwsPort
from .ews_session import Result
from .ews_states import Status


class Bench:
    """A port, a car, and the time."""

    def __init__(self, **car: float | bool) -> None:
        self.car = Car(**car)  # type: ignore[arg-type]
        self.port = EwsPort(1, self.car)
        self.time = 0.0
        self.events = 0
        self.port.on_event = self._count
        self.port.step(0.0)

    def _count(self) -> None:
        self.events += 1

    def live(self, seconds: float = 2.0) -> int:
        end = self.time + seconds
        while self.time < end:
            self.time += 0.05
            self.port.step(self.time)
            assert not self.port.history.unlocked_under_power
            if self.port.contactor and self.port.has_lock:
                assert self.port.locked
        return self.port.status

    def sl(self, order: int) -> int:
        return execute(self.port, order, lambda port: setattr(port, "start_mode", 1))

    def charging(self) -> Bench:
        self.car.plug_in()
        assert self.live() == Status.WAITING
        assert self.sl(3) == Code.OK
        assert self.live() == Status.CHARGING
        return self


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_whole_charge(bench: Bench) -> None:
    bench.car.plug_in()
    bench.live(5)
    bench.sl(3)
    bench.live(10)
    bench.sl(1)
    bench.live()
    bench.car.leave()
    bench.live()
    statuses = [status for _, status in bench.port.history.statuses]
    assert statuses == [0x10, 0x30, 0x42, 0x40, 0x50, 0x00]
    session = bench.port.session
    assert session.result == Result.STOPPED
    assert session.last_wh > 0
    assert 9 < session.last_seconds < 10
    assert session.total_wh == session.last_wh
    assert session.wh == 0
    assert session.cycles == 1
    assert bench.events == 1


def test_locked_before_there_is_voltage(bench: Bench) -> None:
    bench.car.plug_in()
    bench.live()
    bench.sl(3)
    bench.live(0.3)
    assert bench.port.status == Status.WAITING
    assert not bench.port.contactor
    assert bench.port.lock.moving
    bench.live(0.2)
    assert bench.port.locked
    assert bench.port.contactor


def test_a_car_that_is_not_ready_is_a_pause(bench: Bench) -> None:
    bench.charging()
    bench.car.finish()
    assert bench.live() == Status.PAUSE
    assert not bench.port.contactor
    assert bench.port.locked
    bench.sl(4)
    assert bench.live() == Status.PAUSE_OPTIMISED
    bench.car.request()
    assert bench.live() == Status.CHARGING_OPTIMISED
    bench.sl(5)
    assert bench.live() == Status.CHARGING


@pytest.mark.parametrize("shown", [0x50, 0x42])
def test_the_second_six_unlocks(bench: Bench, shown: int) -> None:
    bench.port.pause_status = shown  # type: ignore[assignment]
    bench.charging()
    assert bench.sl(6) == Code.OK
    assert bench.live() == shown
    assert bench.port.locked
    assert not bench.port.contactor
    assert not bench.port.unlocked_while_car_wants
    assert bench.sl(3) == Code.OK
    assert bench.live() == Status.CHARGING
    bench.sl(6)
    bench.live()
    assert bench.sl(6) == Code.OK
    assert bench.live() == Status.ENDED
    assert not bench.port.locked
    assert [u.reason for u in bench.port.unlocked_while_car_wants] == ["sl 6"]
    assert bench.sl(3) == Code.ENDED


def test_a_resumed_charge_keeps_its_counters(bench: Bench) -> None:
    bench.charging()
    bench.sl(6)
    before = bench.port.session.wh
    bench.live(60)
    assert bench.port.session.wh == before
    bench.sl(3)
    bench.live(10)
    assert bench.port.session.wh > before
    assert bench.port.session.cycles == 1


def test_a_start_reverses_an_unlocking(bench: Bench) -> None:
    bench.car.plug_in()
    bench.live()
    bench.sl(7)
    bench.live()
    bench.sl(6)
    assert bench.sl(3) == Code.OK
    assert bench.live() == Status.CHARGING
    assert bench.port.locked


def test_lock_first_start_later(bench: Bench) -> None:
    """The way of 3.1.8 to wait for enough current."""
    assert bench.sl(7) == Code.LOCK
    bench.car.plug_in()
    bench.live()
    assert bench.sl(7) == Code.OK
    assert bench.live() == Status.WAITING
    assert bench.port.locked
    bench.sl(3)
    assert bench.live(0.1) == Status.CHARGING
    assert bench.sl(7) == Code.OK
    assert bench.live() == Status.CHARGING


def test_a_start_without_a_car_is_for_the_next_one(bench: Bench) -> None:
    assert bench.sl(3) == Code.OK
    assert bench.port.start_mode == 2
    bench.live()
    bench.car.plug_in()
    assert bench.live() == Status.CHARGING


def test_a_request_ends_when_the_car_leaves(bench: Bench) -> None:
    bench.car.plug_in()
    bench.live()
    assert bench.sl(2) == Code.OK
    assert bench.port.start_mode == 1
    bench.car.leave()
    bench.live()
    assert bench.port.start_mode == 0
    bench.car.plug_in()
    assert bench.live() == Status.WAITING


def test_pulled_at_the_car(bench: Bench) -> None:
    bench.charging()
    bench.car.leave()
    assert bench.live(0.1) == Status.ENDED
    assert not bench.port.contactor
    assert bench.live() == Status.NOT_CONNECTED
    assert bench.port.session.result == Result.PILOT_LOST
    assert not bench.port.unlocked_while_car_wants


def test_a_pause_by_the_server_ends_when_the_car_leaves(bench: Bench) -> None:
    bench.charging()
    bench.sl(6)
    bench.live()
    bench.car.leave()
    assert bench.live() == Status.NOT_CONNECTED
    assert bench.port.start_mode == 0


def test_a_cable_torn_out(bench: Bench) -> None:
    bench.charging()
    bench.port.cable_in = False
    bench.car.plugged = False
    assert bench.live(0.1) in (Status.ABORTED, Status.NOT_CONNECTED)
    assert bench.port.session.result == Result.CABLE_LOST


def test_the_residual_current_device(bench: Bench) -> None:
    bench.charging()
    bench.port.rcd_tripped = True
    assert bench.live() == Status.RCD
    assert not bench.port.contactor
    assert bench.port.session.result == Result.RCD
    assert bench.sl(3) == Code.RCD
    assert bench.sl(7) == Code.RCD
    bench.port.rcd_tripped = False
    assert bench.live() == Status.ABORTED
    bench.car.leave()
    assert bench.live() == Status.NOT_CONNECTED


def test_the_rcd_of_an_idle_port(bench: Bench) -> None:
    bench.port.rcd_tripped = True
    assert bench.live() == Status.RCD
    bench.port.rcd_tripped = False
    assert bench.live() == Status.NOT_CONNECTED
    assert len(bench.port.history.statuses) == 2


def test_a_lock_that_does_not_lock(bench: Bench) -> None:
    bench.port.lock.jammed = "lock"
    bench.car.plug_in()
    bench.live()
    assert bench.sl(3) == Code.OK
    assert bench.live() == Status.LOCK_ERROR
    assert not bench.port.contactor
    assert bench.sl(3) == bench.sl(7) == Code.LOCK
    bench.car.leave()
    assert bench.live() == Status.NOT_CONNECTED


def test_a_lock_that_does_not_unlock(bench: Bench) -> None:
    bench.charging()
    bench.port.lock.jammed = "unlock"
    bench.sl(1)
    assert bench.live() == Status.UNLOCK_ERROR
    assert bench.sl(3) == Code.LOCK
    bench.port.lock.jammed = ""
    assert bench.sl(1) == Code.OK
    assert bench.live() == Status.ENDED
    assert not bench.port.locked


def test_a_contactor_that_does_not_close(bench: Bench) -> None:
    bench.port.relay.broken = "open"
    bench.car.plug_in()
    bench.live()
    bench.sl(3)
    assert bench.live() == Status.CONTACTOR_ON_ERROR
    assert bench.sl(3) == Code.CONTACTOR


def test_a_welded_contactor_keeps_the_lock(bench: Bench) -> None:
    bench.charging()
    bench.port.relay.broken = "closed"
    bench.sl(1)
    assert bench.live() == Status.CONTACTOR_OFF_ERROR
    assert bench.port.locked
    assert bench.sl(3) == Code.CONTACTOR
    assert bench.sl(6) == Code.OK
    assert bench.live() == Status.CONTACTOR_OFF_ERROR
    assert bench.port.locked
    bench.port.relay.broken = ""
    assert bench.live() == Status.ABORTED
    assert not bench.port.locked


@pytest.mark.parametrize(
    ("cable", "must_match", "status"),
    [
        (20, False, Status.WAITING),
        (20, True, Status.CABLE_ERROR),
        (None, False, Status.CABLE_ERROR),
        (32, True, Status.WAITING),
    ],
)
def test_cables(bench: Bench, cable: int | None, must_match: bool, status: int) -> None:  # noqa: FBT001
    bench.port.cable = cable
    bench.port.cable_must_match = must_match
    bench.car.plug_in()
    assert bench.live() == status
    assert bench.sl(3) == (Code.CABLE if status == Status.CABLE_ERROR else Code.OK)


def test_the_offer_is_the_lowest_of_all_limits(bench: Bench) -> None:
    port = bench.port
    assert port.offered == 32
    port.installation.limit = 25
    port.cable = 20
    assert port.offered == 25
    bench.charging()
    assert port.offered == 20
    port.limit = 13
    assert port.offered == 13
    bench.live(10)
    assert max(port.currents) == pytest.approx(13)
    port.limit = 0
    bench.live(10)
    assert max(port.currents) == pytest.approx(16)
    assert port.history.highest_offer == 20


def test_ventilation(bench: Bench) -> None:
    bench.port.wants_fan = True
    bench.car.plug_in()
    bench.live()
    assert bench.sl(3) == Code.OK
    assert bench.live() == Status.ABORTED
    assert bench.port.session.result == Result.NO_FAN
    bench.car.leave()
    bench.live()
    bench.port.installation.fan = True
    bench.charging()


def test_an_unstable_pilot(bench: Bench) -> None:
    bench.charging()
    for _ in range(4):
        bench.car.requesting = False
        bench.car.current = 0.0
        bench.live(0.5)
        bench.car.request()
        bench.live(0.5)
    assert bench.port.status == Status.ABORTED
    assert bench.port.session.result == Result.UNSTABLE


def test_a_broken_meter(bench: Bench) -> None:
    bench.charging()
    bench.port.meter_broken = True
    assert bench.live() == Status.ABORTED
    assert bench.port.session.result == Result.METER


def test_a_fixed_cable_has_no_lock(bench: Bench) -> None:
    bench.port.installation.fixed_cable = True
    assert bench.live() == Status.SEARCHING
    bench.charging()
    assert not bench.port.locked
    assert bench.sl(7) == Code.CONFIG
    bench.sl(6)
    assert bench.live() == Status.ENDED
    bench.sl(3)
    assert bench.live() == Status.CHARGING
    bench.car.leave()
    assert bench.live() == Status.SEARCHING


def test_mode_1(bench: Bench) -> None:
    bench.port.installation.mode1 = True
    bench.charging()
    assert bench.port.offered == 16
    assert not bench.port.locked


def test_power_failure_opens_everything(bench: Bench) -> None:
    bench.charging()
    bench.port.limit = 10
    bench.port.power_off(bench.time, restart=True)
    assert not bench.port.contactor
    assert not bench.port.locked
    bench.port.initialise(bench.time, 1.0)
    assert bench.live(0.9) == Status.INIT
    assert bench.sl(1) == bench.sl(3) == bench.sl(7) == Code.INITIALISING
    assert bench.live() == Status.CHARGING
    assert bench.port.offered == 32
    assert [cause for _, cause in bench.port.history.starts] == [
        "sl 3",
        "power failure",
    ]


def test_no_restart_unless_configured_or_without_the_car(bench: Bench) -> None:
    bench.charging()
    bench.port.power_off(bench.time, restart=False)
    bench.port.initialise(bench.time, 1.0)
    assert bench.live(3) == Status.WAITING
    bench.sl(3)
    bench.live()
    bench.port.power_off(bench.time, restart=True)
    bench.car.leave()
    bench.port.initialise(bench.time, 1.0)
    assert bench.live(3) == Status.NOT_CONNECTED
    bench.car.plug_in()
    assert bench.live(3) == Status.WAITING


def test_orders_that_do_not_exist(bench: Bench) -> None:
    assert bench.sl(0) == bench.sl(8) == Code.NO_SUCH_ORDER
    bench.port.installation.enabled = False
    assert bench.sl(3) == Code.CONFIG
