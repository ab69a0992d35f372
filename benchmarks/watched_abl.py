"""ABL boxes, and what a witness compares of them."""

from collections.abc import Mapping
from typing import ClassVar, Final, override

from custom_components.evse_bus.evse.abl import PROTOCOL, AblConfig
from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.model import Fault
from custom_components.evse_bus.evse.readings import ConnectorReading
from tests.virtual import AblBox, VirtualBus

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

CHARGING: Final = ("C2", "C3", "C4")
OVERCURRENT: Final = frozenset({Fault.OVERCURRENT})


class WatchedAbl(WatchedBox[AblBox]):
    """An ABL box; its energy is an estimate from measured currents."""

    # Faults are read every 30 s.
    windows: ClassVar = {"faults": 45.0}
    # 0.1 A, which the box rounds to, is the floor of the meter, and shown as none.
    tolerances: ClassVar = {f"1.current.L{n}": 0.151 for n in (1, 2, 3)} | {
        "1.power": 0.151 * 3 * VOLTAGE
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
            self._failures += outlet.state.startswith("F") and not self.disturbed
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
            "1.charging": outlet.state in CHARGING,
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
        return outlet.ic_amps if outlet.state in CHARGING else 0.0

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
    async def make(self) -> None:
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
        self.bus = PROTOCOL.bus(self.virtual.url)
        for box in made:
            config = AblConfig(
                key=box.name,
                name=box.name,
                address=box.device_id,
                serial=box.serial,
                installation_limit=LIMIT,
            )
            charger = PROTOCOL.charger(config, orders())
            self.bus.add(charger)
            self.boxes.append(WatchedAbl(box, charger))
