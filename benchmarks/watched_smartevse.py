"""SmartEVSE boxes, polled and with a master, and what a witness compares of them."""

from collections.abc import Sequence
from typing import ClassVar, Final, override

from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.model import Circuit, Fault, Setting
from custom_components.evse_bus.evse.readings import ConnectorReading
from custom_components.evse_bus.evse.smartevse import (
    MASTER,
    POLLED,
    PolledConfig,
    SlaveConfig,
)
from tests.virtual import SmartEvse, VirtualBus
from tests.virtual.smartevse_states import pwm_of

from .watched import LIMIT, TICK, Scene, WatchedBox, orders, visiting_car
from .witness import LimitWatch, Values

ERRORS: Final = {
    1: Fault.LESS_6A,
    2: Fault.NO_COMM,
    4: Fault.TEMP_HIGH,
    8: Fault.NO_CURRENT,
    16: Fault.RCD,
    32: Fault.NO_SUN,
}
"""By the manual's table of 0x00A1."""
NO_COMM: Final = 2
LETTERS: Final = "ABCDEFGH"
"""States by their number, from 2.20 on; 2.17 reports the letter."""
NAMED: Final = frozenset({*LETTERS, "T", "B1", "C1"})
OFFERING: Final = ("B", "C", "D", "G", "G+")
SUPPLY: Final = 25.0
"""A for three boxes, each of which may ask for 16 A."""
NODES: Final = ("2.30", "2.30+", "3")
"""Dialects of nodes that may have one master."""


class WatchedSmartEvse(WatchedBox[SmartEvse]):
    """A SmartEVSE."""

    # The settings are read every few minutes, a box of a later dialect every 8 s.
    windows: ClassVar = {"1.minimum": 1200.0, "maximum": 1200.0}
    stale: ClassVar = 45.0

    def __init__(self, device: SmartEvse, charger: Charger) -> None:
        """Begin without a missed keep-alive."""
        super().__init__(device, charger)
        self._silent = False
        self._missed = 0

    @override
    def truth(self) -> Values:
        box = self.device
        error = box.error
        silent = bool(error & NO_COMM)
        self._missed += silent and not self._silent and not self.disturbed
        self._silent = silent
        car = box.car
        plugged = car is not None and car.plugged
        settings = box.outlet.settings
        return {
            "connectors": (1,),
            "allowed": box.access,
            # The register has the next current as soon as there is a car; the pilot
            # follows with the next cycle.
            "offered": pwm_of(box.outlet.current) if box.state in OFFERING else 0.0,
            "faults": frozenset(one for bit, one in ERRORS.items() if error & bit),
            "temperature": box.outlet.temperature,
            "maximum": min(
                settings["max_current"],
                box.outlet.cable_measured or settings["max_current"],
            ),
            f"settings.{Setting.MINIMUM_CURRENT}": settings["min_current"],
            f"settings.{Setting.MAXIMUM_CURRENT}": settings["max_current"],
            "1.state": self._state,
            "1.plugged": plugged,
            "1.charging": box.contactor,
            "1.minimum": settings["min_current"],
        }

    @property
    def _state(self) -> str:
        """Return the letter by which the library calls its state."""
        code = self.device.controller.dialect.states[self.device.state]
        if code in range(len(LETTERS)):
            return LETTERS[code]
        return self.device.state if self.device.state in NAMED else str(code)

    @override
    def shown(self) -> Values:
        values = dict(super().shown())
        reading = self.charger.reading
        if reading is not None:
            values["temperature"] = reading.temperature
            for name in (Setting.MINIMUM_CURRENT, Setting.MAXIMUM_CURRENT):
                values[f"settings.{name}"] = reading.settings.get(name)
        # The wire has no identity but the dialect, which is inferred.
        return {name: one for name, one in values.items() if name[:5] != "info."}

    @override
    def connector(self, reading: ConnectorReading) -> dict[str, object]:
        return {
            "state": reading.raw_state,
            "plugged": reading.plugged,
            "charging": reading.charging,
            "minimum": reading.minimum_current,
        }

    @override
    def offered(self) -> float:
        return self.device.pilot_current if self.device.contactor else 0.0

    @override
    def missed(self) -> int:
        """Return how often it has reported NO_COMM."""
        return self._missed


class PolledScene(Scene):
    """One box of a dialect, load balancing off."""

    allowed_over = 30.0

    def __init__(self, seed: int, *, dialect: str) -> None:
        """Describe it."""
        super().__init__()
        self._seed = seed
        self._dialect = dialect

    @override
    async def make(self) -> None:
        box = SmartEvse(
            self._dialect,  # type: ignore[arg-type] # one of them
            car=visiting_car(self._seed, max_current=32.0),
            cable=32,
            max_current=int(LIMIT),
        )
        self.virtual = VirtualBus.in_loop(box, seed=self._seed, ring=100, tick=TICK)
        self.virtual.start()
        self.bus = POLLED.bus(self.virtual.url)
        config = PolledConfig(
            key=box.name, name=box.name, address=box.unit, installation_limit=LIMIT
        )
        charger = POLLED.charger(config, orders())
        self.bus.add(charger)
        self.boxes.append(WatchedSmartEvse(box, charger))


class SlaveScene(Scene):
    """Slaves of 2.17 or nodes under our master, on a supply that is not enough for all."""

    allowed_over = 30.0

    def __init__(
        self,
        seed: int,
        *,
        dialects: Sequence[str] = ("2.17",) * 3,
    ) -> None:
        """Describe them, from unit 2 on."""
        super().__init__()
        self._seed = seed
        self._dialects = dialects

    @override
    async def make(self) -> None:
        made = [
            SmartEvse(
                dialect,
                load_balance=unit,
                car=visiting_car(self._seed * 10 + unit, max_current=32.0),
                cable=32,
                max_current=int(LIMIT),
            )
            for unit, dialect in enumerate(self._dialects, 2)
        ]
        self.virtual = VirtualBus.in_loop(*made, seed=self._seed, ring=100, tick=TICK)
        self.virtual.start()
        self.bus = MASTER.bus(self.virtual.url, circuit=Circuit(limit=SUPPLY))
        for box in made:
            config = SlaveConfig(
                key=box.name, name=box.name, address=box.unit, installation_limit=LIMIT
            )
            charger = MASTER.charger(config, orders())
            self.bus.add(charger)
            self.boxes.append(WatchedSmartEvse(box, charger))
        self.shared = LimitWatch(
            lambda: sum(box.offered() for box in self.boxes),
            lambda: SUPPLY,
            0.0,
        )
