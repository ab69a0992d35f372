"""Search for ChargePoints. There is no read: a probe sets limits.

A probe sends the orders that the user has confirmed, through the same clamp as any
request: at most 6 A, because no maximum is known yet.

Serial number 0 (and command 69) addresses all ChargePoints at once. By the rule of
silence several of them may reply one after the other, so a probe listens for as long
as replies come. If they reply at the same time the frames are unreadable, and the
serial numbers must be typed in.
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
from .charger import encode_request, setpoint_for
from .config import INTERVAL_MARGIN, UNKNOWN_INTERVAL, EvboxConfig
from .frames import ANY_SERIAL, EvboxFrame, Reply, decode_reply
from .memory import EvboxMemory
from .plausibility import implausible_values
from .readings import charger_info, serial_number

TRIES: Final = 2
RETRY_PAUSE = UNKNOWN_INTERVAL + INTERVAL_MARGIN
"""Between two tries where no minimum interval is known, s."""
_PROGRESS_STEP: Final = 0.5
"""s"""


@dataclass(slots=True)
class _Answers:
    """Everything received after one probe."""

    replies: list[Reply] = field(default_factory=list)
    bad_frames: bool = False
    """There were unreadable frames: several at once, or a bad line."""
    noise: bool = False

    @property
    def unreadable(self) -> bool:
        return self.bad_frames or self.noise


async def scan(
    bus: Bus, config: EvboxConfig, orders: Orders, progress: Progress
) -> ScanResult:
    """Send these orders to the addressed ChargePoints, and return those that reply.

    Takes one second with a reply, 23 s without. A ChargePoint may have received a probe
    although its reply was unreadable, and its reaction to another one too soon is not
    documented: so there is a minimum interval between two. After an earlier search that
    found one, or a bus that was stopped a moment ago, its rest comes first. Raises RefusedOrderError for orders
    that cannot be sent, and for a probe of all ChargePoints on a bus that has chargers
    already; LineError when the line cannot be used.
    """
    if config.addressed == ANY_SERIAL and bus.chargers:
        message = (
            "a search would set the limits of the chargers already on this bus: "
            "type the serial number of the new one"
        )
        raise RefusedOrderError(message)
    limits = Limits(installation=config.installation_limit, reports_maximum=True)
    request = encode_request(config, setpoint_for(orders, limits, UNKNOWN_INTERVAL))
    memory = bus.line.memory.of(EvboxMemory)
    known = memory.interval(config.addressed).reported is not None
    answers = _Answers()
    for number in range(TRIES):
        if number or known:
            await _wait(memory, config, partial(_share, progress, number))
        answers = await bus.run(partial(_probe, bus, config, request))
        if answers.replies:
            break
    progress(1.0)
    _learn(memory, config, answers)
    return _result(config, answers)


def _share(progress: Progress, number: int, share: float) -> None:
    progress((number + share) / TRIES)


async def _wait(memory: EvboxMemory, config: EvboxConfig, progress: Progress) -> None:
    """Wait for the rest of the minimum interval since the last request."""
    loop = asyncio.get_running_loop()
    interval = memory.interval(config.addressed)
    known = interval.reported is not None
    pause = interval.value + INTERVAL_MARGIN if known else RETRY_PAUSE
    ends = memory.sent_at(config.addressed) + pause
    while (left := ends - loop.time()) > 0:
        progress(1.0 - left / pause)
        await asyncio.sleep(min(_PROGRESS_STEP, left))


def _learn(memory: EvboxMemory, config: EvboxConfig, answers: _Answers) -> None:
    """Keep the minimum intervals for the chargers that are set up next."""
    for reply in answers.replies:
        for address in {_address(config, reply), config.addressed}:
            memory.interval(address).update(reply.minimum_interval)


async def _probe(bus: Bus, config: EvboxConfig, request: bytes, turn: Turn) -> _Answers:
    answers = _Answers()

    def collect(frame: EvboxFrame) -> None:
        reply = decode_reply(frame)
        if reply is None or reply.command != config.command:
            return
        if config.addressed and reply.serial != f"{config.addressed:08d}":
            return
        if implausible_values(reply):
            answers.bad_frames = True
        elif reply not in answers.replies:
            answers.replies.append(reply)

    bad = bus.wire.statistics.bad_frames
    try:
        # No frame ends the exchange, so that all ChargePoints have time to reply.
        await turn.exchange(request, collect)
    except GarbledReplyError:
        if bus.wire.statistics.bad_frames > bad:
            answers.bad_frames = True
        else:
            answers.noise = True
    except ReplyTimeoutError:
        pass
    finally:
        if turn.sent_at is not None:
            memory = bus.line.memory.of(EvboxMemory)
            memory.sent(config.addressed, turn.sent_at)
    return answers


def _result(config: EvboxConfig, answers: _Answers) -> ScanResult:
    found: dict[int, FoundCharger] = {}
    duplicates: set[int] = set()
    for reply in answers.replies:
        address = _address(config, reply)
        if address in found:
            duplicates.add(address)
        else:
            found[address] = _found(address, reply)
    if answers.bad_frames and config.addressed == ANY_SERIAL:
        duplicates.add(ANY_SERIAL)
    return ScanResult(
        found=tuple(found[address] for address in sorted(found.keys() - duplicates)),
        duplicates=tuple(sorted(duplicates)),
        unreadable=answers.unreadable,
    )


def _address(config: EvboxConfig, reply: Reply) -> int:
    serial = serial_number(reply)
    # A serial number that is not decimal cannot be addressed.
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
