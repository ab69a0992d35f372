"""Virtual ChargePoints on a wire in simulated time.

The ChargePoints are those of `tests.virtual`: they check requests by the manual, share
no code with the library, and take their time from this wire.
"""

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from random import Random
from typing import Self, override

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.errors import LineLostError
from custom_components.evse_bus.evse.evbox import PROTOCOL, EvboxCharger, EvboxConfig
from custom_components.evse_bus.evse.evbox.frames import EvboxFramer
from custom_components.evse_bus.evse.line import Line
from custom_components.evse_bus.evse.model import CurrentLimit, Orders
from tests.simulated_time import now
from tests.virtual import CLIENT, EvboxChargePoint, Faults, Order
from tests.virtual.evbox_frames import checked, order
from tests.virtual.wire import Segment

FOREIGN = "foreign"


@dataclass(frozen=True, slots=True)
class Sent:
    """A request that the library sent."""

    at: float
    """Loop time at which the last byte had left, s."""
    order: Order


class Ether(Line):
    """A wire with ChargePoints; for these it stands in for their bus."""

    def __init__(self, *points: EvboxChargePoint) -> None:
        super().__init__("ether", PROTOCOL.settings)
        self.points: list[EvboxChargePoint] = []
        for point in points:
            self.join(point)
        self.sent: list[Sent] = []
        self.faults = Faults()
        self.rng = Random(1)  # noqa: S311 - repeatable on purpose
        self.byte_time = self.settings.byte_time
        self.damage: Callable[[bytes], bytes] = lambda data: data
        """Changes bytes on their way to the library."""
        self.watch: Callable[[Order], None] = lambda _order: None
        """Called with each request at the moment it is sent."""
        self._open = False
        self._idle_from = -1000.0

    def join(self, point: EvboxChargePoint) -> None:
        point.bus = self  # type: ignore[assignment]
        self.points.append(point)

    # -- The library's end

    @property
    @override
    def is_open(self) -> bool:
        return self._open

    @override
    async def open(self) -> None:
        self._open = True
        self.last_activity = now()

    @override
    async def close(self) -> None:
        self._open = False

    def unplug(self) -> None:
        self._open = False
        self.on_lost(LineLostError("unplugged"))

    @override
    def write(self, data: bytes, *, reply_may_equal: bool = False) -> float:
        end = now() + len(data) * self.byte_time
        body = checked(data[1:-1].decode())
        assert body is not None, "wrong checksums"
        request = order(body, end)
        assert request is not None, "not a request of the manual"
        self.watch(request)
        self.sent.append(Sent(end, request))
        self._put(data, CLIENT)
        self.last_activity = end
        return end

    # -- The wire

    def _put(self, data: bytes, source: str) -> None:
        start = now()
        silence = start - self._idle_from
        self._idle_from = start + len(data) * self.byte_time
        segment = Segment(start, self.byte_time, data, (source,), silence)
        asyncio.get_running_loop().call_at(self._idle_from, self._deliver, segment)

    def _deliver(self, segment: Segment) -> None:
        (source,) = segment.sources
        if source != CLIENT and self._open:
            self.last_activity = max(self.last_activity, now())
            self.on_data(self.damage(segment.data))
        for point in self.points:
            if point.name != source and not point.faults.dead:
                point.receive(segment)

    def foreign(self, data: bytes) -> None:
        """Send bytes of another station now."""
        self._put(data, FOREIGN)

    # -- The part of a bus that a ChargePoint uses

    def time(self) -> float:
        return now()

    now = time

    def call[T](self, function: Callable[[], T]) -> T:
        return function()

    def send_after_silence(
        self, device: EvboxChargePoint, data: bytes, at: float, silence: float
    ) -> None:
        start = max(at, self._idle_from + silence)
        if start <= now() + 1e-9:
            self._put(data, device.name)
            return
        asyncio.get_running_loop().call_at(
            start, self.send_after_silence, device, data, at, silence
        )

    # -- For assertions

    @property
    def orders(self) -> list[Order]:
        return [sent.order for sent in self.sent]

    def pauses(self) -> list[float]:
        times = [sent.at for sent in self.sent]
        return [later - one for one, later in pairwise(times)]


ORDERS = Orders(limit=CurrentLimit(current=16.0))


@dataclass
class Scene:
    """A bus in simulated time with one or more ChargePoints."""

    ether: Ether
    bus: Bus

    @classmethod
    def of(cls, *points: EvboxChargePoint) -> Scene:
        ether = Ether(*points)
        return cls(ether, Bus(ether, EvboxFramer(), PROTOCOL.timing, "ether"))

    def add(
        self, address: int = 1923054, orders: Orders = ORDERS, **values: object
    ) -> EvboxCharger:
        config = EvboxConfig(
            key=str(len(self.bus.chargers)),
            name=f"box {address}",
            address=address,
            installation_limit=32.0,
        )
        charger = EvboxCharger(replace(config, **values), orders)  # type: ignore[arg-type]
        self.bus.add(charger)
        return charger

    async def __aenter__(self) -> Self:
        await self.bus.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.bus.stop()
        for point in self.ether.points:
            assert point.counters.silence_violations == 0
            assert point.counters.bad_checksum == 0
            assert point.counters.malformed == 0
            assert point.counters.zero_timeouts == 0


async def until(condition: Callable[[], object], limit: float = 300.0) -> None:
    """Wait in simulated time until a condition is true."""
    end = now() + limit
    while not condition():
        assert now() < end, "it did not happen"
        await asyncio.sleep(0.01)


@contextmanager
def updates(charger: EvboxCharger) -> Iterator[list[int]]:
    """Count the calls of a listener."""
    calls: list[int] = []
    stop = charger.subscribe(lambda: calls.append(1))
    yield calls
    stop()
