"""Virtual SmartEVSEs that record their offers.

The box itself records the current of its pilot and the state of its contactor whenever
they change. A frame changes them 3 ms after its last byte; other changes are recorded
within the 50 ms of the tick of the bus.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, override

from tests.virtual import Car, CarLife, SmartEvse
from tests.virtual.device import Device


@dataclass(frozen=True, slots=True)
class Offer:
    """The offer of a box from a time on (s of CLOCK_MONOTONIC)."""

    at: float
    name: str
    amps: float
    """Of its pilot; 0: no PWM."""
    closed: bool
    """Its contactor is closed: a car can draw this current."""


class RecordingSmartEvse(SmartEvse):
    """A SmartEVSE that records its offers."""

    def __init__(self, **options: Any) -> None:  # noqa: ANN401 - those of `SmartEvse`
        """Begin without an offer."""
        super().__init__(**options)
        self.offers: list[Offer] = []

    @override
    def step(self) -> None:
        super().step()
        self._record()

    @override
    def _take_frame(self) -> None:
        super()._take_frame()
        self._record()

    def _record(self) -> None:
        if self.bus is None:
            return
        now = Offer(self.bus.time(), self.name, self.pilot_current, self.contactor)
        last = self.offers[-1] if self.offers else None
        if last is None or (last.amps, last.closed) != (now.amps, now.closed):
            self.offers.append(now)


def smartevse_boxes(boxes: Sequence[Mapping[str, Any]]) -> list[Device]:
    """Make boxes, each with a car of 32 A.

    ``car``: "plugged" charges for ever; else the arguments of a `CarLife`, by which it
    comes and goes. All other items are arguments of `SmartEvse`.
    """
    devices: list[Device] = []
    for box in boxes:
        options = dict(box)
        life = options.pop("car")
        plugged = life == "plugged"
        car = Car(max_current=32.0, life=None if plugged else CarLife(**life))
        if plugged:
            car.plug_in()
        devices.append(RecordingSmartEvse(car=car, **options))
    return devices


def offers_of(devices: Sequence[Device]) -> list[Offer]:
    """Return the offers of all boxes, by time (on the bus thread)."""
    entries = [
        offer
        for device in devices
        if isinstance(device, RecordingSmartEvse)
        for offer in device.offers
    ]
    return sorted(entries, key=lambda offer: offer.at)
