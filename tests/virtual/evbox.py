"""A virtual EVBox ChargePoint (Protocol Max v4), written from the manual."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from .device import Device, on_bus_thread
from .evbox_frames import (
    CHARGEPOINT,
    SILENCE_TOLERANCE,
    SMARTGRID,
    FrameFinder,
    Order,
    ReceivedFrame,
    checked,
    frame,
    order,
    twin_errors,
    word,
)
from .log import CLIENT

if TYPE_CHECKING:
    from .car import Car
    from .wire import Segment

MAX_MODULES = 20
SILENCE = 0.1
INTERVAL_TOLERANCE = 0.05
IDLE_COS_PHI = 1.0
ANY_SERIAL = "00000000"
Three = tuple[float, float, float]


@dataclass
class Module:
    """One ChargeBox module: a connector with its own meter and perhaps a car."""

    car: Car | None = None
    min_current: float = 6.0
    energy_wh: float = 0.0
    voltages: Three = (230.0, 230.0, 230.0)
    # Values reported in place of the measured ones.
    currents: Three | None = None
    cos_phis: Three | None = None
    offered: float = 0.0

    def measured(self) -> tuple[Three, Three]:
        """Return currents and cos phi of the three phases."""
        currents = self.car.phase_currents if self.car else (0.0, 0.0, 0.0)
        phi = self.car.cos_phi if self.car else IDLE_COS_PHI
        one, two, three = (phi if i else IDLE_COS_PHI for i in currents)
        return self.currents or currents, self.cos_phis or (one, two, three)


@dataclass
class Distortion:
    """An implausible reply, with valid checksums."""

    module: int
    times: int | None
    current: Three | None = None
    cos_phi: Three | None = None
    voltage: Three | None = None
    energy_jump: float = 0.0


@dataclass
class Counters:
    """Counters of requests, by what became of them."""

    accepted: int = 0
    too_soon: int = 0
    bad_checksum: int = 0
    malformed: int = 0
    for_others: int = 0
    over_limit_requests: int = 0
    zero_timeouts: int = 0
    silence_violations: int = 0
    fail_backs: int = 0


@dataclass
class _Standing:
    """The order in force, and the time at which it was received."""

    limits: Three
    fallback: Three
    timeout: float
    since: float
    received_at: float = field(default=float("-inf"))


class EvboxChargePoint(Device):
    """A ChargePoint with up to 20 modules, which share its limit.

    - `orders`: every accepted order; `limits_in_force`, `failed_back`: the order now
    - `counters`: refused and malformed requests
    - `serial` can be set: another ChargePoint in its place
    - `min_interval` (s): reported in the reply, and enforced in real time
    - `ignore_limit`: takes orders without effect (a defect)
    - `too_soon_restarts`: a request within it begins it anew (no source settles that)
    """

    protocol: ClassVar[str] = "evbox"
    silence_rule: ClassVar[float] = SILENCE

    def __init__(
        self,
        serial: int | str = 1923054,
        modules: int | list[Module] = 1,
        *,
        max_current: float = 35.0,
        min_interval: int = 1,
        too_soon_restarts: bool = False,
        commands: frozenset[int] | set[int] = frozenset({68, 69}),
        turn_round: float = 0.0,
        jitter: float = 0.0002,
        name: str = "",
    ) -> None:
        """Make a ChargePoint; its limits are its maximum until an order comes."""
        self.serial = f"{int(serial):08d}"
        super().__init__(name or f"evbox-{int(serial)}")
        self.faults.twin = twin_errors
        if isinstance(modules, int):
            modules = [Module() for _ in range(modules)]
        self.modules = modules
        self.max_current = max_current
        self.min_interval = min_interval
        self.too_soon_restarts = too_soon_restarts
        self.commands = set(commands)
        self.turn_round = turn_round
        self.jitter = jitter
        self.counters = Counters()
        self.orders: list[Order] = []
        self.failed_back = False
        self.ignore_limit = False
        self._finder = FrameFinder()
        self._standing: _Standing | None = None
        self._distortions: list[Distortion] = []

    # For tests

    @property
    def limits_in_force(self) -> Three:
        """Return the limits in force, A per phase, never above the maximum.

        "Initially the maximum currents are equal to the maximum rating of the
        connection" (command 68, note **).
        """
        standing = self._standing
        if standing is None or self.ignore_limit:
            return (self.max_current,) * 3
        return self._capped(standing.fallback if self.failed_back else standing.limits)

    @property
    def silence_violations(self) -> int:
        """Return the number of requests to it without the required silence before."""
        return self.counters.silence_violations

    @property
    def over_limit_requests(self) -> int:
        """Return the number of orders above the maximum of the connection."""
        return self.counters.over_limit_requests

    def distort(
        self,
        module: int = 0,
        *,
        times: int | None = 1,
        current: float | None = None,
        cos_phi: float | None = None,
        voltage: float | None = None,
        energy_jump: float = 0.0,
    ) -> None:
        """Report implausible values in the next `times` replies (None: all).

        The energy jump (Wh) is added to the reported total, not to the meter.
        """
        self._distortions.append(
            Distortion(
                module,
                times,
                _three(current),
                _three(cos_phi),
                _three(voltage),
                energy_jump,
            )
        )

    def undistort(self) -> None:
        """Report measured values again."""
        self._distortions.clear()

    @on_bus_thread
    def add_module(
        self, module: Module | None = None, index: int | None = None
    ) -> None:
        """Add a module, at the end or at an index."""
        if len(self.modules) >= MAX_MODULES:
            msg = f"a ChargePoint has at most {MAX_MODULES} modules"
            raise ValueError(msg)
        self.modules.insert(
            len(self.modules) if index is None else index, module or Module()
        )

    @on_bus_thread
    def remove_module(self, index: int = -1) -> Module:
        """Remove a module; those behind it move up."""
        return self.modules.pop(index)

    @on_bus_thread
    def power_cycle(self) -> None:
        """Lose the order in force."""
        self._standing = None
        self.failed_back = False

    def stats(self) -> dict[str, object]:
        """Return the counters."""
        return {**super().stats(), **vars(self.counters)}

    # On the bus

    def receive(self, segment: Segment) -> None:
        """Receive bytes; reply to a request addressed to this box."""
        for received in self._finder.feed(segment):
            self._receive_frame(received)

    def step(self) -> None:
        """Time out, share the limit among the modules, advance the cars."""
        now = self.now()
        standing = self._standing
        if (
            standing is not None
            and not self.failed_back
            and now - standing.since >= standing.timeout
        ):
            self._step_modules(standing.since + standing.timeout)
            self.failed_back = True
            self.counters.fail_backs += 1
        self._step_modules(now)

    def _receive_frame(self, received: ReceivedFrame) -> None:
        body = checked(received.text)
        if body is None:
            if received.source == CLIENT:
                self.counters.bad_checksum += 1
            return
        if body[:2] != CHARGEPOINT:
            self.counters.for_others += 1
            return
        request = order(body, received.end)
        if request is None:
            self.counters.malformed += 1
            return
        if request.command not in self.commands:
            return
        if request.serial not in (None, self.serial, ANY_SERIAL):
            self.counters.for_others += 1
            return
        self.requests += 1
        if received.silence < SILENCE - SILENCE_TOLERANCE and received.source == CLIENT:
            self.counters.silence_violations += 1
        last = self._standing.received_at if self._standing else float("-inf")
        if received.end - last < self.min_interval - INTERVAL_TOLERANCE:
            self.counters.too_soon += 1
            if self._standing and self.too_soon_restarts:
                self._standing.received_at = received.end
            return
        self._accept(request)

    def _accept(self, request: Order) -> None:
        self.step()
        self.counters.accepted += 1
        self.orders.append(request)
        if max(request.limits + request.fallback) > self.max_current:
            self.counters.over_limit_requests += 1
        if not request.timeout:
            self.counters.zero_timeouts += 1
        self._standing = _Standing(
            request.limits,
            request.fallback,
            float(request.timeout),
            self.now(),
            request.t,
        )
        self.failed_back = False
        self.step()
        jitter = self.bus.rng.random() * self.jitter if self.bus else 0.0
        # The silence counts from the end of the request, so it is the least wait.
        self.send(frame(self._reply(request)), self.turn_round, SILENCE + jitter)

    def _reply(self, request: Order) -> str:
        parts = [SMARTGRID, CHARGEPOINT, f"{request.command:02d}"]
        long = request.command == 68
        if long:
            parts.append(self.serial)
        parts += [word(self.min_interval), word(self.max_current * 10)]
        parts.append(f"{len(self.modules):02X}")
        for index, module in enumerate(self.modules):
            currents, cos_phis = module.measured()
            energy, voltages = module.energy_wh, module.voltages
            for distortion in self._distortions:
                if distortion.module == index:
                    currents = distortion.current or currents
                    cos_phis = distortion.cos_phi or cos_phis
                    voltages = distortion.voltage or voltages
                    energy += distortion.energy_jump
            parts.append(word(module.min_current * 10))
            parts += [word(current * 10) for current in currents]
            parts += [word(phi * 1000) for phi in cos_phis]
            parts.append(f"{int(energy) & 0xFFFFFFFF:08X}")
            if long:
                parts += [word(voltage) for voltage in voltages]
        for distortion in tuple(self._distortions):
            if distortion.times is not None:
                distortion.times -= 1
                if distortion.times <= 0:
                    self._distortions.remove(distortion)
        return "".join(parts)

    def _step_modules(self, now: float) -> None:
        self._share()
        for module in self.modules:
            if module.car is not None:
                module.energy_wh += module.car.step(
                    now, module.offered, module.voltages[0]
                )

    def _share(self) -> None:
        """Share the limit: equal parts, and none below a module's minimum.

        If it is not enough for all, the last module gets nothing; the manual does not
        define which one.
        """
        limits = self.limits_in_force
        asking = []
        for module in self.modules:
            module.offered = 0.0
            if module.car is not None and module.car.accepts(self.max_current):
                asking.append((module, module.car.uses))
        while asking:
            users = [0, 0, 0]
            for _, uses in asking:
                for phase in uses:
                    users[phase] += 1
            shares = [min(limits[p] / users[p] for p in uses) for _, uses in asking]
            starved = [
                index
                for index, share in enumerate(shares)
                if share < asking[index][0].min_current
            ]
            if not starved:
                for (module, _), share in zip(asking, shares, strict=True):
                    module.offered = share
                return
            del asking[starved[-1]]

    def _capped(self, limits: Three) -> Three:
        one, two, three = (min(limit, self.max_current) for limit in limits)
        return one, two, three


def _three(value: float | None) -> Three | None:
    return None if value is None else (value,) * 3
