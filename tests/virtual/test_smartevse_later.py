"""The virtual SmartEVSE of the later dialects: gentle stops, and other masters."""

from __future__ import annotations

import pytest

from tests.simulated_client import living, wait

from .bus import VirtualBus
from .car import Car
from .smartevse import SmartEvse
from .smartevse_alone import SmartEvseAlone
from .smartevse_frames import frame, read_frame, write_several_frame

BURST_GAP = 0.1
NO_COMM = 2


def charging(dialect: str = "2.30+", car: Car | None = None) -> SmartEvseAlone:
    alone = SmartEvseAlone(dialect, car or Car())
    assert alone.outlet.car
    alone.outlet.measures = False
    alone.outlet.car.plug_in()
    alone.live(6)
    assert alone.state == "C"
    return alone


@pytest.mark.parametrize("function", [3, 4])
def test_status_of_220(function: int) -> None:
    alone = SmartEvseAlone("2.20", Car(), max_current=20, cable=32)
    assert alone.read(0xA0, 12, function) == [0, 0, 0, 6, 0, 0, 0, 1, 0, 0, 12, 0]
    assert alone.receive(read_frame(1, 0xA0, 12)) is None
    assert alone.read(0xC0, 4) == [0, 0, 6, 20]
    assert alone.read(0xE0, 3) == [16, 0, 25]
    assert alone.receive(read_frame(0, 0xAC, 1)) == frame(0, 4, b"\x02")


@pytest.mark.parametrize("function", [3, 4])
def test_status_of_later(function: int) -> None:
    alone = SmartEvseAlone("2.30+", Car(), serial=4711)
    want = [0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 293, 4711]
    assert alone.read(0x0000, 12, function) == want
    assert alone.receive(read_frame(1, 0xA0, 9)) == frame(1, 4, b"\x02")
    assert alone.read(0x0100, 5) == [0, 0, 6, 13, 0]
    assert alone.read(0x0200, 8) == [0, 16, 0, 1024, 25, 12, 10, 48]


@pytest.mark.parametrize(
    ("dialect", "current", "access"), [("2.20", 0xA6, 0xA7), ("2.30+", 2, 5)]
)
def test_writes(dialect: str, current: int, access: int) -> None:
    alone = charging(dialect)
    assert alone.write(current, 80) == "ok"
    # Volatile registers are never refused.
    assert alone.write(access, 7, function=6) == "ok"
    assert alone.outlet.access
    assert alone.write(current, 90, function=6) == "silence"
    alone.live(7)
    assert alone.read(current) == [80]
    assert alone.outlet.pilot_current == 8.0


def test_access_of_220_is_state_a() -> None:
    alone = charging("2.20")
    alone.write(0xA7, 0)
    assert (alone.state, alone.outlet.contactor) == ("A", False)
    assert alone.write(0xA8, 1) == "silence"


def test_access_stops_gently() -> None:
    """First the PWM, then, once the car has stopped, the contactor; then B1."""
    alone = charging()
    assert alone.write(5, 0) == "ok"
    assert (alone.state, alone.outlet.contactor) == ("C1", True)
    assert alone.read(0) == [10]
    assert alone.outlet.pilot_current == 0.0
    alone.live(5)
    assert (alone.state, alone.outlet.contactor) == ("B1", False)
    assert alone.read(0) == [9]
    assert alone.outlet.car
    alone.outlet.car.leave()
    alone.live(0.1)
    assert alone.state == "A"


def test_a_car_that_does_not_stop_has_six_seconds() -> None:
    alone = charging(car=Car(requests_without_pwm=True))
    alone.write(5, 0)
    alone.live(5)
    assert alone.outlet.contactor
    alone.live(3)
    assert (alone.state, alone.outlet.contactor) == ("B1", False)


def test_volatile_mode_is_answered_and_ignored() -> None:
    alone = SmartEvseAlone("2.30+", mode=1)
    assert alone.write(3, 2) == "ok"
    assert alone.read(3) == [1]


def test_polling_all_the_time_ends_in_no_comm() -> None:
    """Its own cycle does not run while there are requests, to any address."""
    alone = charging()
    for _ in range(6):
        alone.receive(read_frame(77, 0, 1))
        alone.live(2)
    alone.live(0.5)
    assert alone.outlet.error == NO_COMM
    assert alone.state == "C1"
    # It recovers by itself after some silence.
    alone.live(6.2)
    assert alone.outlet.error == 0
    alone.live(25)
    assert alone.state == "C"


def test_bursts_with_six_seconds_of_silence_do_no_harm() -> None:
    alone = charging()
    for _ in range(30):
        for _ in range(4):
            assert alone.read(0, 12)
            alone.live(BURST_GAP)
        alone.live(6.2)
        assert alone.outlet.error == 0
        assert alone.state == "C"


def test_override_needs_its_own_cycle() -> None:
    alone = charging()
    alone.write(2, 70)
    alone.live(2.9)
    assert alone.read(2) == [130]
    alone.live(2.9)
    assert alone.read(2) == [130]
    alone.live(6.2)
    assert alone.read(2) == [70]
    assert alone.outlet.pilot_current == 7.0


