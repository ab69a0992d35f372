"""The virtual ChargePoint against bytes of the manual and of a real box."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.simulated_client import PortClient, living

from .bus import VirtualBus
from .car import Car
from .evbox import EvboxChargePoint, Module
from .evbox_frames import checksums, frame, orders_in, requests_without_silence

MANUAL_69 = b"\x0280A06900E6008C0154003C002800500046F703\x03"
LIMITS = "00E6008C0154003C002800500046"
INFORMATION = "00112233445566778899AABBCCDDEEFF"
SILENT = 0.15


@contextmanager
def line_to(*points: EvboxChargePoint) -> Iterator[tuple[VirtualBus, PortClient]]:
    with living(VirtualBus.in_loop(*points)) as bus:
        yield bus, PortClient(bus)


def polite(bus: VirtualBus) -> None:
    """Wait for the silence that the protocol requires."""
    bus.wait_for(lambda: not bus.wire.busy(bus.time()))
    end = bus.wire.idle_from + 0.101
    bus.wait_for(lambda: bus.time() >= end)


def command(number: int, limits: str = LIMITS, serial: str = "01923054") -> bytes:
    addressed = serial + INFORMATION if number == 68 else ""
    return frame(f"80A0{number}{addressed}{limits}")


def ask(client: PortClient, data: bytes) -> str:
    answer = client.ask(data, b"\x03")
    assert answer[:1] == b"\x02"
    text = answer[1:-1].decode()
    assert checksums(text[:-4]) == text[-4:]
    return text[:-4]


def two_modules() -> list[Module]:
    """Return the modules of the manual's example."""
    return [
        Module(
            min_current=12,
            currents=(14, 14, 14),
            cos_phis=(0.540, 0.320, 0.900),
            energy_wh=85021,
            voltages=(230, 229, 231),
        ),
        Module(
            min_current=8,
            currents=(0, 0, 16),
            cos_phis=(0.133, -0.065, -0.206),
            energy_wh=754236,
            voltages=(227, 228, 226),
        ),
    ]


def test_checksums_of_known_frames() -> None:
    assert checksums("80A069" + LIMITS) == "F703"
    field = "A080690001015E02007800000000000003E803E803E80000002800"
    field += "7800000000000003E803E803E80000001E"
    assert checksums(field) == "C47A"
    text = f"80A06801923054{INFORMATION}" + LIMITS
    assert checksums(text) == "D20A"
    assert checksums(text.replace("0154003C", "0140003C")) == "CD0F"


def test_command_69_of_the_manual() -> None:
    point = EvboxChargePoint(1923054, two_modules(), min_interval=20)
    with line_to(point) as (_, client):
        answer = ask(client, MANUAL_69)
        # The reply in the manual, with FF32 for -0.206 as in its text.
        expected = "A080690014015E020078008C008C008C021C0140038400014C1D"
        expected += "0050" + "0000000000A0" + "0085FFBFFF32" + "000B823C"
        assert answer == expected
        assert point.limits_in_force == (23.0, 14.0, 34.0)
        order = point.orders[0]
        assert order.timeout == 60
        assert order.fallback == (4.0, 8.0, 7.0)


def test_command_68_of_the_manual() -> None:
    point = EvboxChargePoint(1923054, two_modules(), min_interval=20)
    with line_to(point) as (_, client):
        answer = ask(client, command(68))
        expected = "A080680192305400" + "14015E020078008C008C008C021C01400384"
        expected += "00014C1D00E600E500E7" + "00500000000000A0" + "0085FFBFFF32"
        expected += "000B823C00E300E400E2"
        assert answer == expected
        assert point.orders[0].information == bytes.fromhex(INFORMATION)
        assert point.orders[0].serial == "01923054"


def test_reply_of_a_real_box() -> None:
    modules = [Module(min_current=12, energy_wh=wh) for wh in (40, 30)]
    with line_to(EvboxChargePoint(1, modules)) as (_, client):
        answer = client.ask(MANUAL_69, b"\x03")
    assert answer == (
        b"\x02A080690001015E02007800000000000003E803E803E800000028"
        b"007800000000000003E803E803E80000001EC47A\x03"
    )


