"""Looking for an EWS-Box on a bus; nothing is written.

There is one box on a line: it is found by its serial number, whichever ports it has.
``id`` is asked under both readings of the checksum (manual, 3.2.2).
"""

from math import inf
from typing import TYPE_CHECKING, Final

from ..errors import (
    ExchangeRefusedError,
    GarbledReplyError,
    ImplausibleReplyError,
    LineBusyError,
    ReplyTimeoutError,
)
from ..model import ChargerConfig, Orders
from ..scan import FoundCharger, ScanResult
from .box import EwsBox
from .readings import charger_info, limits_of

if TYPE_CHECKING:
    from ..bus import Bus
    from ..protocol import Progress

TRIES: Final = 4
"""How often a silent line is asked, under one reading and the other in turn."""


async def scan(
    bus: Bus, config: ChargerConfig, orders: Orders, progress: Progress
) -> ScanResult:
    """Look for a box; ``config`` and ``orders`` are not needed.

    Raises LineLostError when the port is lost meanwhile.
    """
    del config, orders
    box = EwsBox()
    unreadable = 0
    progress(0.0)
    for attempt in range(TRIES):
        try:
            await bus.run(box.meet)
        except GarbledReplyError:
            unreadable += 1
        except ReplyTimeoutError, LineBusyError:
            pass
        except ImplausibleReplyError, ExchangeRefusedError:
            # It speaks as a box does, and is none that we understand.
            unreadable += 1
        if box.known and box.installation is not None:
            progress(1.0)
            return ScanResult(found=_found(box))
        progress((attempt + 1) / TRIES)
    # A box is silent under the reading of the checksum that is not its own.
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
