"""Buses for the benchmarks, set up with the library alone."""

import asyncio
from collections.abc import Iterable
from typing import Final

from custom_components.evse_bus.evse.abl import PROTOCOL as ABL, AblConfig
from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.evbox import PROTOCOL as EVBOX, EvboxConfig
from custom_components.evse_bus.evse.ews import PROTOCOL as EWS, EwsPortConfig
from custom_components.evse_bus.evse.framing import LineSettings
from custom_components.evse_bus.evse.model import (
    Circuit,
    CurrentLimit,
    Orders,
)
from custom_components.evse_bus.evse.smartevse import (
    MASTER,
    POLLED,
    PolledConfig,
    SlaveConfig,
)

from .oracle import LoggedFrame

ABL_LIMIT: Final = 16.0
EVBOX_LIMIT: Final = 320.0
"""A for a ChargePoint of 20 modules."""
EWS_LIMIT: Final = 16.0
SMARTEVSE_LIMIT: Final = 16.0
SETTLED_AFTER: Final = 1.5
"""Time without a time-out after which all boxes are known, s."""
SETTLES_WITHIN: Final = 60.0

READING_REQUEST: Final = b"03002E0005"
"""The bytes after the device-ID in a regular read of an ABL box."""
LIMIT_REQUEST: Final = b"100014"
"""The bytes after the device-ID in a write of the limit of an ABL box."""


def abl_bus(
    url: str,
    ids: Iterable[int],
    *,
    poll_interval: float = 0.0,
    settings: LineSettings | None = None,
) -> Bus:
    """Return a bus with wallboxes that are polled without pause."""
    bus = ABL.bus(url, settings=settings)
    for number in ids:
        config = AblConfig(
            key=f"abl-{number}",
            name=f"ABL {number}",
            address=number,
            installation_limit=ABL_LIMIT,
            poll_interval=poll_interval,
        )
        orders = Orders(limit=CurrentLimit(current=ABL_LIMIT))
        bus.add(ABL.charger(config, orders))
    return bus


def evbox_bus(url: str, serials: Iterable[int], *, period: float, timeout: int) -> Bus:
    """Return a bus with ChargePoints."""
    bus = EVBOX.bus(url)
    for serial in serials:
        config = EvboxConfig(
            key=f"evbox-{serial}",
            name=f"EVBox {serial}",
            address=serial,
            serial=f"{serial:08d}",
            installation_limit=EVBOX_LIMIT,
            poll_interval=period,
        )
        limit = CurrentLimit(current=EVBOX_LIMIT)
        orders = Orders(limit=limit, fail_safe=limit, fail_safe_timeout=timeout)
        bus.add(EVBOX.charger(config, orders))
    return bus


def ews_bus(url: str, ports: Iterable[int], *, poll_interval: float) -> Bus:
    """Return the bus of an EWS-Box, with these ports."""
    bus = EWS.bus(url)
    for port in ports:
        config = EwsPortConfig(
            key=f"ews-{port}",
            name=f"EWS-Box {port}",
            address=port,
            installation_limit=EWS_LIMIT,
            poll_interval=poll_interval,
        )
        bus.add(EWS.charger(config, Orders(limit=CurrentLimit(current=EWS_LIMIT))))
    return bus


def smartevse_bus(url: str, unit: int) -> Bus:
    """Return a bus with one SmartEVSE that is polled."""
    bus = POLLED.bus(url)
    config = PolledConfig(
        key=f"smartevse-{unit}",
        name=f"SmartEVSE {unit}",
        address=unit,
        installation_limit=SMARTEVSE_LIMIT,
    )
    bus.add(POLLED.charger(config, _smartevse_orders()))
    return bus


def master_bus(url: str, units: Iterable[int], supply: float) -> Bus:
    """Return a bus with slaves that share a supply (A)."""
    bus = MASTER.bus(url, circuit=Circuit(limit=supply))
    for unit in units:
        config = SlaveConfig(
            key=f"smartevse-{unit}",
            name=f"SmartEVSE {unit}",
            address=unit,
            installation_limit=SMARTEVSE_LIMIT,
        )
        bus.add(MASTER.charger(config, _smartevse_orders()))
    return bus


def _smartevse_orders() -> Orders:
    return Orders(limit=CurrentLimit(current=SMARTEVSE_LIMIT), allowed=True)


async def settled(bus: Bus, dead: Iterable[str] = ()) -> None:
    """Wait until the chargers that answer are known and the dead ones unavailable."""
    gone = set(dead)
    statistics = bus.wire.statistics
    loop = asyncio.get_running_loop()
    timeouts, since = -1, loop.time()
    async with asyncio.timeout(SETTLES_WITHIN):
        while True:
            if statistics.timeouts != timeouts and not gone:
                timeouts, since = statistics.timeouts, loop.time()
            if loop.time() - since >= SETTLED_AFTER and all(
                _is_given_up(one) if key in gone else one.available
                for key, one in bus.chargers.items()
            ):
                return
            await asyncio.sleep(0.1)


def _is_given_up(charger: Charger) -> bool:
    return charger.misses >= charger.timing.misses


def unit_of(request: LoggedFrame) -> int:
    """Return the device-ID of an ABL request."""
    return int(request.data[1:3], 16)


def starts_of(log: Iterable[LoggedFrame], unit: int, kind: bytes) -> list[float]:
    """Return the start times of requests of a kind to a box."""
    return [
        frame.start
        for frame in log
        if frame.from_client and unit_of(frame) == unit and frame.data[3:13] == kind
    ]
