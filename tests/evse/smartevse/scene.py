"""A simulated RS-485 line with SmartEVSE slaves and our master on it.

The boxes are virtual ones, in simulated time; frames that overlap on the wire are lost.
The oracle is the sum of what the boxes offer with their contactors closed.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
import itertools
from typing import override

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.framing import LineSettings
from custom_components.evse_bus.evse.memory import LineMemory
from custom_components.evse_bus.evse.modbus import RtuFramer
from custom_components.evse_bus.evse.model import Circuit, CurrentLimit, Orders
from custom_components.evse_bus.evse.smartevse import MASTER
from custom_components.evse_bus.evse.smartevse.config import SlaveConfig
from custom_components.evse_bus.evse.smartevse.dialects import Dialect
from custom_components.evse_bus.evse.smartevse.master import Master
from custom_components.evse_bus.evse.smartevse.slave import SlaveSmartEvse
from tests.evse.simulated_line import LiveScene, SimulatedLine
from tests.simulated_time import now
from tests.virtual import Car, SmartEvseController
from tests.virtual.smartevse_registers import DIALECTS

SETTINGS = LineSettings(baudrate=9600)
BYTE = SETTINGS.byte_time
BROADCASTS = (bytes((0, 0x10, 0, 1)), bytes((9, 0x10, 0, 1)), bytes((9, 0x10, 0, 0x20)))


@dataclass
class Box:
    """A virtual slave, and the losses between it and the wire."""

    controller: SmartEvseController
    car: Car
    deaf: bool = False
    """It receives nothing."""
    mute: bool = False
    """Nothing that it sends arrives."""
    delay: float = 0.008
    """From the end of a request to its reply, s."""
    misses: Callable[[bytes], bool] = lambda _data: False
    """Frames that it does not receive."""
    loses: Callable[[bytes], bool] = lambda _data: False
    """Frames of it that do not arrive."""

    @property
    def unit(self) -> int:
        return self.controller.unit

    @property
    def offers(self) -> float:
        """Return the current that a car may draw now, A."""
        outlet = self.controller.outlet
        return outlet.pilot_current if outlet.contactor else 0.0

    @property
    def state(self) -> str:
        return self.controller.outlet.state


@dataclass
class Sent:
    when: float
    data: bytes

    @property
    def is_broadcast(self) -> bool:
        return self.data.startswith(BROADCASTS)

    @property
    def values(self) -> tuple[int, ...]:
        """Return the values of a broadcast, 0.1 A."""
        pairs = itertools.batched(self.data[7:-2], 2, strict=True)
        return tuple(int.from_bytes(bytes(pair), "big") for pair in pairs)


class SmartEvseLine(SimulatedLine[Sent]):
    """The wire: bytes take their time, and frames that overlap are lost."""

    def __init__(self) -> None:
        super().__init__(SETTINGS)
        self.boxes: dict[int, Box] = {}
        self.busy_until = 0.0
        self.lumps = 1
        self._lost_until = 0.0

    @override
    def record(self, data: bytes, end: float) -> Sent:
        return Sent(now(), data)

    @override
    def carry(self, data: bytes, end: float) -> None:
        if now() < self.busy_until:
            # It collides with the frame of another station.
            self._lost_until = self.busy_until = max(self.busy_until, end)
            return
        self.busy_until = end
        self.loop.call_at(end, self._arrive, data, None)

    def send(self, data: bytes, sender: Box | None = None) -> None:
        """Send a frame of another station once the line was quiet for 6 ms."""
        wait = self.busy_until + 0.0061 - now()
        if wait > 0:
            self.loop.call_later(wait, self.send, data, sender)
            return
        self.busy_until = self.deliver(data, now())
        self.loop.call_at(self.busy_until, self._arrive, data, sender)

    @override
    def hear(self, data: bytes) -> None:
        if now() > self._lost_until:
            super().hear(data)

    def noise(self, data: bytes) -> None:
        """Receive bytes out of nowhere, at our end only."""
        self.hear(data)

    def _arrive(self, data: bytes, sender: Box | None) -> None:
        """Bring a frame to all boxes but its sender."""
        if now() <= self._lost_until:
            return
        for box in self.boxes.values():
            if box is sender or box.deaf or (sender is None and box.misses(data)):
                continue
            answer = box.controller.receive(data, now())
            self._send_for(box)
            if answer is not None and not box.mute and not box.loses(answer):
                self.loop.call_later(box.delay, self.send, answer, box)

    def _send_for(self, box: Box) -> None:
        sending = box.controller.sending
        while sending:
            data = sending.pop(0)
            if not box.mute and not box.loses(data):
                self.send(data, box)

    def live(self) -> None:
        """Bring the boxes up to now."""
        for box in tuple(self.boxes.values()):
            box.controller.step(now())
            self._send_for(box)


@dataclass
class MasterScene(LiveScene):
    """Our master, its slaves and their cars."""

    units: tuple[int, ...] = (2, 3)
    limit: float = 16.0
    minimum: float = 6.0
    current: float = 16.0
    allowed: bool | None = True
    maximum: int = 16
    watch: bool = True
    dialect: str = "2.17"
    kept: Dialect | None = None
    """Dialect of the slaves, as found earlier."""
    line: SmartEvseLine = field(init=False)
    bus: Bus = field(init=False)
    master: Master = field(init=False)
    most: float = field(init=False, default=0.0)
    """Most that all boxes have offered at one moment, A."""
    overshoot: float = field(init=False, default=0.0)
    """By how much that was above the limit at worst, A."""
    excess: float = field(init=False, default=0.0)
    """By how much the values of one broadcast were above it at worst, 0.1 A."""

    def __post_init__(self) -> None:
        self.line = SmartEvseLine()
        self.line.on_sent = self._add_up
        self.new_bus()
        for unit in self.units:
            self.plug_box(unit)
            self.add(unit)

    def new_bus(self, *, reload: bool = False) -> None:
        """Restart the library; the boxes go on.

        ``reload``: in the same process, which remembers the line.
        """
        if not reload:
            self.line.memory = LineMemory()
        self.master = Master(Circuit(limit=self.limit, minimum=self.minimum))
        self.bus = Bus(
            self.line, RtuFramer(), MASTER.timing, "simulated", group=self.master
        )

    def plug_box(self, unit: int, dialect: str | None = None) -> Box:
        car = Car(max_current=32.0)
        settings = {"load_balance": unit, "max_current": self.maximum}
        controller = SmartEvseController(
            DIALECTS[dialect or self.dialect],
            car,
            cable=32,
            settings=settings,
        )
        box = Box(controller, car)
        self.line.boxes[unit] = box
        return box

    def make(self, unit: int, **orders: object) -> SlaveSmartEvse:
        config = SlaveConfig(
            key=str(unit),
            name=f"slave {unit}",
            address=unit,
            installation_limit=32.0,
            dialect=self.kept,
        )
        usual = {"limit": CurrentLimit(current=self.current), "allowed": self.allowed}
        return SlaveSmartEvse(config, Orders(**(usual | orders)))  # type: ignore[arg-type]

    def add(self, unit: int, **orders: object) -> SlaveSmartEvse:
        slave = self.make(unit, **orders)
        self.bus.add(slave)
        return slave

    def box(self, unit: int) -> Box:
        return self.line.boxes[unit]

    def slave(self, unit: int) -> SlaveSmartEvse:
        slave = self.bus.chargers[str(unit)]
        assert isinstance(slave, SlaveSmartEvse)
        return slave

    @property
    def offers(self) -> float:
        return sum(box.offers for box in self.line.boxes.values())

    def broadcasts(self, since: float = 0.0) -> list[Sent]:
        return [s for s in self.line.sent if s.is_broadcast and s.when >= since]

    def gaps(self, since: float = 0.0) -> list[float]:
        times = [sent.when for sent in self.broadcasts(since)]
        return [b - a for a, b in itertools.pairwise(times)]

    def frames(self, start: str, since: float = 0.0) -> list[str]:
        """Return the frames we sent that begin with these hex digits."""
        return [
            sent.data.hex()
            for sent in self.line.sent
            if sent.data.hex().startswith(start) and sent.when >= since
        ]

    async def charge(self, *units: int) -> None:
        """Let cars come, and wait until they charge."""
        for unit in units:
            self.box(unit).car.plug_in()
        await self.until(lambda: all(self.box(u).state == "C" for u in units))

    def _add_up(self, sent: Sent) -> None:
        if sent.is_broadcast:
            # A box that cannot be reached gets 6 A, whatever the limit.
            lowest = 60 * sum(value > 0 for value in sent.values)
            limit = max(self.master.circuit.limit * 10, lowest)
            self.excess = max(self.excess, sum(sent.values) - limit)

    @override
    def step(self) -> None:
        self.line.live()
        offers = self.offers
        self.most = max(self.most, offers)
        over = offers - self.master.circuit.limit
        self.overshoot = max(self.overshoot, over)

    @override
    async def __aexit__(self, *exc: object) -> None:
        await super().__aexit__(*exc)
        if exc[0] is None:
            assert self.excess <= 0, f"{self.excess / 10:g} A too much in a broadcast"
        if exc[0] is None and self.watch:
            assert self.overshoot <= 1e-6, f"{self.overshoot:g} A above the limit"
