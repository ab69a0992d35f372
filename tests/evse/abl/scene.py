"""A virtual bus with ABL boxes, and the library's bus on the other end of it.

The oracle is the traffic on the wire (`writes`), not the state of the library.
"""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import Self

from custom_components.evse_bus.evse.abl import PROTOCOL, AblCharger, AblConfig
from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.model import CurrentLimit, Orders
from tests.virtual import AblBox, Car, Request, VirtualBus, requests_in

LIMIT = 0x14
STATE = 0x05
SETUP = 0x2C
READING = 0x2E
SERIAL = 0x50
WRITE = 0x10

PATIENCE = 10.0
FOREVER = 1e6


def config(
    address: int = 1,
    *,
    serial: str | None = None,
    installation_limit: float = 16,
    poll_interval: float = 0.01,
    order_lifetime: float | None = None,
) -> AblConfig:
    return AblConfig(
        key=f"box {address}",
        name=f"Box {address}",
        address=address,
        serial=serial,
        installation_limit=installation_limit,
        poll_interval=poll_interval,
        order_lifetime=order_lifetime,
    )


def orders(
    current: float = 16, *, allowed: bool | None = None, fail_safe: float = 6
) -> Orders:
    return Orders(
        limit=CurrentLimit(current=current),
        allowed=allowed,
        fail_safe=CurrentLimit(current=fail_safe),
    )


async def until(holds: Callable[[], object], patience: float = PATIENCE) -> None:
    """Wait until a condition holds."""
    async with asyncio.timeout(patience):
        while not holds():  # noqa: ASYNC110 - there is no event for it
            await asyncio.sleep(0.005)


class Scene:
    """The two ends of a bus, as a context."""

    def __init__(self, *boxes: AblBox, tcp: bool = False) -> None:
        make = VirtualBus.tcp if tcp else VirtualBus.in_loop
        self.virtual = make(*boxes, baud=38_400, parity="E")
        self.boxes = boxes
        self.bus: Bus

    async def __aenter__(self) -> Self:
        self.virtual.start()
        self.bus = PROTOCOL.bus(self.virtual.url)
        await self.bus.start()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.bus.stop()
        self.virtual.stop()

    def add(self, settings: AblConfig, wanted: Orders) -> AblCharger:
        """Put a charger on the bus."""
        charger = PROTOCOL.charger(settings, wanted)
        assert isinstance(charger, AblCharger)
        self.bus.add(charger)
        return charger

    async def settled(self, settings: AblConfig, wanted: Orders) -> AblCharger:
        """Put a charger on the bus; return after its first exchanges."""
        charger = self.add(settings, wanted)
        await until(lambda: charger.available and charger.info is not None)
        await self.polled(charger)
        return charger

    def resume_polls(self, charger: AblCharger) -> None:
        """Undo `stop_polls`."""
        charger._config = replace(charger.config, poll_interval=0.01)
        charger.slot.ready = 0
        self.bus.add(charger)

    async def stop_polls(self, charger: AblCharger) -> None:
        """Stop the polls: all traffic after this comes from commands."""
        charger._config = replace(charger.config, poll_interval=FOREVER)
        await until(lambda: charger.slot.ready > FOREVER)

    async def polled(
        self, charger: AblCharger, times: int = 2, patience: float = PATIENCE
    ) -> None:
        """Wait for polls that began after this call; a changed status is read twice."""
        reads = len(self.reads(charger.config.address)) + times
        await until(lambda: len(self.reads(charger.config.address)) >= reads, patience)
        await asyncio.sleep(0)

    def requests(self) -> list[Request]:
        """Return all requests on the wire."""
        return requests_in(self.virtual.log.bursts())

    def reads(self, address: int, register: int = READING) -> list[Request]:
        """Return the reads of a block."""
        return [
            one
            for one in self.requests()
            if one.device_id == address
            and one.register == register
            and one.function != WRITE
        ]

    def writes(self, register: int | None = None) -> list[int]:
        """Return the values written, oldest first."""
        return [
            one.value
            for one in self.requests()
            if one.value is not None and register in (None, one.register)
        ]


def sleepy() -> Car:
    """Return a car that is plugged in, may charge, and draws nothing."""
    car = Car(ramp=0.1, reaction=0.0)
    car.plug_in(request=False)
    return car


def box_with(car: Car | None = None, **settings: object) -> AblBox:
    return AblBox(1, car=car, boot_time=0.05, **settings)  # type: ignore[arg-type]


def answers(box: AblBox, *fates: str | bytes) -> None:
    """Set the fate of the next replies: good, lose, or other bytes instead."""
    for fate in fates:
        if fate == "good":
            box.faults.once("noise", b"")
        elif isinstance(fate, bytes):
            box.faults.once("replace", fate)
        else:
            box.faults.once("lose")
