"""A bus in simulated time: no byte moves and no second passes for real."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, Self, override

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.conversation import FollowUp
from custom_components.evse_bus.evse.exchange import Turn
from custom_components.evse_bus.evse.framing import (
    Frame,
    Framer,
    LineSettings,
    Timing,
)
from custom_components.evse_bus.evse.model import (
    Capability,
    ChargerConfig,
    CurrentLimit,
    Limits,
    OrderChange,
    Orders,
)
from custom_components.evse_bus.evse.readings import ChargerReading
from custom_components.evse_bus.evse.safety import clamp
from tests.evse.simulated_line import SimulatedLine
from tests.simulated_time import now

SETTINGS = LineSettings(baudrate=38400)
TIMING = Timing(reply_timeout=0.25, longest_reply=40, silence=0.0)


class Telegram(Frame):
    """``@`` address command value: four bytes, no checksum."""

    def __init__(self, raw: bytes) -> None:
        self.raw = raw
        self.address, self.command, self.value = raw[1:]


class TelegramFramer(Framer[Telegram]):
    def __init__(self) -> None:
        super().__init__()
        self._buffer = b""

    @override
    def feed(self, data: bytes) -> list[Telegram]:
        self._buffer += data
        frames = []
        while self._buffer:
            if self._buffer[:1] != b"@":
                self._buffer = self._buffer[1:]
                self.noise += 1
            elif len(self._buffer) < 4:
                break
            else:
                frames.append(Telegram(self._buffer[:4]))
                self._buffer = self._buffer[4:]
        return frames

    @override
    def reset(self) -> None:
        self.noise += len(self._buffer)
        self._buffer = b""

    @property
    @override
    def pending(self) -> int:
        return len(self._buffer)


@dataclass
class Device:
    """Something that answers after its turn-round time."""

    address: int
    alive: bool = True
    delay: float = 0.002
    value: int = 0
    lose_next: int = 0
    answer: Callable[[bytes], bytes | None] | None = None

    def reply(self, request: bytes) -> bytes | None:
        if self.lose_next:
            self.lose_next -= 1
            return None
        if not self.alive:
            return None
        if self.answer is not None:
            return self.answer(request)
        if request[2] == ord("W"):
            self.value = request[3]
        return bytes((ord("@"), self.address, request[2], self.value))


@dataclass
class Sent:
    when: float
    address: int
    command: str
    value: int


class TelegramLine(SimulatedLine[Sent]):
    """Devices and a wire that takes its time."""

    def __init__(self, *devices: Device) -> None:
        super().__init__(SETTINGS)
        self.devices = {device.address: device for device in devices}

    @override
    def record(self, data: bytes, end: float) -> Sent:
        return Sent(now(), data[1], chr(data[2]), data[3])

    @override
    def carry(self, data: bytes, end: float) -> None:
        device = self.devices.get(data[1])
        if device is not None and (reply := device.reply(data)) is not None:
            self.deliver(reply, end + device.delay)

    def times(self, address: int, command: str = "R") -> list[float]:
        return [
            sent.when
            for sent in self.sent
            if sent.address == address and sent.command == command
        ]


@dataclass(frozen=True, slots=True, kw_only=True)
class SimulatedConfig(ChargerConfig):
    keep_alive: float | None = None
    """Hard deadline after each exchange, s."""
    minimum_interval: float = 0.0


class SimulatedCharger(Charger[SimulatedConfig]):
    """Reads with ``R`` and writes amperes with ``W``; a pause is ``W 0``."""

    timing: ClassVar[Timing] = TIMING

    def __init__(self, config: SimulatedConfig, orders: Orders) -> None:
        super().__init__(config, orders)
        self.spoken = -1000.0
        self.polls = 0
        self.asked: list[int] = []

    @property
    @override
    def capabilities(self) -> frozenset[Capability]:
        return frozenset()

    @property
    @override
    def limits(self) -> Limits:
        return Limits(installation=self.config.installation_limit, step=1.0)

    @property
    @override
    def longest_request(self) -> int:
        return 4

    @override
    def on_line_open(self) -> None:
        pass

    @override
    def minimum_pause(self, now: float) -> float:
        return max(0.0, self.spoken + self.config.minimum_interval - now)

    @override
    def plan(self, now: float) -> None:
        super().plan(now)
        if self.config.keep_alive is not None:
            self.slot.start_by = self.spoken + self.config.keep_alive
            self.slot.ready = self.slot.due = self.slot.start_by - 0.5

    def _accept(self, command: str) -> Callable[[Telegram], int | None]:
        def accept(frame: Telegram) -> int | None:
            if (frame.address, chr(frame.command)) != (self.config.address, command):
                return None
            return frame.value

        return accept

    async def say(self, turn: Turn, command: str, value: int = 0) -> int:
        self.spoken = turn.now
        request = bytes((ord("@"), self.config.address, ord(command), value))
        return await turn.exchange(request, self._accept(command))

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        value = await self.say(turn, "R")
        self.polls += 1
        self.reading = ChargerReading(offered_current=float(value))
        return None

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        await self.say(turn, "W", int(clamp(orders, self.limits).current))

    @override
    def on_unsolicited(self, frame: Frame) -> FollowUp | None:
        if (
            isinstance(frame, Telegram)
            and frame.address == self.config.address
            and chr(frame.command) == "?"
        ):

            async def answer(turn: Turn) -> None:
                self.asked.append(frame.value)
                await self.say(turn, "!", frame.value)

            return FollowUp(answer)
        return None


@dataclass
class Scene:
    """A bus with simulated chargers, ready to start."""

    addresses: tuple[int, ...] = (1,)
    interval: float = 1.0
    keep_alive: float | None = None
    minimum_interval: float = 0.0
    lifetime: float | None = None
    line: TelegramLine = field(init=False)
    bus: Bus = field(init=False)

    def __post_init__(self) -> None:
        self.line = TelegramLine(*(Device(address) for address in self.addresses))
        self.bus = Bus(self.line, TelegramFramer(), TIMING, "simulated")
        for address in self.addresses:
            self.bus.add(self.make(address))

    def make(self, address: int) -> SimulatedCharger:
        return SimulatedCharger(
            SimulatedConfig(
                key=str(address),
                name=f"charger {address}",
                address=address,
                installation_limit=32.0,
                poll_interval=self.interval,
                keep_alive=self.keep_alive,
                minimum_interval=self.minimum_interval,
                order_lifetime=self.lifetime,
            ),
            Orders(limit=CurrentLimit(current=10.0)),
        )

    def charger(self, address: int) -> SimulatedCharger:
        charger = self.bus.chargers[str(address)]
        assert isinstance(charger, SimulatedCharger)
        return charger

    async def __aenter__(self) -> Self:
        await self.bus.start()
        return self

    async def __aexit__(self, *_exc: object) -> None:
        await self.bus.stop()
