"""The command line of `scripts/virtual-chargers`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import signal
import sys
import threading
import time
from typing import TYPE_CHECKING

from . import ews_cli
from .abl import AblBox
from .bus import VirtualBus
from .car import Car, CarLife
from .control import HELP, Control, describe
from .evbox import EvboxChargePoint, Module
from .ews_box import EwsBox
from .smartevse import SmartEvse
from .smartevse_registers import DIALECTS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from .device import Device

STATUS_INTERVAL = 5.0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run until SIGTERM, SIGINT, or the end of --duration."""
    options = _parser().parse_args(arguments)
    make = {"abl": _abl, "evbox": _evbox, "smartevse": _smartevse, "ews": _ews}
    devices = make[options.protocol](options)
    for device in devices:
        if _number(device) in options.dead:
            device.faults.dead = True
    settings = {
        "baud": options.baud,
        "parity": options.parity,
        "time_scale": options.time_scale,
        "granularity": options.granularity,
        "seed": options.seed,
    }
    if options.protocol == "ews" and options.dial:
        bus = ews_cli.fleet(options, devices, settings)
    elif options.tcp is not None:
        bus = VirtualBus.tcp(*devices, port=options.tcp, **settings)
    else:
        bus = VirtualBus.pty(*devices, link=options.pty or None, **settings)
    bus.faults.byte_error_rate = options.error_rate
    bus.faults.lose_rate = options.lose_rate
    bus.faults.late_rate = options.late_rate
    bus.faults.late_by = options.late_by
    bus.faults.noise_rate = options.noise_rate
    bus.faults.echo = options.echo
    over = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: over.set())
    with bus:
        _print(f"ready {options.protocol} {bus.url}")
        if options.control:
            control = Control(bus, _print)
            threading.Thread(
                target=_read_commands, args=(control,), daemon=True
            ).start()
        _run(bus, options, over)
        if options.stats:
            text = json.dumps(bus.stats(), indent=2) + "\n"
            Path(options.stats).write_text(text, encoding="utf-8")
    return 0


def _run(bus: VirtualBus, options: argparse.Namespace, over: threading.Event) -> None:
    end = time.monotonic() + options.duration if options.duration else float("inf")
    while not over.is_set():
        left = end - time.monotonic()
        if left <= 0:
            return
        over.wait(min(left, STATUS_INTERVAL))
        if options.verbose and not over.is_set():
            _print(bus.call(lambda: describe(bus)))


def _read_commands(control: Control) -> None:
    for text in sys.stdin:
        control.do(text)


