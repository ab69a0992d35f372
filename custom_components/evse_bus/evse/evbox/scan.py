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
"""Probes of a line on which no ChargePoint replies."""
PROBES: Final = 4
"""Probes until two replies of each ChargePoint agree."""
LONGEST_WAIT: Final = 60.0
"""A ChargePoint with a longer minimum interval is not sent a second probe, s."""
RETRY_PAUSE = UNKNOWN_INTERVAL + INTERVAL_MARGIN
"""Between two tries where no minimum interval is known, s."""
_PROGRESS_STEP: Final = 0.5
"""s"""


@dataclass(slots=True)
class _Answers:
    """All that was received after one probe."""

    replies: list[Reply] = field(default_factory=list)
    bad_frames: bool = False
    """There were unreadable frames: several at once, or a bad line."""
    noise: bool = False
    is_over: bool = False
    """What comes now is late, and of no use for the probe under way."""

    def accept(self, config: EvboxConfig, frame: EvboxFrame) -> Reply | None:
        """Keep a reply of an addressed ChargePoint; return it."""
        reply = decode_reply(frame)
        if reply is None or reply.command != config.command:
            return None
        if config.addressed and reply.serial != f"{config.addressed:08d}":
            return None
        if implausible_values(reply):
            self.bad_frames = True
        elif not self.is_over and reply not in self.replies:
            self.replies.append(reply)
        return reply

    @property
    def unreadable(self) -> bool:
        return self.bad_frames or self.noise


async def scan(
    bus: Bus, config: EvboxConfig, orders: Orders, progress: Progress
) -> ScanResult:
    """Send these orders to the addressed ChargePoints, and return those that reply.

    One reply may be damaged, so each is found when two agree: after one minimum
    interval, 1 to 20 s; without a reply the search takes 23 s. A ChargePoint may have
    received a probe although its reply was unreadable, and its reaction to another one
    too soon is not documented: so there is a minimum interval between two, also after
    an earlier search, or a bus that was stopped a moment ago.

    Raises RefusedOrderError for orders that cannot be sent, and for a probe of all
    ChargePoints on a bus that has chargers already; LineError when the line cannot be
    used.
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
    probes: list[_Answers] = []
    while not _is_over(probes, memory, config):
        if probes or known:
            await _wait(memory, config, partial(_share, progress, len(probes)))
        probes.append(await bus.run(partial(_probe, bus, config, request)))
        _learn(memory, config, probes[-1])
    progress(1.0)
    return _result(config, probes)


def _is_over(probes: list[_Answers], memory: EvboxMemory, config: EvboxConfig) -> bool:
    """Return whether another probe would add nothing, or come too late."""
    if not any(one.replies for one in probes):
        return len(probes) >= TRIES
    if len(probes) >= PROBES or _pause(memory, config) > LONGEST_WAIT:
        return True
    last = probes[-1].replies
    return bool(last) and all(_agreeing(probes, reply) > 1 for reply in last)


def _agreeing(probes: list[_Answers], reply: Reply) -> int:
    """Return after how many probes such a reply came: identity and maximum agree."""
    return sum(any(_key(one) == _key(reply) for one in each.replies) for each in probes)


def _key(reply: Reply) -> tuple[object, ...]:
    return reply.serial, reply.maximum_current, len(reply.modules)


def _share(progress: Progress, number: int, share: float) -> None:
    progress((number + share) / PROBES)


def _pause(memory: EvboxMemory, config: EvboxConfig) -> float:
    """Return the time between two probes, s."""
    interval = memory.interval(config.addressed)
    if interval.reported is None:
        return RETRY_PAUSE
    # One that no other reply has confirmed may be damaged: up to 10 min.
    unconfirmed = min(interval.reported, LONGEST_WAIT)
    return max(interval.value, unconfirmed) + INTERVAL_MARGIN


async def _wait(memory: EvboxMemory, config: EvboxConfig, progress: Progress) -> None:
    """Wait for the rest of the minimum interval since the last request."""
    loop = asyncio.get_running_loop()
    pause = _pause(memory, config)
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
    bad = bus.wire.statistics.bad_frames
    try:
        # All ChargePoints have time to reply.
        await turn.collect(request, partial(answers.accept, config))
    except GarbledReplyError:
        if bus.wire.statistics.bad_frames > bad:
            answers.bad_frames = True
        else:
            answers.noise = True
    except ReplyTimeoutError:
        pass
    finally:
        answers.is_over = True
        if turn.sent_at is not None:
            memory = bus.line.memory.of(EvboxMemory)
            memory.sent(config.addressed, turn.sent_at)
    return answers


def _result(config: EvboxConfig, probes: list[_Answers]) -> ScanResult:
    found: dict[int, FoundCharger] = {}
    duplicates: set[int] = set()
    for reply in _confirmed(probes):
        address = _address(config, reply)
        if address in found:
            duplicates.add(address)
        else:
            found[address] = _found(address, reply)
    received = [one for one in probes if one.replies or one.unreadable]
    if received and all(one.bad_frames for one in received):
        if config.addressed == ANY_SERIAL:
            duplicates.add(ANY_SERIAL)
    elif not found and len(probes) == 1 and received:
        # Too long an interval for a second probe: its number is read by the charger,
        # from two replies, before it counts.
        found[config.address] = FoundCharger(
            address=config.address, info=charger_info(None)
        )
    return ScanResult(
        found=tuple(found[address] for address in sorted(found.keys() - duplicates)),
        duplicates=tuple(sorted(duplicates)),
        unreadable=bool(received) and (not found or received[-1].unreadable),
    )


def _confirmed(probes: list[_Answers]) -> list[Reply]:
    """Return the replies that agree with one to another probe, the last of each."""
    latest: dict[object, list[Reply]] = {}
    for one in probes:
        for key in {_key(reply) for reply in one.replies}:
            latest[key] = [reply for reply in one.replies if _key(reply) == key]
    return [
        reply
        for replies in latest.values()
        for reply in replies
        if _agreeing(probes, reply) > 1
    ]


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
