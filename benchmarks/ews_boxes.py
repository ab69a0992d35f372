"""Virtual EWS-Boxes in the witness's process: made, touched, and asked what they heard.

On a pty of their own, or as diallers: all of a fleet live on one thread.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from tests.virtual import Car, EwsBox, VirtualBus
from tests.virtual.device import Device
from tests.virtual.ews_cli import EwsFleet

type Buses = VirtualBus | EwsFleet

REDIALS_AFTER: Final = 0.5
"""Pause before a box dials again, s; the manual names none."""


def ews_boxes(*, boxes: Sequence[Mapping[str, Any]]) -> list[Device]:
    """Make boxes with a car for each port, that answer 2 ms after a command.

    ``plugged``: the cars wait at their ports. All else is for `EwsBox`.
    """
    devices: list[Device] = []
    for box in boxes:
        about = dict(box)
        cars = (Car(max_current=16.0), Car(max_current=16.0))
        if about.pop("plugged", False):
            for car in cars:
                car.plug_in()
        devices.append(EwsBox(cars=cars, jitter=0.0, **about))
    return devices


def dialling(devices: Sequence[Device], address: str) -> EwsFleet:
    """Return these boxes as diallers of HOST:PORT; they keep all of their logs."""
    host, _, port = address.rpartition(":")
    boxes = [device for device in devices if isinstance(device, EwsBox)]
    return EwsFleet(boxes, host, int(port), retry=REDIALS_AFTER, ring=None)


def buses_of(bus: Buses) -> Sequence[VirtualBus]:
    """Return the lines: one a dialler, or the one there is."""
    return bus.diallers if isinstance(bus, EwsFleet) else [bus]


def touch(bus: Buses, name: str, what: str, port: int, *values: int) -> float:
    """Do something to a box; return when (s of CLOCK_MONOTONIC)."""
    (box,) = (
        one for one in bus.devices if isinstance(one, EwsBox) and one.name == name
    )
    do = {
        "key_down": box.key_down,
        "key_up": box.key_up,
        "ask_for_start": box.start_on_web_page,
        "take_back": box.stop_on_web_page,
    }[what]

    def now() -> float:
        at = buses_of(bus)[0].time()
        do(port, *values)
        return at

    return bus.call(now)


def plug_in(bus: Buses) -> None:
    """Let a car come to each port."""
    for box in bus.devices:
        if isinstance(box, EwsBox):
            for port in box.ports:
                if port.car is not None:
                    port.car.plug_in()


def asked(bus: Buses, since: float) -> dict[str, list[tuple[float, str]]]:
    """Return what each box has been asked from then on: when, and by which command."""
    return bus.call(
        lambda: {
            box.name: [(one.t, one.name) for one in box.commands if one.t >= since]
            for box in bus.devices
            if isinstance(box, EwsBox)
        }
    )
