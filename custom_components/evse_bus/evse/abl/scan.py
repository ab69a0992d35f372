"""Scan for ABL wallboxes at device-IDs 1 to 16; nothing is written."""

import asyncio
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from ..bus import Bus
from ..errors import GarbledReplyError, LineBusyError, ReplyTimeoutError
from ..exchange import Turn
from ..model import ChargerConfig, Orders
from ..protocol import Progress
from ..readings import ChargerInfo
from ..scan import FoundCharger, ScanResult
from .exchanges import collect
from .readings import charger_info
from .registers import (
    ADDRESSES,
    INFO,
    SERIAL,
    Serial,
)

ATTEMPTS: Final = 2
"""Requests to a silent device-ID: a box asleep loses the first one."""
NOISY_ATTEMPTS: Final = 4
"""Requests where a reply was unreadable or the line was busy."""
REPEAT_PAUSE: Final = 0.6
"""Pause between two requests to one device-ID, s; others are scanned meanwhile."""
MOST_DUPLICATES: Final = 2
"""More unreadable device-IDs than these are no collisions, but wrong line settings."""


@dataclass(slots=True)
class _Candidate:
    """One device-ID and the outcome of the requests to it."""

    address: int
    ready: float = 0.0
    """Loop time of the next request, s; not before."""
    silent: int = 0
    garbled: int = 0
    busy: int = 0
    found: FoundCharger | None = None

    @property
    def done(self) -> bool:
        """Return whether another request would change nothing."""
        if self.found is not None or self.silent >= ATTEMPTS:
            return True
        return self.silent + self.garbled + self.busy >= NOISY_ATTEMPTS


@dataclass(slots=True)
class _Scan:
    """One scan of all device-IDs."""

    bus: Bus
    waiting: deque[_Candidate] = field(
        default_factory=lambda: deque(_Candidate(address) for address in ADDRESSES)
    )
    scanned: list[_Candidate] = field(default_factory=list)

    async def run(self, progress: Progress) -> ScanResult:
        """Send a request to one device-ID after the other, to silent ones again."""
        loop = asyncio.get_running_loop()
        while self.waiting:
            progress(len(self.scanned) / len(ADDRESSES))
            one = min(self.waiting, key=lambda one: max(one.ready, loop.time()))
            if (pause := one.ready - loop.time()) > 0:
                await asyncio.sleep(pause)
            await self._scan(one)
            one.ready = loop.time() + REPEAT_PAUSE
            if one.done:
                self.waiting.remove(one)
                self.scanned.append(one)
        progress(1.0)
        return self._result()

    async def _scan(self, one: _Candidate) -> None:
        try:
            info = await self.bus.run(partial(_read_info, one.address))
            one.found = FoundCharger(address=one.address, info=info, serial=info.serial)
        except GarbledReplyError:
            one.garbled += 1
        except ReplyTimeoutError:
            one.silent += 1
        except LineBusyError:
            one.busy += 1

    def _result(self) -> ScanResult:
        self.scanned.sort(key=lambda one: one.address)
        found = tuple(one.found for one in self.scanned if one.found is not None)
        garbled = tuple(
            one.address
            for one in self.scanned
            if one.found is None and one.garbled >= ATTEMPTS
        )
        if not found and len(garbled) > MOST_DUPLICATES:
            return ScanResult(unreadable=True)
        return ScanResult(found=found, duplicates=garbled)


async def _read_info(address: int, turn: Turn) -> ChargerInfo:
    """Return identity and options of the box at a device-ID.

    The replies of two equal boxes may collide and look like one. Their serial numbers
    differ: that reply is then unreadable, or there are two. Raises GarbledReplyError
    in both cases.
    """
    infos = await collect(turn, address, INFO)
    serials = {serial.number for serial in await _read_serials(turn, address)}
    if len(infos) > 1 or len(serials) > 1:
        message = f"several replies from device-ID {address}: {len(serials)} serials"
        raise GarbledReplyError(message)
    return charger_info(infos[0], serials.pop() if serials else None, None)


async def _read_serials(turn: Turn, address: int) -> list[Serial]:
    """Return all serial numbers at a device-ID; none where the register is missing.

    A disturbed exchange is repeated: what could be read may be the slower of two boxes.
    Raises GarbledReplyError when each one is.
    """
    for attempt in range(ATTEMPTS):
        try:
            return await collect(turn, address, SERIAL, disturbed=False)
        except GarbledReplyError:
            if attempt + 1 == ATTEMPTS:
                raise
        except ReplyTimeoutError:
            pass
    return []


async def scan(
    bus: Bus, config: ChargerConfig, orders: Orders, progress: Progress
) -> ScanResult:
    """Scan all device-IDs; reading needs neither ``config`` nor ``orders``.

    Raises LineLostError when the port is lost meanwhile.
    """
    del config, orders
    return await _Scan(bus).run(progress)
