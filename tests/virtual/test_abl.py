"""The virtual ABL box against bytes of the manual and of real boxes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.simulated_client import PortClient, living

from .abl import AblBox
from .abl_frames import duty_of, line, requests_in
from .bus import VirtualBus
from .car import Car
from .control import Control

READ_FULL = b":0103002E0005C9\r\n"
SET_10_A = b":0110001400010200A632\r\n"
SET_OK = b">011000140001DA\r\n"
FAILED = b">0190046B\r\n"
READ_ICMAX = b":0103000F0005E8\r\n"
SILENT = 0.03


@contextmanager
def line_to(*boxes: AblBox) -> Iterator[tuple[VirtualBus, PortClient]]:
    with living(VirtualBus.in_loop(*boxes)) as bus:
        yield bus, PortClient(bus)


def write(register: int, value: int, box: int = 1) -> bytes:
    numbers = (register, 1)
    data = bytes((box, 0x10)) + b"".join(n.to_bytes(2, "big") for n in numbers)
    return line(":", data + b"\x02" + value.to_bytes(2, "big"))


def read(register: int, count: int, box: int = 1) -> bytes:
    return line(":", bytes((box, 3, 0, register, 0, count)))


def duty(answer: bytes) -> int:
    return int(answer[11:15], 16) & 0x0FFF


def icmax(answer: bytes) -> int:
    return int(answer[19:23], 16)


def state(answer: bytes) -> bytes:
    return answer[9:11]


def test_reads_of_the_manual() -> None:
    box = AblBox(1, firmware=(1, 2), hardware=0, meter=True)
    with line_to(box) as (_, client):
        assert client.ask(b":010300010002F9\r\n") == line(
            ">", bytes.fromhex("01030401011234")
        )
        assert client.ask(b":010300030001F8\r\n") == b">0103020327D0\r\n"
        assert client.ask(b":010300330003C6\r\n") == b">0103063300A1646464F6\r\n"
        serial = b">0103105000325732327879303132333435363722\r\n"
        assert client.ask(b":010300500008A4\r\n") == serial
        assert client.ask(SET_10_A) == SET_OK
        assert duty(client.ask(READ_FULL)) == 166


def test_answers_of_real_boxes() -> None:
    car = Car()
    box = AblBox(1, car=car, firmware=(5, 0), cable_current=16, enable_input=2)
    box.coding_resistor = True
    box.unreadable_in_b2 = True
    box.outlet.default_duty = 0x10B
    box.outlet.cable_current = 20
    with line_to(box) as (bus, client):
        assert client.ask(b":010300010002F9\r\n") == b">010304014150BEA8\r\n"
        client.ask(write(0x14, 100))
        assert client.ask(READ_FULL) == b">01030A2EA1106403E803E803E8EE\r\n"
        client.ask(write(0x14, 0x10B))
        car.plug_in(request=False)
        bus.advance(1)
        assert client.ask(READ_FULL) == b">01030A2EB2910B03E803E803E8B5\r\n"
        client.ask(write(0x14, 100))
        box.outlet.meter = False
        box.fail(4)
        assert client.ask(READ_FULL) == b">01030A2EF4106403E803E803E89B\r\n"


@pytest.mark.parametrize(
    "request_bytes",
    [
        b":0103002E0005C8\r\n",  # LRC
        read(0x14, 1),  # 0x14 cannot be read back
        read(0x14, 5),
        read(0x2E, 3),  # not the whole block
        read(0x04, 1),  # not in the manual: off by default
        read(0x0F, 4),  # exactly five registers
        read(0x0F, 6),
        read(0x99, 1),
        write(0x13, 0x10B),
        line(":", bytes.fromhex("0106001400A6")),  # function 6
        line(":", bytes.fromhex("01040001 0002")),
        line(":", bytes.fromhex("011000140001 0400A600A6")),  # bytes and registers
        line(":", bytes.fromhex("011000140002 0400A600A6")),  # two registers
        read(0x2E, 5, box=2),
        read(0x2E, 5, box=0),  # not readable by broadcast
        read(0x2E, 5).replace(b":", b">"),
        read(0x2E, 5).lower(),
    ],
)
def test_silence(request_bytes: bytes) -> None:
    box = AblBox(1)
    with line_to(box) as (bus, client):
        client.write(request_bytes)
        assert client.read(1, SILENT) == b""
        assert client.ask(READ_FULL).startswith(b">01030A2E")
        assert box.writes == []
        assert bus.log.bursts()[0].data == request_bytes


@pytest.mark.parametrize("value", [0, 0x4F, 0x3E9, 0xFFFF])
def test_limit_out_of_range_is_refused(value: int) -> None:
    box = AblBox(1)
    with line_to(box) as (_, client):
        assert client.ask(write(0x14, value)) == FAILED
        assert duty(client.ask(READ_FULL)) == 266
        assert not box.writes[0].accepted
        assert box.limits_written == []


def test_ic_is_the_lowest() -> None:
    box = AblBox(1, default_current=20, cable_current=13)
    with line_to(box) as (_, client):
        assert duty(client.ask(READ_FULL)) == duty_of(13)
        client.ask(write(0x14, duty_of(10)))
        assert duty(client.ask(READ_FULL)) == duty_of(10)
        client.ask(write(0x14, duty_of(32)))
        assert duty(client.ask(READ_FULL)) == duty_of(13)
        # A pause lowers nothing.
        client.ask(write(0x14, 0x3E8))
        assert duty(client.ask(READ_FULL)) == duty_of(13)
        assert box.ic_amps == 0


def test_broadcast() -> None:
    box = AblBox(7)
    with line_to(box) as (_, client):
        client.write(write(0x14, 166, box=0))
        assert client.read(1, SILENT) == b""
        assert box.writes[0].broadcast
        assert box.limits_written == [166]
        # "Broadcast supported: yes" for a read can only mean a reply.
        assert client.ask(read(0x01, 2, box=0)).startswith(b">07030401")


def test_a_car_charges_pauses_and_leaves() -> None:
    car = Car(max_current=12, phases=2)
    box = AblBox(1, car=car)
    with line_to(box) as (bus, client):
        assert state(client.ask(READ_FULL)) == b"A1"
        car.plug_in(request=False)
        assert state(client.ask(READ_FULL)) == b"B1"
        bus.advance(1)
        answer = client.ask(READ_FULL)
        assert state(answer) == b"B2"
        assert answer[11:].startswith(b"910A000000000000")
        car.request()
        bus.advance(10)
        answer = client.ask(READ_FULL)
        assert state(answer) == b"C2"
        assert answer[11:].startswith(b"910A000000780078")
        assert client.ask(b":010300330003C6\r\n").startswith(b">0103063380C2000C0C")
        client.ask(SET_10_A)
        bus.advance(10)
        assert client.ask(READ_FULL)[11:].startswith(b"90A6000000640064")
        client.ask(write(0x14, 0x3E8))
        bus.advance(10)
        answer = client.ask(READ_FULL)
        assert state(answer) == b"B2"
        assert answer[11:].startswith(b"910A000000000000")
        car.leave()
        assert state(client.ask(READ_FULL)) == b"A1"


@pytest.mark.parametrize(
    ("before", "value", "after"),
    [
        ("A1", 0xE0E0, "E0"),
        ("E0", 0xA1A1, "A1"),
        ("A1", 0xE2E2, "E2"),
        ("E0", 0xE2E2, "E2"),
        ("E2", 0xA1A1, "A1"),
        ("E2", 0x3838, "E2"),
        ("A1", 0xF1F1, "F1"),
        # Refused.
        ("A1", 0xA1A1, None),
        ("F3", 0xA1A1, None),
        ("F3", 0xE0E0, None),
        ("F3", 0xE2E2, None),
        ("A1", 0x3838, None),
        ("A1", 0x1234, None),
        ("A1", 0x0000, None),
    ],
)
def test_modify_state(before: str, value: int, after: str | None) -> None:
    box = AblBox(1)
    with line_to(box) as (bus, client):
        bus.call(lambda: box.outlet.go(before))
        answer = client.ask(write(0x05, value))
        assert (answer == FAILED) is (after is None)
        assert box.state == (after or before)


def test_e0_hides_the_cable() -> None:
    car = Car()
    box = AblBox(1, car=car)
    with line_to(box) as (bus, client):
        car.plug_in()
        bus.advance(10)
        client.ask(write(0x05, 0xE0E0))
        bus.advance(1)
        answer = client.ask(READ_FULL)
        assert state(answer) == b"E0"
        assert not int(answer[11:15], 16) & 0x8000
        assert car.current == 0


def test_a_new_device_id_takes_effect_after_the_reset() -> None:
    box = AblBox(1, boot_time=0.05)
    with line_to(box) as (bus, client):
        assert client.ask(write(0x2C, 0xF005)) == FAILED
        client.ask(write(0x05, 0xE2E2))
        for wrong in (0xF000, 0xF011, 0xF105):
            assert client.ask(write(0x2C, wrong)) == FAILED
        client.ask(write(0x2C, 0xA005))
        assert client.ask(READ_FULL).startswith(b">01")
        assert client.ask(write(0x05, 0x5A5A)) == line(
            ">", bytes.fromhex("011000050001")
        )
        bus.wait_for(lambda: box.resets)
        client.write(read(0x01, 2, box=5))
        assert client.read(1, 0.03) == b""
        bus.wait_for(lambda: bus.time() > box._deaf_until)
        answer = client.ask(read(0x01, 2, box=5))
        assert answer.startswith(b">05030401")
        assert int(answer[13:15], 16) & 0x40, "upstream time-out switched on"
        assert box.outlet.b2_needs_enable_after_power
        assert client.ask(READ_FULL, timeout=SILENT) == b""


def set_up(client: PortClient, value: int = 0xF005) -> bytes:
    """Go to E2 and write a device-ID; return the reply to that."""
    client.ask(write(0x05, 0xE2E2))
    return client.ask(write(0x2C, value))


def test_a_device_id_may_count_from_its_write_on() -> None:
    box = AblBox(1, boot_time=0.01)
    box.id_applies = "write"
    with line_to(box) as (bus, client):
        assert set_up(client).startswith(b">0110002C")
        assert client.ask(READ_FULL, timeout=SILENT) == b""
        assert state(client.ask(read(0x2E, 5, box=5))) == b"E2"
        box.id_confirmed_from = "new"
        assert client.ask(write(0x2C, 0xF006, box=5)).startswith(b">0610002C")
        # Not stored before the reset: whether it outlives the power is not known.
        box.id_kept_without_power = False
        box.power_cycle()
        assert box.device_id == 1
        bus.wait_for(lambda: bus.time() > box._deaf_until)
        set_up(client)
        box.id_kept_without_power = True
        box.power_cycle()
        assert box.device_id == 5


def test_a_device_id_before_the_reset_and_the_power() -> None:
    for kept, device_id in ((True, 5), (False, 1)):
        box = AblBox(1)
        box.id_kept_without_power = kept
        with line_to(box) as (_, client):
            set_up(client)
            box.power_cycle()
            assert (box.device_id, box.state) == (device_id, "A1")


def test_a_write_of_a_device_id_outside_e2_may_be_ignored() -> None:
    box = AblBox(1)
    box.outside_e2 = "ignored"
    with line_to(box) as (_, client):
        assert client.ask(write(0x2C, 0xF005), timeout=SILENT) == b""
        assert box.refused == 1


def test_the_reply_to_a_reset() -> None:
    reset = write(0x05, 0x5A5A)
    box = AblBox(1, boot_time=0.2)
    with line_to(box) as (bus, client):
        box.reset_answer = "never"
        assert client.ask(reset, timeout=0.3) == b""
        assert box.resets == 1
        set_up(client)
        box.reset_answer = "after"
        # It has its new ID by then.
        assert client.ask(reset, timeout=0.3).startswith(b">05100005")
        assert bus.time() > box._deaf_until


def test_reads_in_e2_may_stay_unanswered() -> None:
    box = AblBox(1)
    box.reads_in_e2 = False
    with line_to(box) as (_, client):
        client.ask(write(0x05, 0xE2E2))
        assert client.ask(READ_FULL, timeout=SILENT) == b""
        assert client.ask(write(0x05, 0xA1A1)).startswith(b">01100005")
        assert state(client.ask(READ_FULL)) == b"A1"


def test_a_box_that_is_switched_off() -> None:
    twins = [AblBox(1, serial=f"2W22xy0000000{n}", boot_time=0.01) for n in (1, 2)]
    serial = read(0x50, 8)
    with line_to(*twins) as (bus, client):
        client.ask(SET_10_A)
        assert [round(box.ic_amps) for box in twins] == [10, 10]
        assert bus.wire.collisions
        replies: list[str] = []
        control = Control(bus, replies.append)
        control.do("off 2W22xy00000002")
        assert twins[0].serial.encode().hex().upper().encode() in client.ask(serial)
        control.do("on 2W22xy00000002")
        assert replies == ["ok", "ok"]
        bus.wait_for(lambda: bus.time() > twins[1]._deaf_until)
        # It has forgotten its limit.
        assert [round(box.ic_amps) for box in twins] == [10, 16]


def test_a_write_notes_whether_a_car_is_plugged_in() -> None:
    car = Car()
    box = AblBox(1, car=car)
    with line_to(box) as (_, client):
        client.ask(write(0x05, 0xE0E0))
        car.plug_in()
        client.ask(write(0x05, 0xE2E2))
        assert [(one.value, one.plugged) for one in box.writes] == [
            (0xE0E0, False),
            (0xE2E2, True),
        ]
        # The bit of the pilot is not valid there.
        assert not int(client.ask(READ_FULL)[11:15], 16) & 0x8000


def test_icmax_is_lost_with_the_power() -> None:
    box = AblBox(1, boot_time=0.01)
    with line_to(box) as (bus, client):
        client.ask(SET_10_A)
        box.power_cycle()
        bus.wait_for(lambda: bus.time() > box._deaf_until)
        assert duty(client.ask(READ_FULL)) == 266


def test_upstream_timeout_and_recovery() -> None:
    car = Car()
    box = AblBox(1, car=car, upstream_enabled=True, upstream_timeout=20)
    with line_to(box) as (bus, client):
        car.plug_in()
        bus.advance(10)
        client.ask(READ_FULL)
        assert box.state == "C2"
        bus.advance(21)
        assert box.state == "F4"
        assert car.current == 0
        assert client.ask(read(0x06, 2))[9:13] == b"F480"
        bus.advance(2)
        client.ask(READ_FULL)
        bus.advance(1)
        assert box.state == "C2"


def test_upstream_timeout_f14_only_reduces() -> None:
    car = Car()
    box = AblBox(1, car=car, upstream_enabled=True, upstream_timeout=20)
    box.outlet.timeout_triggers_f4 = False
    with line_to(box) as (bus, client):
        car.plug_in()
        bus.advance(10)
        client.ask(READ_FULL)
        bus.advance(21)
        bus.advance(5)
        assert box.state == "C3"
        assert box.ic_amps == pytest.approx(9.96)
        assert car.current == pytest.approx(9.96)
        client.ask(READ_FULL)
        bus.wait_for(lambda: box.state == "C2")


@pytest.mark.parametrize("wakes_on", ["any", "own"])
def test_the_first_request_after_a_sleep_is_lost(wakes_on: str) -> None:
    box = AblBox(1, sleep_after=30, wake_time=0.05, wakes_on=wakes_on)  # type: ignore[arg-type]
    with line_to(box) as (bus, client):
        assert client.ask(READ_FULL, timeout=0.1) == b""
        assert client.ask(READ_FULL) != b""
        bus.advance(29)
        assert client.ask(READ_FULL) != b""
        bus.advance(31)
        assert box.asleep
        assert client.ask(READ_FULL, timeout=0.1) == b""
        assert client.ask(READ_FULL) != b""
        assert box.lost_asleep == 2


def test_other_traffic_keeps_awake_only_if_configured() -> None:
    lazy = AblBox(2, sleep_after=30, wakes_on="own", wake_time=0.01)
    light = AblBox(3, sleep_after=30, wakes_on="any", wake_time=0.01)
    with line_to(AblBox(1), lazy, light) as (_, client):
        client.ask(READ_FULL)
        assert lazy.asleep
        assert not light.asleep


@pytest.mark.parametrize(
    ("flag", "state_name", "bit"),
    [("imbalance", "C4", 8), ("hot", "C3", 7), ("meter_failed", "C3", 6)],
)
def test_errors_that_reduce(flag: str, state_name: str, bit: int) -> None:
    car = Car()
    box = AblBox(1, car=car)
    with line_to(box) as (bus, client):
        car.plug_in()
        bus.advance(10)
        setattr(box.outlet, flag, True)
        bus.advance(10)
        assert box.state == state_name
        answer = client.ask(READ_FULL)
        assert int(answer[11:15], 16) & 0x4000
        assert duty(answer) == 166
        if flag == "meter_failed":
            assert answer[15:27] == b"03E8" * 3
        assert int(client.ask(read(0x06, 2))[11:15], 16) >> bit & 1


def test_overcurrent_ends_in_f9() -> None:
    car = Car(greedy=1.15, max_current=32)
    box = AblBox(1, car=car)
    with line_to(box) as (bus, client):
        car.plug_in()
        bus.advance(10)
        bus.advance(1)
        assert int(client.ask(read(0x06, 2))[11:15], 16) & 7 == 0b011
        bus.advance(101)
        assert box.state == "F9"


def test_two_boxes_with_one_id_collide() -> None:
    boxes = AblBox(1), AblBox(1, serial="2W22xy07654321")
    with line_to(*boxes) as (bus, client):
        client.write(READ_FULL)
        bus.wait_for(lambda: bus.wire.collisions)
        answer = client.read_line(timeout=SILENT)
        assert line(">", bytes.fromhex("01030A2EA1110A03E803E803E8")) != answer
        assert boxes[1].name == "abl-1#2"


def test_defects() -> None:
    car = Car(phases=1, first_phase=1)
    box = AblBox(1, car=car)
    with line_to(box) as (bus, client):
        box.outlet.ignore_limit = True
        assert client.ask(SET_10_A) == SET_OK
        assert duty(client.ask(READ_FULL)) == 266
        box.answer_register = 0x33
        assert client.ask(READ_FULL).startswith(b">01030A33A1")
        box.answer_register = None
        car.plug_in()
        bus.advance(10)
        assert client.ask(READ_FULL)[15:27] == b"0000" * 2 + b"00A0"
        box.l3_first = False
        assert client.ask(READ_FULL)[15:27] == b"00A0" + b"0000" * 2
        box.stop_locally()
        assert state(client.ask(READ_FULL)) == b"E0"
        box.start_locally()
        box.set_by_other_master(8)
        assert duty(client.ask(READ_FULL)) == 133


def test_extra_registers() -> None:
    box = AblBox(1, extra_registers=True)
    with line_to(box) as (_, client):
        assert client.ask(read(0x04, 1)) == b">01030204A155\r\n"


def test_a_box_that_does_not_report_icmax() -> None:
    with line_to(AblBox(1, tells_icmax=False)) as (_, client):
        assert client.ask(READ_ICMAX, timeout=SILENT) == b""


def box_of(default: int, **settings: object) -> AblBox:
    """Return a box that reports this Idefault."""
    box = AblBox(1, **settings)  # type: ignore[arg-type]
    box.outlet.default_duty = default
    box.outlet.icmax = box.outlet.icmax_shown = default
    return box


def test_a_paused_box_of_32_a_in_a1() -> None:
    # T1, 09:29 [trace]: both frames in one minute.
    box = box_of(0x215)
    with line_to(box) as (_, client):
        client.ask(write(0x14, 0x3E8))
        assert client.ask(READ_ICMAX) == b">01030A0F3F0215021503E8021574\r\n"
        assert client.ask(READ_FULL) == b">01030A2EA1121503E803E803E83B\r\n"


def test_a_paused_box_of_16_a_in_b2() -> None:
    # T2, 17:32 [trace]: the pause was written twice.
    car = Car()
    box = box_of(0x10B, car=car)
    box.unreadable_in_b2 = True
    with line_to(box) as (bus, client):
        car.plug_in()
        for _ in range(2):
            assert client.ask(b":0110001400010203E8ED\r\n") == SET_OK
        bus.advance(10)
        assert client.ask(READ_FULL) == b">01030A2EB2910B03E803E803E8B5\r\n"


@pytest.mark.parametrize(
    ("default", "written", "zero", "answer"),
    [
        # K [dump], and w4 = 0 on the same box.
        (0x10B, 0xE9, False, b">01030A0F3F010B010B00E900E9BA\r\n"),
        (0x10B, 0xE9, True, b">01030A0F3F010B010B00E90000A3\r\n"),
        (0x85, None, False, b">01030A0F3F010B00850085008509\r\n"),
        (0x85, 0x64, False, b">01030A0F3F010B0085006400644B\r\n"),
    ],
)
def test_icmax_of_real_boxes(
    default: int,
    written: int | None,
    zero: bool,  # noqa: FBT001
    answer: bytes,
) -> None:
    box = box_of(default)
    box.outlet.rated_duty = 0x10B
    box.outlet.offered_reads_zero = zero
    with line_to(box) as (_, client):
        if written is not None:
            client.ask(write(0x14, written))
        assert client.ask(READ_ICMAX) == answer


@pytest.mark.parametrize(
    ("default", "written", "answer"),
    [
        (0x10B, None, b">01030A2EA1110B03E803E803E846\r\n"),  # T3 [trace]
        (0x85, None, b">01030A2EA1108503E803E803E8CD\r\n"),  # K [dump]
        (0x10B, 0x64, b">01030A2EA1106403E803E803E8EE\r\n"),  # K [dump]
    ],
)
def test_a_limit_shows_in_a1(default: int, written: int | None, answer: bytes) -> None:
    box = box_of(default)
    with line_to(box) as (_, client):
        if written is not None:
            client.ask(write(0x14, written))
        assert client.ask(READ_FULL) == answer


def test_charging_with_and_without_a_meter() -> None:
    car = Car(max_current=15.1, phases=1)
    box = box_of(0x10B, car=car)
    box.outlet.idle_floor = 1
    with line_to(box) as (bus, client):
        client.ask(write(0x14, 0x10A))
        car.plug_in()
        bus.advance(30)
        # T4 [trace]: the load stands in the third word.
        assert client.ask(READ_FULL) == b">01030A2EC2910A000100010097CE\r\n"
        box.outlet.meter = False
        client.ask(write(0x14, 0x10B))
        # K [dump].
        assert client.ask(READ_FULL) == b">01030A2EC2910B03E803E803E8A5\r\n"


def test_a_limit_is_kept_in_e0() -> None:
    box = box_of(0x10B)
    box.outlet.meter = False
    with line_to(box) as (_, client):
        client.ask(write(0x14, 0x64))
        assert client.ask(b":01100005000102E0E027\r\n") == b">011000050001E9\r\n"
        assert client.ask(READ_FULL) == b">01030A2EE0106403E803E803E8AF\r\n"


def test_time_to_take_effect() -> None:
    box = box_of(0x10B)
    box.outlet.icmax_delay, box.outlet.ic_delay = 2.0, 4.0
    with line_to(box) as (bus, client):
        assert client.ask(SET_10_A) == SET_OK
        assert icmax(client.ask(READ_ICMAX)) == duty(client.ask(READ_FULL)) == 0x10B
        bus.advance(3)
        assert icmax(client.ask(READ_ICMAX)) == 0xA6
        assert duty(client.ask(READ_FULL)) == 0x10B
        bus.advance(2)
        assert duty(client.ask(READ_FULL)) == 0xA6


@pytest.mark.parametrize(
    ("behaviour", "answer", "shown"),
    [
        ("clipped", SET_OK, 0x10B),
        ("unchanged", SET_OK, 0xA6),
        ("stored", SET_OK, 0x215),
        ("refused", FAILED, 0xA6),
    ],
)
def test_a_code_above_idefault(behaviour: str, answer: bytes, shown: int) -> None:
    # 32 A to a box of 16 A is answered, the current stays [trace]; all else is unknown.
    box = box_of(0x10B)
    box.outlet.above_default = behaviour  # type: ignore[assignment]
    with line_to(box) as (_, client):
        client.ask(SET_10_A)
        assert client.ask(b":011000140001020215C1\r\n") == answer
        assert icmax(client.ask(READ_ICMAX)) == shown
        assert duty(client.ask(READ_FULL)) <= 0x10B


def test_codes_that_give_a_pilot_of_5_percent() -> None:
    box = AblBox(1)
    box.outlet.low_codes_taken = True
    with line_to(box) as (_, client):
        assert client.ask(write(0x14, 49)) == FAILED
        assert client.ask(write(0x14, 50)) == SET_OK
        assert box.outlet.five_percent == 1
        assert box.ic_amps == 0
        # 80 to 99 are taken as 100.
        assert client.ask(write(0x14, 80)) == SET_OK
        assert icmax(client.ask(READ_ICMAX)) == 100


def test_several_requests_lost_asleep_and_stray_bytes_after_it() -> None:
    box = AblBox(1, sleep_after=20, wake_time=0.01)
    box.lost_asleep_each = 3
    box.stray = b"\xff\x00"
    with line_to(box) as (bus, client):
        for _ in range(2):
            for _ in range(3):
                assert client.ask(READ_FULL, timeout=0.05) == b""
            assert client.ask(READ_FULL).endswith(b"\r\n")
            bus.advance(21)


def test_the_log_is_an_oracle() -> None:
    with line_to(AblBox(1)) as (bus, client):
        client.ask(SET_10_A)
        client.write(write(0x14, 500, box=9))
        client.read(1, SILENT)
        seen = requests_in(bus.log.bursts())
    assert [(r.device_id, r.register, r.value) for r in seen] == [
        (1, 0x14, 166),
        (9, 0x14, 500),
    ]
