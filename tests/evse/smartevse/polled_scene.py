"""A simulated line with one SmartEVSE that is polled; the wire is the oracle."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import override

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.memory import LineMemory
from custom_components.evse_bus.evse.model import CurrentLimit, Orders
from custom_components.evse_bus.evse.readings import ChargerReading, ConnectorReading
from custom_components.evse_bus.evse.smartevse import POLLED
from custom_components.evse_bus.evse.smartevse.config import PolledConfig
from custom_components.evse_bus.evse.smartevse.dialects import MAPS, Dialect
from custom_components.evse_bus.evse.smartevse.polled import QUIET, PolledSmartEvse
from tests.evse.simulated_line import LiveScene
from tests.simulated_time import simulate
from tests.virtual import Car, SmartEvseController
from tests.virtual.smartevse_registers import DIALECTS

from .scene import Box, SmartEvseLine

OLDER = (Dialect.V2_17, Dialect.V2_20)
LATER = (Dialect.V2_30, Dialect.V2_HEAD)
ALL = OLDER + LATER
"""The dialects that can be polled without load balancing."""
V2_30 = Dialect.V2_30
HEAD = Dialect.V2_HEAD
V2_17 = Dialect.V2_17
V2_20 = Dialect.V2_20


@dataclass(frozen=True)
class Write:
    """A write of one register."""

    when: float
    unit: int
    register: int
    value: int


@dataclass
class PolledScene(LiveScene):
    """One box, its car, and the library."""

    dialect: Dialect = V2_17
    unit: int | None = None
    current: float = 10.0
    allowed: bool | None = None
    installation: float = 32.0
    maximum: int = 16
    minimum: int = 6
    cable: int = 16
    load_balance: int = 0
    serial: int = 4711
    expected: str | None = None
    stop_on_shutdown: bool = False
    lifetime: float | None = None
    poll_interval: float = 2.0
    settings: dict[str, int] = field(default_factory=dict)
    override_works: bool = True
    measures: bool = False
    """HEAD searches for the smallest current of each car."""
    line: SmartEvseLine = field(init=False)
    car: Car = field(init=False)
    box: Box = field(init=False)
    charger: PolledSmartEvse = field(init=False)
    on_step: list[Callable[[], None]] = field(default_factory=list)
    """Called at each step of the simulated time."""

    def __post_init__(self) -> None:
        self.line = SmartEvseLine()
        self.car = Car(max_current=32.0)
        self.box = self.make_box(self.dialect)
        self.line.boxes[0] = self.box
        self.bus = Bus(self.line, POLLED.framer(), POLLED.timing, "simulated")
        self.charger = self.make_charger()
        self.bus.add(self.charger)

    async def restart(self, away: float = 0.0, *, reload: bool = False) -> None:
        """Restart the library; ``reload``: in the same process, which remembers."""
        await self.bus.stop()
        if not reload:
            self.line.memory = LineMemory()
        await asyncio.sleep(away)
        self.bus = Bus(self.line, POLLED.framer(), POLLED.timing, "again")
        self.charger = self.make_charger()
        self.bus.add(self.charger)
        await self.bus.start()

    def make_box(self, dialect: Dialect) -> Box:
        controller = SmartEvseController(
            DIALECTS[dialect.value],
            self.car,
            cable=self.cable,
            settings={
                "max_current": self.maximum,
                "min_current": self.minimum,
                "load_balance": self.load_balance,
                **self.settings,
            },
            serial=self.serial,
            unit=self.unit,
            override_works=self.override_works,
        )
        controller.outlet.measures &= self.measures
        return Box(controller, self.car)

    def make_charger(self, key: str = "box") -> PolledSmartEvse:
        charger = POLLED.charger(
            PolledConfig(
                key=key,
                name="the box",
                address=self.box.unit,
                installation_limit=self.installation,
                serial=self.expected,
                stop_on_shutdown=self.stop_on_shutdown,
                order_lifetime=self.lifetime,
                poll_interval=self.poll_interval,
            ),
            Orders(
                limit=CurrentLimit(current=self.current),
                allowed=self.allowed,
                fail_safe=CurrentLimit(current=6.0),
            ),
        )
        assert isinstance(charger, PolledSmartEvse)
        return charger

    def replace_box(self, dialect: Dialect) -> None:
        """Put another firmware, or another box, in its place."""
        self.box = self.make_box(dialect)
        self.line.boxes[0] = self.box

    # -- Observations --------------------------------------------------------------

    @property
    def outlet(self):  # type: ignore[no-untyped-def] # noqa: ANN201 - the virtual one
        return self.box.controller.outlet

    @property
    def reading(self) -> ChargerReading:
        assert self.charger.reading is not None
        return self.charger.reading

    @property
    def connector(self) -> ConnectorReading:
        return self.reading.connectors[1]

    def writes(self, register: int | None = None, since: float = 0.0) -> list[Write]:
        """Return the writes on the wire, one register a frame."""
        return [
            write
            for sent in self.line.sent
            if (write := as_write(sent.when, sent.data)) is not None
            and write.when >= since
            and register in (None, write.register)
        ]

    @property
    def layout(self):  # type: ignore[no-untyped-def] # noqa: ANN201 - a Map
        return MAPS[self.dialect]

    def currents(self, since: float = 0.0) -> list[int]:
        return [w.value for w in self.writes(self.layout.current_register, since)]

    def accesses(self, since: float = 0.0) -> list[int]:
        return [w.value for w in self.writes(self.layout.access_register, since)]

    # -- Time ----------------------------------------------------------------------

    async def settled(self) -> None:
        """Wait until the box is known and no conversation is under way."""
        await self.until(
            lambda: (
                self.charger.reading is not None
                and self.charger.configuration is not None
                and not self.charger.busy
            )
        )

    async def charge(self) -> None:
        """Let a car come, and wait until it charges within the order."""
        self.car.plug_in()
        await self.until(lambda: self.box.state == "C")
        await self.until(self.is_followed)

    def is_followed(self) -> bool:
        ceiling = min(self.charger.orders.limit.current, self.charger.limits.ceiling)
        return 0 < self.box.offers <= ceiling

    async def polled(self, times: int = 2) -> None:
        pause = max(self.poll_interval, QUIET if self.dialect in LATER else 0.0)
        await asyncio.sleep(times * (pause + 0.5))

    @override
    def step(self) -> None:
        self.line.live()
        for call in self.on_step:
            call()


def as_write(when: float, data: bytes) -> Write | None:
    """Return the write in a request (function 0x10); ``None``: it is a read."""
    if data[1] != 0x10:
        assert data[1] in (3, 4), f"{data.hex()} neither reads nor writes"
        return None
    assert data[4:7] == b"\x00\x01\x02", f"{data.hex()} writes several registers"
    return Write(
        when,
        data[0],
        int.from_bytes(data[2:4], "big"),
        int.from_bytes(data[7:9], "big"),
    )


def play(scene: PolledScene, acts: Callable[[PolledScene], object]) -> PolledScene:
    """Run a scene in simulated time."""

    async def run() -> None:
        async with scene:
            await scene.settled()
            await acts(scene)  # type: ignore[misc]

    simulate(run())
    return scene
