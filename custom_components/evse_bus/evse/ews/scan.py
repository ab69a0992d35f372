"""Search for an EWS-Box on a bus; nothing is written.

A line has one box, which is found by its serial number, with the ports it has. ``id``
is sent with either checksum (manual, 3.2.2).
"""

from math import inf
from typing import Final

from ..bus import Bus
from ..errors import (
    ExchangeRefusedError,
    GarbledReplyError,
    ImplausibleReplyError,
    LineBusyError,
    ReplyTimeoutError,
)
from ..model import ChargerConfig, Orders
from ..protocol import Progress
from ..scan import FoundCharger, ScanResult
from .box import BoxMemory, EwsBox
from .readings import charger_info, limits_of

TRIES: Final = 4
"""How often ``id`` is sent to a silent line, with either checksum in turn."""


async def scan(
    bus: Bus, config: ChargerConfig, orders: Orders, progress: Progress
) -> ScanResult:
    """Search for a box; ``config`` and ``orders`` are not needed.

    Raises LineLostError when the port is lost meanwhile.
    """
    del config, orders
    box = EwsBox()
    box.memory = bus.line.memory.of(BoxMemory)
    unreadable = 0
    progress(0.0)
    for attempt in range(TRIES):
        try:
            await bus.run(box.identify)
        except GarbledReplyError:
            unreadable += 1
        except ReplyTimeoutError, LineBusyError:
            pass
        except ImplausibleReplyError, ExchangeRefusedError:
            # It replies as a box does, but not as one of a known kind.
            unreadable += 1
        if box.identified and box.installation is not None:
            progress(1.0)
            return ScanResult(found=_found(box))
        progress((attempt + 1) / TRIES)
    # A box does not answer to the checksum that is not its own.
    return ScanResult(unreadable=unreadable >= TRIES // 2)


def _found(box: EwsBox) -> tuple[FoundCharger, ...]:
    status, installation = box.status, box.installation
    if status is None or installation is None:
        return ()
    each = tuple(
        limits_of(port, inf, status, installation, None).reported
        for port in range(1, installation.ports + 1)
    )
    return (
        FoundCharger(
            address=status.serial,
            info=charger_info(status),
            serial=status.serial,
            maximum_current=min((one for one in each if one is not None), default=None),
            connectors=installation.ports,
            maximum_currents=each,
        ),
    )
