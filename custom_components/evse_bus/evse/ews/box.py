"""What all ports of one EWS-Box share: who it is, and what it told last.

Two ports are one box on one line: one ``rc`` and one ``rd`` tell of both. The box is
known when ``id`` and ``rs`` were answered since the line was opened; after a lost
answer both are asked again, since another box may be there now, and because an answer
that comes late must not be taken for one to a later command (answers have no number,
but they come in their order).
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from functools import partial
from math import inf
from typing import Final, Protocol, cast, override

from ..charger import Charger
from ..conversation import rest
from ..errors import ExchangeError, LineError, ReplyTimeoutError
from ..exchange import Turn
from ..master import ChargerGroup
from ..throttle import RateLimiter
from .events import CardPresented, Events
from .timing import (
    BOX_INTERVAL,
    CLOCK_PAUSE,
    CLOCK_TOLERANCE,
    PARAMETERS_INTERVAL,
    PARAMETERS_RETRY,
)
from .wire.answers import answer, confirmed, decode_firmware_id
from .wire.box_status import BoxFlags, BoxStatus, decode_box
from .wire.commands import read, set_clock
from .wire.frames import Bcc, CommandId, EwsFrame, Request
from .wire.info import Change, Info
from .wire.parameters import EXTRA_BLOCK, SYSTEM_BLOCK, SystemMode, SystemParameters
from .wire.status import Details, Pair, PortStatus, decode_details, decode_ports

MOST_KEYS: Final = 100
"""Keys pressed or released in a second: nobody does more, and each is an event."""
_OTHER_TRY: Final = 3
"""Every so many tries the other reading of the checksum is tried."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Installation:
    """What of the parameters has to be known; the secrets are not kept."""

    ports: int = 2
    mode: SystemMode | None = None
    mode_1: Pair[bool] = (False, False)
    fixed_cable: bool | None = None
    """``None``: not known."""
    maximum: Pair[int | None] = (None, None)
    """Highest current of each port by parameter, A; ``None``: what the jumper says."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """All that a box has told."""

    ports: tuple[PortStatus, ...]
    details: Details
    status: BoxStatus
    installation: Installation


class EwsBox:
    """One box, as its ports know it."""

    def __init__(self) -> None:
        """Nothing is known before it answers."""
        self.events = Events()
        self._keys = RateLimiter(MOST_KEYS, 1.0)
        self.clock: Callable[[], datetime] = partial(datetime.now, UTC)
        """The right time."""
        self.heard_at = -inf
        """Loop time at which the last command that was answered had left."""
        self.changes = 0
        """How many info records have come."""
        self.restarts = 0
        """How often the box has said that it was restarted."""
        self.bcc: Bcc | None = None
        """How it counts the checksum; ``None``: not known."""
        self._opened = -1
        self._tries = 0
        self.forget()

    def forget(self) -> None:
        """Learn anew who it is before anything is written."""
        self.firmware: str | None = None
        self.status: BoxStatus | None = None
        self.installation: Installation | None = None
        self.ports: tuple[PortStatus, ...] = ()
        self.details: Details | None = None
        self.ports_at = -inf
        """Loop time at which `ports` were read."""
        self.status_due = -inf
        self.parameters_due = -inf
        self._answers = False
        self._known = False
        self._flagged = False
        self._card_changed = False
        self._clock_after = -inf

    def line_opened(self, times: int) -> None:
        """Forget everything if the line was opened since the last call."""
        if times != self._opened:
            self._opened = times
            # The reading it was answered under last is the first to be tried.
            self._tries = 0
            self.forget()

    @property
    def known(self) -> bool:
        """Return whether it is known who answers."""
        return self._known

    @property
    def serial(self) -> str | None:
        """Return its serial number."""
        return self.status.serial if self.status is not None else None

    @property
    def told(self) -> Told | None:
        """Return all that it told; ``None``: not all of it yet."""
        if self.details is None or self.status is None or self.installation is None:
            return None
        return Told(
            ports=self.ports,
            details=self.details,
            status=self.status,
            installation=self.installation,
        )

    # -- Asking --------------------------------------------------------------------

    async def read[T](
        self, turn: Turn, command: CommandId, decode: Callable[[bytes], T]
    ) -> T:
        """Return what the answer to a reading command says.

        Raises ImplausibleReplyError, and what `Turn.exchange` raises.
        """
        return await self.ask(turn, command, lambda: read(command), decode)

    async def tell(
        self, turn: Turn, command: CommandId, make: Callable[[], Request]
    ) -> None:
        """Say something that is answered by one byte; return when it was OK.

        Raises EwsRefusedError, and what `read` raises.
        """
        await self.ask(turn, command, make, confirmed(command))

    async def ask[T](
        self,
        turn: Turn,
        command: CommandId,
        make: Callable[[], Request],
        decode: Callable[[bytes], T],
        *,
        patience: float = 0.0,
    ) -> T:
        """Have one exchange; ``make`` is asked right before its command goes."""
        bcc = self.bcc or Bcc.ALL
        try:
            result = await turn.exchange(
                lambda: make().encode(bcc),
                answer(command, decode, self.bcc),
                patience=patience,
            )
        except ReplyTimeoutError, LineError:
            self.doubt()
            raise
        except ExchangeError:
            self._note(turn)
            raise
        self._note(turn)
        return result

    def doubt(self) -> None:
        """Ask who it is before the next command: an answer was lost."""
        self._answers = self._known = False
        self.ports_at = -inf

    def was_reset(self) -> None:
        """Note that it restarts: it is another box now, as far as anybody can know."""
        self._flagged = False
        self.doubt()

    def _note(self, turn: Turn) -> None:
        if turn.sent_at is not None:
            self.heard_at = turn.sent_at

    # -- Who it is -----------------------------------------------------------------

    async def identify(self, turn: Turn) -> BoxStatus:
        """Ask who it is, under one reading of the checksum and the other, until told.

        Nothing but ``id`` and ``rs``. Raises LineError, and ImplausibleReplyError or
        ExchangeRefusedError for what is no EWS-Box; silence is the caller's to end.
        """
        while True:
            try:
                await self._find_reading(turn)
                return await self.read_status(turn)
            except ReplyTimeoutError:
                continue

    async def meet(self, turn: Turn) -> None:
        """Find out who answers, and what is installed, one exchange a turn.

        Two ports may do so at the same time: what one has learnt the other skips.
        Raises what `read` raises.
        """
        while not self._known:
            if not self._answers:
                await self._find_reading(turn)
            else:
                await self.read_status(turn)
                self._known = True
            await rest(0.0)
        if self.installation is None:
            await self.read_parameters(turn)

    async def _find_reading(self, turn: Turn) -> None:
        """Let it answer ``id``, under one reading of the checksum or the other."""
        readings = tuple(Bcc)
        usual = readings.index(self.bcc or readings[self._tries % 2])
        other = self.bcc is not None and self._tries % _OTHER_TRY == _OTHER_TRY - 1
        bcc = readings[usual ^ other]
        self._tries += 1

        def accept(frame: EwsFrame) -> tuple[str, Bcc] | None:
            firmware = answer(CommandId.READ_FIRMWARE_ID, decode_firmware_id)(frame)
            return None if firmware is None else (firmware, frame.bcc)

        request = read(CommandId.READ_FIRMWARE_ID).encode(bcc)
        self.firmware, self.bcc = await turn.exchange(request, accept)
        self._tries = 0
        self._answers = True
        self._note(turn)

    async def read_status(self, turn: Turn) -> BoxStatus:
        """Read ``rs``: who it is, its clock, the card at the reader."""
        status = await self.read(turn, CommandId.READ_BOX, decode_box)
        before, self.status = self.status, status
        self.status_due = turn.now + BOX_INTERVAL
        if before is not None and before.serial != status.serial:
            self.installation = None
            self.ports = ()
            self.details = None
            before = None
        flagged = BoxFlags.RESTARTED in status.flags
        if flagged and not self._flagged:
            self.restarts += 1
            self.parameters_due = self._clock_after = -inf
        self._flagged = flagged
        self._tell_card(before, status)
        return status

    def _tell_card(self, before: BoxStatus | None, status: BoxStatus) -> None:
        card, changed = status.card, self._card_changed
        self._card_changed = False
        if card is None:
            return
        if changed or (before is not None and before.card != card):
            self.events.tell(
                CardPresented(
                    group=card.group,
                    number=card.number,
                    user=card.user,
                    tag=card.tag,
                    readable=card.decode_error == 0,
                )
            )

    async def read_parameters(self, turn: Turn) -> None:
        """Read what is installed; a box that does not tell is taken as it comes."""
        self.parameters_due = turn.now + PARAMETERS_RETRY
        system: SystemParameters | None = None
        try:
            system = await self.read(turn, SYSTEM_BLOCK.read, SYSTEM_BLOCK.decode)
            await rest(0.0)
            extra = await self.read(turn, EXTRA_BLOCK.read, EXTRA_BLOCK.decode)
        except ExchangeError:
            if system is not None:
                # What one block tells counts, also when the other is not told.
                self.installation = self._installation(system, None)
            self.installation = self.installation or Installation()
            return
        self.parameters_due = turn.now + PARAMETERS_INTERVAL
        self.installation = self._installation(system, extra.maximum_current_2)

    def _installation(
        self, system: SystemParameters, second: int | None
    ) -> Installation:
        """Return what is installed; ``second``: port 2's maximum, if it was told."""
        first = system.maximum_current or None
        if second is not None:
            return _installation(system, (first, second or first))
        # The last that was known of port 2, as long as nothing else is.
        before = self.installation.maximum[1] if self.installation else None
        return _installation(system, (first, before or first))

    # -- What it says --------------------------------------------------------------

    async def refresh(self, turn: Turn, oldest: float) -> None:
        """Read what is older than ``oldest`` (loop time): up to three exchanges."""
        if self.ports_at < oldest or self.details is None:
            await self.look(turn)
            await self.look_closer(turn)
        if turn.now >= self.status_due:
            await self.read_status(turn)

    async def look(self, turn: Turn) -> tuple[PortStatus, ...]:
        """Read ``rc``: how the ports are, right now."""
        known = self.installation or Installation()
        decode = partial(decode_ports, mode_1=known.mode_1, count=known.ports)
        changes = self.changes
        self.ports = await self.read(turn, CommandId.READ_PORTS, decode)
        # A record that came meanwhile says that they are not so any more.
        self.ports_at = turn.now if changes == self.changes else -inf
        return self.ports

    async def look_closer(self, turn: Turn) -> Details:
        """Read ``rd``: limit and power of the ports."""
        self.details = await self.read(turn, CommandId.READ_DETAILS, decode_details)
        return self.details

    def hear(self, info: Info) -> None:
        """Take an info record: what was read is old now."""
        self.changes += 1
        self.ports_at = -inf
        if Change.CARD in info.changes:
            self._card_changed = True
            self.status_due = -inf
        now = asyncio.get_running_loop().time()
        for key in info.key_events:
            if self._keys.take(now):
                self.events.tell(key)

    # -- Its clock -----------------------------------------------------------------

    def clock_is_wrong(self, zone: tzinfo | None, now: float) -> bool:
        """Return whether its clock is to be set; not all the time, if in vain."""
        status = self.status
        if zone is None or status is None or now < self._clock_after:
            return False
        if status.clock is None:
            return True
        off = (self._local(zone) - status.clock).total_seconds()
        return abs(off) > CLOCK_TOLERANCE

    def check_clock(self) -> None:
        """Let its clock be set soon if it is wrong: it is to show another zone."""
        self._clock_after = -inf

    async def set_clock(self, turn: Turn, zone: tzinfo) -> None:
        """Set its clock to the time in this zone.

        Raises EwsRefusedError, and what `read` raises.
        """
        self._clock_after = turn.now + CLOCK_PAUSE
        await self.tell(turn, CommandId.SET_CLOCK, lambda: set_clock(self._local(zone)))
        self.status_due = -inf

    def _local(self, zone: tzinfo) -> datetime:
        return self.clock().astimezone(zone).replace(tzinfo=None, microsecond=0)


class Port(Protocol):
    """A port, as the owner of its box knows it."""

    box: EwsBox


class Ports(ChargerGroup):
    """The ports of one bus: they are of one box, which they share."""

    def __init__(self) -> None:
        """Begin with a box that is not known yet."""
        self.box = EwsBox()

    @override
    def added(self, charger: Charger) -> None:
        cast("Port", charger).box = self.box


def _installation(system: SystemParameters, maximum: Pair[int | None]) -> Installation:
    return Installation(
        ports=system.ports,
        mode=system.mode,
        mode_1=system.mode_1,
        fixed_cable=system.fixed_cable,
        maximum=maximum,
    )