def _print(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _number(device: Device) -> int:
    if isinstance(device, AblBox):
        return device.device_id
    if isinstance(device, SmartEvse):
        return device.unit
    if isinstance(device, EvboxChargePoint | EwsBox):
        return int(device.serial)
    return 0


def _car(options: argparse.Namespace, index: int) -> Car:
    """Make the car of one connector; each has its own seed and parameters."""
    life = CarLife(
        seed=options.seed * 1000 + index,
        away=tuple(options.away),
        wants_wh=tuple(options.wants),
    )
    car = Car(
        max_current=(16.0, 32.0, 20.0)[index % 3],
        phases=(3, 3, 1)[index % 3],
        life=life if options.cars == "auto" else None,
    )
    if options.cars == "plugged":
        car.plug_in()
    return car


def _abl(options: argparse.Namespace) -> list[Device]:
    boxes: list[Device] = []
    for index, device_id in enumerate(options.ids):
        box = AblBox(
            device_id,
            car=_car(options, index),
            serial=f"2W22xy{1234567 + index:08d}",
            default_current=options.default_current,
            meter=not options.no_meter,
            upstream_enabled=options.upstream_timeout is not None,
            upstream_timeout=options.upstream_timeout or 30.0,
            sleep_after=options.sleep,
            extra_registers=options.extra_registers,
            tells_icmax=not options.no_icmax,
            turn_round=options.turn_round,
            boot_time=options.boot_time,
        )
        box.id_applies = "write" if options.id_at_once else "reset"
        box.reset_answer = options.reset_answer
        box.l3_first = not options.l1_first
        box.outlet.default_duty = options.default_duty
        box.outlet.idle_floor = options.idle_floor
        box.outlet.icmax_delay = box.outlet.ic_delay = options.effect_delay
        box.outlet.e0_after_pause = options.e0_after_pause
        box.lost_asleep_each = options.lost_asleep
        boxes.append(box)
    return boxes


def _evbox(options: argparse.Namespace) -> list[Device]:
    points: list[Device] = []
    numbers = options.modules
    for index, serial in enumerate(options.serials):
        count = numbers[min(index, len(numbers) - 1)]
        modules = [
            Module(
                car=_car(options, index * 20 + number),
                min_current=options.min_current,
                energy_wh=1000.0 * (index * 20 + number + 1),
            )
            for number in range(count)
        ]
        points.append(
            EvboxChargePoint(
                serial,
                modules,
                max_current=options.max_current,
                min_interval=options.min_interval,
                commands=set(options.commands),
            )
        )
    return points


def _smartevse(options: argparse.Namespace) -> list[Device]:
    boxes: list[Device] = []
    cables = options.cables
    for index, load_balance in enumerate(options.load_balance):
        boxes.append(
            SmartEvse(
                options.dialect,
                load_balance=load_balance,
                car=_car(options, index),
                config="fixed" if options.fixed_cable else "socket",
                cable=cables[min(index, len(cables) - 1)],
                max_current=options.max_current,
                min_current=options.min_current,
                mode=options.mode,
                serial=options.serial + index,
                unit=options.unit,
                override_works=not options.no_override,
                turn_round=options.turn_round,
            )
        )
    return boxes


def _ews(options: argparse.Namespace) -> list[Device]:
    return ews_cli.boxes(options, _car)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="virtual-chargers",
        description="Virtual chargers on a virtual RS-485 bus, at the line's real pace."
        " Prints `ready <protocol> <url>` when a client may open it.",
    )
    kinds = parser.add_subparsers(dest="protocol", required=True)
    abl = kinds.add_parser("abl", help="ABL EVCC2/3 boxes")
    _common(abl.add_argument)
    add = abl.add_argument
    add(
        "--ids",
        type=int,
        nargs="+",
        default=[1],
        help="device-IDs; an ID twice: two boxes",
    )
    add("--no-meter", action="store_true", help="no phase-current meter")
    add("--default-current", type=float, default=16.0, metavar="A")
    add("--sleep", type=float, metavar="S", help="sleep after S seconds of silence")
    add(
        "--upstream-timeout",
        type=float,
        metavar="S",
        help="F4 after S seconds without polling",
    )
    add(
        "--extra-registers",
        action="store_true",
        help="register 0x04 can be read too",
    )
    add("--no-icmax", action="store_true", help="register 0x0F is not answered")
    add(
        "--default-duty",
        type=lambda text: int(text, 0),
        metavar="CODE",
        help="Idefault as boxes report it: 0x10B on those of 16 A",
    )
    add("--idle-floor", type=int, default=0, metavar="N", help="0.1 A on idle phases")
    add(
        "--effect-delay",
        type=float,
        default=0.0,
        metavar="S",
        help="time from a write of a limit or a pause to its effect",
    )
    add(
        "--e0-after-pause",
        type=float,
        metavar="S",
        help="goes to E0 by itself after a pause of S seconds",
    )
    add("--lost-asleep", type=int, default=1, metavar="N", help="requests lost asleep")
    add("--turn-round", type=float, default=0.002, metavar="S")
    add("--boot-time", type=float, default=0.3, metavar="S", help="deaf after a reset")
    add(
        "--id-at-once", action="store_true", help="a new ID counts before the reset too"
    )
    add(
        "--reset-answer",
        choices=["before", "after", "never"],
        default="before",
        help="when a reset is confirmed",
    )
    add("--l1-first", action="store_true", help="L1 in the first word, not the third")
    evbox = kinds.add_parser("evbox", help="EVBox ChargePoints (Protocol Max v4)")
    _common(evbox.add_argument)
    add = evbox.add_argument
    add("--serials", type=int, nargs="+", default=[1923054])
    add(
        "--modules",
        type=int,
        nargs="+",
        default=[1],
        help="one number for each ChargePoint",
    )
    add("--max-current", type=float, default=35.0, metavar="A")
    add("--min-current", type=float, default=6.0, metavar="A")
    add("--min-interval", type=int, default=1, metavar="S")
    add("--commands", type=int, nargs="+", default=[68, 69], choices=[68, 69])
    smartevse = kinds.add_parser("smartevse", help="SmartEVSE v2 boxes")
    _common(smartevse.add_argument)
    add = smartevse.add_argument
    add("--dialect", choices=list(DIALECTS), default="2.17", help="the firmware")
    add(
        "--load-balance",
        type=int,
        nargs="+",
        default=[0],
        metavar="N",
        help="for each box: 0 off, 1 master, 2 to 8 slaves; also its address",
    )
    add("--unit", type=int, help="address with load balancing off, if not the default")
    add("--cables", type=int, nargs="+", default=[16], choices=[13, 16, 32, 63])
    add("--fixed-cable", action="store_true", help="no socket: --max-current counts")
    add("--max-current", type=int, default=13, metavar="A")
    add("--min-current", type=int, default=6, metavar="A")
    add("--mode", type=int, choices=[0, 1, 2], default=0, help="normal, smart, solar")
    add("--serial", type=int, default=1, help="of the first box; dialect later only")
    add(
        "--no-override", action="store_true", help="the boxes ignore a charging current"
    )
    add("--turn-round", type=float, default=0.01, metavar="S")
    ews = kinds.add_parser("ews", help="P-CHARGE EWS-Boxes (MCS binary)")
    _common(ews.add_argument)
    ews_cli.add_arguments(ews.add_argument)
    return parser


