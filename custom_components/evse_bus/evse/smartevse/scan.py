"""Looking for a polled SmartEVSE on a bus; nothing is written.

Asked are unit 1 and unit 0: the addresses of a box without load balancing, and of one
that is its own master. Slaves (2 and up) are not asked: without a master's broadcast
they stop, so there is nothing to poll. At unit 0 a box answers only in the dialect 2.17
(and some of 2.20), which there is alone on its bus.
"""

from functools import partial
from typing import Final

from ..bus import Bus
from ..errors import (
    ExchangeError,
    ExchangeRefusedError,
    GarbledReplyError,
    ImplausibleReplyError,
    LineBusyError,
    ReplyTimeoutError,
)
from ..exchange import Turn
from ..model import ChargerConfig, Orders, Setting
from ..protocol import Progress
from ..scan import FoundCharger, ScanResult
from .dialects import MAPS, Dialect, Status
from .exchanges import read
from .probing import Probe
from .readings import charger_info
from .registers import decode_configuration, decode_status

UNITS: Final = (1, 0)
"""The more common one first."""
ASKED: Final = 2
"""How often a unit is asked that stays silent."""
ASKED_PATIENTLY: Final = 4
"""On a line where others talk, or where an answer was unreadable."""


async def scan(
    bus: Bus, config: ChargerConfig, orders: Orders, progress: Progress
) -> ScanResult:
    """Look for a box at both units; nothing is written.

    ``config`` and ``orders`` are not needed: every box can be read without setting
    anything. Raises LineLostError when the port is lost meanwhile.
    """
    del config, orders
    found: list[FoundCharger] = []
    garbled: list[int] = []
    progress(0.0)
    for index, unit in enumerate(UNITS):
        charger, unreadable = await _look_at(bus, unit)
        if charger is not None:
            found.append(charger)
        elif unreadable:
            garbled.append(unit)
        progress((index + 1) / len(UNITS))
    if not found and len(garbled) == len(UNITS):
        # No collision is at both: the line does not fit.
        return ScanResult(unreadable=True)
    return ScanResult(found=tuple(found), duplicates=tuple(garbled))


async def _look_at(bus: Bus, unit: int) -> tuple[FoundCharger | None, bool]:
    """Return the box at a unit, and whether what answered could not be read."""
    silent = garbled = busy = 0
    while silent < ASKED and silent + garbled + busy < ASKED_PATIENTLY:
        try:
            return await bus.run(partial(_ask, unit)), False
        except GarbledReplyError:
            garbled += 1
        except ReplyTimeoutError:
            silent += 1
        except LineBusyError:
            busy += 1
        except ImplausibleReplyError, ExchangeRefusedError:
            # Something else speaks Modbus at this address.
            return None, False
    return None, garbled >= ASKED


async def _ask(unit: int, turn: Turn) -> FoundCharger:
    """Return what the box at a unit is.

    Raises ImplausibleReplyError where no SmartEVSE answers, and what `read` raises.
    """
    probe = Probe()
    while probe.found is None:
        try:
            probe.told(await read(turn, unit, probe.ask))
        except ExchangeRefusedError as error:
            probe.refused(error.code)
    dialect = probe.found
    status = decode_status(dialect, await read(turn, unit, MAPS[dialect].status.block))
    info = charger_info(dialect, status.serial)
    return FoundCharger(
        address=unit,
        info=info,
        serial=info.serial,
        maximum_current=await _maximum(turn, unit, dialect, status),
    )


async def _maximum(
    turn: Turn, unit: int, dialect: Dialect, status: Status
) -> float | None:
    """Return the maximum that a box tells of itself, A; ``None``: not told."""
    try:
        told = {
            block: await read(turn, unit, block)
            for block in MAPS[dialect].configuration
        }
        settings = decode_configuration(dialect, told).settings
    except ExchangeError:
        return None if status.maximum is None else float(status.maximum)
    configured = settings[Setting.MAXIMUM_CURRENT]
    return float(min(configured, status.maximum or configured))
