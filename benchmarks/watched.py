"""Virtual chargers and the library's chargers for them, as a witness compares them.

One `Scene` is a bus with all that is on it, in simulated time. What is said of a box is
its state in `tests.virtual`, by the names of the readings of the library; what no
reading shows is left out.
"""

from abc import ABC, abstractmethod
import asyncio
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Final, Self, override

from custom_components.evse_bus.evse.abl import PROTOCOL as ABL, AblConfig
from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.evbox import PROTOCOL as EVBOX, EvboxConfig
from custom_components.evse_bus.evse.model import CurrentLimit, Fault, Orders
from custom_components.evse_bus.evse.readings import ConnectorReading
from tests.virtual import AblBox, Car, CarLife, EvboxChargePoint, Module, VirtualBus
from tests.virtual.device import Device

from .witness import Values, Witness

LIMIT: Final = 16.0
VOLTAGE: Final = 230.0
TICK: Final = 0.2
"""Time between two steps of the virtual chargers, s."""
NO_FAULTS: Final[frozenset[Fault]] = frozenset()
OVERCURRENT: Final = frozenset({Fault.OVERCURRENT})
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

    def meters(self) -> Mapping[int, float]:
        """Return the truth of each meter, by connector, Wh."""
        return {}

    def estimates(self) -> Mapping[int, float]:
        """Return the truth of estimated energies, by connector, Wh."""
        return {}

    def ordered(self) -> float:
        """Return the highest current that the orders allow, A."""
        orders = self.charger.orders
        return 0.0 if orders.allowed is False else max(orders.limit.effective())

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

    def __init__(self) -> None:
        """Make the chargers in `make`."""
        self.boxes: list[WatchedBox[Any]] = []
        self.witnesses: list[Witness] = []
        self.virtual: VirtualBus
        self.bus: Bus

    @abstractmethod
    def make(self) -> None:
        """Make the virtual bus and its chargers, start it, make the library's bus."""

    async def __aenter__(self) -> Self:
        """Start both ends and the witnesses."""
        self.make()
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
        for witness in self.witnesses:
            witness.disturbed_until = until

    async def lose_port(self, seconds: float) -> None:
        """Unplug the adapter for a time, s."""
        self.disturbed(seconds + _SETTLE)
        self.virtual.unplug()
        await asyncio.sleep(seconds)
        self.virtual.replug()

    def _sample_with(self, device: Device) -> None:
        """Let the witnesses sample whenever the device takes a step."""
        step = device.step
        witnesses = [one for one in self.witnesses if one.box.device is device]

        def step_and_sample() -> None:
            step()
            for witness in witnesses:
                witness.sample()

        device.step = step_and_sample  # type: ignore[method-assign]
        step_and_sample()


# -- ABL ---------------------------------------------------------------------------


class WatchedAbl(WatchedBox[AblBox]):
    """An ABL box; its energy is an estimate from measured currents."""

    # Faults are read every 30 s.
    windows: ClassVar = {"faults": 45.0}
    # 0.1 A is the floor of the meter, and shown as none.
    tolerances: ClassVar = {f"1.current.L{n}": 0.11 for n in (1, 2, 3)} | {
        "1.power": 0.11 * 3 * VOLTAGE
    }

    def __init__(self, device: AblBox, charger: Charger) -> None:
        """Begin without energy."""
        super().__init__(device, charger)
        self._failures = 0
        self._state = ""
        self._energy = 0.0
        self._at: float | None = None

    @override
    def truth(self) -> Values:
        box, outlet = self.device, self.device.outlet
        self._integrate(box.now(), sum(outlet.phase_currents) * VOLTAGE)
        if outlet.state != self._state:
            self._failures += outlet.state.startswith("F")
            self._state = outlet.state
        major, minor = box.firmware
        enabled = outlet.state != "E0"
        return {
            "info.serial": box.serial,
            "info.firmware": f"{major}.{minor}",
            "info.upstream_timeout": outlet.upstream_enabled,
            "info.meter": outlet.meter,
            "info.rdc_md": box.rdc_md,
            "info.welding_detection": box.welding_detection,
            # By the manual's table of 0x01 and 0x06.
            "info.hardware": "pcba 160307",
            "info.socket": box.coding_resistor,
            "info.enable_input": "none",
            "info.enable_after_power_cycle": True,
            "info.upstream_timeout_state": "F4",
            "info.china_limits": False,
            "info.coding_resistor": box.coding_resistor,
            "connectors": (1,),
            "allowed": enabled and outlet.ic_amps > 0,
            "offered": outlet.ic_amps,
            "outlet enabled": enabled,
            # Bit 0 alone is up to 5 %, which the box tolerates.
            "faults": OVERCURRENT if outlet.overcurrent > 1 else NO_FAULTS,
            "1.state": outlet.state,
            "1.plugged": outlet.ev_connected,
            "1.charging": outlet.state in ("C2", "C3", "C4"),
            "1.power": sum(outlet.phase_currents) * VOLTAGE,
            **phases("1.current", outlet.phase_currents),
        }

    def _integrate(self, now: float, power: float) -> None:
        if self._at is not None:
            self._energy += power * (now - self._at) / 3600
        self._at = now

    @override
    def connector(self, reading: ConnectorReading) -> dict[str, object]:
        return {
            "state": reading.raw_state,
            "plugged": reading.plugged,
            "charging": reading.charging,
            "power": reading.estimated_power,
            **phases("current", reading.current),
        }

    @override
    def estimates(self) -> Mapping[int, float]:
        return {1: self._energy}

    @override
    def offered(self) -> float:
        outlet = self.device.outlet
        return outlet.ic_amps if outlet.ev_connected else 0.0

    @override
    def missed(self) -> int:
        """Return how often its upstream time-out has fired."""
        return self._failures


