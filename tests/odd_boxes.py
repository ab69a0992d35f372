"""Boxes with minima and maxima of their own, for what must work with every box."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import floor, inf

from tests.virtual import AblBox, Car, EvboxChargePoint, EwsBox, Module, SmartEvse
from tests.virtual.device import Device


@dataclass(frozen=True)
class OddBox:
    """A box, and what it can do."""

    make: Callable[[Car], Device]
    minimum: float = 6
    """Least that it charges with, A."""
    maximum: float = inf
    """Most that box or cable allow, A."""
    step: float = 0.1
    port: str = ""
    """What the keys of its entities begin with."""
    data: Mapping[str, object] = field(default_factory=dict)
    """Its set-up."""

    def kept(self, asked: float) -> float:
        """Return the order that a request becomes, A."""
        return float(floor(asked)) if self.step == 1 else asked

    def offers(self, order: float, installation: float) -> float:
        """Return what a car may draw then, A."""
        current = self.kept(min(order, self.maximum, installation))
        return current if current >= self.minimum else 0

    def reason(self, order: float, installation: float) -> str:
        """Return why a car may draw nothing then."""
        if self.kept(min(self.maximum, installation)) < self.minimum:
            return "maximum_too_low"
        return "limit_too_low" if order < self.minimum else "none"


def _evbox(car: Car, *, minimum: float = 6.0, maximum: float = 35.0) -> Device:
    module = Module(car=car, min_current=minimum)
    return EvboxChargePoint(1923054, [module], max_current=maximum, min_interval=0)


def _with_cable(car: Car) -> Device:
    box = EwsBox(cars=(car,), ports=1)
    box.ports[0].cable = 13
    return box


_EVBOX: Mapping[str, object] = {"poll_interval": 0.5}
_EWS: Mapping[str, object] = {"ports": 1}

ODD_BOXES: Mapping[str, OddBox] = {
    "abl": OddBox(lambda car: AblBox(1, car=car), maximum=16),
    "evbox that needs 14 A": OddBox(
        lambda car: _evbox(car, minimum=14.0), minimum=14, maximum=35, data=_EVBOX
    ),
    "evbox with a thin connection": OddBox(
        lambda car: _evbox(car, maximum=12.0), maximum=12, data=_EVBOX
    ),
    "evbox that cannot charge": OddBox(
        lambda car: _evbox(car, minimum=14.0, maximum=12.0),
        minimum=14,
        maximum=12,
        data=_EVBOX,
    ),
    "smartevse that needs 10 A": OddBox(
        lambda car: SmartEvse(
            "2.20", car=car, cable=32, max_current=20, min_current=10
        ),
        minimum=10,
        maximum=20,
    ),
    "ews with a maximum": OddBox(
        lambda car: EwsBox(cars=(car,), ports=1, jumper=20, max_current=15),
        maximum=15,
        step=1,
        port="1_",
        data=_EWS,
    ),
    "ews with a thin cable": OddBox(
        _with_cable, maximum=13, step=1, port="1_", data=_EWS
    ),
    "ews with a household socket": OddBox(
        lambda car: EwsBox(cars=(car,), ports=1, mode1=(True, False)),
        minimum=16,
        maximum=16,
        step=1,
        port="1_",
        data=_EWS,
    ),
}
