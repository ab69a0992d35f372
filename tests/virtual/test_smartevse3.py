"""The virtual SmartEVSE 3.x as a node, and as a box that talks by itself.

Each expectation is a line of the facts that were read in its sources (README).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from .car import Car
from .smartevse_alone import SmartEvseAlone
from .smartevse_frames import frame, read_frame, write_several_frame
from .smartevse_registers import LINES_3, V3, V3_00, V3_SERKRI, Dialect

if TYPE_CHECKING:
    from .smartevse_outlet3 import SmartEvseOutlet3

LESS_6A, NO_COMM, EV_METER = 1, 2, 8
UNIT = 4

every_line = pytest.mark.parametrize("line", LINES_3, ids=lambda one: one.name)


def node(
    line: Dialect = V3, car: Car | None = None, *, unit: int = UNIT, **settings: int
) -> SmartEvseAlone:
    settings = {"max_current": 25, "load_balance": unit} | settings
    return SmartEvseAlone(line, car, cable=32, **settings)


def outlet_of(alone: SmartEvseAlone) -> SmartEvseOutlet3:
    return alone.outlet  # type: ignore[return-value]


def broadcast(alone: SmartEvseAlone, tenths: int, *, words: int = 8) -> None:
    values = [0] * words
    values[alone.outlet.load_balance - 1] = tenths
    assert alone.receive(write_several_frame(9, 0x20, *values)) is None


def kept_alive(alone: SmartEvseAlone, tenths: int, seconds: float) -> None:
    for _ in range(round(seconds)):
        broadcast(alone, tenths)
        alone.live(1)


def charging(
    line: Dialect = V3, car: Car | None = None, **settings: int
) -> SmartEvseAlone:
    """Return a node that was granted 8 A."""
    car = car or Car()
    alone = node(line, car, **settings)
    broadcast(alone, 0)
    car.plug_in()
    alone.live(0.5)
    assert alone.read(0) == [4]
    assert alone.write(0, 5, 0) == "ok"
    kept_alive(alone, 80, 2)
    assert alone.read(0) == [6]
    assert alone.write(0, 7, 0) == "ok"
    alone.live(0.1)
    assert (alone.state, alone.outlet.pilot_current) == ("C", 8.0)
    return alone


@every_line
def test_only_a_node_answers(line: Dialect) -> None:
    for unit in range(2, 9):
        alone = node(line, unit=unit)
        assert alone.read(0, 12)
        assert alone.read(0, 12, function=3)
        assert alone.receive(read_frame(unit % 8 + 1, 0, 1)) is None
        assert alone.receive(frame(unit, 5, b"\0\0\xff\0")) is None
    for load_balance in (0, 1):
        alone = node(line, unit=load_balance)
        for unit in range(10):
            assert alone.receive(read_frame(unit, 0, 12)) is None


def test_a_write_of_0x0104_makes_it_deaf() -> None:
    alone = node()
    # Whether this write still has a reply is not settled.
    alone.write(0x0104, 0)
    assert alone.outlet.load_balance == 0
    assert alone.receive(read_frame(UNIT, 0, 1)) is None
    alone = node()
    # The next number is an address at once.
    alone.write(0x0104, 5)
    assert alone.read(0x0104) == [5]
    assert alone.box.eeprom_writes == {0x0104: 1}


@pytest.mark.parametrize(
    ("load_balance", "kinds"), [(0, {"meter"}), (1, {"meter", "poll", "broadcast"})]
)
def test_without_a_master_it_talks_every_two_seconds(
    load_balance: int, kinds: set[str]
) -> None:
    """Whoever else speaks: it does not yield."""
    alone = node(unit=load_balance, mains_meter=1)
    for _ in range(20):
        alone.receive(read_frame(3, 0, 12))
        alone.live(1)
    said: dict[str, list[float]] = {}
    for t, data in alone.sent:
        kind = {10: "meter", 9: "broadcast"}.get(data[0], "poll")
        said.setdefault(kind, []).append(t)
        if kind == "broadcast":
            assert data[:7].hex() == "09100020000b16"
        if kind == "poll":
            assert data[1:6].hex() == "0400000008"
    assert said.keys() == kinds
    assert all(len(times) in range(9, 12) for times in said.values())


def test_a_first_or_serkri_master_broadcasts_eight_words() -> None:
    alone = node(V3_SERKRI, unit=1)
    alone.live(5)
    assert {data[:7].hex() for _, data in alone.sent if data[0] == 9} == {
        "09100020000810"
    }


@every_line
def test_standard_exceptions(line: Dialect) -> None:
    alone = node(line)
    assert alone.receive(read_frame(UNIT, 0x0C, 1)) == frame(UNIT, 0x84, b"\x02")
    assert alone.receive(read_frame(UNIT, 0x0B, 2)) == frame(UNIT, 0x84, b"\x02")
    assert alone.receive(read_frame(UNIT, 0xA0, 9)) == frame(UNIT, 0x84, b"\x02")
    long = alone.read(0x0200, 26)
    assert bool(long) == (line is not V3)
    assert alone.read(0x0216) == ([0] if line is not V3 else [])
    assert len(alone.read(0x0200, 22)) == 22
    assert alone.write(0x0103, 81, function=6) == "refused 3"
    assert alone.write(0x0103, 5, function=16) == "refused 3"
    assert alone.write(0x0300, 1) == "refused 2"
    # Maximum, phases and current are refused.
    for register in (7, 8, 9, 10):
        assert alone.write(register, 1) == "refused 3"


def test_several_words_are_answered_with_the_count_taken() -> None:
    alone = node()
    taken = alone.receive(write_several_frame(UNIT, 0x0102, 7, 99, UNIT))
    assert taken == frame(UNIT, 16, b"\x01\x02\x00\x02")
    assert alone.read(0x0102, 3) == [7, 25, UNIT]


def test_no_write_is_dropped() -> None:
    alone = node()
    assert [alone.write(0x0102, 6 + n, function=6) for n in range(4)] == ["ok"] * 4


@every_line
def test_temperature_and_maximum(line: Dialect) -> None:
    alone = node(line, Car())
    assert alone.outlet.car
    alone.outlet.temperature = -7
    alone.live(2)
    assert alone.read(10) == [266 if line is V3_00 else 0xFFF9]
    assert alone.read(7) == [0]
    broadcast(alone, 0)
    alone.outlet.car.plug_in()
    alone.live(1)
    assert alone.read(7) == [32 if line in (V3_00, V3_SERKRI) else 25]


@every_line
def test_access_in_flash_or_not(line: Dialect) -> None:
    alone = node(line)
    out = outlet_of(alone)
    for word in (0, 0, 2, 7):
        assert alone.write(5, word) == "ok"
    stored = line not in (V3_00, V3_SERKRI)
    assert alone.read(5) == [7 if stored else 0]
    assert out.flash_writes == (4 if stored else 0)
    alone.box.power_cycle()
    assert alone.read(5) == [7 if stored else 1]
    assert not alone.box.eeprom_writes


@pytest.mark.parametrize("word", [0, 2])
def test_without_access_a_charge_ends(word: int) -> None:
    alone = charging()
    alone.write(5, word)
    assert (alone.state, alone.outlet.contactor) == ("C1", True)
    kept_alive(alone, 80, 8)
    assert (alone.state, alone.outlet.contactor) == ("B1", False)
    kept_alive(alone, 80, 60)
    assert alone.read(0) == [9]
    alone.write(5, 1)
    kept_alive(alone, 80, 2)
    assert alone.read(0) == [4]


@pytest.mark.parametrize("keeps", [False, True])
def test_a_broadcast_of_0_is_a_stop_for_a_while(keeps: bool) -> None:  # noqa: FBT001
    """C1 with a closed contactor, for as long as the car requests; B1; 15 s; again."""
    alone = charging(car=Car(requests_without_pwm=keeps))
    begin = alone.now
    broadcast(alone, 0)
    assert alone.read(0) == [10]
    assert alone.outlet.contactor
    assert alone.outlet.pilot_current == 0.0
    while alone.outlet.contactor:
        kept_alive(alone, 0, 1)
    assert alone.read(0) == [9]
    assert (6 <= alone.now - begin <= 8) == keeps
    while alone.read(0) == [9] and alone.now < begin + 30:
        kept_alive(alone, 0, 1)
    # A car that asks without PWM is not at 9 V.
    assert alone.read(0) == ([9] if keeps else [4])
    assert keeps or alone.now - begin == pytest.approx(15.5, abs=1.5)


def test_refused_for_a_minute() -> None:
    """From the clearing of the error on; it needs the master for that."""
    car = Car()
    alone = node(car=car)
    broadcast(alone, 0)
    car.plug_in()
    alone.live(0.5)
    assert alone.write(0, 4, LESS_6A) == "ok"
    assert alone.read(0, 2) == [9, LESS_6A]
    kept_alive(alone, 0, 90)
    assert alone.read(0, 2) == [9, LESS_6A]
    cleared = alone.now
    assert alone.write(0, 9, 0) == "ok"
    while alone.read(0) == [9]:
        kept_alive(alone, 0, 1)
    assert alone.read(0, 2) == [4, 0]
    assert alone.now - cleared == pytest.approx(60, abs=1.5)


@every_line
@pytest.mark.parametrize("mode", [0, 1])
def test_without_broadcasts(line: Dialect, mode: int) -> None:
    """After 10 or 11 s and up to one more, or never in mode normal."""
    alone = charging(line, mode=mode)
    broadcast(alone, 80)
    begin = alone.now
    while alone.state == "C" and alone.now < begin + 60:
        alone.read(0, 8)
        alone.live(0.5)
    version = line.version3
    assert version
    if mode == 0 and not version.no_comm_in_normal:
        assert (alone.state, alone.outlet.pilot_current) == ("C", 8.0)
        return
    assert alone.outlet.error == NO_COMM
    seconds = alone.now - begin
    assert version.no_comm <= seconds <= version.no_comm + 1.5
    alone.live(3)
    assert (alone.read(0), alone.outlet.contactor) == ([9], False)
    # One broadcast clears it.
    broadcast(alone, 0)
    alone.live(0.1)
    assert alone.outlet.error == 0
    kept_alive(alone, 0, 20)
    assert alone.read(0) == [4]


def test_a_car_that_does_not_let_go_holds_the_contactor() -> None:
    """11 to 12 s, then C1 for 6 to 7 s."""
    alone = charging(car=Car(requests_without_pwm=True))
    broadcast(alone, 80)
    begin = alone.now
    while alone.outlet.contactor:
        alone.live(0.1)
    assert 17 <= alone.now - begin <= 19.1


@pytest.mark.parametrize("opens", [True, False])
def test_a_changed_mode_word_opens_access(opens: bool) -> None:  # noqa: FBT001
    assert V3.version3
    line = replace(V3, version3=replace(V3.version3, mode_opens_access=opens))
    alone = node(line)
    alone.write(5, 0)
    assert alone.write(3, 0) == "ok"
    assert alone.read(5) == [0]
    assert alone.write(3, 2) == "ok"
    assert alone.read(3, 3) == [2, 0, int(opens)]
    assert alone.write(3, 9) == "ok"
    assert alone.read(3) == [2]


def test_settings_leave_access() -> None:
    alone = node()
    alone.write(5, 0)
    assert alone.write(0x0103, 20) == "ok"
    assert alone.read(5, 2) == [0, 1]


def test_a_node_ignores_the_override() -> None:
    alone = charging()
    assert alone.write(2, 200) == "ok"
    kept_alive(alone, 80, 5)
    assert alone.read(2) == [80]
    assert alone.outlet.pilot_current == 8.0


def test_nothing_is_clamped() -> None:
    """In B and C the word goes to the pilot; under 6 A and over 80 A it is 6 A."""
    alone = charging()
    for tenths, amps in ((400, 40.0), (30, 6.0), (801, 6.0), (800, 80.0)):
        broadcast(alone, tenths, words=11)
        assert alone.outlet.pilot_current == amps
        assert alone.read(2) == [tenths]


def test_the_pilot_stays_while_it_waits_for_c() -> None:
    """A broadcast in state 6 is in word 2, and not at the pilot."""
    car = Car()
    alone = node(car=car)
    broadcast(alone, 0)
    car.plug_in()
    alone.live(0.5)
    alone.write(0, 5, 0)
    kept_alive(alone, 160, 2)
    assert alone.read(0) == [6]
    broadcast(alone, 60)
    assert alone.read(2) == [60]
    alone.write(0, 7, 0)
    alone.live(0.1)
    assert alone.outlet.pilot_current == 16.0
    broadcast(alone, 60)
    assert alone.outlet.pilot_current == 6.0


def test_the_modem_comes_first() -> None:
    assert V3.version3
    line = replace(V3, version3=replace(V3.version3, modem=3))
    car = Car()
    alone = node(line, car)
    broadcast(alone, 0)
    car.plug_in()
    seen: list[int] = []
    for _ in range(300):
        broadcast(alone, 0)
        alone.live(0.1)
        seen += [code for code in alone.read(0) if code not in seen]
        assert not alone.outlet.contactor
    assert seen == [11, 12, 13, 9, 4]


def test_its_ev_meter_must_be_read_by_its_master() -> None:
    alone = charging(ev_meter=1, mode=1)
    kept_alive(alone, 80, 60)
    assert alone.state == "C"
    kept_alive(alone, 80, 6)
    assert alone.outlet.error == EV_METER
    assert alone.state == "B1"


def test_after_a_power_cut_it_asks_again() -> None:
    alone = charging()
    alone.box.power_cycle()
    assert not alone.outlet.contactor
    alone.live(1)
    assert alone.read(0) == [4]
