"""The simulated line: a wire in simulated time between the library and test devices.

`SimulatedLine` is the library's end of the wire, and stands in for the bus of virtual
devices. A subclass says how it keeps a request, and brings bytes to its devices.
"""

from abc import ABC, abstractmethod
import asyncio
from collections.abc import Callable
from contextlib import suppress
from random import Random
from typing import Self, override

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.errors import LineLostError
from custom_components.evse_bus.evse.framing import LineSettings
from custom_components.evse_bus.evse.line import Line
from tests.simulated_time import now
from tests.virtual import Faults

STEP = 0.02
"""Time between two steps of virtual devices, s."""


class SimulatedLine[S](Line, ABC):
    """A wire without bytes that move for real; ``S``: a request, as tests see it."""

    def __init__(self, settings: LineSettings) -> None:
        super().__init__("simulated", settings)
        self.sent: list[S] = []
        """Requests of the library, oldest first."""
        self.on_sent: Callable[[S], None] = lambda _sent: None
        """Called with each request at the moment it is sent."""
        self.refuse_open: Exception | None = None
        self.damage: Callable[[bytes], bytes] = lambda data: data
        """Changes bytes on their way to the library."""
        self.lumps = 0
        """Bytes that arrive at the library at once; 0: all of a frame."""
        self.faults = Faults()
        self.rng = Random(1)  # noqa: S311 - repeatable on purpose
        self.byte_time = settings.byte_time
        self._open = False

    # -- The library's end

    @property
    @override
    def is_open(self) -> bool:
        return self._open

    @override
    async def open(self) -> None:
        if self.refuse_open is not None:
            raise self.refuse_open
        self._open = True
        self.statistics.opened += 1
        self.last_activity = now()

    @override
    async def close(self) -> None:
        self._open = False

    def unplug(self) -> None:
        self._open = False
        self.on_lost(LineLostError("unplugged"))

    @override
    def write(self, data: bytes, *, reply_may_equal: bool = False) -> float:
        if not self._open:
            raise LineLostError("not open")
        end = now() + len(data) * self.byte_time
        self.sent.append(self.record(data, end))
        self.on_sent(self.sent[-1])
        self.last_activity = end
        self.carry(data, end)
        return end

    def hear(self, data: bytes) -> None:
        """Let the library hear bytes now."""
        if self._open:
            self.last_activity = max(self.last_activity, now())
            self.on_data(self.damage(data))

    # -- The wire

    @abstractmethod
    def record(self, data: bytes, end: float) -> S:
        """Return a request as it is kept in `sent`; its last byte leaves at ``end``."""

    @abstractmethod
    def carry(self, data: bytes, end: float) -> None:
        """Bring a request to the devices."""

    def deliver(self, data: bytes, begin: float) -> float:
        """Bring bytes that begin then to the library; return when the last is over."""
        loop = asyncio.get_running_loop()
        size = self.lumps or len(data)
        for at in range(0, len(data), size):
            lump = data[at : at + size]
            loop.call_at(begin + (at + len(lump)) * self.byte_time, self.hear, lump)
        return begin + len(data) * self.byte_time

    # -- The part of a bus that virtual devices use

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        return asyncio.get_running_loop()

    def time(self) -> float:
        return now()

    def now(self) -> float:
        return now()

    def call[T](self, function: Callable[[], T]) -> T:
        return function()


async def until(condition: Callable[[], object], patience: float = 300.0) -> float:
    """Wait until a condition holds; return how long it took, s."""
    begin = now()
    while not condition():
        assert now() - begin < patience, "it never happened"
        await asyncio.sleep(STEP)
    return now() - begin


class LiveScene(ABC):
    """The library's bus and what it speaks to, as a context."""

    bus: Bus
    _life: asyncio.Task[None] | None = None

    until = staticmethod(until)

    @abstractmethod
    def step(self) -> None:
        """Bring the virtual devices up to now, and look at them."""

    async def live(self) -> None:
        """Let the virtual devices live."""
        while True:
            self.step()
            await asyncio.sleep(STEP)

    async def __aenter__(self) -> Self:
        self._life = asyncio.create_task(self.live())
        await self.bus.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.bus.stop()
        if self._life is not None:
            self._life.cancel()
            with suppress(asyncio.CancelledError):
                await self._life