def test_ignored() -> None:
    requests = [
        MANUAL_69.replace(b"F703", b"F704"),
        MANUAL_69.replace(b"F703", b"F603"),
        MANUAL_69.lower(),
        frame("80A069" + LIMITS + "00"),
        frame("80A069" + LIMITS[:-2]),
        frame("80A067" + LIMITS),
        frame("A08069" + LIMITS),
        frame("81A069" + LIMITS),
        command(68, serial="01923055"),
        MANUAL_69[:-1],
    ]
    point = EvboxChargePoint(1923054)
    with line_to(point) as (bus, client):
        for number, request in enumerate(requests, 1):
            client.write(request)
            bus.wait_for(lambda count=number: len(bus.log) == count)
            assert point.orders == [], request
        assert client.read(1, SILENT) == b""
        assert point.limits_in_force == (35.0, 35.0, 35.0)
        assert ask(client, MANUAL_69)


def test_stx_restarts_a_frame() -> None:
    with line_to(EvboxChargePoint()) as (_, client):
        assert ask(client, MANUAL_69[:15] + MANUAL_69).startswith("A08069")


def test_serial_zero_and_69_address_any_box() -> None:
    point = EvboxChargePoint(7, min_interval=0)
    with line_to(point) as (bus, client):
        assert ask(client, command(68, serial="00000000")).startswith("A0806800000007")
        polite(bus)
        assert ask(client, command(69)).startswith("A08069")


def test_commands_can_be_missing() -> None:
    with line_to(EvboxChargePoint(commands={69})) as (bus, client):
        client.write(command(68))
        assert client.read(1, SILENT) == b""
        polite(bus)
        assert ask(client, command(69))


def test_several_boxes_reply_to_serial_zero_at_once() -> None:
    points = [EvboxChargePoint(serial, min_interval=0) for serial in (1, 2)]
    with line_to(*points) as (bus, client):
        client.write(command(68, serial="00000000"))
        bus.wait_for(lambda: len(bus.log) == 3)
        assert bus.wire.collisions == 2
        assert client.read(78) not in [entry.data for entry in bus.log]
        client.read(100, 0.11)
        assert ask(client, command(68, serial="00000002"))
        assert [len(p.orders) for p in points] == [1, 2]


def test_the_reply_waits_for_silence() -> None:
    with line_to(EvboxChargePoint()) as (bus, client):
        client.write(MANUAL_69)
        # Another station sends while it waits.
        bus.inject(b"\x02BC800000\x03", after=0.08, source="other")
        client.read_line(b"\x03")
        client.read_line(b"\x03")
        request, other, reply = bus.log.entries
        assert request.source == "client"
        assert other.t - request.end == pytest.approx(0.07, abs=0.02)
        assert reply.t - other.end >= 0.1


def test_minimum_interval_is_enforced() -> None:
    point = EvboxChargePoint(min_interval=1)
    with line_to(point) as (bus, client):
        ask(client, MANUAL_69)
        polite(bus)
        client.write(command(69, "000000000000003C000000000000"))
        assert client.read(1, SILENT) == b""
        assert point.counters.too_soon == 1
        assert point.limits_in_force == (23.0, 14.0, 34.0)
        assert point.silence_violations == 0


def test_missing_silence_is_counted() -> None:
    point = EvboxChargePoint(min_interval=0)
    with line_to(point) as (bus, client):
        ask(client, MANUAL_69)
        ask(client, MANUAL_69)
        assert point.silence_violations == 1
        polite(bus)
        ask(client, MANUAL_69)
        assert point.silence_violations == 1
        assert len(requests_without_silence(bus.log)) == 1


def test_fail_back() -> None:
    point = EvboxChargePoint(max_current=7)
    with line_to(point) as (bus, client):
        assert point.limits_in_force == (7.0, 7.0, 7.0)
        ask(client, MANUAL_69)
        assert point.limits_in_force == (7.0, 7.0, 7.0)
        assert point.over_limit_requests == 1
        bus.advance(58)
        assert not point.failed_back
        bus.advance(3)
        assert point.failed_back
        assert point.limits_in_force == (4.0, 7.0, 7.0)
        bus.wait_for(lambda: bus.time() - bus.log.entries[0].end > 1)
        ask(client, MANUAL_69)
        assert not point.failed_back


