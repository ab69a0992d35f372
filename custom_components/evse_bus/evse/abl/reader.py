"""One ABL wallbox as far as it is read: identity, status, and the reading of it.

The identity is checked after each (re)connect and after each missed reply, before
anything else is exchanged (PROTOCOLS.md, 2).
"""

import asyncio
from collections import deque
from dataclasses import replace
from math import inf
from typing import ClassVar, Final, override

from ..charger import Charger
from ..conversation import FollowUp
from ..errors import (
    ExchangeRefusedError,
    GarbledReplyError,
    ReplyTimeoutError,
    WrongChargerError,
)
from ..exchange import Turn
from ..framing import Frame
from ..modbus import ModbusFrame
from ..model import ChargerConfig, Fault, Orders, OrderState
from ..pause_watch import FOLLOW_TIME, NO_CURRENT
from ..registers import Registers
from .config import TIMING, AblConfig, Pauses
from .decisions import (
    Decision,
    Standing,
)
from .duty import PAUSE, current_for
from .evidence import BoxEvidence
from .exchanges import collect
from .plausibility import MOST_READS, StatusCheck, agreeing
from .readings import (
    EnergyEstimate,
    Snapshot,
    charger_info,
    charger_reading,
    phase_currents,
    power_of,
)
from .registers import (
    FLAGS,
    ICMAX,
    INFO,
    LONGEST_REQUEST,
    READING,
    SERIAL,
    Flags,
    Icmax,
    Info,
    Reading,
    Serial,
    limit_duty,
    read_answer,
    read_request,
)
from .states import E0

SERIAL_PROBES: Final = 2
"""Identifications in which 0x0050 is silent that prove its absence."""
SURPLUS_REPLIES: Final = 3
"""Replies that belong to no request, within `SURPLUS_TIME`, that suggest a second box;
a damaged reply or one too many does not."""
SURPLUS_TIME: Final = 10.0
"""s"""
FLAGS_INTERVAL: Final = 30.0
"""Time between two reads of the system flags, s."""
FLAGS_MISSES: Final = 3
"""Unanswered reads of the flags in a row after which the old flags are dropped."""

PROBE_REQUESTS: Final = 3
"""Requests of one probe of a silent box, 0.7 s apart: one at a time never wakes it."""
SHORTEST_GRACE: Final = 15.0
"""A car may draw more than a new limit for this long, or longer, s."""
STILL_CHARGING: Final = 30.0
"""A box that measures no current, and is in C for so long after its pause, has not
followed it, s."""

E0_OURS: Final = 60.0
"""An E0 so soon after a request for it is no E0 by itself, s."""

REPORTS_ICMAX: Final = "reports_icmax"
"""Note with the orders: serial number of the box that has answered 0x000F."""
PAUSED_BY_LIMIT: Final = "paused_by_limit"
"""Note with the orders: serial number of the box that a limit of 0 A has paused."""


async def read[T](
    turn: Turn, address: int, registers: Registers[T], *, attempts: int = 1
) -> T:
    """Return the contents of a block; raises what `Turn.exchange` raises.

    More than one attempt is for a box known to be awake: its reply was disturbed, and
    an immediate repeat helps.
    """
    request = read_request(address, registers.block)
    answer = read_answer(address, registers.block)
    for _ in range(attempts - 1):
        try:
            return registers.decode(await turn.exchange(request, answer))
        except ReplyTimeoutError:
            continue
    return registers.decode(await turn.exchange(request, answer))


