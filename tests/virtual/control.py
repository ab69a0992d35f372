"""Text commands, for the demo and other processes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from . import ews_cli
from .abl import AblBox
from .commands import ALL, BUS, CARS, CHARGERS
from .evbox import EvboxChargePoint
from .ews_box import EwsBox
from .smartevse import SmartEvse

if TYPE_CHECKING:
    from collections.abc import Callable

    from .bus import VirtualBus
    from .car import Car
    from .device import Device


class Control:
    """Executes lines of text; replies `ok`, a status, or `error ...`."""

    def __init__(self, bus: VirtualBus, reply: Callable[[str], None]) -> None:
        """Control this bus; replies go to `reply`."""
        self._bus = bus
        self._reply = reply

    def do(self, text: str) -> None:
        """Execute one line."""
        words = text.split()
        if not words:
            return
        try:
            self._reply(self._bus.call(lambda: self._do(words[0], words[1:])))
        except (IndexError, KeyError, TypeError, ValueError) as error:
            self._reply(f"error {text.strip()}: {error}")

    def _do(self, word: str, values: list[str]) -> str:
        if word == "status":
            return describe(self._bus)
        if word in BUS:
            BUS[word].run(self._bus, values)
        elif word in CARS:
            CARS[word].run(self._car(values[0]), values[1:])
        else:
            key, *rest = values
            device = self._device(key)
            commands = {**ALL, **CHARGERS.get(type(device), {})}
            if word not in commands:
                names = ", ".join(sorted({*commands, *CARS, *BUS, "status"}))
                msg = f"no such command; there are: {names}"
                raise ValueError(msg)
            commands[word].run(device, int(key.partition(".")[2] or 1), rest)
        return "ok"

    def _device(self, key: str) -> Device:
        key = key.partition(".")[0]
        for device in self._bus.devices:
            if isinstance(device, AblBox) and key == device.serial:
                return device
        for device in self._bus.devices:
            if isinstance(device, AblBox) and device.device_id == int(key):
                return device
            if isinstance(device, SmartEvse) and device.unit == int(key):
                return device
            if not isinstance(device, EvboxChargePoint | EwsBox):
                continue
            if int(device.serial) == int(key):
                return device
        msg = f"no charger {key}"
        raise KeyError(msg)

    def _car(self, key: str) -> Car:
        number, _, module = key.partition(".")
        device = self._device(number)
        car = None
        if isinstance(device, AblBox):
            car = device.outlet.car
        elif isinstance(device, SmartEvse):
            car = device.car
        elif isinstance(device, EvboxChargePoint):
            car = device.modules[int(module or 1) - 1].car
        elif isinstance(device, EwsBox):
            car = device.ports[int(module or 1) - 1].car
        if car is None:
            msg = f"no car at {key}"
            raise KeyError(msg)
        return car


def describe(bus: VirtualBus) -> str:
    """Return the state of all chargers, one line each (on the bus thread)."""
    if isinstance(bus, ews_cli.EwsFleet):
        return "\n".join(describe(dialler) for dialler in bus.diallers)
    client = "connected" if bus.connected else "away"
    traffic = f"{bus.log.total} transmissions, {bus.wire.collisions} collisions"
    lines = [f"{bus.url}: client {client}, {traffic}"]
    for device in bus.devices:
        dead = " (dead)" if device.faults.dead else ""
        if isinstance(device, EwsBox):
            lines.append(f"  {device.name}{dead}: {ews_cli.describe_box(device)}")
        elif isinstance(device, AblBox):
            currents = "/".join(f"{c:.1f}" for c in device.outlet.phase_currents)
            off = "" if device.on else " (off)"
            lines.append(
                f"  {device.name}{dead}{off}: ID {device.device_id},"
                f" {device.serial}, {device.state}, may {device.ic_amps:.1f} A,"
                f" draws {currents} A, {device.requests} requests"
            )
        elif isinstance(device, EvboxChargePoint):
            limits = "/".join(f"{c:.1f}" for c in device.limits_in_force)
            back = " (failed back)" if device.failed_back else ""
            draws = ", ".join(
                "/".join(f"{c:.1f}" for c in m.measured()[0]) for m in device.modules
            )
            lines.append(
                f"  {device.name}{dead}: limits {limits} A{back}, draws {draws},"
                f" {device.counters.accepted} orders"
            )
        elif isinstance(device, SmartEvse):
            closed = "closed" if device.contactor else "open"
            access = "" if device.access else ", no access"
            lines.append(
                f"  {device.name}{dead}: {device.state}, error {device.error}{access},"
                f" offers {device.pilot_current:.1f} A, contactor {closed},"
                f" draws {device.car_current:.1f} A, {device.requests} requests"
            )
    return "\n".join(lines)
