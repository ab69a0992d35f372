"""A simulated line with one virtual EWS-Box on it; the wire is the oracle."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Self, override

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.errors import PortMissingError
from custom_components.evse_bus.evse.events import Event
from custom_components.evse_bus.evse.ews import PROTOCOL
from custom_components.evse_bus.evse.ews.charger import EwsPort
from custom_components.evse_bus.evse.ews.config import EwsPortConfig
from custom_components.evse_bus.evse.ews.port import BoxPorts
from custom_components.evse_bus.evse.ews.timing import SETTINGS
from custom_components.evse_bus.evse.framing import Timing
from custom_components.evse_bus.evse.model import CurrentLimit, OrderChange, Orders
from custom_components.evse_bus.evse.readings import ChargerReading, ConnectorReading
from tests.evse.simulated_line import LiveScene, SimulatedLine
from tests.simulated_time import now, simulate
from tests.virtual import Car
from tests.virtual.ews_box import EwsBox as VirtualBox
from tests.virtual.log import CLIENT
from tests.virtual.wire import Segment

BYTE = SETTINGS.byte_time
SERIAL = "012345678901"


@dataclass(frozen=True)
class Sent:
    """A command on the wire."""

    when: float
    name: str
    parameters: bytes


class EwsLine(SimulatedLine[Sent]):
    """A wire for each direction; chosen messages can be lost."""

    def __init__(self) -> None:
        super().__init__(SETTINGS)
        self.box: VirtualBox | None = None
        self.deaf: Callable[[str], bool] = lambda _name: False
        """Which commands the box does not receive."""
        self.mute: Callable[[str], bool] = lambda _name: False
        """Which answers of the box are lost."""
        self.cut = False
        """Everything is lost."""
        self.held_until = 0.0
        """Bytes that the box sends before this time arrive then, in their order."""
        # As a serial adapter delivers them.
        self.lumps = 16
        self._free_at = 0.0

    @override
    def record(self, data: bytes, end: float) -> Sent:
        return Sent(now(), data[4:6].decode(), data[6:-1])

    @override
    def carry(self, data: bytes, end: float) -> None:
        if not self.deaf(data[4:6].decode()) and not self.cut:
            self.loop.call_at(end, self._reach_box, data)

    def _reach_box(self, data: bytes) -> None:
        assert self.box is not None
        end = now()
        self.box.receive(Segment(end - len(data) * BYTE, BYTE, data, (CLIENT,), end))

    def send_at(self, _device: object, data: bytes, at: float) -> None:
        """Send bytes of the box at that time, or as soon as it has passed."""
        if at <= now():
            self.say(data)
        else:
            self.loop.call_at(at, self.say, data)

    def say(self, data: bytes) -> None:
        """Let the box send bytes, after those it is still sending."""
        is_answer = data[3:4] == b"A"
        if self.cut or (is_answer and self.mute(data[4:6].decode("latin-1"))):
            return
        self._free_at = self.deliver(data, max(now(), self._free_at, self.held_until))

    def named(self, *names: str, since: float = 0.0) -> list[Sent]:
        return [one for one in self.sent if one.name in names and one.when >= since]

    def orders(self, order: int | None = None, since: float = 0.0) -> list[Sent]:
        """Return the orders sent (`sl`)."""
        return [
            one
            for one in self.named("sl", since=since)
            if order in (None, one.parameters[1])
        ]

    def limits(self, port: int = 1, since: float = 0.0) -> list[int]:
        return [
            one.parameters[1]
            for one in self.named("st", since=since)
            if one.parameters[0] == port
        ]


@dataclass
class EwsScene(LiveScene):
    """One box, two cars, and the library."""

    current: float = 16.0
    allowed: bool | None = None
    installation: float = 32.0
    expected: str | None = SERIAL
    ports: tuple[int, ...] = (1, 2)
    lifetime: float | None = None
    fail_safe: float = 6.0
    timing: Timing = PROTOCOL.timing
    config: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    """Of the virtual box."""
    line: EwsLine = field(init=False)
    box: VirtualBox = field(init=False)
    cars: tuple[Car, Car] = field(init=False)
    events: list[Event] = field(default_factory=list)
    watchers: list[Callable[[], None]] = field(default_factory=list)
    """Called at each step of the simulated time."""

    def __post_init__(self) -> None:
        self.line = EwsLine()
        self.cars = (Car(max_current=32.0), Car(max_current=32.0))
        self.bus = Bus(
            self.line, PROTOCOL.framer(), self.timing, "simulated", group=BoxPorts()
        )
        for port in self.ports:
            self.bus.add(self.make_charger(port))
        self.box = self.make_box()

    def make_box(self, serial: str = SERIAL) -> VirtualBox:
        box = VirtualBox(serial=serial, cars=self.cars, **self.options)
        box.bus = self.line  # type: ignore[assignment]
        self.line.box = box
        return box

    def make_charger(self, port: int, key: str | None = None) -> EwsPort:
        charger = PROTOCOL.charger(
            EwsPortConfig(
                key=key or f"port{port}",
                name=f"port {port}",
                address=port,
                installation_limit=self.installation,
                serial=self.expected,
                order_lifetime=self.lifetime,
                **self.config,
            ),
            Orders(
                limit=CurrentLimit(current=self.current),
                allowed=self.allowed,
                fail_safe=CurrentLimit(current=self.fail_safe),
            ),
        )
        assert isinstance(charger, EwsPort)
        return charger

    # -- State ---------------------------------------------------------------------

    def charger(self, port: int = 1) -> EwsPort:
        charger = self.bus.chargers[f"port{port}"]
        assert isinstance(charger, EwsPort)
        return charger

    def reading(self, port: int = 1) -> ChargerReading:
        reading = self.charger(port).reading
        assert reading is not None
        return reading

    def connector(self, port: int = 1) -> ConnectorReading:
        return self.reading(port).connectors[port]

    def status(self, port: int = 1) -> int:
        return self.box.ports[port - 1].status

    def unlocked(self, port: int = 1) -> list[str]:
        """Return the reasons why the lock of a port has opened."""
        return [one.reason for one in self.box.ports[port - 1].history.unlockings]

    def starts(self, port: int = 1) -> list[str]:
        """Return the causes of the starts of a port."""
        return [cause for _, cause in self.box.ports[port - 1].history.starts]

    # -- Time ----------------------------------------------------------------------

    async def settled(self) -> None:
        """Wait until all is known, and nothing more has to be sent."""
        await self.until(
            lambda: all(
                one.reading is not None
                and not one._conversations
                and not one.limiter.must_reassert()
                for one in map(self.charger, self.ports)
            )
        )

    async def plug(self, port: int = 1) -> None:
        """Plug a car in, and wait until it is read as waiting."""
        self.cars[port - 1].plug_in()
        await self.until(lambda: self.connector(port).raw_state == "0x30")

    async def charge(self, port: int = 1) -> None:
        """Plug a car in and let it charge, by order of the user."""
        await self.plug(port)
        await self.charger(port).change_orders(OrderChange(allowed=True))
        await self.until(lambda: self.status(port) == 0x40)
        await asyncio.sleep(2.5)

    def unplug(self, gone: float = 1.0) -> None:
        """Take the line away; it cannot be opened for a time, s."""
        self.line.refuse_open = PortMissingError("unplugged")
        self.line.unplug()
        asyncio.get_running_loop().call_later(gone, self._replug)

    def _replug(self) -> None:
        self.line.refuse_open = None

    @override
    def step(self) -> None:
        self.box.step()
        for watch in self.watchers:
            watch()

    @override
    async def __aenter__(self) -> Self:
        await super().__aenter__()
        self.charger(self.ports[0]).box.events.subscribe(self.events.append)
        return self


def play(scene: EwsScene, acts: Callable[[EwsScene], object]) -> EwsScene:
    """Run the acts in simulated time, once everything is known."""

    async def run() -> None:
        async with scene:
            await scene.settled()
            await acts(scene)  # type: ignore[misc]

    simulate(run())
    return scene


def quick(scene: EwsScene, **changes: float) -> EwsScene:
    """Return a scene with other times of its bus."""
    return replace(scene, timing=replace(scene.timing, **changes))  # type: ignore[arg-type]
