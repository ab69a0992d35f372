"""Looking for ABL boxes on a bus: device-IDs 1 to 16, reading only."""

import asyncio
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from ..bus import Bus
from ..errors import GarbledReplyError, LineBusyError, ReplyTimeoutError
from ..exchange import Turn
from ..modbus import ModbusFrame
from ..model import ChargerConfig, Orders
from ..protocol import Progress
from ..readings import ChargerInfo
from ..scan import FoundCharger, ScanResult
from .exchanges import read
from .readings import charger_info
from .registers import (
    ADDRESSES,
    INFO,
    SERIAL,
    read_answer,
    read_request,
)

ASKED: Final = 2
"""A box asleep loses the first request, so every ID is asked twice."""
ASKED_PATIENTLY: Final = 4
"""On a line where others talk, or where an answer was unreadable."""
REPEAT_AFTER: Final = 0.6
"""Pause between two requests to one ID; others are asked meanwhile, s."""
FEW: Final = 2
"""More unreadable IDs than these are no collisions, but a line that does not fit."""


@dataclass(slots=True)
class _Asked:
    """One device-ID, and what came of asking it."""

    address: int
    ready: float = 0.0
    """Not before this loop time."""
    silent: int = 0
    garbled: int = 0
    busy: int = 0
    found: FoundCharger | None = None

    @property
    def done(self) -> bool:
        """Return whether nothing more can be learnt."""
        if self.found is not None or self.silent >= ASKED:
            return True
        return self.silent + self.garbled + self.busy >= ASKED_PATIENTLY


@dataclass(slots=True)
class _Scan:
    """One look at all IDs."""

    bus: Bus
    waiting: deque[_Asked] = field(
        default_factory=lambda: deque(_Asked(address) for address in ADDRESSES)
    )
    asked: list[_Asked] = field(default_factory=list)

    async def run(self, progress: Progress) -> ScanResult:
        """Ask one ID after the other; those that stay silent again, in their time."""
        loop = asyncio.get_running_loop()
        while self.waiting:
            progress(len(self.asked) / len(ADDRESSES))
            one = min(self.waiting, key=lambda one: max(one.ready, loop.time()))
            if (pause := one.ready - loop.time()) > 0:
                await asyncio.sleep(pause)
            await self._ask(one)
            one.ready = loop.time() + REPEAT_AFTER
            if one.done:
                self.waiting.remove(one)
                self.asked.append(one)
        progress(1.0)
        return self._report()

    async def _ask(self, one: _Asked) -> None:
        try:
            info = await self.bus.run(partial(_ask_info, one.address))
            one.found = FoundCharger(address=one.address, info=info, serial=info.serial)
        except GarbledReplyError:
            one.garbled += 1
        except ReplyTimeoutError:
            one.silent += 1
        except LineBusyError:
            one.busy += 1

    def _report(self) -> ScanResult:
        """Return what was found, addresses in order."""
        self.asked.sort(key=lambda one: one.address)
        found = tuple(one.found for one in self.asked if one.found is not None)
        garbled = tuple(
            one.address
            for one in self.asked
            if one.found is None and one.garbled >= ASKED
        )
        if not found and len(garbled) > FEW:
            return ScanResult(unreadable=True)
        return ScanResult(found=found, duplicates=garbled)


async def _ask_info(address: int, turn: Turn) -> ChargerInfo:
    """Return what a box at this address is.

    Two equal boxes may answer this as one; their serial numbers differ, so that
    answer is then unreadable, or there are two. Raises GarbledReplyError for both.
    """
    info = await read(turn, address, INFO)
    serials = await _listen_for_serials(turn, address)
    if len(serials) > 1:
        message = f"device-ID {address} has {len(serials)} serial numbers"
        raise GarbledReplyError(message)
    return charger_info(info, serials.pop() if serials else None, None)


async def _listen_for_serials(turn: Turn, address: int) -> set[str | None]:
    """Return every serial number told at an address; none: it has no such register.

    Nothing is taken for the answer, so that a second box which is a little slower
    than the first one is heard as well.
    """
    serials: set[str | None] = set()
    answer = read_answer(address, SERIAL.block)

    def collect(frame: ModbusFrame) -> None:
        if (data := answer(frame)) is not None:
            serials.add(SERIAL.decode(data).number)

    garbled: GarbledReplyError | None = None
    for _ in range(ASKED):
        try:
            await turn.exchange(read_request(address, SERIAL.block), collect)
        except GarbledReplyError as error:
            garbled = error
        except ReplyTimeoutError:
            pass
        if serials:
            return serials
    if garbled is not None:
        raise garbled
    return serials


async def scan(
    bus: Bus, config: ChargerConfig, orders: Orders, progress: Progress
) -> ScanResult:
    """Look for boxes at all device-IDs; nothing is written.

    ``config`` and ``orders`` are not needed: every box can be read without setting
    anything. Raises LineLostError when the port is lost meanwhile.
    """
    del config, orders
    return await _Scan(bus).run(progress)
