"""The virtual SmartEVSE v2.17 as a slave and as a master."""

from __future__ import annotations

import itertools

import pytest

from tests.simulated_client import living

from .bus import VirtualBus
from .car import Car
from .smartevse import SmartEvse
from .smartevse_alone import SmartEvseAlone
from .smartevse_frames import (
    read_frame,
    smartevse_requests_in,
    write_frame,
    write_several_frame,
)

LESS_6A, NO_COMM = 1, 2
ACK_A, ACK_B, ACK_C, ACK_CB = range(0x81, 0x85)


class Slave(SmartEvseAlone):
    """Slave 2, and frames of its master."""

    def __init__(self, car: Car | None = None, **settings: int) -> None:
        super().__init__("2.17", car or Car(), load_balance=2, **settings)
        self.word = 60
        self.broadcast()

    @property
    def car(self) -> Car:
        assert self.outlet.car
        return self.outlet.car

    def broadcast(self, word: int | None = None) -> None:
        self.word = self.word if word is None else word
        data = write_several_frame(0, 1, 0, self.word, 0, 0)
        assert self.receive(data) is None

    def mastered(self, seconds: float) -> None:
        """Let time pass with a broadcast every 2 s, and no acknowledgements."""
        while seconds > 0:
            self.broadcast()
            self.live(min(2.0, seconds))
            seconds -= 2.0

    def acknowledge(self, register: int, value: int = 60) -> None:
        assert self.receive(write_frame(2, register, value)) is None

    def charge(self) -> None:
        """Start a charge of 6 A."""
        self.car.plug_in()
        self.mastered(0.5)
        self.acknowledge(ACK_B)
        self.mastered(0.5)
        self.acknowledge(ACK_C)
        assert (self.state, self.outlet.contactor) == ("C", True)
        self.sent.clear()

    def asked(self) -> list[tuple[int, int]]:
        return [(r.register, r.value) for r in self.box.requests_sent]


def test_it_repeats_its_request_every_second_until_acknowledged() -> None:
    slave = Slave(max_current=32, cable=13)
    slave.car.plug_in()
    slave.mastered(3.5)
    assert slave.asked() == [(0x02, 130)] * 4
    assert [data for _, data in slave.sent] == [write_frame(2, 0x02, 130)] * 4
    assert slave.read(0xA0) in ([ord("F")], [ord("A")])
    times = [t for t, _ in slave.sent]
    assert all(0.9 < b - a < 1.2 for a, b in itertools.pairwise(times))
    slave.acknowledge(ACK_B)
    assert (slave.state, slave.outlet.pilot_current) == ("B", 6.0)
    assert not slave.outlet.contactor
    slave.box.requests_sent.clear()
    slave.mastered(3.5)
    assert slave.asked() == [(0x03, 130)] * 4
    assert not slave.outlet.contactor
    slave.acknowledge(ACK_C, 80)
    assert (slave.state, slave.outlet.pilot_current) == ("C", 8.0)
    assert [(a.register, a.value) for a in slave.box.answers] == [
        (ACK_B, 60),
        (ACK_C, 80),
    ]
    slave.box.requests_sent.clear()
    slave.mastered(20)
    assert slave.asked() == []


def test_a_car_that_is_full_and_one_that_leaves() -> None:
    slave = Slave()
    slave.charge()
    slave.box.requests_sent.clear()
    slave.car.finish()
    slave.mastered(2.5)
    assert slave.state == "H"
    assert not slave.outlet.contactor
    assert slave.asked() == [(0x04, 0)] * 3
    slave.acknowledge(ACK_CB, 0)
    assert slave.state == "B"
    slave.box.requests_sent.clear()
    slave.car.leave()
    slave.mastered(1.5)
    assert slave.read(0xA0) == [ord("E")]
    assert slave.asked() == [(0x01, 0)] * 2
    slave.acknowledge(ACK_A, 0)
    assert slave.state == "A"


@pytest.mark.parametrize("stage", [ACK_B, ACK_C])
def test_acknowledged_with_no_current(stage: int) -> None:
    """A minute in A; then it sends its request again."""
    slave = Slave()
    slave.car.plug_in()
    slave.mastered(0.5)
    if stage == ACK_C:
        slave.acknowledge(ACK_B)
        slave.mastered(0.5)
    slave.acknowledge(stage, 0)
    slave.mastered(1.2)
    assert (slave.state, slave.outlet.error) == ("A", LESS_6A)
    slave.box.requests_sent.clear()
    slave.mastered(56)
    assert slave.asked() == []
    slave.mastered(5)
    assert slave.outlet.error == 0
    assert slave.asked()[0] == (0x02, 130)


