"""Searching a bus for SmartEVSEs, polled or slaves; nothing is written.

Every box can be read without being set up, so the configuration and orders that other
protocols need to search are not used here.
"""

import asyncio
from dataclasses import replace
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
from ..model import ChargerConfig, FailSafe, Fault, Orders, Setting
from ..protocol import Progress
from ..registers import Block
from ..scan import FoundCharger, ScanResult
from .dialects import MAPS, PROBE_A0, SLAVES, Dialect, Status
from .memory import SmartEvseMemory
from .polled import QUIET
from .probing import Read, find_dialect
from .readings import charger_info
from .registers import (
    decode_configuration,
    decode_status,
    read_answer,
    read_request,
)

POLLED_UNITS: Final = (1, 0)
"""The addresses of a box without load balancing: 1 from 2.30 on, else 0, alone on its
bus; a box that is its own master has 1. Slaves stop without a master's broadcast, so
there is nothing to poll."""
POLL_FIRST: Final = 0.1
"""Pause between the end of the quiet of a running box and the first request, s."""
ATTEMPTS: Final = 2
"""Requests to a unit that does not reply."""
ATTEMPTS_ON_BAD_LINE: Final = 4
"""Requests on a line that is busy, or where a reply was garbled."""
SLAVE_ATTEMPTS: Final = 3
"""Requests to a slave that has replied before: it may miss one."""
ROUNDS: Final = (SLAVES, SLAVES, MAPS[Dialect.V2_17].balancing.units)
"""The units asked in each round of a search, less those found. Right after power-up a
box may miss a request, one of 2.17 also during a request of its own."""


async def scan_polled(
    bus: Bus, config: ChargerConfig, orders: Orders, progress: Progress
) -> ScanResult:
    """Search for a box at both units; nothing is written.

    Raises LineLostError when the port is lost meanwhile.
    """
    del config, orders
    memory = bus.line.memory
    if memory.of(SmartEvseMemory).needs_quiet:
        # A box that was found or polled a moment ago gets its quiet first. If it is
        # being polled, its next poll and the search are one burst.
        quiet = memory.sent_at + QUIET + POLL_FIRST - bus.now
        await asyncio.sleep(max(quiet, 0.0))
    found: list[FoundCharger] = []
    garbled: list[int] = []
    progress(0.0)
    for index, unit in enumerate(POLLED_UNITS):
        charger, unreadable = await _search(bus, unit)
        if charger is not None:
            found.append(charger)
        elif unreadable:
            garbled.append(unit)
        progress((index + 1) / len(POLLED_UNITS))
    if not found and len(garbled) == len(POLLED_UNITS):
        # Boxes do not collide at both: the line settings do not fit.
        return ScanResult(unreadable=True)
    return ScanResult(found=tuple(found), duplicates=tuple(garbled))


async def scan_slaves(
    bus: Bus, config: ChargerConfig, orders: Orders, progress: Progress
) -> ScanResult:
    """Search for slaves on a bus that we are the master of; nothing is written.

    One exchange a turn, so that the broadcasts of a running bus go on. Beside another
    master nothing is sent, and the result reports it. Raises LineLostError when the
    port is lost meanwhile.
    """
    del config, orders
    found: dict[int, FoundCharger] = {}
    garbled: set[int] = set()
    silent: set[int] = set()
    strangers: set[int] = set()
    progress(0.0)
    plan = [unit for units in ROUNDS for unit in units]
    for index, unit in enumerate(plan):
        if unit in found or unit in strangers:
            continue
        try:
            found[unit] = await _identify_slave(bus, unit)
        except GarbledReplyError:
            garbled.add(unit)
        except ReplyTimeoutError:
            silent.add(unit)
        except LineBusyError:
            pass
        except ImplausibleReplyError, ExchangeRefusedError:
            # Another Modbus device has this address.
            strangers.add(unit)
        except NotAvailableError:
            if not _has_other_master(bus):
                raise
            return ScanResult(other_master=True)
        progress((index + 1) / len(plan))
    progress(1.0)
    # Two boxes disturb each other in every round; in some of them, it was noise.
    doubled = garbled - silent - strangers - found.keys()
    if len(doubled) == len(SLAVES):
        # Boxes do not collide at all addresses: the line settings do not fit.
        return ScanResult(unreadable=True)
    return ScanResult(
        found=tuple(found[unit] for unit in sorted(found)),
        duplicates=tuple(sorted(doubled)),
    )


async def _identify_slave(bus: Bus, unit: int) -> FoundCharger:
    charger, dialect = await _identify(unit, partial(_read_slave, bus, unit))
    proven = MAPS[dialect].balancing.fail_safe_proven
    return replace(charger, fail_safe=FailSafe.STOPS if proven else FailSafe.UNPROVEN)


def _has_other_master(bus: Bus) -> bool:
    return bus.master is not None and Fault.SECOND_MASTER in bus.master.noticed


async def _search(bus: Bus, unit: int) -> tuple[FoundCharger | None, bool]:
    """Return the polled box at a unit, and whether replies were garbled."""
    silent = garbled = busy = 0
    while silent < ATTEMPTS and silent + garbled + busy < ATTEMPTS_ON_BAD_LINE:
        try:
            charger, dialect = await bus.run(partial(_identify_in_a_turn, unit))
        except GarbledReplyError:
            garbled += 1
        except ReplyTimeoutError:
            silent += 1
        except LineBusyError:
            busy += 1
        except ImplausibleReplyError, ExchangeRefusedError:
            # Another Modbus device has this address.
            return None, False
        else:
            memory = bus.line.memory.of(SmartEvseMemory)
            memory.needs_quiet |= MAPS[dialect].needs_quiet
            return charger, False
    return None, garbled >= ATTEMPTS


async def _identify_in_a_turn(unit: int, turn: Turn) -> tuple[FoundCharger, Dialect]:
    return await _identify(unit, partial(_read, unit, turn))


async def _identify(unit: int, read: Read) -> tuple[FoundCharger, Dialect]:
    """Return the box at a unit, and its dialect.

    Raises ImplausibleReplyError for a device that is no SmartEVSE, and what ``read``
    raises.
    """
    dialect = await find_dialect(read)
    status = decode_status(dialect, await read(MAPS[dialect].status.block))
    info = charger_info(dialect, status.serial)
    charger = FoundCharger(
        address=unit,
        info=info,
        serial=info.serial,
        maximum_current=await _maximum(dialect, status, read),
        facts={"dialect": dialect.value},
    )
    return charger, dialect


async def _maximum(dialect: Dialect, status: Status, read: Read) -> float | None:
    """Return the maximum that a box reports, A; ``None``: it reports none."""
    try:
        blocks = {block: await read(block) for block in MAPS[dialect].configuration}
        settings = decode_configuration(dialect, blocks).settings
    except ExchangeError:
        return None if status.maximum is None else float(status.maximum)
    configured = settings[Setting.MAXIMUM_CURRENT]
    return float(min(configured, status.maximum or configured))


async def _read_slave(bus: Bus, unit: int, block: Block) -> bytes:
    """Return a block, each request in a turn of its own.

    Nothing may have this address, so the first block is asked for once.
    """
    attempts = 1 if block == PROBE_A0 else SLAVE_ATTEMPTS
    for last in (False,) * (attempts - 1) + (True,):
        try:
            return await bus.run(lambda turn: _read(unit, turn, block))
        except ReplyTimeoutError, LineBusyError:
            if last:
                raise
    raise ReplyTimeoutError


async def _read(unit: int, turn: Turn, block: Block) -> bytes:
    return await turn.exchange(read_request(unit, block), read_answer(unit, block))
