"""The virtual SmartEVSE v2.17, polled: registers, refusals, access, override."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.simulated_client import PortClient, living

from .bus import VirtualBus
from .car import Car
from .smartevse import SmartEvse
from .smartevse_alone import SmartEvseAlone
from .smartevse_frames import (
    frame,
    read_frame,
    smartevse_requests_in,
    write_frame,
    write_several_frame,
)

SILENT = 0.05
A, B, C = (ord(letter) for letter in "ABC")


@contextmanager
def line_to(*boxes: SmartEvse) -> Iterator[tuple[VirtualBus, PortClient]]:
    with living(VirtualBus.in_loop(*boxes)) as bus:
        yield bus, PortClient(bus)


def charging(
    dialect: str = "2.17", car: Car | None = None, **options: int
) -> SmartEvseAlone:
    """Return a box whose car charges."""
    alone = SmartEvseAlone(dialect, car or Car(), **options)
    assert alone.outlet.car
    alone.outlet.car.plug_in()
    alone.live(6)
    assert alone.state == "C"
    return alone


def test_a_car_comes_charges_and_leaves() -> None:
    car = Car(max_current=16)
    alone = SmartEvseAlone("2.17", car)
    alone.live(2)
    assert alone.read(0xA0, 9) == [A, 0, 0, 6, 0, 0, 0, 1, 0]
    car.plug_in(request=False)
    alone.live(1)
    assert alone.read(0xA0, 9) == [B, 0, 16, 6, 0, 0, 130, 1, 0]
    alone.live(2)
    assert alone.outlet.pilot_current == 13.0
    assert not alone.outlet.contactor
    car.request()
    alone.live(5)
    assert alone.state == "C"
    assert alone.outlet.contactor
    assert alone.outlet.car_current == pytest.approx(13.0)
    car.finish()
    alone.live(0.1)
    assert (alone.state, alone.outlet.contactor) == ("B", False)
    car.leave()
    alone.live(0.1)
    assert alone.state == "A"
    assert alone.outlet.car_current == 0.0
    # The measured cable current is kept.
    assert alone.read(0xA2) == [16]


def test_pilot_without_pwm() -> None:
    """A real car ends its request when the PWM stops; a defective one does not."""
    for odd in (False, True):
        alone = charging(car=Car(requests_without_pwm=odd))
        assert alone.write(0xA7, 0) == "ok"
        alone.live(0.1)
        assert alone.outlet.pilot == (6 if odd else 9)
        assert alone.outlet.car_current == 0.0
        alone.write(0xA7, 1)
        alone.live(5)
        assert alone.state == ("A" if odd else "C")


@pytest.mark.parametrize("function", [6, 16])
def test_override(function: int) -> None:
    """The reply is a refusal, but it takes effect within two seconds."""
    alone = charging()
    assert alone.write(0xA6, 80, function=function) == "refused 3"
    alone.live(2.1)
    assert alone.read(0xA6) == [80]
    assert alone.outlet.pilot_current == 8.0
    # Above the maximum of the cable and of the box.
    alone.write(0xA6, 250)
    alone.live(2.1)
    assert alone.outlet.pilot_current == 25.0
    alone.write(0xA6, 0)
    alone.live(2.1)
    assert alone.read(0xA6) == [130]
    assert alone.outlet.contactor
    # Below 6 A: read back as written, signalled as 6 A.
    alone.write(0xA6, 30)
    alone.live(2.1)
    assert alone.read(0xA6) == [30]
    assert alone.outlet.pilot_current == 6.0
    assert alone.outlet.contactor


def test_override_waits_for_the_car_and_is_lost_with_the_power() -> None:
    car = Car()
    alone = SmartEvseAlone("2.17", car)
    alone.write(0xA6, 80)
    car.plug_in(request=False)
    alone.live(4)
    assert alone.read(0xA6) == [130]
    car.request()
    alone.live(0.1)
    assert alone.read(0xA6) == [80]
    alone.box.power_cycle()
    alone.live(6)
    assert alone.state == "C"
    assert alone.read(0xA6) == [130]


def test_an_earlier_217_has_no_override() -> None:
    """The same refusal, and no effect."""
    alone = SmartEvseAlone("2.17", Car(), override_works=False)
    assert alone.outlet.car
    alone.outlet.car.plug_in()
    alone.live(6)
    assert alone.write(0xA6, 80) == "refused 3"
    alone.live(5)
    assert alone.read(0xA6) == [130]
    assert alone.outlet.pilot_current == 13.0


def test_fixed_cable_has_its_maximum() -> None:
    alone = charging(config=1, max_current=20)
    assert alone.read(0xA2) == [20]
    assert alone.outlet.pilot_current == 20.0
    alone = charging(cable=13, max_current=32)
    assert alone.outlet.pilot_current == 13.0


@pytest.mark.parametrize("state", ["A", "B", "C"])
def test_access_off_is_state_a_at_once(state: str) -> None:
    car = Car()
    alone = SmartEvseAlone("2.17", car)
    if state != "A":
        car.plug_in(request=state == "C")
    alone.live(6)
    assert alone.state == state
    assert alone.write(0xA7, 0) == "ok"
    assert alone.state == "A"
    assert not alone.outlet.contactor
    assert alone.outlet.pilot_current == 0.0
    alone.live(60)
    assert alone.state == "A"


def test_every_second_single_write_is_dropped() -> None:
    alone = SmartEvseAlone("2.17")
    results = [alone.write(0xA7, n % 2, function=6) for n in range(4)]
    assert results == ["ok", "silence", "ok", "silence"]
    assert alone.read(0xA7) == [0]
    assert alone.box.dropped == 2
    # After a read, another function or a request to another unit it is a request.
    for between in (read_frame(0, 0xA0, 1), read_frame(7, 0, 1), write_frame(9, 1, 1)):
        assert alone.write(0xA7, 1, function=6) == "ok"
        alone.receive(between)
    assert [alone.write(0xA7, 1) for _ in range(3)] == ["ok"] * 3
    # Unknown frames change nothing.
    alone.receive(read_frame(0, 0xA0, 1))
    alone.write(0xA7, 1, function=6)
    alone.receive(read_frame(0, 0xA0, 1, function=3))
    assert alone.write(0xA7, 1, function=6) == "silence"


def test_unit_is_the_load_balance_setting() -> None:
    alone = SmartEvseAlone("2.17", load_balance=3)
    assert alone.receive(read_frame(0, 0xA0, 9)) is None
    assert alone.receive(read_frame(3, 0xA0, 9))
    # A broadcast write is accepted, without a reply.
    assert alone.receive(write_several_frame(0, 0xA7, 0)) is None
    assert not alone.outlet.access
    assert alone.receive(write_several_frame(2, 0xA7, 1)) is None
    assert not alone.outlet.access


def test_volatile_mode() -> None:
    """Ignored unless balancing is on and the mode is not normal."""
    for load_balance, mode, works in ((0, 1, False), (1, 0, False), (1, 1, True)):
        alone = SmartEvseAlone("2.17", load_balance=load_balance, mode=mode)
        assert alone.read(0xA8) == ([mode] if works else [])
        assert alone.read(0xA0, 9)[-1] == mode
        assert alone.write(0xA8, 2) == ("ok" if works else "silence")
        assert alone.read(0xA0, 9)[-1] == (2 if works else mode)
        assert alone.box.eeprom_writes.total() == 0
        alone.box.power_cycle()
        assert alone.read(0xA0, 9)[-1] == mode


def test_refusals() -> None:
    alone = SmartEvseAlone("2.17")
    assert alone.write(0xA0, 1) == "refused 3"
    assert alone.write(0xA7, 2) == "refused 3"
    assert alone.write(0xC2, 17) == "refused 3"
    assert alone.write(0xA9, 1) == "refused 2"
    assert alone.receive(read_frame(0, 0xA8, 2)) is None
    assert alone.receive(read_frame(0, 0xA7, 3)) == frame(0, 4, b"\x02")
    # Of two values one is accepted; the reply has that count.
    answer = alone.receive(write_several_frame(0, 0xA6, 80, 0))
    assert answer == frame(0, 16, bytes.fromhex("00a60001"))
    for register in (*range(1, 5), 0x81, 0x82, 0x84):
        assert alone.write(register, 0, function=6) == "silence"
        alone.read(0xA0)


def test_stored_settings() -> None:
    alone = SmartEvseAlone("2.17")
    assert alone.write(0xE0, 20) == "ok"
    assert alone.write(0xC2, 8, function=6) == "ok"
    assert alone.write(0xE1, 3) == "refused 3"
    assert alone.box.eeprom_writes == {0xE0: 1, 0xC2: 1}
    alone.box.power_cycle()
    assert alone.read(0xE0) == [20]
    assert alone.read(0xA3) == [8]


@pytest.mark.parametrize(("switch", "opens"), [(0, True), (1, False), (2, False)])
def test_storing_opens_access(switch: int, opens: bool) -> None:  # noqa: FBT001
    """With a plugged-in car this starts the charge."""
    car = Car()
    alone = SmartEvseAlone("2.17", car, switch=switch)
    alone.write(0xA7, 0)
    car.plug_in()
    alone.live(10)
    assert alone.state == "A"
    alone.write(0xE0, 16)
    alone.live(5)
    assert alone.outlet.access == opens
    assert alone.state == ("C" if opens else "A")
    # So does a power failure.
    alone.write(0xA7, 0)
    alone.box.power_cycle()
    assert alone.outlet.access == opens


def test_the_button_at_the_box() -> None:
    alone = charging(switch=0)
    alone.outlet.press()
    assert alone.state == "A"
    assert alone.outlet.access
    alone.live(14)
    assert alone.state == "A"
    alone.live(5)
    assert alone.state == "C"
    alone = SmartEvseAlone("2.17", switch=1)
    assert not alone.outlet.access
    alone.outlet.press()
    assert alone.read(0xA7) == [1]


def test_0x83_closes_the_contactor_of_a_box_that_is_no_slave() -> None:
    alone = SmartEvseAlone("2.17", Car())
    assert alone.receive(write_frame(0, 0x83, 160)) is None
    assert alone.outlet.contactor


def test_errors() -> None:
    alone = charging()
    out = alone.outlet
    out.temperature = 65
    alone.live(1)
    assert (alone.state, out.error, out.contactor) == ("A", 4, False)
    out.temperature = 54
    alone.live(6)
    assert (alone.state, out.error) == ("C", 0)
    out.rcd_tripped = True
    alone.live(0.1)
    assert (alone.state, out.error) == ("A", 16)
    out.rcd_tripped = False
    alone.live(60)
    assert alone.state == "A"
    out.press()
    alone.live(6)
    assert alone.state == "C"


@pytest.mark.parametrize(("mode", "bit"), [(1, 1), (2, 32)])
def test_its_own_meter(mode: int, bit: int) -> None:
    """Too little current: 60 s; then it broadcasts the cleared errors."""
    alone = charging(mode=mode)
    alone.outlet.meter_leaves = 3
    alone.live(4)
    assert (alone.state, alone.outlet.error) == ("A", bit)
    alone.outlet.meter_leaves = 9
    alone.live(30)
    assert (alone.state, alone.outlet.error) == ("A", 0)
    assert [data for _, data in alone.sent] == [write_frame(0, 2, 0)]
    alone.live(45)
    assert alone.state == "C"
    assert alone.outlet.pilot_current == 9.0
    alone.outlet.meter_works = False
    alone.live(14)
    assert (alone.state, alone.outlet.error) == ("A", 2)


def test_activation_after_thirty_seconds_in_b() -> None:
    car = Car()
    alone = SmartEvseAlone("2.17", car)
    car.plug_in(request=False)
    alone.live(29)
    assert alone.state == "B"
    alone.live(2.5)
    assert alone.read(0xA0) == [ord("T")]
    alone.live(60)
    assert alone.state == "B"


def test_silence_ends_a_frame_on_the_wire() -> None:
    box = SmartEvse()
    request = read_frame(0, 0xA0, 9)
    with line_to(box) as (bus, client):
        # Two requests without a gap are one bad frame, and so is one with a gap.
        client.write(request + request)
        assert client.read(1, SILENT) == b""
        client.write(request[:4])
        assert client.read(1, 0.02) == b""
        client.write(request[4:])
        assert client.read(1, SILENT) == b""
        client.write(request[:-1] + b"\x00")
        assert client.read(1, SILENT) == b""
        client.write(b"\x00" * 60)
        assert client.read(1, 0.1) == b""
        client.write(request)
        assert len(client.read(23)) == 23
        asked, answer = bus.log.entries[-2:]
        assert answer.t - asked.end == pytest.approx(0.01, abs=0.005)
        assert answer.end - answer.t == pytest.approx(23 * 10 / 9600)
        assert [r.register for r in smartevse_requests_in(bus)] == [0xA0]


def test_replies_wait_for_silence() -> None:
    box = SmartEvse(turn_round=0.0)
    with line_to(box) as (bus, client):
        client.write(read_frame(0, 0xA0, 1))
        assert len(client.read(7)) == 7
        asked, answer = bus.log.entries[-2:]
        assert 0.006 < answer.t - asked.end < 0.015
        assert bus.wire.collisions == 0


def test_defects() -> None:
    alone = charging()
    alone.box.ignore_access = True
    assert alone.write(0xA7, 0) == "ok"
    assert alone.read(0xA7) == [1]
    assert alone.outlet.contactor
    box = SmartEvse()
    box.set_by_other_master(10)
    assert box.outlet.override == 100
    box.set_at_the_box("max_current", 16)
    assert box.outlet.settings["max_current"] == 16
    with pytest.raises(ValueError, match="6 to 80"):
        box.set_at_the_box("max_current", 5)


def test_requests_in_the_log() -> None:
    box = SmartEvse(load_balance=2)
    with line_to(box) as (bus, client):
        client.write(write_several_frame(0, 1, 0, 60, 0, 0))
        client.read(1, SILENT)
        client.write(write_several_frame(2, 0xA7, 0))
        client.read(8)
        first, second = smartevse_requests_in(bus)
        assert (first.unit, first.function, first.values) == (0, 16, (0, 60, 0, 0))
        assert (second.register, second.count, second.values) == (0xA7, 1, (0,))
        assert second.t > first.end
        write = box.writes[0]
        assert (write.register, write.values, write.taken) == (0xA7, (0,), 1)
        assert box.broadcasts[0].currents == (0, 60, 0, 0)
        assert box.stats()["writes"] == 1