@pytest.mark.parametrize(
    ("word", "amps"), [(0, 6.0), (59, 6.0), (60, 6.0), (137, 13.7), (801, 6.0)]
)
def test_a_broadcast_is_never_a_stop(word: int, amps: float) -> None:
    """Nor does the box limit it to its own maximum of 13 A."""
    slave = Slave()
    slave.charge()
    slave.mastered(4)
    slave.broadcast(word)
    slave.mastered(10)
    assert (slave.state, slave.outlet.contactor) == ("C", True)
    assert slave.outlet.pilot_current == amps
    assert slave.outlet.car_current == pytest.approx(amps)
    assert slave.read(0xA6) == [word]
    assert slave.box.broadcasts[-1].currents == (0, word, 0, 0)


def test_without_broadcasts_it_stops() -> None:
    slave = Slave()
    slave.charge()
    slave.broadcast()
    slave.live(9.8)
    assert (slave.state, slave.outlet.contactor) == ("C", True)
    # A read or a write is no broadcast.
    slave.read(0xA0, 9)
    slave.live(1.2)
    assert (slave.state, slave.outlet.contactor) == ("A", False)
    assert slave.read(0xA0, 2) == [ord("A"), NO_COMM]
    slave.box.requests_sent.clear()
    slave.live(30)
    assert slave.asked() == []
    slave.broadcast()
    assert slave.read(0xA1) == [NO_COMM]
    slave.live(0.02)
    assert slave.read(0xA1) == [0]
    slave.mastered(1)
    assert slave.asked()[0] == (0x02, 130)


def test_from_the_start_it_waits_five_seconds() -> None:
    alone = SmartEvseAlone("2.17", load_balance=2)
    alone.live(4.9)
    assert alone.outlet.error == 0
    alone.live(1.2)
    assert alone.outlet.error == NO_COMM


def test_access_off_stops_one_slave() -> None:
    slave = Slave()
    slave.charge()
    assert slave.write(0xA7, 0) == "ok"
    assert (slave.state, slave.outlet.contactor) == ("A", False)
    slave.box.requests_sent.clear()
    slave.mastered(20)
    assert slave.asked() == []
    slave.write(0xA7, 1)
    slave.mastered(0.5)
    assert slave.asked()[0] == (0x02, 130)


def test_after_access_a_car_must_have_ended_its_request() -> None:
    slave = Slave(Car(requests_without_pwm=True))
    slave.charge()
    slave.write(0xA7, 0)
    slave.write(0xA7, 1)
    slave.box.requests_sent.clear()
    slave.mastered(10)
    assert slave.state == "A"
    assert slave.asked() == []
    slave.pilot(9)
    assert slave.asked()[0] == (0x02, 130)


def test_a_late_acknowledgement_starts_a_stopped_car() -> None:
    """0x83 closes the contactor in any state, also without access."""
    slave = Slave(Car(requests_without_pwm=True))
    slave.charge()
    slave.write(0xA7, 0)
    slave.acknowledge(ACK_C)
    slave.mastered(1)
    assert (slave.state, slave.outlet.contactor) == ("C", True)
    assert not slave.outlet.access


def test_0x84_to_a_charging_slave_leaves_the_contactor_closed() -> None:
    slave = Slave()
    slave.charge()
    slave.acknowledge(ACK_CB, 0)
    assert (slave.state, slave.outlet.contactor) == ("B", True)
    slave.mastered(0.5)
    assert slave.asked()[-1] == (0x03, 130)
    assert slave.outlet.contactor


def test_error_broadcast_stops_for_a_minute() -> None:
    slave = Slave()
    slave.charge()
    assert slave.receive(write_frame(0, 2, LESS_6A)) is None
    assert (slave.state, slave.outlet.contactor) == ("A", False)
    slave.mastered(56)
    assert slave.outlet.error == LESS_6A
    slave.mastered(6)
    assert slave.outlet.error == 0
    # A master that clears its errors clears those of the slave.
    slave.charge()
    slave.receive(write_frame(0, 2, 0x20))
    slave.receive(write_frame(0, 2, 0))
    assert slave.outlet.error == 0
    assert slave.state == "A"


