"""Base class of all virtual devices."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, ClassVar, ParamSpec, TypeVar

from .faults import Faults

if TYPE_CHECKING:
    from collections.abc import Callable

    from .bus import VirtualBus
    from .wire import Segment

P = ParamSpec("P")
R = TypeVar("R")

# Pause between two messages of one device, s.
REPEAT_GAP = 0.001


def on_bus_thread(method: Callable[P, R]) -> Callable[P, R]:  # noqa: UP047 - runs on 3.11
    """Make a device's method safe to call from any thread."""

    @functools.wraps(method)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        device = args[0]
        bus = device.bus  # type: ignore[attr-defined]
        if bus is None:
            return method(*args, **kwargs)
        return bus.call(lambda: method(*args, **kwargs))

    return wrapper


class Device:
    """A device on the bus: receives bytes, keeps state, may reply."""

    baud: ClassVar[int] = 38400
    parity: ClassVar[str] = "N"
    protocol: ClassVar[str] = "device"
    # The silence that the protocol requires before each request, s.
    silence_rule: ClassVar[float] = 0.0
    # One wire for each direction (RS-232), or one for both (RS-485).
    duplex: ClassVar[bool] = False

    def __init__(self, name: str) -> None:
        """Make a device; the bus makes its name unique."""
        self.name = name
        self.bus: VirtualBus | None = None
        self.faults = Faults()
        self.requests = 0
        self.replies = 0

    def now(self) -> float:
        """Return the device's time, s; faster than real time if scaled."""
        return self.bus.now() if self.bus is not None else 0.0

    def receive(self, segment: Segment) -> None:
        """Receive bytes of another sender (on the bus thread)."""

    def step(self) -> None:
        """Bring the device's state up to now (on the bus thread)."""

    def stats(self) -> dict[str, object]:
        """Return counters for a summary."""
        return {"requests": self.requests, "replies": self.replies}

    def send(self, data: bytes, turn_round: float, silence: float = 0.0) -> None:
        """Send a reply after the turn-round time, and after that much silence (s).

        The faults of the device and of the bus are applied to it.
        """
        bus = self.bus
        if bus is None:
            return
        out = [(0.0, data)]
        for faults in (self.faults, bus.faults):
            out = faults.apply(out, bus.rng)
        at = bus.time() + turn_round
        for delay, reply in out:
            disturbed = self.faults.disturb(reply, bus.rng)
            self.replies += 1
            if silence:
                bus.send_after_silence(self, disturbed, at + delay, silence)
            else:
                bus.send_at(self, disturbed, at + delay)
            at += len(disturbed) * bus.byte_time + REPEAT_GAP
