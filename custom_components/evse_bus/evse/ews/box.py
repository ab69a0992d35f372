"""One EWS-Box, shared by its ports: identity, last readings, clock.

Two ports are one box on one line: one ``rc`` and one ``rd`` read both. The box is
identified when ``id`` and ``rs`` were answered since the line was opened. After a lost
reply both are asked again: another box may be there now, and a late reply must not be
taken for the reply to a later command (replies have no number, but keep their order).

Nothing of a reply counts before another one agrees with it (`agreement`), except on a
line that checks its bytes itself.
"""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from functools import partial
from math import inf
from typing import Final

from ..conversation import rest
from ..errors import (
    ExchangeError,
    ImplausibleReplyError,
    LineError,
    ReplyTimeoutError,
)
from ..events import CardPresented, Events
from ..exchange import Turn
from ..meter import (
    CONFIRMATIONS,
    Meter,
    MeterReading,
    SessionMeter,
    SessionReading,
    Total,
)
from ..throttle import RateLimiter
from .agreement import (
    Agreement,
    box_continues,
    details_continue,
    equal,
    never,
    ports_are_like,
    ports_continue,
)
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

MOST_READS: Final = 2 * CONFIRMATIONS
"""Most readings of a record in a row until two agree, and its meters are plausible or
confirmed."""
MOST_KEYS: Final = 100
"""Most key events reported per second: more cannot come from people."""
_TRIES_PER_OTHER_BCC: Final = 3
"""Each third try uses the other checksum than the one the box answered to before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Installation:
    """The parameters that are needed here; the secret ones are not kept."""

    ports: int = 2
    mode: SystemMode | None = None
    mode_1: Pair[bool] = (False, False)
    fixed_cable: bool | None = None
    """``None``: not known."""
    maximum: Pair[int | None] = (None, None)
    """Highest current of each port by parameter, A; ``None``: set by the jumper."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """All readings of a box."""

    ports: tuple[PortStatus, ...]
    meters: tuple[MeterReading, ...]
    """Of the ports: their accepted totals."""
    sessions: tuple[SessionReading, ...]
    """Of the ports: their accepted charges under way."""
    details: Details
    status: BoxStatus
    installation: Installation


@dataclass(slots=True)
class BoxMemory:
    """What is known of the box on one line, kept from one bus to the next."""

    bcc: Bcc | None = None
    """The checksum it uses; ``None``: not known. It is the first that is tried."""


class EwsBox:
    """The box of one bus."""

    def __init__(self) -> None:
        """Nothing is known before it answers."""
        self.events = Events()
        self.clock: Callable[[], datetime] = partial(datetime.now, UTC)
        """Returns the correct time."""
        self.last_answered_at = -inf
        """Loop time at which the last answered command had been sent, s."""
        self.info_count = 0
        """Info records received."""
        self.restarts = 0
        """Restarts that the box has reported."""
        self.memory = BoxMemory()
        """That of its line, once it is on a bus."""
        self.meters: Pair[Meter] = (Meter(), Meter())
        """Of the ports. They stay while it is away: another box's totals jump."""
        self.sessions: Pair[SessionMeter] = (SessionMeter(), SessionMeter())
        """Of the ports: the charges under way."""
        self.line_checks = False
        """The line checks its bytes itself (TCP): one reply is enough for a reading."""
        self._status_replies = Agreement(box_continues, box_continues)
        self._port_replies = Agreement(equal, ports_continue, ports_are_like)
        self._detail_replies = Agreement(equal, details_continue)
        self._key_limiter = RateLimiter(MOST_KEYS, 1.0)
        self._opened = -1
        self._tries = 0
        self.forget()

    def forget(self) -> None:
        """Drop all readings; the box is identified again before anything is written."""
        self.firmware: str | None = None
        self.status: BoxStatus | None = None
        self.installation: Installation | None = None
        self.ports: tuple[PortStatus, ...] = ()
        self.details: Details | None = None
        self.status_due = -inf
        self.parameters_due = -inf
        self._ports_read_at = -inf
        self._answers = False
        self._identified = False
        self._restart_flag = False
        self._card_changed = False
        self._clock_after = -inf
        for agreement in (
            self._status_replies,
            self._port_replies,
            self._detail_replies,
        ):
            agreement.forget()

    def on_line_open(self, times: int, *, checked: bool) -> None:
        """Drop all readings if the line was opened since the last call.

        ``times``: how often it was opened. ``checked``: it checks its bytes itself.
        Each port calls this.
        """
        self.line_checks = checked
        if times != self._opened:
            self._opened = times
            # The checksum it answered to last is tried first.
            self._tries = 0
            self.forget()

    @property
    def bcc(self) -> Bcc | None:
        """Return the checksum it uses; ``None``: not known."""
        return self.memory.bcc

    @property
    def identified(self) -> bool:
        """Return whether ``id`` and ``rs`` were answered, and no reply lost since."""
        return self._identified

    @property
    def serial(self) -> str | None:
        """Return its serial number; ``None``: not read yet."""
        return self.status.serial if self.status is not None else None

    @property
    def snapshot(self) -> Snapshot | None:
        """Return all readings; ``None``: some are missing yet."""
        if self.details is None or self.status is None or self.installation is None:
            return None
        return Snapshot(
            ports=self.ports,
            meters=tuple(meter.reading for meter in self.meters),
            sessions=tuple(session.reading for session in self.sessions),
            details=self.details,
            status=self.status,
            installation=self.installation,
        )

    # -- Exchanges -----------------------------------------------------------------

    async def read[T](
        self, turn: Turn, command: CommandId, decode: Callable[[bytes], T]
    ) -> T:
        """Send a reading command; return its decoded reply.

        Raises ImplausibleReplyError, and what `Turn.exchange` raises.
        """
        return await self.exchange(turn, command, lambda: read(command), decode)

    async def read_confirmed[T](
        self,
        turn: Turn,
        command: CommandId,
        decode: Callable[[bytes], T],
        agreement: Agreement[T] | None = None,
        is_plausible: Callable[[T], bool] = lambda _value: True,
    ) -> tuple[T, bool]:
        """Send a reading command, one exchange a turn, until its reply counts.

        ``agreement``: of the replies to this command; ``None``: two must be equal.
        ``is_plausible`` is called with each reply that others agree with: where it is
        not, more are read before it counts all the same. Returns the reply, and whether
        no info record has outdated it. Raises ImplausibleReplyError where none agree,
        and what `read` raises.
        """
        agreement = agreement or Agreement(equal, never)
        series = agreement.begin()
        reason = ImplausibleReplyError(f"{command}: replies that do not agree")
        agreed: tuple[T, bool] | None = None
        for attempt in range(MOST_READS):
            if attempt:
                await rest(0.0)
            infos = self.info_count
            try:
                value = await self.read(turn, command, decode)
            except ImplausibleReplyError as error:
                if self.line_checks:
                    raise
                reason = error
                series.interrupt()
                continue
            if not (self.line_checks or series.agrees(value, turn.now)):
                continue
            agreement.counts(value, turn.now)
            agreed = value, infos == self.info_count
            if is_plausible(value):
                break
        if agreed is not None:
            return agreed
        if series.like is None:
            raise reason
        return series.like, False

    async def send_command(
        self, turn: Turn, command: CommandId, make: Callable[[], Request]
    ) -> None:
        """Send a command that is confirmed by one byte; return when it was OK.

        Where a reply was lost since the box was identified, perhaps by its other port,
        nothing is sent. Raises ReplyTimeoutError then, EwsRefusedError, and what `read`
        raises.
        """

        def request() -> Request:
            if not self._identified:
                message = "the box has to be identified again: nothing was sent"
                raise ReplyTimeoutError(message)
            return make()

        await self.exchange(turn, command, request, confirmed(command))

    async def exchange[T](
        self,
        turn: Turn,
        command: CommandId,
        make: Callable[[], Request],
        decode: Callable[[bytes], T],
        *,
        patience: float = 0.0,
    ) -> T:
        """Have one exchange; ``make`` is called right before its request is sent.

        ``patience``: additional time for the reply, s.
        """
        bcc = self.bcc or Bcc.ALL
        try:
            result = await turn.exchange(
                lambda: make().encode(bcc),
                answer(command, decode, self.bcc),
                patience=patience,
            )
        except ReplyTimeoutError, LineError:
            self.require_identification()
            raise
        except ExchangeError:
            self._note_answered(turn)
            raise
        self._note_answered(turn)
        return result

    def require_identification(self) -> None:
        """Identify the box before the next command: a reply was lost."""
        self._answers = self._identified = False
        self.expire_ports()

    def on_reset(self) -> None:
        """Take note of a reset: after its restart it might be any box."""
        self._restart_flag = False
        self.require_identification()

    def _note_answered(self, turn: Turn) -> None:
        if turn.sent_at is not None:
            self.last_answered_at = turn.sent_at

    # -- Identity ------------------------------------------------------------------

    async def wait_for_status(self, turn: Turn) -> BoxStatus:
        """Ask for ``id`` and ``rs``, with either checksum, until two ``rs`` agree.

        Raises LineError, and ImplausibleReplyError or ExchangeRefusedError for replies
        that no EWS-Box gives. Does not give up on silence: the caller limits the time.
        """
        series = self._status_replies.begin()
        while True:
            try:
                if not self._answers:
                    await self._read_firmware_id(turn)
                status = await self.read(turn, CommandId.READ_BOX, decode_box)
            except ReplyTimeoutError:
                # Another box may be there.
                series.interrupt()
                continue
            if series.agrees(status, turn.now):
                return status

    async def identify(self, turn: Turn) -> None:
        """Read ``id``, ``rs`` and the installation, one exchange a turn.

        Two ports may do so at the same time: each skips the records the other has read.
        Raises what `read` raises.
        """
        while not self._identified:
            if not self._answers:
                await self._read_firmware_id(turn)
            else:
                await self.read_status(turn)
                self._identified = True
            await rest(0.0)
        if self.installation is None:
            await self.read_parameters(turn)

    async def _read_firmware_id(self, turn: Turn) -> None:
        """Read ``id``, with one checksum or the other, and learn which one it uses."""
        variants = tuple(Bcc)
        usual = variants.index(self.bcc or variants[self._tries % 2])
        last = _TRIES_PER_OTHER_BCC - 1
        other = self.bcc is not None and self._tries % _TRIES_PER_OTHER_BCC == last
        bcc = variants[usual ^ other]
        self._tries += 1

        def accept(frame: EwsFrame) -> tuple[str, Bcc] | None:
            firmware = answer(CommandId.READ_FIRMWARE_ID, decode_firmware_id)(frame)
            return None if firmware is None else (firmware, frame.bcc)

        request = read(CommandId.READ_FIRMWARE_ID).encode(bcc)
        self.firmware, self.memory.bcc = await turn.exchange(request, accept)
        self._tries = 0
        self._answers = True
        self._note_answered(turn)

    async def read_status(self, turn: Turn) -> BoxStatus:
        """Read ``rs``: serial number, flags, clock, the card at the reader."""
        restarted = False

        def decode(data: bytes) -> BoxStatus:
            nonlocal restarted
            status = decode_box(data)
            restarted |= BoxFlags.RESTARTED in status.flags
            return status

        status, _ = await self.read_confirmed(
            turn, CommandId.READ_BOX, decode, self._status_replies
        )
        before, self.status = self.status, status
        self.status_due = turn.now + BOX_INTERVAL
        if before is not None and before.serial != status.serial:
            self.installation = None
            self.ports = ()
            self.details = None
            before = None
        self._check_restart(restarted)
        # Not that of an earlier reply: one that a box clears when it is read would hide
        # a restart before the next reading.
        self._restart_flag = BoxFlags.RESTARTED in status.flags
        self._report_card(before, status)
        return status

    def _check_restart(self, restarted: bool) -> None:  # noqa: FBT001
        # In any of the replies: a box may report it once. Believed in vain, it only
        # makes us read and send more.
        if restarted and not self._restart_flag:
            self.restarts += 1
            self.parameters_due = self._clock_after = -inf

    def _report_card(self, before: BoxStatus | None, status: BoxStatus) -> None:
        card, changed = status.card, self._card_changed
        self._card_changed = False
        if card is None:
            return
        if changed or (before is not None and before.card != card):
            self.events.publish(
                CardPresented(
                    group=card.group,
                    number=card.number,
                    user=card.user,
                    tag=card.tag,
                    readable=card.decode_error == 0,
                )
            )

    # -- Installation --------------------------------------------------------------

    async def read_parameters(self, turn: Turn) -> None:
        """Read the installation; without a reply, the defaults are assumed."""
        self.parameters_due = turn.now + PARAMETERS_RETRY
        try:
            system, _ = await self.read_confirmed(
                turn, SYSTEM_BLOCK.read, SYSTEM_BLOCK.decode
            )
        except ExchangeError:
            self.installation = self.installation or Installation()
            return
        await rest(0.0)
        second: int | None = None
        # One block counts, also when the other could not be read.
        with suppress(ExchangeError):
            extra, _ = await self.read_confirmed(
                turn, EXTRA_BLOCK.read, EXTRA_BLOCK.decode
            )
            second = extra.maximum_current_2
            self.parameters_due = turn.now + PARAMETERS_INTERVAL
        self.installation = self._installation(system, second)

    def _installation(
        self, system: SystemParameters, second: int | None
    ) -> Installation:
        """Return the installation; ``second``: port 2's maximum, A (0: as port 1).

        ``second`` is ``None`` where it could not be read: the last known one counts.
        """
        first = system.maximum_current or None
        if second is None:
            second = self.installation.maximum[1] if self.installation else None
        return Installation(
            ports=system.ports,
            mode=system.mode,
            mode_1=system.mode_1,
            fixed_cable=system.fixed_cable,
            maximum=(first, second or first),
        )

    # -- Ports ---------------------------------------------------------------------

    async def refresh(self, turn: Turn, oldest: float) -> None:
        """Read records older than ``oldest`` (loop time, s): up to three exchanges."""
        if self._ports_read_at < oldest or self.details is None:
            await self.read_ports(turn)
            await self.read_details(turn)
        if turn.now >= self.status_due:
            await self.read_status(turn)

    async def read_ports(self, turn: Turn) -> tuple[PortStatus, ...]:
        """Read ``rc``: the status of the ports.

        Implausible meters are read again, and hold up nothing else. Raises
        ImplausibleReplyError for replies that do not agree, and what `read` raises.
        """
        known = self.installation or Installation()
        decode = partial(decode_ports, mode_1=known.mode_1, count=known.ports)
        self.ports, is_current = await self.read_confirmed(
            turn,
            CommandId.READ_PORTS,
            decode,
            self._port_replies,
            lambda ports: self._check_meters(ports, turn.now),
        )
        # An info record that came meanwhile has outdated it.
        self._ports_read_at = turn.now if is_current else -inf
        return self.ports

    def _check_meters(self, ports: tuple[PortStatus, ...], now: float) -> bool:
        """Return whether the totals and the charges of all ports are accepted."""
        # All are checked, also after one that is not accepted.
        accepted = [
            meter.check(Total(port.total_energy, now))
            for meter, port in zip(self.meters, ports, strict=False)
        ]
        accepted += [
            session.check(Total(port.session_energy, now), port.session_time)
            for session, port in zip(self.sessions, ports, strict=False)
        ]
        return all(accepted)

    async def read_details(self, turn: Turn) -> Details:
        """Read ``rd``: limit and power of the ports."""
        details, _ = await self.read_confirmed(
            turn, CommandId.READ_DETAILS, decode_details, self._detail_replies
        )
        self.details = details
        return details

    @property
    def ports_expired(self) -> bool:
        """Return whether the status of the ports has to be read again."""
        return self._ports_read_at == -inf

    def expire_ports(self) -> None:
        """Read the status of the ports again before it is used."""
        self._ports_read_at = -inf

    def on_info(self, info: Info) -> None:
        """Process an info record: the readings before it are outdated."""
        self.info_count += 1
        self.expire_ports()
        if Change.CARD in info.changes:
            self._card_changed = True
            self.status_due = -inf
        now = asyncio.get_running_loop().time()
        for key in info.key_events:
            if self._key_limiter.take(now):
                self.events.publish(key)

    # -- Clock ---------------------------------------------------------------------

    def must_set_clock(self, zone: tzinfo | None, now: float) -> bool:
        """Return whether its clock is wrong and may be set again.

        ``zone``: the zone it is kept in; ``None``: it is left alone. ``now``: loop
        time, s.
        """
        status = self.status
        if zone is None or status is None or now < self._clock_after:
            return False
        if status.clock is None:
            return True
        off = (self._local(zone) - status.clock).total_seconds()
        return abs(off) > CLOCK_TOLERANCE

    def check_clock_soon(self) -> None:
        """Check its clock with the next reading: it is kept in another zone now."""
        self._clock_after = -inf

    async def set_clock(self, turn: Turn, zone: tzinfo) -> None:
        """Set its clock to the time in this zone.

        Raises EwsRefusedError, and what `read` raises.
        """
        self._clock_after = turn.now + CLOCK_PAUSE
        await self.send_command(
            turn, CommandId.SET_CLOCK, lambda: set_clock(self._local(zone))
        )
        self.status_due = -inf

    def _local(self, zone: tzinfo) -> datetime:
        return self.clock().astimezone(zone).replace(tzinfo=None, microsecond=0)