class AblScene(Scene):
    """Boxes whose own upstream time-out of 30 s ends in F4."""

    def __init__(self, seed: int, *, boxes: int = 2, tells_icmax: bool = True) -> None:
        """Describe them; ``tells_icmax``: register 0x0F is answered."""
        super().__init__()
        self._seed = seed
        self._count = boxes
        self._tells_icmax = tells_icmax

    @override
    def make(self) -> None:
        made = [
            AblBox(
                number,
                car=visiting_car(self._seed * 10 + number, phases=(3, 1)[number % 2]),
                serial=f"2W22xy{number:08d}",
                upstream_enabled=True,
                tells_icmax=self._tells_icmax,
            )
            for number in range(1, self._count + 1)
        ]
        self.virtual = VirtualBus.in_loop(
            *made, seed=self._seed, ring=100, tick=TICK
        ).start()
        self.bus = ABL.bus(self.virtual.url)
        for box in made:
            config = AblConfig(
                key=box.name,
                name=box.name,
                address=box.device_id,
                serial=box.serial,
                installation_limit=LIMIT,
            )
            orders = Orders(limit=CurrentLimit(current=LIMIT), allowed=True)
            charger = ABL.charger(config, orders)
            self.bus.add(charger)
            self.boxes.append(WatchedAbl(box, charger))


# -- EVBox -------------------------------------------------------------------------


class WatchedEvbox(WatchedBox[EvboxChargePoint]):
    """A ChargePoint and its modules, whose meters count whole Wh."""

    tolerances: ClassVar = {
        **{
            f"{module}.{name}.L{phase}": tolerance
            for module in range(1, 21)
            for phase in (1, 2, 3)
            for name, tolerance in (("cos phi", 0.0006), ("voltage", 0.5))
        },
        **{f"{module}.power": 0.051 * 3 * VOLTAGE for module in range(1, 21)},
        **{f"{module}.energy": 1.0 for module in range(1, 21)},
    }

    @override
    def truth(self) -> Values:
        point = self.device
        values: dict[str, object] = {
            "info.serial": point.serial.lstrip("0"),
            "connectors": tuple(range(1, len(point.modules) + 1)),
            "maximum": point.max_current,
            "interval": point.min_interval,
            "faults": NO_FAULTS,
        }
        for number, module in enumerate(point.modules, 1):
            currents, cos_phis = module.measured()
            power = sum(
                i * u * phi
                for i, u, phi in zip(currents, module.voltages, cos_phis, strict=True)
            )
            values |= {
                f"{number}.charging": max(currents) >= 0.45,  # noqa: PLR2004 - rounded
                f"{number}.power": power,
                f"{number}.estimated power": power,
                f"{number}.energy": module.energy_wh,
                f"{number}.generation": 0,
                f"{number}.minimum": module.min_current,
                **phases(f"{number}.current", currents),
                **phases(f"{number}.cos phi", cos_phis),
                **phases(f"{number}.voltage", module.voltages),
            }
        return values

    @override
    def connector(self, reading: ConnectorReading) -> dict[str, object]:
        return {
            "charging": reading.charging,
            "power": reading.power,
            "energy": reading.energy,
            "generation": reading.meter_generation,
            "minimum": reading.minimum_current,
            **phases("current", reading.current),
            **phases("cos phi", reading.cos_phi),
            **phases("voltage", reading.voltage),
        }

    @override
    def meters(self) -> Mapping[int, float]:
        modules = enumerate(self.device.modules, 1)
        return {number: module.energy_wh for number, module in modules}

    @override
    def offered(self) -> float:
        return max(self.device.limits_in_force)

    @override
    def missed(self) -> int:
        """Return how often its time-out has fired."""
        return self.device.counters.fail_backs


class EvboxScene(Scene):
    """One ChargePoint of two modules."""

    def __init__(
        self, seed: int, *, command: int = 68, any_serial: bool = False
    ) -> None:
        """Describe it; ``any_serial``: asked as 0, its serial number is learnt."""
        super().__init__()
        self._seed = seed
        self._command = command
        self._any_serial = any_serial

    @override
    def make(self) -> None:
        modules = [
            Module(
                car=visiting_car(self._seed * 10 + at, phases=count), energy_wh=start
            )
            for at, (count, start) in enumerate(((3, 0.0), (1, 123_456.0)))
        ]
        point = EvboxChargePoint(1923054, modules)
        self.virtual = VirtualBus.in_loop(
            point, seed=self._seed, ring=100, tick=TICK
        ).start()
        self.bus = EVBOX.bus(self.virtual.url)
        config = EvboxConfig(
            key=point.name,
            name=point.name,
            address=0 if self._any_serial else int(point.serial),
            command=self._command,  # type: ignore[arg-type] # 68 or 69
            installation_limit=2 * LIMIT,
        )
        orders = Orders(limit=CurrentLimit(current=2 * LIMIT), allowed=True)
        charger = EVBOX.charger(config, orders)
        self.bus.add(charger)
        self.boxes.append(WatchedEvbox(point, charger))
