"""Looking for slaves on a bus that we are the master of; nothing is written.

One exchange a turn: on a bus that runs already the broadcasts go on between.
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
    NotAvailableError,
    ReplyTimeoutError,
)
from ..exchange import Turn
from ..model import ChargerConfig, Fault, Orders, Setting
from ..protocol import Progress
from ..registers import Block
from ..scan import FoundCharger, ScanResult
from .balancing import SLAVES
from .dialects import MAPS, Dialect, Status
from .exchanges import read
from .probing import Probe
from .readings import charger_info
from .registers import decode_configuration, decode_status

ASKED: Final = 3
"""How often a unit is asked that stays silent: right after it was switched on, or in
the midst of a request of its own, a box may miss one."""


async def scan(
    bus: Bus, config: ChargerConfig, orders: Orders, progress: Progress
) -> ScanResult:
    """Look for slaves at units 2 to 4; nothing is written.

    ``config`` and ``orders`` are not needed: every box can be read without setting
    anything. Where another master speaks nobody is asked, and the report says so.
    Raises LineLostError when the port is lost meanwhile.
    """
    del config, orders
    found: list[FoundCharger] = []
    unsupported: list[FoundCharger] = []
    garbled: list[int] = []
    progress(0.0)
    for index, unit in enumerate(SLAVES):
        try:
            charger, dialect = await _look_at(bus, unit)
        except GarbledReplyError:
            garbled.append(unit)
        except ReplyTimeoutError, LineBusyError:
            pass
        except ImplausibleReplyError, ExchangeRefusedError:
            # Something else speaks Modbus at this address.
            pass
        except NotAvailableError:
            if not _other_master(bus):
                raise
            return ScanResult(other_master=True)
        else:
            (found if dialect is Dialect.V2_17 else unsupported).append(charger)
        progress((index + 1) / len(SLAVES))
    if not found and not unsupported and len(garbled) == len(SLAVES):
        # No collision is at all three: the line does not fit.
        return ScanResult(unreadable=True)
    return ScanResult(
        found=tuple(found),
        unsupported=tuple(unsupported),
        duplicates=tuple(garbled),
    )


def _other_master(bus: Bus) -> bool:
    return bus.master is not None and Fault.SECOND_MASTER in bus.master.noticed


async def _look_at(bus: Bus, unit: int) -> tuple[FoundCharger, Dialect]:
    """Return the box at a unit and its dialect; raises what `_read` raises."""
    probe = Probe()
    while probe.found is None:
        try:
            probe.told(await _read(bus, unit, probe.ask))
        except ExchangeRefusedError as error:
            probe.refused(error.code)
    dialect = probe.found
    status = decode_status(dialect, await _read(bus, unit, MAPS[dialect].status.block))
    info = charger_info(dialect, status.serial)
    charger = FoundCharger(
        address=unit,
        info=info,
        serial=info.serial,
        maximum_current=await _maximum(bus, unit, dialect, status),
    )
    return charger, dialect


async def _maximum(
    bus: Bus, unit: int, dialect: Dialect, status: Status
) -> float | None:
    """Return the maximum that a box tells of itself, A; ``None``: not told."""
    told: dict[Block, bytes] = {}
    try:
        for block in MAPS[dialect].configuration:
            told[block] = await _read(bus, unit, block)
        settings = decode_configuration(dialect, told).settings
    except ExchangeError:
        return None if status.maximum is None else float(status.maximum)
    configured = settings[Setting.MAXIMUM_CURRENT]
    return float(min(configured, status.maximum or configured))


async def _read(bus: Bus, unit: int, block: Block) -> bytes:
    """Return a block, asked for more than once; raises what `read` raises."""
    for last in (False,) * (ASKED - 1) + (True,):
        try:
            return await bus.run(partial(_ask, unit, block))
        except ReplyTimeoutError, LineBusyError:
            if last:
                raise
    raise ReplyTimeoutError


async def _ask(unit: int, block: Block, turn: Turn) -> bytes:
    return await read(turn, unit, block)