def _common(add: Callable[..., object]) -> None:
    add("--tcp", type=int, metavar="PORT", help="a TCP port of this machine; 0 = any")
    add(
        "--pty", nargs="?", const="", metavar="LINK", help="a pseudo-terminal (default)"
    )
    add("--baud", type=int)
    add("--parity", choices=["N", "E", "O"])
    add("--cars", choices=["auto", "plugged", "none"], default="none")
    for name, unit, usual in (
        ("away", "seconds", CarLife.away),
        ("wants", "Wh", CarLife.wants_wh),
    ):
        add(
            f"--{name}",
            type=float,
            nargs=2,
            default=usual,
            metavar=("MIN", "MAX"),
            help=f"{unit}, of cars that come and go by themselves",
        )
    add(
        "--time-scale", type=float, default=1.0, help="cars and time-outs, not the wire"
    )
    add(
        "--granularity",
        type=float,
        default=0.002,
        help="seconds for each chunk of a reply",
    )
    add("--seed", type=int, default=0)
    add("--dead", type=int, nargs="+", default=[], help="IDs, units or serials")
    add(
        "--error-rate",
        type=float,
        default=0.0,
        help="probability that a byte is damaged",
    )
    add("--lose-rate", type=float, default=0.0, help="probability that a reply is lost")
    add("--late-rate", type=float, default=0.0, help="probability that a reply is late")
    add("--late-by", type=float, default=0.5, metavar="S")
    add("--noise-rate", type=float, default=0.0, help="noise bytes per second")
    add("--echo", action="store_true", help="the adapter echoes the client's bytes")
    add("--control", action="store_true", help=f"read commands from stdin: {HELP}")
    add("--duration", type=float, metavar="S", help="end after S seconds")
    add("--stats", metavar="FILE", help="write the counters as JSON at the end")
    add("--verbose", action="store_true", help="print the state every 5 s")