def test_acknowledgements_are_no_replies_and_writes_after_them_are() -> None:
    """Its own request counts as the last one: 82 undoes that."""
    slave = Slave()
    slave.car.plug_in()
    slave.live(0.5)
    # Its request was 06 to unit 2: the next 06 to it counts as the reply.
    assert slave.write(0xA7, 0, function=6) == "silence"
    assert slave.outlet.access
    slave.live(1.2)
    slave.acknowledge(ACK_B)
    assert slave.state == "B"
    assert slave.write(0xA7, 0, function=6) == "ok"
    assert not slave.outlet.access
    assert slave.write(0xA7, 1, function=6) == "silence"
    # An 82 between has no effect on that.
    slave.acknowledge(ACK_B)
    assert slave.write(0xA7, 1, function=6) == "silence"


def test_frames_that_are_no_broadcasts() -> None:
    slave = Slave()
    slave.charge()
    for other in (
        write_several_frame(2, 1, 0, 100, 0, 0),
        write_several_frame(9, 1, 0, 100, 0, 0),
        write_several_frame(0, 0x20, 0, 100, 0, 0),
        write_several_frame(0, 1, 100),
        write_frame(0, 1, 100),
    ):
        slave.receive(other)
        assert slave.read(0xA6) == [60]


def test_a_master_broadcasts_and_acknowledges() -> None:
    car = Car()
    master = SmartEvseAlone("2.17", car, load_balance=1, circuit=20)
    master.live(6)
    master.sent.clear()

    def ask(unit: int, register: int, value: int = 130) -> int:
        assert master.receive(write_frame(unit, register, value)) is None
        answer = master.sent.pop()[1]
        assert answer[:4] == bytes((unit, 6, 0, 0x80 | register))
        return int.from_bytes(answer[4:6], "big")

    assert ask(2, 0x02) == 60
    assert ask(2, 0x03) == 130
    car.plug_in()
    master.live(6)
    assert (master.state, master.outlet.pilot_current) == ("C", 10.0)
    assert master.sent[-1][1] == write_several_frame(0, 1, 100, 100, 0, 0)
    assert ask(3, 0x02) == 60
    assert ask(3, 0x03, 60) == 60
    # Four times 6 A are above the limit of the circuit.
    assert ask(4, 0x02) == 0
    assert ask(2, 0x04) == 0
    master.live(2)
    assert master.sent[-1][1] == write_several_frame(0, 1, 130, 70, 60, 0)


def test_two_slaves_and_their_master_on_the_wire() -> None:
    cars = [Car(), Car()]
    slaves = [SmartEvse(load_balance=2 + n, car=cars[n]) for n in range(2)]
    master = SmartEvse(load_balance=1, settings={"circuit": 20})
    with living(VirtualBus.in_loop(master, *slaves)) as bus:
        bus.wait_for(lambda: all(slave.broadcasts for slave in slaves))
        cars[0].plug_in()
        cars[1].plug_in()
        bus.wait_for(lambda: all(slave.contactor for slave in slaves), 8)
        bus.wait_for(lambda: [s.pilot_current for s in slaves] == [10.0, 10.0])
        sent = smartevse_requests_in(bus.log.bursts(master.name))
        broadcasts = [request for request in sent if request.unit == 0]
        assert {request.register for request in broadcasts} == {1}
        assert all(sum(request.values) <= 200 for request in broadcasts)
        gaps = [b.t - a.t for a, b in itertools.pairwise(broadcasts)]
        assert all(1.5 < gap < 2.5 for gap in gaps)
        assert smartevse_requests_in(bus) == []
        # A dead master: its slaves stop by themselves.
        master.faults.dead = True
        bus.advance(12)
        assert [slave.error for slave in slaves] == [NO_COMM] * 2
        assert not any(slave.contactor for slave in slaves)


def test_another_master_of_a_later_dialect() -> None:
    with living(VirtualBus.in_loop(SmartEvse("2.30+", load_balance=1))) as bus:
        bus.advance(2)
        bus.wait_for(lambda: len(smartevse_requests_in(bus.log.entries)) >= 8)
        sent = smartevse_requests_in(bus.log.entries)[:8]
        seen = [(one.unit, one.register, one.count) for one in sent]
        assert seen == [*((unit, 0, 8) for unit in range(2, 9)), (9, 0x20, 8)]


def test_a_read_of_another_unit_is_ignored() -> None:
    slave = Slave()
    assert slave.receive(read_frame(3, 0xA0, 9)) is None
    assert slave.receive(read_frame(2, 0xA0, 9))
