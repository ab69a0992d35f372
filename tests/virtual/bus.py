"""The virtual bus: devices, wire, the client's port, and the thread they run on."""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING

from .adapter import Adapter
from .device import REPEAT_GAP
from .faults import Faults
from .log import CLIENT, INJECTED, NOISE, Entry, TrafficLog
from .loop import LoopThread
from .ports import DirectPort, Port, PtyPort, TcpPort
from .wire import Wire

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable
    from types import TracebackType
    from typing import Self

    from .device import Device
    from .ports import Answer
    from .wire import Segment

TICK = 0.05
ADVANCE_STEP = 0.25
ADVANCE_STEPS = 200
NO_PARITY_BITS = 10
PARITY_BITS = 11


class VirtualBus(LoopThread):
    """An RS-485 bus with virtual devices on one end and a port on the other.

    - `url`: the path or URL that a client opens
    - `log`: all traffic
    - `faults`: faults of the whole bus
    - `adapter`: what lies between the client and the wire
    - `devices`: all devices on it

    Every method can be called from any thread.
    """

    def __init__(
        self,
        devices: tuple[Device, ...],
        make_port: Callable[[VirtualBus], Port],
        *,
        baud: int | None = None,
        parity: str | None = None,
        time_scale: float = 1.0,
        granularity: float = 0.002,
        seed: int = 0,
        ring: int | None = 20_000,
        own_thread: bool = True,
        tick: float = TICK,
    ) -> None:
        """Prepare a bus; `start` or `with` starts it.

        `tick`: seconds between two steps of the devices, beside those for a request.
        """
        super().__init__("virtual-bus", own_thread=own_thread)
        lines = {(d.baud, d.parity) for d in devices} or {(38400, "N")}
        if len(lines) > 1 and (baud is None or parity is None):
            msg = "devices of different line settings on one bus: set baud and parity"
            raise ValueError(msg)
        line = next(iter(lines))
        self.baud = baud or line[0]
        self.parity = parity or line[1]
        bits = NO_PARITY_BITS if self.parity == "N" else PARITY_BITS
        self.byte_time = bits / self.baud
        self.rng = random.Random(seed)  # noqa: S311 - repeatable on purpose
        self.faults = Faults()
        self.log = TrafficLog(ring)
        self.devices: list[Device] = []
        self.wire = Wire(
            self.byte_time,
            granularity,
            self.faults,
            self.rng,
            duplex=any(device.duplex for device in devices),
        )
        self._make_port = make_port
        self._port: Port | None = None
        self.adapter = Adapter(
            self.rng, self.wire.send_client, lambda: self._port, lambda: self.loop
        )
        self._url = ""
        self._plugged = False
        self._tick_time = tick
        self._ticker: asyncio.TimerHandle | None = None
        self._foreign: list[asyncio.TimerHandle] = []
        self._scale = time_scale
        self._device_time = 0.0
        self._real_time = 0.0
        for device in devices:
            self._add(device)

    @classmethod
    def pty(
        cls,
        *devices: Device,
        link: str | None = None,
        **options: float | str | None,
    ) -> VirtualBus:
        """Make a bus on a pseudo-terminal; `link` is its stable path."""

        def make(bus: VirtualBus) -> Port:
            return PtyPort(bus.loop, bus.adapter.from_client, link)

        return cls(devices, make, **options)  # type: ignore[arg-type]

    @classmethod
    def tcp(
        cls, *devices: Device, port: int = 0, **options: float | str | None
    ) -> VirtualBus:
        """Make a bus on a TCP socket of this machine."""

        def make(bus: VirtualBus) -> Port:
            return TcpPort(bus.loop, bus.adapter.from_client, port)

        return cls(devices, make, **options)  # type: ignore[arg-type]

    @classmethod
    def in_loop(
        cls, *devices: Device, network: bool = False, **options: float | str | None
    ) -> VirtualBus:
        """Make a bus on the running loop, on a `DirectPort`.

        `network`: its URL is that of a TCP port.
        """

        def make(bus: VirtualBus) -> Port:
            return DirectPort(bus.adapter.from_client, network=network)

        return cls(devices, make, own_thread=False, **options)  # type: ignore[arg-type]

    # Life

    def start(self) -> Self:
        """Start the thread and make the port appear."""
        self.start_thread()
        try:
            self.call(self._start)
        except BaseException:
            self.stop_thread()
            raise
        return self

    def stop(self) -> None:
        """Remove the port and end the thread; raise RuntimeError for an error inside."""
        if self.running:
            self.call(self._stop)
            self.stop_thread()
        if self.errors:
            msg = "an error inside the virtual bus"
            raise RuntimeError(msg) from self.errors[0]

    def __enter__(self) -> Self:
        """Start."""
        return self.start()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop."""
        self.stop()

    async def __aenter__(self) -> Self:
        """Start; it takes some milliseconds."""
        return self.start()

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop; it takes some milliseconds."""
        self.stop()

    # The client's end

    @property
    def url(self) -> str:
        """Return the path or URL that a client opens, the same after a replug."""
        return self._url

    @property
    def connected(self) -> bool:
        """Return whether a client has the port open."""
        return self._port is not None and self._port.connected

    @property
    def opened(self) -> int:
        """Return how often a client has opened the port."""
        return self._port.opened if self._port is not None else 0

    def unplug(self) -> None:
        """Pull the adapter: the client loses the port, the path disappears."""
        self.call(self._unplug)

    def replug(self) -> None:
        """Put the adapter back, behind the same path or port number."""
        self.call(self._replug)

    def answer_calls(self, how: Answer) -> None:
        """Accept, refuse or ignore connections from now on (a network adapter)."""

        def change() -> None:
            if self._port is not None:
                self._port.answer(how)

        self.call(change)

    # Time

    def time(self) -> float:
        """Return the real time of the wire, s."""
        return self.loop.time()

    def now(self) -> float:
        """Return the devices' time: real time times `time_scale`."""
        if not self.running:
            return self._device_time
        return self._device_time + (self.time() - self._real_time) * self._scale

    @property
    def time_scale(self) -> float:
        """Return the ratio of the devices' time to real time."""
        return self._scale

    @time_scale.setter
    def time_scale(self, scale: float) -> None:
        """Change the pace of the devices' time (never that of the wire)."""

        def change() -> None:
            self._device_time = self.now()
            self._real_time = self.time()
            self._scale = scale

        self.call(change)

    def advance(self, seconds: float) -> None:
        """Advance the devices' time at once, in small steps."""

        def jump() -> None:
            self._step_devices()
            steps = max(1, min(ADVANCE_STEPS, math.ceil(seconds / ADVANCE_STEP)))
            for _ in range(steps):
                self._device_time += seconds / steps
                self._step_devices()

        self.call(jump)

    # Devices and other traffic

    def add(self, device: Device) -> None:
        """Connect one more device."""
        self.call(lambda: self._add(device))

    def remove(self, device: Device) -> None:
        """Disconnect a device."""

        def remove() -> None:
            self.devices.remove(device)
            device.bus = None

        self.call(remove)

    def inject(
        self, data: bytes, *, after: float = 0.0, source: str = INJECTED
    ) -> None:
        """Put bytes of another sender on the wire, `after` seconds from now."""
        self.call(lambda: self.wire.send(source, data, self.time() + after))

    def foreign_traffic(
        self, data: bytes, every: float, *, polite: float = 0.0
    ) -> None:
        """Let another master send `data` periodically, until `quiet`.

        With `polite` it sends only after that much silence (s), else at any time.
        """

        def send(index: int) -> None:
            self._foreign[index] = self.loop.call_later(every, send, index)
            start = self.time()
            if polite and start - self.wire.idle_from < polite:
                return
            self.wire.send(INJECTED, data, start)

        def begin() -> None:
            index = len(self._foreign)
            self._foreign.append(self.loop.call_later(every, send, index))

        self.call(begin)

    def quiet(self) -> None:
        """End the traffic of all other masters."""

        def end() -> None:
            for timer in self._foreign:
                timer.cancel()

        self.call(end)

    def stats(self) -> dict[str, object]:
        """Return the counters of the bus and its devices."""

        def collect() -> dict[str, object]:
            return {
                "url": self.url,
                "opened": self.opened,
                "transmissions": self.log.total,
                "bytes": self.wire.bytes_carried,
                "collisions": self.wire.collisions,
                "overruns": self._port.overruns if self._port else 0,
                "faults": dict(self.faults.happened),
                "devices": {d.name: d.stats() for d in self.devices},
            }

        return self.call(collect)

    # For devices, on the bus thread

    def send_at(self, device: Device, data: bytes, at: float) -> None:
        """Send at that time, even if the wire is in use."""
        if at <= self.time():
            self._send_due(device, data)
        else:
            self.loop.call_at(at, self._send_due, device, data)

    def send_after_silence(
        self, device: Device, data: bytes, at: float, silence: float
    ) -> None:
        """Send at that time or later, once the wire has been silent for so long."""
        now = self.time()
        free_at = self.wire.audible_until(now) + silence
        if max(at, free_at) <= now:
            self._send_due(device, data)
            return
        self.loop.call_at(
            max(at, free_at), self.send_after_silence, device, data, at, silence
        )

    # Inside

    def _add(self, device: Device) -> None:
        names = {d.name for d in self.devices}
        name, number = device.name, 1
        while device.name in names:
            number += 1
            device.name = f"{name}#{number}"
        device.bus = self
        self.devices.append(device)

    def _start(self) -> None:
        self._real_time = self.time()
        self.wire.attach(self.loop, self._to_client, self._to_devices, self._logged)
        self._port = self._make_port(self)
        self._replug()
        self._url = self._port.url
        self._tick()

    def _stop(self) -> None:
        self._device_time = self.now()
        if self._ticker is not None:
            self._ticker.cancel()
        for timer in self._foreign:
            timer.cancel()
        self.wire.drop_pending()
        self.adapter.stop()
        if self._port is not None:
            self._port.close()

    def _unplug(self) -> None:
        if self._port is not None:
            self._port.unplug()
        self._plugged = False

    def _replug(self) -> None:
        if self._port is not None:
            self._port.plug()
        self._plugged = True

    def _tick(self) -> None:
        self._ticker = self.loop.call_later(self._tick_time, self._tick)
        self._step_devices()
        rate = self.faults.noise_rate
        if rate and self.rng.random() < rate * self._tick_time:
            after = self.rng.random() * self._tick_time
            data = bytes((self.rng.randrange(256),))
            self.wire.send(NOISE, data, self.time() + after)
        self.check_waiters()

    def _step_devices(self) -> None:
        for device in self.devices:
            device.step()

    def _send_due(self, device: Device, data: bytes) -> None:
        if device.bus is not self:
            return
        # Timers may be late: a device never sends over its own bytes.
        free_at = self.wire.free_from(device.name) + REPEAT_GAP
        self.wire.send(device.name, data, max(self.time(), free_at))

    def _to_client(self, data: bytes) -> None:
        self.adapter.to_client(data)

    def _to_devices(self, segments: list[Segment]) -> None:
        for segment in segments:
            if segment.sources == (CLIENT,) and not self._plugged:
                continue
            for device in tuple(self.devices):
                if device.name in segment.sources or device.faults.dead:
                    continue
                if not self.faults.dead:
                    device.receive(segment)
        self.check_waiters()

    def _logged(self, entry: Entry) -> None:
        self.log.add(entry)
        if entry.source != CLIENT and self._port is not None:
            self._port.after_reply()