def test_timeout_zero_fails_back_at_once() -> None:
    point = EvboxChargePoint()
    with line_to(point) as (_, client):
        ask(client, command(69, "00E6008C01540000002800500046"))
        assert point.counters.zero_timeouts == 1
        assert point.limits_in_force == (4.0, 8.0, 7.0)


def test_modules_share_the_limit() -> None:
    cars = [Car(max_current=32), Car(max_current=32), Car(phases=1, max_current=32)]
    point = EvboxChargePoint(1, [Module(car) for car in cars], min_interval=0)
    with line_to(point) as (bus, client):
        for car in cars:
            car.plug_in()
        ask(client, command(69, "00F000F000F0" + "003C" + "000000000000"))
        bus.advance(10)
        assert [m.offered for m in point.modules] == [8, 8, 8]
        assert cars[0].phase_currents == (8, 8, 8)
        assert cars[2].phase_currents == (8, 0, 0)
        polite(bus)
        # 14 A for three: one gets 0 A, none less than its minimum.
        ask(client, command(69, "008C008C008C" + "003C" + "000000000000"))
        bus.advance(10)
        assert [m.offered for m in point.modules] == [7, 7, 0]
        assert cars[2].current == 0
        polite(bus)
        answer = ask(client, command(69, "0000" * 3 + "003C" + "000000000000"))
        assert answer[15 + 1 :].startswith("003C004600460046")
        bus.advance(10)
        assert [car.current for car in cars] == [0, 0, 0]


@pytest.mark.parametrize("count", [0, 20])
def test_number_of_modules(count: int) -> None:
    point = EvboxChargePoint(1, count)
    with line_to(point) as (_, client):
        answer = ask(client, command(68, serial="00000001"))
        assert answer[22:24] == f"{count:02X}"
        assert len(answer) == 24 + count * 48


def test_modules_come_and_go() -> None:
    point = EvboxChargePoint(1, two_modules(), min_interval=0)
    with line_to(point) as (bus, client):
        point.remove_module(0)
        assert ask(client, command(69))[14:20] == "010050"
        polite(bus)
        point.add_module(Module(energy_wh=5), index=0)
        assert ask(client, command(69))[14:20] == "02003C"
        for _ in range(18):
            point.add_module()
        with pytest.raises(ValueError, match="at most 20"):
            point.add_module()


def test_distorted_values_end() -> None:
    point = EvboxChargePoint(1, two_modules(), min_interval=0)
    with line_to(point) as (bus, client):
        honest = ask(client, command(69))
        point.distort(1, current=400, cos_phi=5, energy_jump=-100_000)
        polite(bus)
        reported = ask(client, command(69))[52:]
        assert reported == "0050" + "0FA0" * 3 + "1388" * 3 + f"{654236:08X}"
        polite(bus)
        assert ask(client, command(69)) == honest
        point.distort(0, times=None, voltage=0)
        for _ in range(2):
            polite(bus)
            assert ask(client, command(68, serial="00000000"))[60:72] == "0000" * 3
        point.undistort()
        polite(bus)
        assert ask(client, command(69)) == honest


def test_another_box_in_its_place() -> None:
    point = EvboxChargePoint(1923054, min_interval=0)
    with line_to(point) as (bus, client):
        ask(client, command(68))
        point.serial = "02000001"
        polite(bus)
        client.write(command(68))
        assert client.read(1, SILENT) == b""
        polite(bus)
        assert ask(client, command(68, serial="02000001"))


def test_meter_counts_what_the_car_draws() -> None:
    car = Car(max_current=10, ramp=0, reaction=0, cos_phi=1)
    module = Module(car, energy_wh=1000)
    with line_to(EvboxChargePoint(1, [module])) as (bus, _):
        car.plug_in()
        bus.advance(360)
        assert module.energy_wh == pytest.approx(1000 + 3 * 230 * 10 / 10, rel=0.01)


def test_the_log_is_an_oracle() -> None:
    with line_to(EvboxChargePoint(5)) as (bus, client):
        client.write(command(68, serial="00000099"))
        bus.wait_for(lambda: len(bus.log))
        (seen,) = orders_in(bus.log.bursts())
    assert seen.serial == "00000099"
    assert seen.limits == (23.0, 14.0, 34.0)
