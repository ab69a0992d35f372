"""Virtual EWS-Boxes in the process of the oracle: making and operating them.

On a pty of their own, or as diallers: a whole fleet runs on one thread.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from tests.virtual import Car, EwsBox, VirtualBus
from tests.virtual.device import Device
from tests.virtual.ews_cli import EwsFleet

type Buses = VirtualBus | EwsFleet

REDIALS_AFTER: Final = 0.5
"""Pause before a box dials again, s; not in the manual."""


def ews_boxes(*, boxes: Sequence[Mapping[str, Any]]) -> list[Device]:
    """Make boxes with a car for each port, that reply 2 ms after a command.

    ``plugged``: the cars wait at their ports. All other items are for `EwsBox`.
    """
    devices: list[Device] = []
    for box in boxes:
        options = dict(box)
        cars = (Car(max_current=16.0), Car(max_current=16.0))
        if options.pop("plugged", False):
            for car in cars:
                car.plug_in()
        devices.append(EwsBox(cars=cars, jitter=0.0, **options))
    return devices


def dialling(devices: Sequence[Device], address: str) -> EwsFleet:
    """Return these boxes as diallers of HOST:PORT; their logs are unlimited."""
    host, _, port = address.rpartition(":")
    boxes = [device for device in devices if isinstance(device, EwsBox)]
    return EwsFleet(boxes, host, int(port), retry=REDIALS_AFTER, ring=None)


def buses_of(bus: Buses) -> Sequence[VirtualBus]:
    """Return the buses: one for each dialler, or the only one."""
    return bus.diallers if isinstance(bus, EwsFleet) else [bus]


def operate(bus: Buses, name: str, action: str, port: int, *values: int) -> float:
    """Operate a box; return the time (s of CLOCK_MONOTONIC)."""
    (box,) = (
        one for one in bus.devices if isinstance(one, EwsBox) and one.name == name
    )
    do = {
        "key_down": box.key_down,
        "key_up": box.key_up,
        "request_start": box.start_on_web_page,
        "withdraw": box.stop_on_web_page,
    }[action]

    def now() -> float:
        at = buses_of(bus)[0].time()
        do(port, *values)
        return at

    return bus.call(now)


def plug_in(bus: Buses) -> None:
    """Plug a car in at each port."""
    for box in bus.devices:
        if isinstance(box, EwsBox):
            for port in box.ports:
                if port.car is not None:
                    port.car.plug_in()


def commands(bus: Buses, since: float) -> dict[str, list[tuple[float, str]]]:
    """Return times and names of the commands to each box from a time on."""
    return bus.call(
        lambda: {
            box.name: [(one.t, one.name) for one in box.commands if one.t >= since]
            for box in bus.devices
            if isinstance(box, EwsBox)
        }
    )
