"""Each kind of trouble is shown by a command, or by an argument of the script."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import socket

import pytest

from tests.simulated_client import PortClient, living, wait

from .abl import AblBox
from .arguments import parser
from .bus import VirtualBus
from .car import Car
from .cli import main
from .commands import ABL, ALL, BUS, CARS, EVBOX, EWS, SMARTEVSE
from .control import Control
from .device import Device
from .evbox import EvboxChargePoint
from .evbox_frames import checksums
from .ews_box import EwsBox
from .ews_frames import command
from .smartevse import SmartEvse
from .strangers import KINDS, Strangers

READ_FULL = b":0103002E0005C9\r\n"
READ_ICMAX = b":0103000F0005E8\r\n"
ORDER = b"\x0280A06900E6008C0154003C002800500046F703\x03"
STATUS = bytes.fromhex("000400a0000931ff")
Do = Callable[[str], str]


class Desk:
    """A bus, its one charger, a client, and the commands."""

    def __init__(self, bus: VirtualBus, device: Device) -> None:
        self.bus = bus
        self.device = device
        self.client = PortClient(bus)
        self.replies: list[str] = []
        self._control = Control(bus, self.replies.append)

    def do(self, *lines: str) -> None:
        for line in lines:
            self._control.do(line)
            assert self.replies[-1] == "ok", line
        wait(self.bus, 0.5)

    def error(self, line: str) -> str:
        self._control.do(line)
        assert self.replies[-1].startswith(f"error {line}: ")
        return self.replies[-1]


def desk(device: Device) -> Iterator[Desk]:
    with living(VirtualBus.in_loop(device)) as bus:
        yield Desk(bus, device)


@pytest.fixture
def abl() -> Iterator[Desk]:
    yield from desk(AblBox(1, car=Car(ramp=0)))


@pytest.fixture
def evbox() -> Iterator[Desk]:
    yield from desk(EvboxChargePoint(7, 2))


@pytest.fixture
def smartevse() -> Iterator[Desk]:
    yield from desk(SmartEvse(car=Car()))


@pytest.fixture
def ews() -> Iterator[Desk]:
    yield from desk(EwsBox(serial="000000000042", cars=(Car(), Car())))


# -- ABL ---------------------------------------------------------------------------


def test_a_pause_of_another_master_shows_in_0x0f_only(abl: Desk) -> None:
    abl.do("plug 1", "others 1 0")
    assert abl.client.ask(READ_FULL)[9:15] == b"B2910A"
    assert abl.client.ask(READ_ICMAX)[19:23] == b"03E8"


def test_a_box_stops_answering_0x0f(abl: Desk) -> None:
    abl.do("icmax 1 off")
    assert abl.client.ask(READ_ICMAX, timeout=0.3) == b""
    abl.do("icmax 1 on")
    assert abl.client.ask(READ_ICMAX)


@pytest.mark.parametrize(
    ("line", "state"),
    [
        ("state 1 E0", b"E0"),
        ("state 1 A0", b"A0"),
        ("stop 1", b"E0"),
        ("fail 1 9", b"F9"),
    ],
)
def test_states(abl: Desk, line: str, state: bytes) -> None:
    abl.do(line)
    assert abl.client.ask(READ_FULL)[9:11] == state


def test_a_power_cycle_forgets_the_limit(abl: Desk) -> None:
    abl.do("others 1 6")
    assert abl.client.ask(READ_ICMAX)[19:23] == b"0064"
    abl.do("power-cycle 1")
    wait(abl.bus, 1)
    assert abl.client.ask(READ_ICMAX)[19:23] == b"010A"


def test_a_box_that_ignores_its_limit_and_a_greedy_car(abl: Desk) -> None:
    abl.do("plug 1", "ignore 1 on", "greedy 1 1.5", "slow 1 4")
    box = abl.device
    assert isinstance(box, AblBox)
    assert box.outlet.ignore_limit
    assert box.outlet.car is not None
    assert (box.outlet.car.greedy, box.outlet.car.reaction) == (1.5, 4.0)


def test_faults_of_one_reply(abl: Desk) -> None:
    good = abl.client.ask(READ_FULL)
    abl.do("lose 1", "duplicate 1", "truncate 1 4", "replace 1 414243", "noise 1 00")
    assert abl.client.ask(READ_FULL, timeout=0.2) == b""
    abl.client.write(READ_FULL)
    assert abl.client.read(len(good) * 2) == good * 2
    abl.client.write(READ_FULL)
    assert abl.client.read(31, 0.1) == good[:4]
    abl.client.write(READ_FULL)
    assert abl.client.read(31, 0.1) == b"ABC"
    assert abl.client.ask(READ_FULL) == b"\x00" + good


def test_a_box_that_replies_later_than_others(abl: Desk) -> None:
    good = abl.client.ask(READ_FULL)
    abl.do("turn-round 1 0.4")
    for _ in range(2):
        assert abl.client.ask(READ_FULL, timeout=0.3) == b""
        assert abl.client.read(len(good)) == good


def test_two_boxes_with_one_id_by_serial_number(abl: Desk) -> None:
    box = abl.device
    assert isinstance(box, AblBox)
    abl.do(f"off {box.serial}")
    assert abl.client.ask(READ_FULL, timeout=0.2) == b""
    abl.do(f"on {box.serial}", "serial 1 2W22xy99999999")
    assert box.serial == "2W22xy99999999"


# -- EVBox -------------------------------------------------------------------------


def modules(reply: bytes) -> int:
    return int(reply[15:17], 16)


def module(reply: bytes, number: int) -> bytes:
    return reply[17 + 36 * (number - 1) : 17 + 36 * number]


def ask(evbox: Desk) -> bytes:
    wait(evbox.bus, 1.2)
    return evbox.client.ask(ORDER, b"\x03")


def test_no_modules(evbox: Desk) -> None:
    evbox.do("remove-module 7.2", "remove-module 7.1")
    assert modules(ask(evbox)) == 0
    evbox.do("add-module 7")
    assert modules(ask(evbox)) == 1


def test_an_over_current_with_good_checksums(evbox: Desk) -> None:
    evbox.do("distort 7.2 current 33.6 1")
    assert module(ask(evbox), 2)[4:8] == b"0150"
    assert module(ask(evbox), 2)[4:8] == b"0000"
    evbox.do("distort 7.2 voltage 400", "undistort 7")


def test_a_meter_that_reads_0_for_a_while(evbox: Desk) -> None:
    evbox.do("meter 7.1 5000", "meter-reads 7.1 0 3")
    totals = [int(module(ask(evbox), 1)[28:36], 16) for _ in range(4)]
    assert totals == [0, 0, 0, 5000]


def test_a_point_that_ignores_its_limit(evbox: Desk) -> None:
    ask(evbox)
    point = evbox.device
    assert isinstance(point, EvboxChargePoint)
    assert max(point.limits_in_force) < 35
    evbox.do("ignore 7 on")
    assert point.limits_in_force == (35.0,) * 3
    evbox.do("maximum 7 20", "interval 7 20")
    assert point.limits_in_force == (20.0,) * 3
    assert point.min_interval == 20


# -- SmartEVSE ---------------------------------------------------------------------


def test_button_and_stops_of_a_smartevse(smartevse: Desk) -> None:
    box = smartevse.device
    assert isinstance(box, SmartEvse)
    smartevse.do("menu 0 switch 1", "press 0")
    assert not box.access
    smartevse.do("temperature 0 70", "rcd 0 on", "ignore 0 on", "ignore-access 0 on")
    assert (box.outlet.temperature, box.outlet.rcd_tripped) == (70, True)
    assert not box.controller.override_works
    assert box.controller.ignore_access


# -- EWS-Box -----------------------------------------------------------------------


def total(desk: Desk) -> int:
    desk.client.write(command("rc"))
    return int.from_bytes(desk.client.read(115)[29:33], "big")


def test_a_meter_of_an_ews_box(ews: Desk) -> None:
    ews.do("meter 42.1 5000", "meter-reads 42.1 0 2")
    assert [total(ews) for _ in range(3)] == [0, 0, 5000]


def test_twin_errors_fit_the_checksum(ews: Desk) -> None:
    ews.client.write(command("rc"))
    good = ews.client.read(115)
    ews.do("twin-error 42")
    ews.client.write(command("rc"))
    damaged = ews.client.read(115)
    different = [a ^ b for a, b in zip(good, damaged, strict=True) if a != b]
    assert len(different) == 2
    assert different[0] == different[1]


def test_twin_errors_of_an_abl_box_fit_its_lrc(abl: Desk) -> None:
    good = abl.client.ask(READ_FULL)
    for _ in range(20):
        abl.do("twin-error 1")
        damaged = abl.client.ask(READ_FULL)
        data = bytes.fromhex(damaged[1:-2].decode())
        assert sum(data) & 0xFF == 0
        assert damaged != good
        assert damaged[:7] == good[:7]


def test_twin_errors_of_a_chargepoint_fit_both_its_checksums(evbox: Desk) -> None:
    good = ask(evbox)
    for _ in range(20):
        evbox.do("twin-error 7")
        damaged = ask(evbox)
        text, sums = damaged[1:-5].decode(), damaged[-5:-1].decode()
        assert checksums(text) == sums
        different = [a ^ b for a, b in zip(good, damaged, strict=True) if a != b]
        assert len(different) == 2
        assert different[0] == different[1]


def test_clock_cable_and_limit_of_an_ews_box(ews: Desk) -> None:
    box = ews.device
    assert isinstance(box, EwsBox)
    ews.do("clock 42 1999-12-31T23:00:00", "cable 42.2 13", "ignore 42 on")
    assert box.clock().year == 1999
    assert box.ports[1].cable == 13
    assert box.ignores_limits


def test_only_a_box_that_dials_hangs_up(ews: Desk) -> None:
    assert "does not dial" in ews.error("vanish 42")


# -- The adapter -------------------------------------------------------------------


def test_adapters(abl: Desk) -> None:
    adapter = abl.bus.adapter
    abl.do("delay 0.1 0.2", "jitter 0.05", "idle-timeout 30", "gateway closes")
    assert (adapter.delay_out, adapter.delay_in, adapter.jitter) == (0.1, 0.2, 0.05)
    assert adapter.idle_timeout == 30
    assert adapter.gateway is not None
    assert "maybe is no kind of gateway" in abl.error("gateway maybe")
    abl.do("gateway mute")
    assert adapter.gateway.kind == "mute"
    abl.do("delay 0", "jitter 0", "idle-timeout 0", "gateway no")
    assert (adapter.delay_in, adapter.idle_timeout, adapter.gateway) == (0, None, None)
    assert abl.client.ask(READ_FULL)
    abl.do("hang-adapter on")
    assert abl.client.ask(READ_FULL, timeout=0.2) == b""
    abl.do("hang-adapter off", "stick-adapter")
    assert abl.client.ask(READ_FULL, timeout=0.2) == b""


def test_the_line(abl: Desk) -> None:
    abl.do("error-rate 0.5", "cut-cable on", "foreign 0102 0.1")
    assert abl.bus.faults.byte_error_rate == 0.5
    wait(abl.bus, 0.5)
    assert abl.bus.log.of("injected")
    abl.do("foreign no", "error-rate 0", "cut-cable off")
    abl.client.read_some(0.3)
    assert abl.client.ask(READ_FULL)


def test_what_is_no_command_is_an_error(abl: Desk) -> None:
    assert "no such command; there are: advance" in abl.error("press 1")
    assert "no charger 2" in abl.error("dead 2")
    abl.error("hang-adapter maybe")
    abl.error("delay")
    abl.error("fail 1 x")


# -- The help ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("protocol", "own"),
    [("abl", ABL), ("evbox", EVBOX), ("smartevse", SMARTEVSE), ("ews", EWS)],
)
def test_help_has_all_commands_and_explains_all_arguments(
    protocol: str, own: dict[str, object], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main([protocol, "--help"])
    text = capsys.readouterr().out
    for name in (*own, *ALL, *CARS, *BUS):
        assert f"    {name}" in text
    assert max(map(len, text.splitlines())) <= 110
    kinds = parser()._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    for action in kinds[protocol]._actions:  # type: ignore[index]
        assert action.help, action.option_strings


def test_delays_are_one_number_or_two() -> None:
    read = parser().parse_args
    assert read(["abl", "--delay", "0.1"]).delay == [0.1]
    assert read(["abl", "--delay", "0.1", "0.2"]).delay == [0.1, 0.2]
    with pytest.raises(SystemExit):
        read(["abl", "--delay", "1", "2", "3"])


# -- Strangers ---------------------------------------------------------------------


@pytest.mark.real_time
@pytest.mark.slow
@pytest.mark.usefixtures("socket_enabled")
@pytest.mark.parametrize("kind", KINDS)
def test_strangers(kind: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(5)
        host, port = server.getsockname()
        with Strangers(host, port, count=3, kind=kind) as crowd:
            clients = [server.accept()[0] for _ in range(3)]
            clients[0].settimeout(5)
            if kind == "silent":
                clients[0].settimeout(0.2)
                with pytest.raises(TimeoutError):
                    clients[0].recv(1)
            else:
                assert clients[0].recv(1)
            clients[1].close()
            # A connection that ends is made anew.
            clients.append(server.accept()[0])
            assert crowd.wait_for(lambda: crowd.closed)
        for client in clients:
            client.close()


@pytest.mark.real_time
@pytest.mark.slow
@pytest.mark.usefixtures("socket_enabled")
def test_a_crowd_of_strangers() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=50) as server:
        server.settimeout(5)
        host, port = server.getsockname()
        with Strangers(host, port, count=2, rate=50.0) as crowd:
            for _ in range(10):
                server.accept()[0].close()
            assert crowd.wait_for(lambda: crowd.dialled >= 10)
