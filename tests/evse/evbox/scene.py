"""Virtual ChargePoints on a wire in simulated time.

The ChargePoints are those of `tests.virtual`: they check requests by the manual, share
no code with the library, and take their time from this wire.
"""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self, override

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.evbox import PROTOCOL, EvboxCharger, EvboxConfig
from custom_components.evse_bus.evse.evbox.frames import EvboxFramer
from custom_components.evse_bus.evse.model import CurrentLimit, Orders
from tests.evse.simulated_line import SimulatedLine
from tests.simulated_time import now
from tests.virtual import CLIENT, EvboxChargePoint, Order
from tests.virtual.evbox_frames import checked, order
from tests.virtual.wire import Segment

FOREIGN = "foreign"


@dataclass(frozen=True, slots=True)
class Sent:
    """A request that the library sent."""

    at: float
    """Loop time at which the last byte had left, s."""
    order: Order


class EvboxLine(SimulatedLine[Sent]):
    """A wire with ChargePoints."""

    def __init__(self, *points: EvboxChargePoint) -> None:
        super().__init__(PROTOCOL.settings)
        self.points: list[EvboxChargePoint] = []
        for point in points:
            self.join(point)
        self._idle_from = -1000.0

    def join(self, point: EvboxChargePoint) -> None:
        point.bus = self  # type: ignore[assignment]
        self.points.append(point)

    @override
    def record(self, data: bytes, end: float) -> Sent:
        body = checked(data[1:-1].decode())
        assert body is not None, "wrong checksums"
        request = order(body, end)
        assert request is not None, "not a request of the manual"
        return Sent(end, request)

    @override
    def carry(self, data: bytes, end: float) -> None:
        self._put(data, CLIENT)

    def _put(self, data: bytes, source: str) -> None:
        start = now()
        silence = start - self._idle_from
        self._idle_from = start + len(data) * self.byte_time
        segment = Segment(start, self.byte_time, data, (source,), silence)
        asyncio.get_running_loop().call_at(self._idle_from, self._deliver, segment)

    def _deliver(self, segment: Segment) -> None:
        (source,) = segment.sources
        if source != CLIENT:
            self.hear(segment.data)
        for point in self.points:
            if point.name != source and not point.faults.dead:
                point.receive(segment)

    def foreign(self, data: bytes) -> None:
        """Send bytes of another station now."""
        self._put(data, FOREIGN)

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

    line: EvboxLine
    bus: Bus

    @classmethod
    def of(cls, *points: EvboxChargePoint) -> Scene:
        line = EvboxLine(*points)
        return cls(line, Bus(line, EvboxFramer(), PROTOCOL.timing, "simulated"))

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
        for point in self.line.points:
            assert point.counters.silence_violations == 0
            assert point.counters.bad_checksum == 0
            assert point.counters.malformed == 0
            assert point.counters.zero_timeouts == 0


@contextmanager
def updates(charger: EvboxCharger) -> Iterator[list[int]]:
    """Count the calls of a listener."""
    calls: list[int] = []
    stop = charger.subscribe(lambda: calls.append(1))
    yield calls
    stop()
