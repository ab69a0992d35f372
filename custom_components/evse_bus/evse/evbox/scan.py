"""Finding ChargePoints. There is no read: a probe sets limits.

What is imposed is what the user has confirmed, through the same clamp as always:
6 A at most, because no maximum is known yet.

Serial 0 (and command 69) addresses every ChargePoint at once. The silence rule
lets several of them answer one after the other, so a probe listens for as long
as answers keep coming; where they talk at the same time, nobody can read them,
and their serial numbers have to be typed.
"""

import asyncio
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from ..bus import Bus
from ..errors import GarbledReplyError, RefusedOrderError, ReplyTimeoutError
from ..exchange import Turn
from ..model import Limits, Orders
from ..protocol import Progress
from ..scan import FoundCharger, ScanResult
from .config import EvboxConfig
from .frames import ANY_SERIAL, EvboxFrame, Reply, decode_reply
from .plausibility import range_oddities
from .reading import charger_info, serial_number
from .request import encode, wire_setpoint
from .timing import INTERVAL_MARGIN, UNKNOWN_INTERVAL

TRIES: Final = 2
RETRY_PAUSE = UNKNOWN_INTERVAL + INTERVAL_MARGIN
"""Between two tries, s. A ChargePoint may have heard the first one without being
understood, and what it does with a second one too soon is not in the manual."""
_PROGRESS_STEP: Final = 0.5
"""s"""


@dataclass(slots=True)
class _Heard:
    """What came back from one probe."""

    replies: list[Reply] = field(default_factory=list)
    bad_frames: bool = False
    """Frames that nobody can read: several at once, or a bad line."""
    noise: bool = False

    @property
    def unreadable(self) -> bool:
        return self.bad_frames or self.noise


async def scan(
    bus: Bus, config: EvboxConfig, orders: Orders, progress: Progress
) -> ScanResult:
    """Impose these orders on whoever is addressed, and report who answers.

    Takes one second where somebody answers, 23 s where nobody does. Raises
    RefusedOrderError for orders that cannot be sent, and for a probe of everybody
    on a bus that has chargers already; LineError when the line will not do.
    """
    if config.addressed == ANY_SERIAL and bus.chargers:
        message = (
            "a search would set the limits of the chargers already on this bus: "
            "type the serial number of the new one"
        )
        raise RefusedOrderError(message)
    limits = Limits(installation=config.installation_limit, reports_maximum=True)
    request = encode(config, wire_setpoint(orders, limits, UNKNOWN_INTERVAL))
    heard = _Heard()
    for number in range(TRIES):
        if number:
            await _pause(progress)
        heard = await bus.run(partial(_probe, bus, config, request))
        if heard.replies:
            break
    progress(1.0)
    return _report(config, heard)


async def _pause(progress: Progress) -> None:
    loop = asyncio.get_running_loop()
    start = loop.time()
    while (passed := loop.time() - start) < RETRY_PAUSE:
        progress(passed / RETRY_PAUSE)
        await asyncio.sleep(min(_PROGRESS_STEP, RETRY_PAUSE - passed))


async def _probe(bus: Bus, config: EvboxConfig, request: bytes, turn: Turn) -> _Heard:
    heard = _Heard()

    def collect(frame: EvboxFrame) -> None:
        reply = decode_reply(frame)
        if reply is None or reply.command != config.command:
            return
        if config.addressed and reply.serial != f"{config.addressed:08d}":
            return
        if range_oddities(reply):
            heard.bad_frames = True
        elif reply not in heard.replies:
            heard.replies.append(reply)

    bad = bus.wire.statistics.bad_frames
    try:
        # Nothing is taken for the answer: whoever else has one to give is waited for.
        await turn.exchange(request, collect)
    except GarbledReplyError:
        if bus.wire.statistics.bad_frames > bad:
            heard.bad_frames = True
        else:
            heard.noise = True
    except ReplyTimeoutError:
        pass
    return heard


def _report(config: EvboxConfig, heard: _Heard) -> ScanResult:
    found: dict[int, FoundCharger] = {}
    duplicates: set[int] = set()
    for reply in heard.replies:
        address = _address(config, reply)
        if address in found:
            duplicates.add(address)
        else:
            found[address] = _found(address, reply)
    if heard.bad_frames and config.addressed == ANY_SERIAL:
        duplicates.add(ANY_SERIAL)
    return ScanResult(
        found=tuple(found[address] for address in sorted(found.keys() - duplicates)),
        duplicates=tuple(sorted(duplicates)),
        unreadable=heard.unreadable,
    )


def _address(config: EvboxConfig, reply: Reply) -> int:
    serial = serial_number(reply)
    # A serial number that is no number cannot be addressed.
    return int(serial) if serial and serial.isdecimal() else config.address


def _found(address: int, reply: Reply) -> FoundCharger:
    serial = serial_number(reply)
    return FoundCharger(
        address=address,
        info=charger_info(serial),
        serial=serial,
        maximum_current=reply.maximum_current,
        connectors=len(reply.modules),
    )
