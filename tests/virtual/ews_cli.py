"""The command line of virtual EWS-Boxes: arguments, fleets of diallers, commands."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from .ews_box import EwsBox
from .ews_dialler import EwsDialler
from .ews_driver import Driver
from .faults import Faults

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable
    from types import TracebackType
    from typing import Self, TypeVar

    from .bus import VirtualBus
    from .car import Car
    from .device import Device

    T = TypeVar("T")

FIRST_SERIAL = 12345678901


class EwsFleet:
    """Many boxes that dial the same server, on one thread, used like one bus."""

    def __init__(
        self,
        boxes: list[EwsBox],
        host: str,
        port: int,
        **options: float | None,
    ) -> None:
        """Make a dialler for each box."""
        self.faults = Faults()
        self.diallers: list[EwsDialler] = []
        for box in boxes:
            first = self.diallers[0] if self.diallers else None
            dialler = EwsDialler(box, host, port, on=first, **options)  # type: ignore[arg-type]
            dialler.faults = dialler.wire.faults = self.faults
            self.diallers.append(dialler)
        self.url = f"dial://{host}:{port}"

    def __enter__(self) -> Self:
        """Begin to dial."""
        for dialler in self.diallers:
            dialler.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Hang up; the thread belongs to the first dialler and ends with it."""
        for dialler in reversed(self.diallers):
            dialler.stop()

    @property
    def devices(self) -> list[Device]:
        """Return all boxes."""
        return [device for dialler in self.diallers for device in dialler.devices]

    def call(self, function: Callable[[], T]) -> T:
        """Run a function on the thread."""
        return self.diallers[0].call(function)

    def unplug(self) -> None:
        """Pull the network cable of all boxes."""
        for dialler in self.diallers:
            dialler.unplug()

    def replug(self) -> None:
        """Put it back."""
        for dialler in self.diallers:
            dialler.replug()

    def advance(self, seconds: float) -> None:
        """Advance the time of all boxes."""
        for dialler in self.diallers:
            dialler.advance(seconds)

    def stats(self) -> dict[str, object]:
        """Return the counters of all boxes."""
        return {
            "url": self.url,
            "attempts": sum(dialler.attempts for dialler in self.diallers),
            "connected": sum(dialler.connected for dialler in self.diallers),
            "dropped": {d.box.name: d.dropped for d in self.diallers if d.dropped},
            "devices": {d.name: d.stats() for d in self.devices},
        }


def add_arguments(add: Callable[..., object]) -> None:
    """Add the arguments of `virtual-chargers ews`."""
    add("--dial", metavar="HOST:PORT", help="the boxes dial this server")
    add("--retry", type=float, default=0.5, metavar="S", help="between two attempts")
    add("--serials", nargs="+", metavar="SERIAL", help="12 digits each")
    add("--count", type=int, default=1, help="number of boxes, without --serials")
    add(
        "--jumper",
        type=int,
        default=32,
        choices=[13, 20, 32, 63, 70],
        help="highest current, A",
    )
    add("--max-current", type=int, default=0, metavar="A", help="0: that of the jumper")
    add(
        "--mode1",
        type=int,
        nargs="+",
        default=[],
        choices=[1, 2],
        help="ports that are household sockets: 16 A or nothing",
    )
    add("--cable", type=int, default=32, metavar="A", help="of both ports")
    add("--drivers", action="store_true", help="press start when a car requests charge")
    add("--standalone", action="store_true", help="not in server mode")
    add("--rfid", action="store_true", help="with card authentication")
    add("--manual-io", action="store_true", help="the server handles keys and LEDs")
    add("--exclusive", action="store_true", help="one port at a time")
    add("--fixed-cable", action="store_true", help="no sockets, no locks")
    add("--fan", action="store_true", help="with ventilation")
    add(
        "--restart-after-power",
        action="store_true",
        help="a charge goes on by itself after a power failure",
    )
    add("--power-backup", action="store_true", help="0xF0 for 260 s after power-up")
    add(
        "--bcc",
        choices=["all", "without_msgid"],
        default="all",
        help="what its checksum covers; the manual has both",
    )
    add(
        "--masking",
        choices=["no", "zeros", "stars"],
        default="no",
        help="of passwords that are read",
    )
    add("--ignore-limit", action="store_true", help="takes limits without effect")


def boxes(
    options: argparse.Namespace,
    car: Callable[[argparse.Namespace, int], Car],
) -> list[Device]:
    """Make the boxes of these arguments, with two cars each."""
    serials = options.serials or [
        f"{FIRST_SERIAL + number:012d}" for number in range(options.count)
    ]
    if len(serials) > 1 and not options.dial:
        msg = "a serial line has one box: several boxes need --dial"
        raise SystemExit(msg)
    made = [
        EwsBox(
            serial=serial,
            cars=(car(options, 2 * index), car(options, 2 * index + 1)),
            jumper=options.jumper,
            max_current=options.max_current,
            mode="standalone" if options.standalone else "server",
            bcc=options.bcc,
            rfid=options.rfid,
            manual_io=options.manual_io,
            exclusive=options.exclusive,
            fixed_cable=options.fixed_cable,
            fan=options.fan,
            restart_after_power=options.restart_after_power,
            masking=options.masking,
            mode1=(1 in options.mode1, 2 in options.mode1),
            power_backup=options.power_backup,
        )
        for index, serial in enumerate(serials)
    ]
    for box in made:
        box.ignores_limits = options.ignore_limit
        for port in box.ports:
            port.cable = options.cable
    if options.drivers:
        for index, box in enumerate(made):
            box.drivers = [
                Driver(port, seed=options.seed * 1000 + 2 * index + port.number)
                for port in box.ports
            ]
    return [*made]


def fleet(
    options: argparse.Namespace, devices: list[Device], settings: dict[str, object]
) -> VirtualBus:
    """Return a fleet of these boxes; it has all of a bus that the script uses."""
    host, _, port = options.dial.rpartition(":")
    chosen = {
        key: value for key, value in settings.items() if key not in ("baud", "parity")
    }
    made = EwsFleet(
        cast("list[EwsBox]", devices),
        host or "127.0.0.1",
        int(port),
        retry=options.retry,
        **cast("dict[str, float]", chosen),
    )
    return cast("VirtualBus", made)


def describe_box(box: EwsBox) -> str:
    """Return the state of both ports as text."""
    parts = []
    for port in box.ports:
        marks = "".join(
            mark for mark, holds in (("L", port.locked), ("K", port.contactor)) if holds
        )
        parts.append(
            f"{port.number}: {port.status:#04x} {marks or '-'}"
            f" may {port.offered} A, draws {max(port.currents):.1f} A"
        )
    linked = "connected" if box.server_connected else "no server"
    return f"{', '.join(parts)}; {linked}, {box.requests} commands"
