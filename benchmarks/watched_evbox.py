"""An EVBox ChargePoint, and what a witness compares of it."""

from collections.abc import Mapping
from typing import ClassVar, override

from custom_components.evse_bus.evse.evbox import PROTOCOL, EvboxConfig
from custom_components.evse_bus.evse.readings import ConnectorReading
from tests.virtual import EvboxChargePoint, Module, VirtualBus

from .watched import (
    LIMIT,
    NO_FAULTS,
    TICK,
    VOLTAGE,
    Scene,
    WatchedBox,
    orders,
    phases,
    visiting_car,
)
from .witness import Values


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
    async def make(self) -> None:
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
        self.bus = PROTOCOL.bus(self.virtual.url)
        config = EvboxConfig(
            key=point.name,
            name=point.name,
            address=0 if self._any_serial else int(point.serial),
            command=self._command,  # type: ignore[arg-type] # 68 or 69
            installation_limit=2 * LIMIT,
        )
        charger = PROTOCOL.charger(config, orders(2 * LIMIT))
        self.bus.add(charger)
        self.boxes.append(WatchedEvbox(point, charger))
