"""Virtual SmartEVSEs that keep a diary of what they offer their cars.

The diary is of the box itself: what its pilot says and whether its contactor is
closed, noted whenever a frame or time has changed it. A frame changes it 3 ms after
its last byte; what the box does by itself is seen within the 50 ms of the bus's tick.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, override

from tests.virtual import Car, CarLife, SmartEvse
from tests.virtual.device import Device


@dataclass(frozen=True, slots=True)
class Offer:
    """What a box offers from a moment on (s of CLOCK_MONOTONIC)."""

    at: float
    name: str
    amps: float
    """By its pilot; 0: no PWM."""
    closed: bool
    """Its contactor is: a car can draw that much."""


class DiarySmartEvse(SmartEvse):
    """A SmartEVSE with a diary."""

    def __init__(self, **about: Any) -> None:  # noqa: ANN401 - as `SmartEvse` has them
        """Begin with an empty diary."""
        super().__init__(**about)
        self.offers: list[Offer] = []

    @override
    def step(self) -> None:
        super().step()
        self._note()

    @override
    def _take_frame(self) -> None:
        super()._take_frame()
        self._note()

    def _note(self) -> None:
        if self.bus is None:
            return
        now = Offer(self.bus.time(), self.name, self.pilot_current, self.contactor)
        last = self.offers[-1] if self.offers else None
        if last is None or (last.amps, last.closed) != (now.amps, now.closed):
            self.offers.append(now)


def smartevse_boxes(boxes: Sequence[Mapping[str, Any]]) -> list[Device]:
    """Make boxes, each with a car of 32 A.

    ``car``: "plugged" charges for ever; else what `CarLife` is made with, and it comes
    and goes by itself. All else is for `SmartEvse`.
    """
    devices: list[Device] = []
    for box in boxes:
        about = dict(box)
        habits = about.pop("car")
        plugged = habits == "plugged"
        car = Car(max_current=32.0, life=None if plugged else CarLife(**habits))
        if plugged:
            car.plug_in()
        devices.append(DiarySmartEvse(car=car, **about))
    return devices


def offers_of(devices: Sequence[Device]) -> list[Offer]:
    """Return all diaries as one, by time (on the bus thread)."""
    entries = [
        offer
        for device in devices
        if isinstance(device, DiarySmartEvse)
        for offer in device.offers
    ]
    return sorted(entries, key=lambda offer: offer.at)