def test_polled_all_the_time_a_car_gets_no_pwm() -> None:
    car = Car()
    alone = SmartEvseAlone("2.30+", car)
    alone.live(3)
    alone.read(0, 12)
    car.plug_in()
    for _ in range(4):
        alone.read(0, 12)
        alone.live(2)
    assert alone.state == "B"
    assert alone.outlet.pilot_current == 0.0


def test_stored_settings() -> None:
    alone = SmartEvseAlone("2.30+")
    alone.write(5, 0)
    assert alone.write(0x0103, 81) == "refused 3"
    assert alone.write(0x0103, 32) == "ok"
    assert alone.box.eeprom_writes == {0x0103: 1}
    assert alone.outlet.access
    assert alone.read(6) == [1]


@pytest.mark.parametrize(
    ("dialect", "register", "after"), [("2.20", 1, "A"), ("2.30+", 0x20, "C1")]
)
def test_slaves_follow_unit_9(dialect: str, register: int, after: str) -> None:
    """They wait to be polled, and a broadcast of 0 is a stop."""
    car = Car()
    alone = SmartEvseAlone(dialect, car, load_balance=2)
    state = 0xA0 if dialect == "2.20" else 0

    def broadcast(current: int) -> None:
        data = write_several_frame(9, register, 0, current, *[0] * 6)
        assert alone.receive(data) is None

    broadcast(60)
    car.plug_in()
    alone.live(0.5)
    assert alone.read(state) == [4]
    assert alone.sent == []
    assert alone.write(state, 5) == "ok"
    broadcast(60)
    alone.live(0.5)
    assert alone.read(state) == [6]
    alone.write(state, 7)
    assert alone.outlet.contactor
    broadcast(100)
    assert alone.outlet.pilot_current == 10.0
    broadcast(0)
    assert alone.state == after


def test_head_searches_for_the_smallest_current_of_each_car() -> None:
    """As recorded in `first_minutes`: 13 A for a second, then 6 and 8 A in turn."""
    car = Car()
    alone = SmartEvseAlone("2.30+", car)
    assert alone.write(2, 70) == "ok"
    alone.live(9)
    for _ in range(2):
        car.plug_in()
        begin = alone.now
        seen: list[float] = []
        while alone.now < begin + 100:
            alone.live(0.5)
            if alone.state == "C" and seen[-1:] != [alone.outlet.pilot_current]:
                seen.append(alone.outlet.pilot_current)
        assert seen == [13.0, 6.0, 8.0, 6.0, 8.0, 6.0, 8.0, 7.0]
        car.leave()
        alone.live(5)


@pytest.mark.parametrize("dialect", ["2.20", "2.30", "2.30+", "3-serkri", "3"])
def test_nodes_and_their_master_on_the_wire(dialect: str) -> None:
    cars = [Car(), Car(), Car()]
    nodes = [
        SmartEvse(dialect, load_balance=unit, car=car, cable=32, max_current=32)
        for unit, car in zip((2, 5, 8), cars, strict=True)
    ]
    master = SmartEvse(dialect, load_balance=1, settings={"circuit": 16})
    with living(VirtualBus.in_loop(master, *nodes)) as bus:
        bus.wait_for(lambda: all(node.broadcasts for node in nodes))
        for car in cars[:2]:
            car.plug_in()
        bus.wait_for(lambda: all(node.contactor for node in nodes[:2]), 24)
        if dialect != "2.30+":
            # That one searches for the smallest current of the cars first.
            bus.wait_for(lambda: nodes[0].pilot_current == 8.0, 4)
        cars[2].plug_in()
        bus.wait_for(lambda: nodes[2].error == 1, 24)
        assert sum(node.pilot_current for node in nodes) <= 16.0
        assert {unit for _, unit, _ in master.controller.nodes.granted} == {2, 5}
        cars[0].leave()
        # Refused for a minute from then on.
        bus.wait_for(lambda: nodes[2].error == 0, 6)
        wait(bus, 40)
        assert not nodes[2].contactor
        bus.wait_for(lambda: nodes[2].contactor, 40)


@pytest.mark.parametrize(("late", "before"), [(1, 0), (1, 1), (0, 0)])
def test_an_answer_waits_for_the_cable_measurement(late: int, before: int) -> None:
    """As recorded: some 0.1 s late, with the state after it or before it."""
    car = Car()
    node = SmartEvse("2.30", load_balance=2, car=car, late_answers=bool(late))
    node.controller.answers_as_before = bool(before)
    with living(VirtualBus.in_loop(node, tick=0.01)) as bus:
        bus.inject(write_several_frame(9, 0x20, *[0] * 8))
        car.plug_in()
        begin = bus.time()
        bus.inject(read_frame(2, 0, 1), after=0.04)
        wait(bus, 0.5)
        (reply,) = bus.log.of(node.name)
        assert reply.data[4] == (4 if late and not before else 0)
        assert (0.08 < reply.t - begin < 0.15) == bool(late)