class AblReader(Charger[AblConfig]):
    """One ABL wallbox, as far as it is read."""

    timing = TIMING
    pauses: ClassVar[Pauses] = Pauses()

    def __init__(self, config: AblConfig, orders: Orders) -> None:
        """Nothing is known of the box before its first reply."""
        super().__init__(config, orders)
        self.box = BoxEvidence()
        self.limit_paused = False
        """Our limit of 0 A has paused it, and no reply was missed since."""
        self.paused_into_e0 = False
        """It was seen to go to E0 by itself, out of a confirmed pause of ours."""
        self._e0_sent_at = -inf
        self._serial: str | None = None
        self._info: Info | None = None
        self._flags: Flags | None = None
        self._check = StatusCheck()
        self._identified = False
        self._serial_silent = 0
        """Identifications without a reply to the reads of the serial number."""
        self._surplus: deque[float] = deque(maxlen=SURPLUS_REPLIES)
        """Loop times of the last replies that belong to no request, s."""
        self._doubted = False
        """Perhaps a second, slower box answers, too."""
        self._flags_due = 0.0
        self._flags_missed = 0
        self._energy = EnergyEstimate(config.poll_interval)

    @override
    def reconfigure(self, config: ChargerConfig) -> None:
        super().reconfigure(config)
        self._energy.set_interval(config.poll_interval)
        if config.serial not in (None, self._serial):
            # It was typed in: another box may answer.
            self.require_identification()

    @property
    def has_meter(self) -> bool:
        """Return whether the box is known to measure currents."""
        return self._info is not None and self._info.meter

    @property
    @override
    def longest_request(self) -> int:
        return LONGEST_REQUEST

    @property
    @override
    def exchanges_per_turn(self) -> int:
        # Identity (info, serial, each twice; serial for a second box), status three
        # times, Icmax twice, limit, status and Icmax twice.
        return 15

    # -- Identity ----------------------------------------------------------------

    @override
    def on_line_open(self) -> None:
        self.invalidate()

    def invalidate(self) -> None:
        """Drop all state; the identity is checked before the next exchange."""
        self.require_identification()
        self.box.invalidate()
        self._flags = None
        self._flags_due = 0.0
        self._check = StatusCheck()
        self._forget()
        self._energy.interrupt()

    def require_identification(self) -> None:
        """Check the identity before the next exchange: another box may answer."""
        self._identified = False

    @override
    def on_missed(self, now: float, why: str) -> None:
        super().on_missed(now, why)
        self._forget()
        # The next reply may come from another box.
        self.require_identification()
        since = self.misses - self.timing.misses
        if since > 0 and since % PROBE_REQUESTS:
            # It may be asleep, and has lost the first request or two.
            self.slot.ready = self.slot.due = now + self.timing.retry_pauses[0]

    @override
    def plan(self, now: float) -> None:
        super().plan(now)
        if 0 < self.box.icmax_misses < self.timing.misses:
            # As after any missed reply. What it does answer is shown all the same.
            self.slot.ready = self.slot.due = now + self.timing.retry_pauses[0]

    def _forget(self) -> None:
        """Drop what a power cut or another master may have changed unseen."""
        self.box.forget()
        self.limit_paused = self.paused_into_e0 = False

    @property
    def serial(self) -> str | None:
        """Return the serial number that was read at this address."""
        return self._serial if self._identified else None

    async def identify(self, turn: Turn) -> None:
        """Check that the right box answers, unless that is known already.

        Raises WrongChargerError, and then nothing may be written.
        """
        if self._identified:
            return
        address = self.config.address
        info = await self._read_agreed(turn, INFO, self._info)
        expected = self.config.serial or self._serial
        serial = await self._read_serial(turn, expected)
        if self.is_wrong(serial, expected):
            self.notice(Fault.WRONG_CHARGER, present=True)
            found = serial or "no serial number"
            message = f"found {found} at device-ID {address}, expected {expected}"
            self.set_unavailable(message)
            raise WrongChargerError(message, expected=expected, found=serial)
        self.notice(Fault.WRONG_CHARGER, present=False)
        if self._doubted:
            await self._require_alone(turn, serial)
        if serial != self._serial:
            self.box.replaced()
        self._serial = serial
        self._info = info
        if serial and self.orders.remembered.get(REPORTS_ICMAX) == serial:
            # Its silence is a missed reply from now on, and proves nothing.
            self.box.reports_icmax = True
        self._identified = True
        self.info = charger_info(info, serial, self._flags)

    async def _require_alone(self, turn: Turn, serial: str | None) -> None:
        """Wait for all replies to one read; raises GarbledReplyError for two boxes."""
        address = self.config.address
        if serial is None:
            is_alone = len(await collect(turn, address, INFO, disturbed=False)) == 1
        else:
            replies = await collect(turn, address, SERIAL, disturbed=False)
            is_alone = all(one.number == serial for one in replies)
        if not is_alone:
            message = f"several boxes answer at device-ID {address}"
            raise GarbledReplyError(message)
        self._surplus.clear()
        self._doubted = False

    @override
    def on_unsolicited(self, frame: Frame) -> FollowUp | None:
        if (
            isinstance(frame, ModbusFrame)
            and frame.is_reply
            and frame.unit == self.config.address
        ):
            # The first reply is taken for the reply: a slower box with the same
            # device-ID shows only here, and obeys the same writes.
            now = asyncio.get_running_loop().time()
            self._surplus.append(now)
            several = len(self._surplus) == SURPLUS_REPLIES
            if several and now - self._surplus[0] <= SURPLUS_TIME:
                self._doubted = True
                self._identified = False
        return None

    async def _read_serial(self, turn: Turn, expected: str | None) -> str | None:
        """Return the serial number; ``None`` from a box that has none.

        Another than expected counts when two replies agree. The manual shows 0x0050 in
        an example only: where no serial number is expected, silence means that there is
        no such register.
        """
        try:
            serial = await read(turn, self.config.address, SERIAL, attempts=2)
        except GarbledReplyError:
            raise
        except (ReplyTimeoutError, ExchangeRefusedError) as error:
            if self.config.serial is not None or self._serial is not None:
                raise
            self._serial_silent += isinstance(error, ReplyTimeoutError)
            if 0 < self._serial_silent < SERIAL_PROBES:
                # Replies may be lost: without its number a box of another master
                # would be taken for one of its own.
                raise
            return None
        self._serial_silent = 0
        known = None if expected is None else Serial(number=expected)
        agreed = await self._read_agreed(turn, SERIAL, known, first=serial)
        return agreed.number

    # -- Status, flags, Icmax ----------------------------------------------------

    async def poll_status(self, turn: Turn) -> Reading:
        """Read the status once, and the flags where due; keep and return it.

        The flags are due every `FLAGS_INTERVAL`, when the status has changed, and at
        each poll while the car draws too much.
        """
        status = await self._read_reading(turn)
        await self.read_icmax(turn)
        last = self.box.status
        if (
            last is None
            or (last.state, last.reduced) != (status.state, status.reduced)
            or turn.now >= self._flags_due
        ):
            await self.read_flags(turn)
        self.keep_status(status, turn.now)
        return status

    async def read_status(self, turn: Turn) -> Reading:
        """Read the status in the midst of a conversation, and keep it.

        After a missed reply the box is identified first.
        """
        await self.identify(turn)
        status = await self._read_reading(turn, attempts=2)
        await self.read_icmax(turn)
        self.keep_status(status, turn.now)
        return status

    async def _read_reading(self, turn: Turn, *, attempts: int = 1) -> Reading:
        """Read 0x002E until enough replies agree (see `StatusCheck`)."""
        address = self.config.address
        replies: list[Reading] = []
        for _ in range(MOST_READS):
            try:
                reading = await read(turn, address, READING, attempts=attempts)
            except ReplyTimeoutError:
                self.require_identification()
                raise
            # It is awake.
            attempts = 2
            if replies and not agreeing(replies[-1], reading):
                self.statistics.implausible += len(replies)
                replies.clear()
            replies.append(reading)
            needed = self._check.needed(
                reading, turn.now, maximum=self._maximum, grace=self._grace
            )
            if len(replies) >= needed:
                return reading
        raise self._disagreement()

    async def _read_agreed[T](
        self,
        turn: Turn,
        registers: Registers[T],
        known: T | None,
        *,
        first: T | None = None,
    ) -> T:
        """Read a block; other contents than known ones count when two replies agree.

        ``first``: the reply to a read just before.
        """
        address = self.config.address
        contents = await read(turn, address, registers) if first is None else first
        for _ in range(MOST_READS - 1):
            if contents == known:
                return contents
            again = await read(turn, address, registers, attempts=2)
            if again == contents:
                return contents
            self.statistics.implausible += 1
            contents = again
        raise self._disagreement()

    def _disagreement(self) -> GarbledReplyError:
        """Return the error for replies that do not agree: perhaps of two boxes."""
        return GarbledReplyError(f"{self.config.name}: replies that do not agree")

    @property
    def _maximum(self) -> float:
        """Return the highest current that can be meant, A.

        The rated one, reported by the box, else that of the wiring.
        """
        rated = self.box.rated
        return self.config.installation_limit if rated is None else rated

    @property
    def _grace(self) -> float:
        return max(SHORTEST_GRACE, FOLLOW_TIME + self.config.poll_interval)

    def keep_status(self, status: Reading, now: float) -> None:
        """Keep a status read at a loop time (s), and make the reading of it."""
        self._note_e0(status.state, now)
        self.box.keep_status(status, now)
        decision = self.decide(now)
        if self._info is None or decision is None:
            return
        snapshot = Snapshot(
            reading=status,
            info=self._info,
            flags=self._flags,
            icmax=self.box.icmax,
            paused=decision.paused,
            offered=decision.offered,
        )
        offered = None if decision.offered is None else current_for(decision.offered)
        self._check.keep(
            status, now, offered=offered, maximum=self._maximum, grace=self._grace
        )
        self.notice(Fault.OVERCURRENT, present=self._check.over_current)
        exceeded = self._check.limit_exceeded and not decision.paused
        self.notice(Fault.LIMIT_EXCEEDED, present=exceeded)
        currents = phase_currents(snapshot, self.config.phase_order)
        power = power_of(currents, self.config.voltage)
        self._energy.add(power, now)
        energy = self._energy.energy if self._info.meter else None
        reading = charger_reading(snapshot, currents, power, energy)
        changed = reading != self.reading
        self.reading = reading
        if changed:
            self.updated()
        self._watch_pause(now)

    def _watch_pause(self, now: float) -> None:
        """Notice a car that charges against a pause (rows 2 and 13)."""
        seen = self.box.seen(now)
        patience = STILL_CHARGING if seen and seen.charging else None
        if seen and seen.current is not None and seen.current > NO_CURRENT:
            patience = FOLLOW_TIME
        self.watch_pause(now, shown=self.box.paused is True, patience=patience)

    def on_e0_sent(self, now: float) -> None:
        """Take note that E0 is requested: it does not go there by itself."""
        self._e0_sent_at = now

    def _note_e0(self, state: int, now: float) -> None:
        before = self.box.status
        if state != E0 or before is None:
            self.paused_into_e0 = False
        elif before.state != E0:
            confirmed = self.order_state is OrderState.CONFIRMED
            self.paused_into_e0 = (
                self.code == PAUSE
                and confirmed
                and not self.box.missed
                and now - self._e0_sent_at > E0_OURS
            )

    @property
    def may_enable_again(self) -> bool:
        """Return whether the user's permission may end an E0 that it went to by itself.

        Not where an enable input or the box itself has a say in it.
        """
        return (
            self.config.enable_again
            and self.paused_into_e0
            and self._flags is not None
            and not self._flags.e0_a1_disabled
            and self._info is not None
            and self._info.enable_input == "none"
        )

    async def read_icmax(self, turn: Turn) -> None:
        """Read Icmax, after another reply; find out whether the box answers at all."""
        box = self.box
        if not box.is_icmax_due(turn.now):
            return
        try:
            icmax = await self._read_icmax(turn)
        except GarbledReplyError:
            return
        except (ExchangeRefusedError, ReplyTimeoutError) as error:
            refused = isinstance(error, ExchangeRefusedError)
            box.on_icmax_silent(turn.now, refused=refused)
            if box.icmax_misses:
                # It has missed a request, though it has answered the one before.
                self._forget()
                self.require_identification()
            return
        box.keep_icmax(icmax, turn.now)
        if icmax.duty not in (0, PAUSE) and self.code != PAUSE:
            # It has ended: a later pause is not ours.
            await self.note_pause(by_limit=False)
        if self.serial is not None:
            await self.standing_orders.remember(REPORTS_ICMAX, self.serial)

    async def _read_icmax(self, turn: Turn) -> Icmax:
        """Read 0x000F; what is neither known nor just written is read twice."""
        known, written = self.box.known_icmax, self.box.writes.code
        # Where it is known to be there, a lost reply was disturbed.
        attempts = 2 if self.box.reports_icmax else 1
        icmax = await read(turn, self.config.address, ICMAX, attempts=attempts)
        self.box.reports_icmax = True
        if known and written is not None and icmax == replace(known, duty=written):
            return icmax
        return await self._read_agreed(turn, ICMAX, known, first=icmax)

    async def read_flags(self, turn: Turn) -> None:
        """Read the flags; without a reply the old values count for a while."""
        try:
            self._flags = await self._read_agreed(turn, FLAGS, self._flags)
        except ReplyTimeoutError, ExchangeRefusedError:
            self._flags_missed += 1
            if self._flags_missed >= FLAGS_MISSES:
                self._flags = None
                self._flags_due = turn.now + FLAGS_INTERVAL
            return
        self._flags_missed = 0
        # A car that is still slowing down draws too much for a moment only.
        passes = (self._flags.overcurrent or 0) > 0
        self._flags_due = turn.now + (0.0 if passes else FLAGS_INTERVAL)
        if self._info is not None:
            self.info = charger_info(self._info, self._serial, self._flags)

    # -- The order that stands ------------------------------------------------------

    @property
    def code(self) -> int:
        """Return Icmax that the orders come to, 0.1 %."""
        return limit_duty(self.setpoint)

    def standing(self, now: float) -> Standing:
        """Return the order that stands, and what has become of it."""
        charges = Fault.CHARGES_ALTHOUGH_PAUSED in self.noticed
        return self.box.standing(self.code, now, charges=charges)

    def decide(self, now: float) -> Decision | None:
        """Return what is known about the order; ``None``: nothing was read yet."""
        return self.box.decide(self.standing(now), now)

    @property
    def order_state(self) -> OrderState | None:
        """Return what was proved about the order when the status was read last."""
        decision = self.decide(self.box.status_at)
        return None if decision is None else decision.state

    # -- Who has paused it ---------------------------------------------------------

    @property
    def paused_by_our_limit(self) -> bool:
        """Return whether a limit of 0 A of ours has paused it, not the user.

        After a restart or a missed reply that needs proof: the serial number, and the
        pause in its register.
        """
        noted = self.orders.remembered.get(PAUSED_BY_LIMIT)
        proved = noted is not None and noted == self.serial and self.box.paused is True
        # A pause by a ceiling needs more: the same car (`CeilingPause`).
        return self.limit_paused or (proved and self.governance.unproved is None)

    async def note_pause(self, *, by_limit: bool) -> None:
        """Note who has paused the box, also for the time after a restart."""
        self.limit_paused = by_limit
        await self.standing_orders.remember(
            PAUSED_BY_LIMIT, self.serial if by_limit else None
        )
