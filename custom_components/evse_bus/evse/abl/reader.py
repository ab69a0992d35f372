"""Exchanges with one ABL wallbox, and the state read from it.

The identity is checked after each (re)connect and after each missed reply, before
anything else is exchanged (PROTOCOLS.md, 2).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain, repeat
from math import inf
from typing import ClassVar, Final, override

from ..charger import Charger
from ..conversation import rest
from ..errors import (
    ExchangeRefusedError,
    GarbledReplyError,
    NotConfirmedError,
    ReplyTimeoutError,
    WrongChargerError,
)
from ..exchange import Turn
from ..model import ChargerConfig, Fault, Orders, OrderState
from ..pause_watch import FOLLOW_TIME, NO_CURRENT
from ..registers import Registers
from ..safety import Setpoint
from .config import TIMING, AblConfig, Pauses
from .decisions import (
    FAILED_AFTER,
    FRESH,
    Decision,
    Evidence,
    Standing,
    Writes,
    believed_paused,
    decide,
    is_charging,
)
from .duty import PAUSE, current_for, highest_current
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
    CONFIGURATION_REGISTER,
    FLAGS,
    ICMAX,
    INFO,
    LIMIT_REGISTER,
    LONGEST_REQUEST,
    READING,
    SERIAL,
    STATE_REGISTER,
    Flags,
    Icmax,
    Info,
    Reading,
    Serial,
    StateCode,
    limit_duty,
    read_answer,
    read_request,
    write_answer,
    write_configuration,
    write_limit,
    write_state,
)
from .states import E0

FLAGS_INTERVAL: Final = 30.0
"""Time between two reads of the system flags, s."""
FLAGS_MISSES: Final = 3
"""Unanswered reads of the flags in a row after which the old flags are dropped."""

SETTLING: Final = (0.25, 0.5, 1.0)
"""Pauses between reads of a limit that does not show at once, s."""
PROBE_REQUESTS: Final = 3
"""Requests of one probe of a silent box, 0.7 s apart: one at a time never wakes it."""
ICMAX_PROBES: Final = 3
"""Unanswered reads of 0x000F, each after another reply, that prove its absence."""
ICMAX_ABSENT: Final = 600.0
"""Time after which that is tried again, s."""

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


@dataclass(frozen=True, slots=True)
class Cleanup:
    """A state that a command passes through, and the code that ends it."""

    code: StateCode
    state: int | None = None
    """``None``: any but E0 (the reset of a disabled outlet enables it)."""

    def is_needed(self, state: int) -> bool:
        """Return whether a box in this state must still be led out of it."""
        return state != E0 if self.state is None else state == self.state


class AblReader(Charger[AblConfig]):
    """One ABL wallbox: its exchanges, and the state read so far."""

    timing = TIMING
    pauses: ClassVar[Pauses] = Pauses()

    def __init__(self, config: AblConfig, orders: Orders) -> None:
        """Nothing is known of the box before its first reply."""
        super().__init__(config, orders)
        self.last_status: Reading | None = None
        """Contents of 0x002E, as read last."""
        self.reports_icmax: bool | None = None
        """It answers reads of 0x000F; ``None``: not known yet."""
        self.confirmed: int | None = None
        """Duty cycle (0.1 %) of the last limit that was read back."""
        self.writes = Writes()
        self.raise_pending = False
        """A limit was raised, and not written in the state the box was in."""
        self.missed = False
        """A reply was missed since the last limit was read back."""
        self.allowed_by_user = False
        """The user has allowed charging, and no reply was missed since."""
        self.limit_paused = False
        """Our limit of 0 A has paused it, and no reply was missed since."""
        self.pending_cleanup: Cleanup | None = None
        """State that a command brought about and has not ended yet."""
        self.paused_into_e0 = False
        """It was seen to go to E0 by itself, out of a confirmed pause of ours."""
        self._e0_sent_at = -inf
        self._serial: str | None = None
        self._info: Info | None = None
        self._flags: Flags | None = None
        self._icmax: Icmax | None = None
        self._icmax_at = -inf
        self._icmax_due = -inf
        self._icmax_silent = 0
        self._limits: Icmax | None = None
        """Contents of 0x000F, as read last from this box."""
        self._default: int | None = None
        self._check = StatusCheck()
        self._status_at = 0.0
        self._charging_since = inf
        self._state: int | None = None
        self._state_written: int | None = None
        self._identified = False
        self._flags_due = 0.0
        self._flags_missed = 0
        self._energy = EnergyEstimate(config.poll_interval)

    @override
    def reconfigure(self, config: ChargerConfig) -> None:
        super().reconfigure(config)
        self._energy.set_interval(config.poll_interval)

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
        # Identity (info, serial, each twice), status three times, Icmax twice, limit,
        # status and Icmax twice.
        return 14

    # -- Identity ----------------------------------------------------------------

    @override
    def on_line_open(self) -> None:
        self.invalidate()

    def invalidate(self) -> None:
        """Drop all state; the identity is checked before the next exchange."""
        self.last_status = None
        self._identified = False
        self._flags = None
        self._flags_due = 0.0
        self._icmax = self._limits = None
        self._check = StatusCheck()
        self.reports_icmax = None
        self._forget()
        self._energy.interrupt()

    @override
    def on_missed(self, now: float, why: str) -> None:
        super().on_missed(now, why)
        self._forget()
        # The next reply may come from another box.
        self._identified = False
        since = self.misses - self.timing.misses
        if since > 0 and since % PROBE_REQUESTS:
            # It may be asleep, and has lost the first request or two.
            self.slot.ready = self.slot.due = now + self.timing.retry_pauses[0]

    def _forget(self) -> None:
        """Drop what a power cut or another master may have changed unseen."""
        self.missed = True
        self.allowed_by_user = self.limit_paused = self.paused_into_e0 = False
        self.writes.forget()
        self._icmax_silent = 0

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
        if expected is not None and serial != expected:
            self.notice(Fault.WRONG_CHARGER, present=True)
            found = serial or "no serial number"
            message = f"found {found} at device-ID {address}, expected {expected}"
            self.set_unavailable(message)
            raise WrongChargerError(message, expected=expected, found=found)
        self.notice(Fault.WRONG_CHARGER, present=False)
        if serial != self._serial:
            self._default = self._limits = None
        self._serial = serial
        self._info = info
        if serial and self.orders.remembered.get(REPORTS_ICMAX) == serial:
            # Its silence is a missed reply from now on, and proves nothing.
            self.reports_icmax = True
        self._identified = True
        self.info = charger_info(info, serial, self._flags)

    async def _read_serial(self, turn: Turn, expected: str | None) -> str | None:
        """Return the serial number; ``None`` from a box that has none.

        Another than expected counts when two replies agree. The manual shows 0x0050 in an example only. Where no serial number is
        expected, silence means that there is no such register.
        """
        try:
            serial = await read(turn, self.config.address, SERIAL, attempts=2)
        except GarbledReplyError:
            raise
        except ReplyTimeoutError, ExchangeRefusedError:
            if self.config.serial is not None or self._serial is not None:
                raise
            return None
        known = None if expected is None else Serial(number=expected)
        agreed = await self._read_agreed(turn, SERIAL, known, first=serial)
        return agreed.number

    # -- Status, flags, Icmax ----------------------------------------------------

    async def poll_status(self, turn: Turn) -> Reading:
        """Read the status once, and the flags where due; keep and return it.

        The flags are due every `FLAGS_INTERVAL`, and when the status has changed.
        """
        status = await self._read_reading(turn)
        await self.read_icmax(turn)
        last = self.last_status
        if (
            last is None
            or (last.state, last.reduced) != (status.state, status.reduced)
            or turn.now >= self._flags_due
        ):
            await self.read_flags(turn)
        self.keep_status(status, turn.now)
        return status

    async def read_status(self, turn: Turn) -> Reading:
        """Read the status in the midst of a conversation, and keep it."""
        status = await self._read_reading(turn, attempts=2)
        await self.read_icmax(turn)
        self.keep_status(status, turn.now)
        return status

    async def _read_reading(self, turn: Turn, *, attempts: int = 1) -> Reading:
        """Read 0x002E until enough replies agree (see `StatusCheck`)."""
        address = self.config.address
        replies: list[Reading] = []
        for _ in range(MOST_READS):
            reading = await read(turn, address, READING, attempts=attempts)
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
        rated = None if self._limits is None else highest_current(self._limits.rated)
        return self.config.installation_limit if rated is None else rated

    @property
    def _grace(self) -> float:
        return max(SHORTEST_GRACE, FOLLOW_TIME + self.config.poll_interval)

    def keep_status(self, status: Reading, now: float) -> None:
        """Keep a status read at a loop time (s), and make the reading of it."""
        self._note_e0(status.state, now)
        self._note_state(status.state, now)
        self.last_status = status
        self._status_at = now
        decision = self.decide(now)
        if self._info is None or decision is None:
            return
        snapshot = Snapshot(
            reading=status,
            info=self._info,
            flags=self._flags,
            icmax=self._icmax,
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
        self._watch_pause(self.evidence(status, now), now)

    def _watch_pause(self, seen: Evidence, now: float) -> None:
        """Notice a car that charges against a pause (rows 2 and 13)."""
        patience = STILL_CHARGING if seen.charging else None
        if seen.current is not None and seen.current > NO_CURRENT:
            patience = FOLLOW_TIME
        self.watch_pause(now, shown=believed_paused(seen) is True, patience=patience)

    def _note_e0(self, state: int, now: float) -> None:
        before = self.last_status
        if state != E0 or before is None:
            self.paused_into_e0 = False
        elif before.state != E0:
            confirmed = self.order_state is OrderState.CONFIRMED
            self.paused_into_e0 = (
                self.code == PAUSE
                and confirmed
                and not self.missed
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

    def _note_state(self, state: int, now: float) -> None:
        if not is_charging(state):
            self._charging_since = inf
        elif self._charging_since == inf:
            self._charging_since = now
        self._state = state

    async def read_icmax(self, turn: Turn) -> None:
        """Read Icmax, after another reply; find out whether the box answers at all."""
        if self.reports_icmax is False:
            if turn.now < self._icmax_due:
                return
            self.reports_icmax = None
            self._icmax_silent = 0
        try:
            icmax = await self._read_icmax(turn)
        except GarbledReplyError:
            return
        except ExchangeRefusedError:
            self._icmax_silent = ICMAX_PROBES
        except ReplyTimeoutError:
            self._icmax_silent += 1
        else:
            await self._keep_icmax(icmax, turn.now)
            return
        if self.reports_icmax is None and self._icmax_silent >= ICMAX_PROBES:
            self.reports_icmax = False
            self._icmax_due = turn.now + ICMAX_ABSENT

    async def _read_icmax(self, turn: Turn) -> Icmax:
        """Read 0x000F; what is neither known nor just written is read twice."""
        known = self._limits
        icmax = await read(turn, self.config.address, ICMAX)
        self.reports_icmax = True
        if known is not None and self.writes.code is not None:
            written = replace(known, duty=self.writes.code)
            if icmax == written:
                return icmax
        return await self._read_agreed(turn, ICMAX, known, first=icmax)

    async def _keep_icmax(self, icmax: Icmax, now: float) -> None:
        self._icmax = self._limits = icmax
        self._icmax_at = now
        self._icmax_silent = 0
        self.reports_icmax = True
        if highest_current(icmax.default) is not None:
            self._default = icmax.default
        if icmax.duty not in (0, PAUSE) and self.code != PAUSE:
            # It has ended: a later pause is not ours.
            await self.note_pause(by_limit=False)
        if self._serial is not None and self._identified:
            await self.remember(REPORTS_ICMAX, self._serial)

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
        self._flags_due = turn.now + FLAGS_INTERVAL
        if self._info is not None:
            self.info = charger_info(self._info, self._serial, self._flags)

    # -- Evidence of the registers -------------------------------------------------

    @property
    def code(self) -> int:
        """Return Icmax that the orders come to, 0.1 %."""
        return limit_duty(self.setpoint)

    @property
    def highest(self) -> float | None:
        """Return the highest current that the box allows, A; ``None``: not reported."""
        return None if self._default is None else highest_current(self._default)

    def evidence(self, status: Reading, now: float) -> Evidence:
        """Return what was read, with Icmax if it is fresh."""
        known = [current for current in status.currents if current is not None]
        fresh = self._icmax is not None and now - self._icmax_at <= FRESH
        return Evidence(
            state=status.state,
            ic=status.duty,
            reports_icmax=self.reports_icmax,
            icmax=self._icmax.duty if self._icmax is not None and fresh else None,
            current=max(known, default=None),
            charging_for=max(0.0, now - self._charging_since),
        )

    def standing(self, now: float) -> Standing:
        """Return the order that stands, and what has become of it."""
        code = self.code
        writes = self.writes
        acknowledged = writes.acknowledged if writes.code == code else None
        return Standing(
            code=code,
            acknowledged=None if acknowledged is None else now - acknowledged,
            state_changed=self._state_written != self._state,
            raised=self.raise_pending,
            confirmed=self.confirmed is not None,
            missed=self.missed,
            allowed=self.allowed_by_user,
            failed=writes.failed(code, now),
            charges=Fault.CHARGES_ALTHOUGH_PAUSED in self.noticed,
        )

    def decide(self, now: float) -> Decision | None:
        """Return what is known about the order; ``None``: nothing was read yet."""
        if self.last_status is None:
            return None
        return decide(self.evidence(self.last_status, now), self.standing(now))

    @property
    def order_state(self) -> OrderState | None:
        """Return what was proved about the order when the status was read last."""
        decision = self.decide(self._status_at)
        return None if decision is None else decision.state

    @property
    def paused(self) -> bool | None:
        """Return whether the box is paused, as far as its registers show."""
        if self.last_status is None:
            return None
        return believed_paused(self.evidence(self.last_status, self._status_at))

    @property
    def paused_by_our_limit(self) -> bool:
        """Return whether a limit of 0 A of ours has paused it, not the user.

        After a restart or a missed reply that needs proof: the serial number, and the
        pause in its register.
        """
        noted = self.orders.remembered.get(PAUSED_BY_LIMIT)
        proved = noted is not None and noted == self.serial and self.paused is True
        return self.limit_paused or proved

    async def note_pause(self, *, by_limit: bool) -> None:
        """Note who has paused the box, also for the time after a restart."""
        self.limit_paused = by_limit
        await self.remember(PAUSED_BY_LIMIT, self.serial if by_limit else None)

    # -- Writes ------------------------------------------------------------------

    async def apply_setpoint(
        self,
        turn: Turn,
        setpoint: Callable[[], Setpoint],
        *,
        starts: bool = False,
        patience: float = FAILED_AFTER,
    ) -> Reading:
        """Write a set-point until the register that means it shows it.

        ``setpoint`` is called right before each write: the orders may change.
        ``starts``: a pause that is read back does not count as below. Waits for
        ``patience`` seconds at most. Returns the status that confirms it.

        Raises NotConfirmedError when the box does not follow, ExchangeRefusedError
        when it refuses.
        """
        until = turn.now + patience
        pauses = chain(SETTLING, repeat(SETTLING[-1]))
        refused: ExchangeRefusedError | None = None
        has_rested = False
        while True:
            over = turn.now >= until
            due = self.writes.due(limit_duty(setpoint()))
            try:
                if turn.now >= due and not over:
                    # A reply may have been missed since the last turn.
                    await self.identify(turn)
                    await self._write_limit(turn, setpoint)
                status = await self.read_status(turn)
            except ExchangeRefusedError as error:
                # It may have been taken all the same: read first, then repeat.
                refused = error
                status = await self.read_status(turn)
            except ReplyTimeoutError:
                # Before a rest the bus repeats the whole conversation.
                if not has_rested or over:
                    raise
                await rest(next(pauses))
                continue
            code = limit_duty(setpoint())
            if self._is_taken(status, turn.now, code, starts=starts, finally_=over):
                if code != PAUSE:
                    self.confirmed = code
                self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
                return status
            if over:
                break
            await rest(min(next(pauses), max(until - turn.now, 0.0)))
            has_rested = True
        # Where the pause is taken, the car alone is the problem (`_watch_pause`).
        taken = code == PAUSE and self.writes.acknowledged is not None
        not_taken = not taken or self.paused is False
        self.notice(Fault.LIMIT_NOT_TAKEN, present=not_taken)
        if refused is not None:
            raise refused
        message = f"{self.config.name} does not follow its limit"
        raise NotConfirmedError(message)

    async def _write_limit(self, turn: Turn, setpoint: Callable[[], Setpoint]) -> None:
        def request() -> bytes:
            wanted = setpoint()
            code = limit_duty(wanted)
            if self.writes.is_repeat(code, turn.now):
                self.statistics.reasserted += 1
            self.writes.wrote(code, turn.now)
            self.raise_pending = False
            # Only what is read after the write counts.
            self._icmax = None
            return write_limit(self.config.address, wanted)

        try:
            await turn.exchange(
                request, write_answer(self.config.address, LIMIT_REGISTER)
            )
        except ReplyTimeoutError:
            self.writes.unanswered()
            raise
        self.writes.acknowledge(turn.now)
        self._state_written = self._state

    def _is_taken(
        self, status: Reading, now: float, code: int, *, starts: bool, finally_: bool
    ) -> bool:
        """Return whether what was just read confirms a code.

        ``finally_``: there is no more time to wait for a raise.
        """
        seen = self.evidence(status, now)
        if PAUSE in (seen.ic, seen.icmax):
            return code == PAUSE or not starts
        if seen.reports_icmax:
            if seen.icmax is None or code == PAUSE:
                return False
            return seen.icmax == code or (finally_ and seen.icmax < code)
        if self.writes.code != code or self.writes.acknowledged is None:
            return False
        if seen.reports_icmax is None:
            # It may still show that it can be read.
            return False
        return seen.idle if code == PAUSE else 0 < seen.ic <= code

    async def set_state(self, turn: Turn, code: StateCode) -> bool:
        """Write a state code once; return whether the box has confirmed it.

        A reply that stays away decides nothing: the state has to be read.
        """
        if code is StateCode.E0:
            self._e0_sent_at = turn.now
        try:
            await turn.exchange(
                write_state(self.config.address, code),
                write_answer(self.config.address, STATE_REGISTER),
            )
        except ReplyTimeoutError:
            return False
        return True

    async def set_configuration(
        self,
        turn: Turn,
        *,
        upstream_timeout: bool | None = None,
        needs_enable: bool | None = None,
    ) -> None:
        """Write settings (in E2); ``None``: no change."""
        request = write_configuration(
            self.config.address,
            self.config.address,
            upstream_timeout=upstream_timeout,
            needs_enable=needs_enable,
        )
        await turn.exchange(
            request, write_answer(self.config.address, CONFIGURATION_REGISTER)
        )
