"""Virtual chargers and the library's chargers for them, as a witness compares them.

One `Scene` is a bus with all that is on it, in simulated time. What is said of a box is
its state in `tests.virtual`, by the names of the readings of the library; what no
reading shows is left out.
"""

from abc import ABC, abstractmethod
import asyncio
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from math import inf
from typing import Any, ClassVar, Final, Self

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.model import (
    CurrentLimit,
    Fault,
    OrderChange,
    Orders,
)
from custom_components.evse_bus.evse.readings import ConnectorReading
from tests.virtual import Car, CarLife, VirtualBus
from tests.virtual.device import Device

from .witness import LimitWatch, Values, Witness

LIMIT: Final = 16.0
VOLTAGE: Final = 230.0
TICK: Final = 0.2
"""Time between two steps of the virtual chargers, s."""
NO_FAULTS: Final[frozenset[Fault]] = frozenset()
_SETTLE: Final = 30.0
"""Time after the start and after a loss in which a box need not follow yet, s."""


def visiting_car(seed: int, **options: float) -> Car:
    """Return a car that comes, charges some kWh, and goes."""
    life = CarLife(
        seed=seed,
        away=(60.0, 3600.0),
        hesitates=(0.0, 120.0),
        wants_wh=(2000.0, 20000.0),
        stays=(30.0, 3600.0),
    )
    return Car(life=life, **options)  # type: ignore[arg-type]


def orders(current: float = LIMIT) -> Orders:
    """Return orders that let a car charge."""
    return Orders(limit=CurrentLimit(current=current), allowed=True)


def phases(name: str, values: Iterable[object]) -> dict[str, object]:
    """Return the values of L1, L2 and L3 by name."""
    return {f"{name}.L{at}": value for at, value in enumerate(values, 1)}


class WatchedBox[D: Device](ABC):
    """One charger, virtual and in the library (a `witness.Box`)."""

    windows: ClassVar[Mapping[str, float]] = {}
    tolerances: ClassVar[Mapping[str, float]] = {}
    stale: ClassVar[float] = 30.0

    def __init__(self, device: D, charger: Charger) -> None:
        """Compare these two."""
        self.name = charger.config.key
        self.device = device
        self.charger = charger
        self.disturbed_until = -inf
        self.asked = 0.0
        """The current of an order that is under way, A."""

    @abstractmethod
    def truth(self) -> Values:
        """Return its state now."""

    @abstractmethod
    def offered(self) -> float:
        """Return the current that a car may draw now, A."""

    @abstractmethod
    def missed(self) -> int:
        """Return how often the box has missed a keep-alive."""

    @abstractmethod
    def connector(self, reading: ConnectorReading) -> dict[str, object]:
        """Return what is shown of a connector."""

    @property
    def disturbed(self) -> bool:
        """Return whether the port was just away."""
        return asyncio.get_running_loop().time() < self.disturbed_until

    def meters(self) -> Mapping[int, float]:
        """Return the truth of each meter, by connector, Wh."""
        return {}

    def estimates(self) -> Mapping[int, float]:
        """Return the truth of estimated energies, by connector, Wh."""
        return {}

    def ordered(self) -> float:
        """Return the highest current that the orders allow, or one under way, A."""
        orders = self.charger.orders
        stands = 0.0 if orders.allowed is False else max(orders.limit.effective())
        return max(stands, self.asked)

    def shown(self) -> Values:
        """Return what the library shows."""
        values: dict[str, object] = {}
        if (info := self.charger.info) is not None:
            values |= {
                "info.serial": info.serial,
                "info.firmware": info.firmware,
                "info.hardware": info.hardware,
                **{f"info.{name}": value for name, value in info.options.items()},
            }
        reading = self.charger.reading
        if reading is None:
            return values
        values |= {
            "connectors": tuple(sorted(reading.connectors)),
            "allowed": reading.allowed,
            "offered": reading.offered_current,
            "maximum": reading.maximum_current,
            "interval": reading.minimum_interval,
            "outlet enabled": reading.outlet_enabled,
            "faults": reading.faults,
        }
        for number, connector in reading.connectors.items():
            for name, value in self.connector(connector).items():
                values[f"{number}.{name}"] = value
        return values


class Scene(ABC):
    """A bus with virtual chargers, and the library on it."""

    allowed_over: float = 15.0
    """Time in which a lower limit must have arrived, s."""
    dials: bool = False
    """The box dials: its bus gets the line later."""
    checks_bytes: bool = False
    """Its line checks its bytes by itself: none of them arrives damaged."""

    def __init__(self) -> None:
        """Make the chargers in `make`."""
        self.boxes: list[WatchedBox[Any]] = []
        self.witnesses: list[Witness] = []
        self.shared: LimitWatch | None = None
        """Watches a supply that all boxes share."""
        self.virtual: VirtualBus
        self.bus: Bus

    @abstractmethod
    async def make(self) -> None:
        """Make the virtual bus and its chargers, start it, make the library's bus."""

    async def __aenter__(self) -> Self:
        """Start both ends and the witnesses."""
        await self.make()
        self.witnesses = [Witness(box, self.allowed_over) for box in self.boxes]
        for device in {id(box.device): box.device for box in self.boxes}.values():
            self._sample_with(device)
        await self.bus.start()
        self.disturbed(_SETTLE)
        for witness in self.witnesses:
            witness.begin()
        return self

    async def __aexit__(self, *_error: object) -> None:
        """Stop both ends."""
        await self.bus.stop()
        self.virtual.stop()

    @property
    def chargers(self) -> list[Charger]:
        """Return the chargers of the library."""
        return [box.charger for box in self.boxes]

    def disturbed(self, seconds: float = _SETTLE) -> None:
        """Expect nothing for a time, s: the port was away."""
        until = asyncio.get_running_loop().time() + seconds
        for box in self.boxes:
            box.disturbed_until = until

    @contextmanager
    def ordering(self, charger: Charger, change: OrderChange) -> Iterator[None]:
        """Let a box follow an order already while it is under way."""
        box = next(one for one in self.boxes if one.charger is charger)
        limit = max(charger.orders.limit.effective())
        box.asked = change.current or (limit if change.allowed else 0.0)
        try:
            yield
        finally:
            box.asked = 0.0

    async def lose_port(self, seconds: float) -> None:
        """Unplug the adapter for a time, s."""
        self.disturbed(seconds + _SETTLE)
        self.virtual.unplug()
        await asyncio.sleep(seconds)
        self.virtual.replug()

    def _sample_with(self, device: Device) -> None:
        """Let the witnesses sample after each step of a device, and with each reply."""
        step, send = device.step, device.send
        witnesses = [one for one in self.witnesses if one.box.device is device]

        def sample() -> None:
            for witness in witnesses:
                witness.sample()
            if self.shared is not None:
                self.shared.look(disturbed=self.boxes[0].disturbed)

        def step_and_sample() -> None:
            step()
            sample()

        def sample_and_send(*args: Any, **kwargs: Any) -> None:  # noqa: ANN401 - of send
            sample()
            send(*args, **kwargs)

        device.step = step_and_sample  # type: ignore[method-assign]
        device.send = sample_and_send  # type: ignore[method-assign]
        step_and_sample()
