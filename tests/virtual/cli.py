"""The command line of `scripts/virtual-chargers`."""

from __future__ import annotations

import json
from pathlib import Path
import signal
import sys
import threading
import time
from typing import TYPE_CHECKING

from . import arguments, ews_cli
from .abl import AblBox
from .adapter import ModbusTcpGateway
from .bus import VirtualBus
from .car import Car, CarLife
from .commands import buses_of
from .control import Control, describe
from .evbox import EvboxChargePoint, Module
from .ews_box import EwsBox
from .smartevse import SmartEvse
from .strangers import Strangers

if TYPE_CHECKING:
    import argparse
    from collections.abc import Sequence

    from .device import Device

STATUS_INTERVAL = 5.0


def main(words: Sequence[str] | None = None) -> int:
    """Run until SIGTERM, SIGINT, or the end of --duration."""
    options = arguments.parser().parse_args(words)
    over = _interrupted()
    if options.protocol == "strangers":
        return _strangers(options, over)
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
    for one in buses_of(bus):
        _disturb(one, options)
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


def _interrupted() -> threading.Event:
    """Return an event that SIGTERM and SIGINT set."""
    over = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: over.set())
    return over


def _strangers(options: argparse.Namespace, over: threading.Event) -> int:
    host, _, port = options.dial.rpartition(":")
    crowd = Strangers(
        host or "127.0.0.1",
        int(port),
        count=options.count,
        kind=options.kind,
        rate=options.rate,
        seed=options.seed,
    )
    with crowd:
        _print(f"ready strangers {crowd.url}")
        end = time.monotonic() + (options.duration or float("inf"))
        while not over.is_set() and (left := end - time.monotonic()) > 0:
            over.wait(min(left, STATUS_INTERVAL))
            if options.verbose:
                _print(str(crowd.stats()))
        if options.stats:
            text = json.dumps(crowd.stats(), indent=2) + "\n"
            Path(options.stats).write_text(text, encoding="utf-8")
    return 0


def _disturb(bus: VirtualBus, options: argparse.Namespace) -> None:
    """Set faults and adapter of a bus."""
    faults, adapter = bus.faults, bus.adapter
    faults.byte_error_rate = options.error_rate
    faults.damage = tuple(options.damage)
    faults.lose_rate = options.lose_rate
    faults.late_rate = options.late_rate
    faults.late_by = options.late_by
    faults.noise_rate = options.noise_rate
    faults.echo = options.echo
    adapter.delay_out, adapter.delay_in = options.delay[0], options.delay[-1]
    adapter.jitter = options.jitter
    adapter.idle_timeout = options.idle_timeout
    if options.gateway:
        adapter.gateway = ModbusTcpGateway(options.gateway)


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
            wakes_on=options.wakes_on,
        )
        box.id_applies = "write" if options.id_at_once else "reset"
        box.reset_answer = options.reset_answer
        box.l3_first = not options.l1_first
        box.outlet.default_duty = options.default_duty
        box.outlet.idle_floor = options.idle_floor
        box.outlet.icmax_delay = box.outlet.ic_delay = options.effect_delay
        box.stray = options.stray
        box.outlet.e0_after_pause = options.e0_after_pause
        box.outlet.pause_forced_after = options.pause_forced_after
        box.outlet.pause_in_ic = options.pause_in_ic
        box.outlet.above_default = options.above_default
        box.outlet.low_codes_taken = options.low_codes
        box.outlet.offered_reads_zero = options.offered_zero
        box.outlet.meter_bit = True if options.meter_bit else None
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
        point = EvboxChargePoint(
            serial,
            modules,
            max_current=options.max_current,
            min_interval=options.min_interval,
            commands=set(options.commands),
        )
        point.ignore_limit = options.ignore_limit
        points.append(point)
    return points


def _smartevse(options: argparse.Namespace) -> list[Device]:
    boxes: list[Device] = []
    cables, dialects = options.cables, options.dialect
    for index, load_balance in enumerate(options.load_balance):
        boxes.append(
            SmartEvse(
                dialects[min(index, len(dialects) - 1)],
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
                settings=dict(options.set),
                turn_round=options.turn_round,
            )
        )
    return boxes


def _ews(options: argparse.Namespace) -> list[Device]:
    return ews_cli.boxes(options, _car)
