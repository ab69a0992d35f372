"""The virtual EWS-Box on a serial line: every command of the reference (manual)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import struct

import pytest

from tests.simulated_client import PortClient, living, wait

from .bus import VirtualBus
from .car import Car
from .ews_box import EwsBox
from .ews_client import EwsClient
from .ews_commands import COMMANDS
from .ews_frames import command, ews_commands_in, frame
from .ews_records import InfoMix
from .log import CLIENT

OK = b"\x00"
REFUSED = b"\x01"
SIZES = {"id": 11, "rc": 108, "rd": 56, "rf": 256, "rg": 28}
SIZES |= {"ri": 130, "rp": 27, "rs": 105, "ru": 34, "rz": 64}


@contextmanager
def line_to(box: EwsBox) -> Iterator[tuple[VirtualBus, EwsClient]]:
    with living(VirtualBus.in_loop(box)) as bus:
        yield bus, EwsClient(PortClient(bus), box.bcc)


def charging(bus: VirtualBus, box: EwsBox, client: EwsClient, car: Car) -> None:
    car.plug_in()
    bus.advance(1)
    assert client.order(1, 3) == 0
    bus.advance(1)
    assert box.ports[0].contactor


def test_every_command_of_the_reference_exists() -> None:
    reference = "cr fw id ma mc oe ow rc rd rf rg ri rp rs ru rz sc se sf si sl sp st"
    assert set(COMMANDS) == {*reference.split(), "su", "sz", "zz"}


def test_sizes_of_the_answers() -> None:
    box = EwsBox()
    with line_to(box) as (_, client):
        assert client.ask("id") == b"M165300103\x00"
        for name, size in SIZES.items():
            assert len(client.ask(name)) == size, name
        box.rd_extra = b"later"
        assert client.ask("rd")[56:] == b"later"
    assert [c.name for c in box.commands] == ["id", *SIZES, "rd"]
    assert not box.writes


def test_bcc_without_the_message_id() -> None:
    box = EwsBox(bcc="without_msgid")
    with line_to(box) as (bus, client):
        assert len(client.ask("id")) == 11
        client.write(command("id"))
        assert client.next(0.1) is None
        assert box.frames.counters.bad_bcc == 1
        received = ews_commands_in(bus.log.of(CLIENT), "without_msgid")
        assert [m.name for m in received] == ["id"]


def test_other_messages_are_ignored() -> None:
    box = EwsBox()
    with line_to(box) as (_, client):
        for data in (
            b"\x00UU",
            frame(b"D", b"xx"),
            frame(b"A", b"id"),
            frame(b"C", b""),
        ):
            client.write(data)
        assert client.ask("??", timeout=0.1) == b"?"
        assert len(client.ask("id")) == 11
    assert [c.answer is None for c in box.commands] == [True, False]


def test_a_command_with_a_pause_is_dropped() -> None:
    box = EwsBox()
    with line_to(box) as (bus, client):
        client.write(command("id")[:4])
        wait(bus, 0.15)
        assert len(client.ask("id")) == 11
        assert box.frames.counters.timeouts == 1


def test_status_of_a_charge() -> None:
    car = Car(phases=1)
    box = EwsBox(cars=(car,))
    with line_to(box) as (bus, client):
        one, two = client.ports()
        assert (one["status"], one["cable"], one["offered"]) == (0x00, 0, 32)
        assert (one["low"], one["high"]) == (1200, 1200)
        car.plug_in()
        bus.advance(1)
        one, _ = client.ports()
        assert (one["status"], one["cable"], one["locked"]) == (0x30, 32, 0)
        assert client.limit(1, 10) == 0
        assert client.order(1, 3) == 0
        bus.advance(540)
        one, two = client.ports()
        assert (one["status"], one["offered"], one["start_mode"]) == (0x40, 10, 2)
        assert (one["locked"], one["contactor"], one["rcd"]) == (1, 1, 0)
        assert (one["low"], one["high"]) == (-1200, 600)
        assert 530 < one["seconds"] <= 540
        assert one["wh"] == pytest.approx(10 * 230 * 0.98 * 540 / 3600, rel=0.02)
        assert one["total_wh"] == one["wh"]
        assert two["status"] == 0
        data = client.ask("rd")
        power, _, duty = struct.unpack(">IIB", data[:9])
        assert power == round(10 * 230 * 0.98)
        assert duty == 16
        assert data[14:16] == bytes((10, 0))


def test_orders_on_the_wire() -> None:
    car = Car()
    box = EwsBox(cars=(car,))
    with line_to(box) as (bus, client):
        charging(bus, box, client, car)
        assert client.order(1, 6) == 0
        bus.advance(1)
        assert box.ports[0].locked
        assert client.order(1, 6) == 0
        bus.advance(1)
        assert len(box.ports[0].unlocked_while_car_wants) == 1
        assert client.order(1, 3) == 4
        assert client.order(1, 9) == 2
        assert client.order(3, 1) == 1
        assert client.ask("sl", b"\x01") == b"\x01"
        assert client.order(2, 7) == 6
    assert [c.parameters for c in box.writes][:3] == [
        b"\x01\x03",
        b"\x01\x06",
        b"\x01\x06",
    ]


def test_a_limit() -> None:
    box = EwsBox(jumper=20, max_current=16)
    with line_to(box) as (_, client):
        assert [client.limit(1, amps) for amps in (6, 16, 17, 5, 0)] == [0, 0, 1, 1, 0]
        assert client.limit(3, 6) == 1
        assert client.limit(2, 6) == 0
        assert box.ports[0].limit == 0
        assert client.ports()[1]["offered"] == 6
        box.clamps_limits = True
        assert client.limit(1, 32) == 0
        assert box.ports[0].limit == 16
        box.ignores_limits = True
        assert client.limit(1, 6) == 0
        assert box.ports[0].limit == 16
    limits = [(limit.port, limit.amps, limit.accepted) for limit in box.currents_set]
    assert limits[:3] == [(1, 6, True), (1, 16, True), (1, 17, False)]


def test_a_limit_is_lost_with_the_power_and_the_charge_may_come_back() -> None:
    car = Car(max_current=32)
    box = EwsBox(cars=(car,), restart_after_power=True)
    with line_to(box) as (bus, client):
        charging(bus, box, client, car)
        client.limit(1, 8)
        box.power_cycle(5)
        assert client.ask("rc", timeout=0.05) == b"?"
        bus.advance(5.5)
        assert client.ports()[0]["status"] == 0xF0
        bus.advance(20)
        one = client.ports()[0]
        assert (one["status"], one["offered"]) == (0x40, 32)
        assert car.current == 32
        client.limit(1, 8)
        bus.advance(20)
        assert car.current == 8


def test_restart_flag() -> None:
    box = EwsBox()
    with line_to(box) as (bus, client):
        assert client.ask("rs")[11] & 1
        assert not client.ask("rs")[11] & 1
        assert client.ask("zz") == b""
        bus.wait_for(lambda: box.restarts == 1)
        assert client.ports()[0]["status"] == 0xF0
        bus.advance(2)
        box.restart_flag_until = "clock"
        assert client.ask("rs")[11] & 1
        assert client.ask("sc", bytes.fromhex("07EA0B16061E00")) == OK
        assert not client.ask("rs")[11] & 1


def test_clock() -> None:
    box = EwsBox()
    with line_to(box) as (bus, client):
        assert client.ask("rs")[64:71] == bytes.fromhex("07D0 01 01 00 00 00")
        assert client.ask("sc", bytes.fromhex("07EA 0C 1F 17 3B 3A")) == OK
        bus.advance(3)
        assert client.ask("rs")[64:70] == bytes.fromhex("07EB 01 01 00 00")
        assert client.ask("sc", bytes.fromhex("07EA 0D 1F 17 3B 3A")) == REFUSED
        assert client.ask("sc", b"") == REFUSED
        box.power_cycle()
        assert client.ask("rs")[64:66] == bytes.fromhex("07D0")


def test_serial_number_in_rs() -> None:
    box = EwsBox(serial="000000004711", jumper=63)
    with line_to(box) as (_, client):
        data = client.ask("rs")
        assert data[:11] == b"M165300103\x00"
        assert data[12:24] == b"000000004711"
        assert data[57] == 1
        assert data[62] == 63


def test_meter() -> None:
    box = EwsBox()
    with line_to(box) as (_, client):
        assert client.ask("cr", b"\x02\x00\x01\x00\x00") == OK
        assert [p["total_wh"] for p in client.ports()] == [0, 65536]
        assert client.ask("cr", b"\x03\x00\x00\x00\x00") == REFUSED


def test_ten_minutes_without_a_server() -> None:
    car = Car()
    box = EwsBox(cars=(car,))
    with line_to(box) as (bus, client):
        charging(bus, box, client, car)
        bus.advance(590)
        assert box.ports[0].contactor
        bus.advance(15)
        assert not box.ports[0].contactor
        assert not box.ports[0].locked
        one = client.ports()[0]
        assert (one["status"], one["result"]) == (0x60, 7)
        assert box.server_timeouts == 2


def test_ten_minutes_have_no_effect_in_standalone_mode() -> None:
    car = Car()
    box = EwsBox(cars=(car,), mode="standalone")
    with line_to(box) as (bus, client):
        charging(bus, box, client, car)
        bus.advance(700)
        assert box.ports[0].contactor
        assert not box.infos


def test_last_charge() -> None:
    car = Car()
    box = EwsBox(cars=(car,))
    with line_to(box) as (bus, client):
        client.ask("sc", bytes.fromhex("07EA 0B 16 06 1E 00"))
        charging(bus, box, client, car)
        bus.advance(60)
        client.order(1, 1)
        bus.advance(1)
        one = client.ports()[0]
        assert (one["status"], one["result"]) == (0x50, 1)
        assert one["last_seconds"] in (60, 61)
        assert one["last_wh"] == one["wh"] > 0
        assert client.ask("rd")[42:47] == bytes.fromhex("07EA 0B 16 06")


def test_server_connected_on_a_serial_line() -> None:
    box = EwsBox()
    with line_to(box) as (bus, client):
        assert not box.server_connected
        client.ask("id")
        assert box.server_connected
        bus.advance(31)
        assert not box.server_connected


def test_exclusive_ports() -> None:
    cars = (Car(), Car())
    box = EwsBox(cars=cars, exclusive=True)
    with line_to(box) as (bus, client):
        cars[0].plug_in()
        bus.advance(1)
        assert [p["status"] for p in client.ports()] == [0x30, 0xA9]
        assert client.order(2, 3) == 12
        cars[0].leave()
        bus.advance(1)
        assert [p["status"] for p in client.ports()] == [0, 0]


def test_one_port_only() -> None:
    box = EwsBox(ports=1)
    with line_to(box) as (_, client):
        assert client.order(2, 3) == 3
        assert len(client.ask("rc")) == 108


def test_power_backup_takes_260_seconds() -> None:
    box = EwsBox(power_backup=True)
    with line_to(box) as (bus, client):
        assert client.ask("rs")[11] & 0b1100 == 0b1100
        box.power_cycle()
        bus.advance(250)
        assert client.ask("rs")[11] & 0b1100 == 0b0100
        assert client.order(1, 3) == 9
        bus.advance(11)
        assert client.ports()[0]["status"] == 0


def test_debug_and_application_messages() -> None:
    box = EwsBox()
    with line_to(box) as (_, client):
        box.send_debug(b"hello")
        box.send_application(0x99, b"\x02\x02")
        assert len(client.ask("id")) == 11
        assert [m.msgid for m in client.unasked] == [b"D", b"\x99"]


@pytest.mark.parametrize("where", ["before", "after", "none"])
def test_an_info_record_at_every_cut_of_an_answer(where: str) -> None:
    box = EwsBox(turn_round=0.0, jitter=0.0)
    record, answer = 16, 18
    whole = answer + (0 if where == "none" else record)
    with line_to(box) as (_, client):
        for cut in range(1, whole):
            box.mix_info(InfoMix(where, cut=cut, pause=0.001))  # type: ignore[arg-type]
            assert client.ask("id") == b"M165300103\x00"
        if where != "none":
            client.ask("id")
            assert len(client.unasked) == len(box.infos) == whole - 1


def test_an_info_record_inside_an_answer_damages_it() -> None:
    box = EwsBox()
    with line_to(box) as (bus, client):
        box.mix_info(InfoMix("inside", at=7))
        client.write(command("id"))
        bus.wait_for(lambda: bus.log.of(box.name))
        entry = bus.log.of(box.name)[-1]
        answer = frame(b"A", b"idM165300103\x00")
        assert entry.data[:7] == answer[:7]
        assert entry.data[7:12] == b"\x02\x00\x0bIi"
        assert entry.data[-11:] == answer[7:]


def test_a_wrong_length() -> None:
    box = EwsBox()
    with line_to(box) as (bus, client):
        for difference in (3, -3):
            box.false_length_once(difference)
            client.write(command("id"))
            sent = bus.wait_for(lambda: bus.log.of(box.name))
            assert sent[-1].data[:3] == bytes((2, 0, 13 + difference))
            bus.log.clear()


def test_both_directions_at_once() -> None:
    """RS-232 has two wires: a record may come while a command is sent."""
    box = EwsBox(manual_io=True, turn_round=0.0)
    with line_to(box) as (bus, client):
        for _ in range(5):
            client.write(command("sf", bytes(256)))
            box.key_down(1, 1)
            box.key_up(1, 1)
            assert client.ask("id") == b"M165300103\x00"
        assert bus.wire.collisions == 0
        assert [c.answer for c in box.commands_named("sf")] == [OK] * 5
