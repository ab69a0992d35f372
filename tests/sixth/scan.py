"""The scan for Sextant S6: all addresses, nothing is written."""

from functools import partial
from typing import Final

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.errors import (
    GarbledReplyError,
    ReplyTimeoutError,
)
from custom_components.evse_bus.evse.exchange import Turn
from custom_components.evse_bus.evse.model import Orders
from custom_components.evse_bus.evse.protocol import Progress
from custom_components.evse_bus.evse.scan import FoundCharger, ScanResult

from .charger import SextantConfig, charger_info, read_identity

ADDRESSES: Final = range(1, 10)


async def scan(
    bus: Bus, _config: SextantConfig, _orders: Orders, progress: Progress
) -> ScanResult:
    """Ask every address for its identity."""
    found = []
    unreadable = False
    for done, address in enumerate(ADDRESSES):
        progress(done / len(ADDRESSES))
        try:
            found.append(await bus.run(partial(_identify, address)))
        except GarbledReplyError:
            unreadable = True
        except ReplyTimeoutError:
            continue
    progress(1.0)
    return ScanResult(found=tuple(found), unreadable=unreadable)


async def _identify(address: int, turn: Turn) -> FoundCharger:
    identity = await read_identity(turn, address)
    return FoundCharger(
        address=address,
        info=charger_info(identity),
        serial=identity.serial,
        maximum_current=identity.maximum_current,
    )
