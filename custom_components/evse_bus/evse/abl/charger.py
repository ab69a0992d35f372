"""One ABL wallbox (EVCC2/3): what to ask, what to check, what to repeat.

The box is read first, always; its limit is asserted downward whenever it is read
back above the order (Icmax does not survive a power cycle), and permission is never
given by ourselves. PROTOCOLS.md, 2.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final, override

from ..charger import Charger
from ..exchange import Talk
from ..framing import Timing
from ..jobs import Later
from ..model import (
    Capability,
    ChargerConfig,
    Command,
    ExchangeRefusedError,
    Fault,
    GarbledReplyError,
    Limits,
    NotAvailableError,
    NotConfirmedError,
    OrderChange,
    Orders,
    Phases,
    ReplyTimeoutError,
    WrongChargerError,
)
from ..safety import Setpoint, clamp
from ..turns import Turns, in_turns
from .commands import CommandSet
from .duty import PAUSE, is_within
from .exchanges import read, set_limit
from .readings import (
    EnergyEstimate,
    Told,
    charger_info,
    charger_reading,
    phase_currents,
    power_of,
)
from .registers import (
    FLAGS,
    ICMAX,
    INFO,
    LONGEST_REPLY,
    LONGEST_REQUEST,
    READING,
    SERIAL,
    Flags,
    Info,
    Reading,
    decode_flags,
    decode_icmax,
    decode_info,
    decode_reading,
    decode_serial,
    limit_duty,
)
from .states import E0, SETUP

TIMING: Final = Timing(
    # A box answers within some milliseconds; network adapters take longer.
    reply_timeout=0.3,
    longest_reply=LONGEST_REPLY,
    # The first request after an idle time is lost; the repeat comes 0.7 s after it.
    retry_pauses=(0.4, 1.0),
)

FLAGS_INTERVAL: Final = 30.0
"""Time between two readings of the system flags, s."""
FLAGS_MISSES: Final = 3
"""Flags left unanswered in a row until the old ones no longer count."""
GARBLED: Final = 3
"""Unreadable answers in a row that look like two boxes with one ID."""
WRITES: Final = 2
"""How often a limit is written until it must be read back."""
SETTLING: Final = 0.25
"""Time a box is given to follow a limit that is not read back at once, s."""

_CAPABILITIES: Final = frozenset(
    {
        Capability.STATUS,
        Capability.RAW_STATE,
        Capability.PLUGGED,
        Capability.CHARGING,
        Capability.OFFERED_CURRENT,
        Capability.FAULTS,
        Capability.UPSTREAM_TIMEOUT,
        Capability.ENABLE_AFTER_POWER_CYCLE,
        Capability.OUTLET_ENABLED,
        Capability.RESET,
        Capability.WAKE,
        Capability.SET_ADDRESS,
    }
)
_WITH_METER: Final = frozenset(
    {Capability.CURRENT, Capability.ESTIMATED_POWER, Capability.ESTIMATED_ENERGY}
)


@dataclass(frozen=True, slots=True, kw_only=True)
class AblConfig(ChargerConfig):
    """What the user set up for one ABL wallbox."""

    phase_order: Phases[int] = (1, 2, 3)
    """The phase that each of Ict1, Ict2, Ict3 measures; some boxes begin with L3."""

    def __post_init__(self) -> None:
        """Raise ValueError for what is no order of three phases."""
        if sorted(self.phase_order) != [1, 2, 3]:
            message = f"{self.phase_order} is no order of the phases 1, 2, 3"
            raise ValueError(message)


class AblCharger(Charger):
    """One ABL wallbox."""

    timing = TIMING

    def __init__(self, config: ChargerConfig, orders: Orders) -> None:
        """Take the set-up; the box is not known before it answers."""
        super().__init__(config, orders)
        self.raw: Reading | None = None
        """What 0x002E told last, undecided."""
        self.owes_a1 = False
        """We disabled the outlet to wake a car, and have not enabled it again."""
        self._commands = CommandSet(self)
        self._serial: str | None = None
        self._info: Info | None = None
        self._flags: Flags | None = None
        self._icmax: int | None = None
        self._tells_icmax: bool | None = None
        self._identified = False
        self._flags_due = 0.0
        self._flags_missed = 0
        self._garbled = 0
        self._conversations: set[object] = set()
        self._confirmed: int | None = None
        self._limit_paused = False
        self._fell_back = False
        self._energy = EnergyEstimate(config.poll_interval)

    @property
    @override
    def capabilities(self) -> frozenset[Capability]:
        known = _CAPABILITIES
        if self._info is not None and self._info.meter:
            known |= _WITH_METER
        if self.config.order_lifetime is not None:
            # The box has no such value; it counts when orders are not renewed.
            known |= {Capability.FAIL_SAFE_CURRENT}
        return known

    @property
    @override
    def limits(self) -> Limits:
        return Limits(installation=self.config.installation_limit)

    @property
    @override
    def longest_request(self) -> int:
        return LONGEST_REQUEST

    @property
    @override
    def exchanges_per_turn(self) -> int:
        # Identity (info, serial twice), reading, limit, reading twice.
        return 7

    # -- Who it is ---------------------------------------------------------------

    @override
    def on_line_open(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Ask anew who it is before anything else is said."""
        self.raw = None
        self._identified = False
        self._flags = None
        self._flags_due = 0.0
        self._icmax = None
        self._tells_icmax = None
        self._energy.interrupt()

    @override
    def missed(self, now: float) -> None:
        super().missed(now)
        # Whoever answers next may be another one.
        self._identified = False

    @property
    def serial(self) -> str | None:
        """Return the serial number that was read at this address."""
        return self._serial if self._identified else None

    async def identify(self, talk: Talk) -> Info:
        """Make sure that the right box answers; return what it is.

        Raises WrongChargerError, and then nothing may be written.
        """
        if self._identified and self._info is not None:
            return self._info
        address = self.config.address
        info = decode_info(await read(talk, address, INFO))
        serial = await self._read_serial(talk)
        expected = self.config.serial or self._serial
        if expected is not None and serial != expected:
            self._tell(Fault.WRONG_CHARGER, present=True)
            self.set_unavailable()
            found = serial or "no serial number"
            message = f"at device-ID {address} answers {found}, not {expected}"
            raise WrongChargerError(message, expected=expected, found=found)
        self._tell(Fault.WRONG_CHARGER, present=False)
        self._serial = serial
        self._info = info
        self._identified = True
        self.info = charger_info(info, serial, self._flags)
        return info

    async def _read_serial(self, talk: Talk) -> str | None:
        """Return the serial number; ``None`` from a box that tells none.

        The manual shows 0x0050 in an example only. Where no serial number is
        expected, silence is taken for a register that is not there.
        """
        try:
            data = await read(talk, self.config.address, SERIAL, attempts=2)
        except GarbledReplyError:
            raise
        except ReplyTimeoutError:
            if self.config.serial is not None or self._serial is not None:
                raise
            return None
        return decode_serial(data)

    # -- The regular exchange ----------------------------------------------------

    @override
    async def poll(self, talk: Talk) -> Later[None] | None:
        try:
            await self.identify(talk)
            before = self.raw
            raw = await self._read(talk)
        except GarbledReplyError:
            self._garbled += 1
            if self._garbled >= GARBLED:
                self._tell(Fault.DUPLICATE_ADDRESS, present=True)
            raise
        self._garbled = 0
        self._tell(Fault.DUPLICATE_ADDRESS, present=False)
        changed = before is None or (before.state, before.reduced) != (
            raw.state,
            raw.reduced,
        )
        if changed or talk.now >= self._flags_due:
            await self.read_flags(talk)
        self._take(raw, talk.now)
        return self._what_now(raw)

    def _what_now(self, raw: Reading) -> Later[None] | None:
        """Return what must be said because of a reading."""
        if self._conversations:
            return None
        if self.owes_a1:
            if raw.state == E0:
                return Later(0.0, in_turns(self._commands.enable_again))
            self.owes_a1 = False
        if self._must_assert(raw):
            return Later(0.0, in_turns(self._assert))
        if self._tells_icmax is None:
            return Later(0.0, self._look_for_icmax)
        return None

    def _must_assert(self, raw: Reading) -> bool:
        if raw.state in SETUP:
            return False
        duty = limit_duty(self.setpoint)
        if not is_within(raw.duty, duty):
            return True
        self._confirmed = duty
        self._tell(Fault.LIMIT_NOT_TAKEN, present=False)
        if self.orders_expired and not self._fell_back:
            # The fail-safe may be the higher one: raised to once, and never in a box
            # that is paused.
            if raw.duty < duty != PAUSE:
                return True
            self._fell_back = True
        return False

    async def _look_for_icmax(self, talk: Talk) -> None:
        """Find out whether the box knows a register that the manual omits."""
        # Silence is its answer for "no", and no miss.
        self._tells_icmax = False
        try:
            data = await read(talk, self.config.address, ICMAX)
        except ReplyTimeoutError:
            return
        self._tells_icmax = True
        self._icmax = decode_icmax(data)

    async def read_flags(self, talk: Talk) -> None:
        """Read the flags; without an answer the old ones count for a while."""
        try:
            self._flags = decode_flags(await read(talk, self.config.address, FLAGS))
            if self._tells_icmax:
                data = await read(talk, self.config.address, ICMAX)
                self._icmax = decode_icmax(data)
        except ReplyTimeoutError:
            self._flags_missed += 1
            if self._flags_missed >= FLAGS_MISSES:
                self._flags = None
                self._icmax = None
                self._flags_due = talk.now + FLAGS_INTERVAL
            return
        self._flags_missed = 0
        self._flags_due = talk.now + FLAGS_INTERVAL
        if self._info is not None:
            self.info = charger_info(self._info, self._serial, self._flags)

    async def look(self, talk: Talk) -> Reading:
        """Read the state anew in the midst of a conversation, and keep it."""
        raw = await self._read(talk, attempts=2)
        self._take(raw, talk.now)
        return raw

    async def _read(self, talk: Talk, *, attempts: int = 1) -> Reading:
        data = await read(talk, self.config.address, READING, attempts=attempts)
        return decode_reading(data)

    def _take(self, raw: Reading, now: float) -> None:
        """Make a reading of what was told."""
        self.raw = raw
        if raw.duty != PAUSE:
            self._limit_paused = False
        if self._info is None:
            return
        told = Told(reading=raw, info=self._info, flags=self._flags, icmax=self._icmax)
        order = (
            self.config.phase_order if isinstance(self.config, AblConfig) else (1, 2, 3)
        )
        currents = phase_currents(told, order)
        power = power_of(currents, self.config.voltage)
        self._energy.add(power, now)
        energy = self._energy.energy if self._info.meter else None
        reading = charger_reading(told, currents, power, energy)
        changed = reading != self.reading
        self.reading = reading
        if changed:
            self.updated()

    def _tell(self, fault: Fault, *, present: bool) -> None:
        """Note a fault of our own finding, and tell the listeners of a change."""
        if present != (fault in self.noticed):
            self.notice(fault, present=present)
            self.updated()

    # -- Orders ------------------------------------------------------------------

    @override
    async def impose(
        self, talk: Talk, orders: Orders, change: OrderChange
    ) -> Later[None] | None:
        return await in_turns(partial(self._impose, orders, change))(talk)

    async def _impose(self, orders: Orders, change: OrderChange, talk: Talk) -> Turns:
        token = self.begin()
        try:
            await self.identify(talk)
            setpoint = clamp(orders, self.limits)
            # The user's pause goes out at once; else the box says what may be sent.
            if change.allowed is not False and not self._may_write(
                await self.look(talk), setpoint, orders, change
            ):
                return
            wanted = partial(self._wanted, orders)
            starts = change.allowed is True
            async for pause in self.enforce(talk, wanted, starts=starts):
                yield pause
            self._limit_paused = setpoint.paused and orders.allowed is not False
            self._fell_back = False
        finally:
            self.end(token)

    def _wanted(self, orders: Orders) -> Setpoint:
        return clamp(self.careful(orders), self.limits)

    def _may_write(
        self, raw: Reading, setpoint: Setpoint, orders: Orders, change: OrderChange
    ) -> bool:
        """Return whether these orders go to a box in this state now.

        False: they are stored, and count when the box lets a car charge again. No
        change of a limit may start a car; raises NotAvailableError where the user
        wants one started that cannot be.
        """
        if raw.state in SETUP:
            message = f"{self.config.name} is being set up"
            raise NotAvailableError(message)
        if change.allowed is True:
            if raw.state == E0:
                message = f"{self.config.name}: the outlet is disabled, enable it first"
                raise NotAvailableError(message)
            return True
        duty = limit_duty(setpoint)
        lowers = not is_within(raw.duty, duty)
        if setpoint.paused or raw.duty == duty:
            return lowers
        asked = change.current is not None or any(
            phase is not None for phase in change.phases
        )
        if raw.duty == PAUSE:
            # Only what our own limit of 0 A has paused, a limit sets going again.
            ours = self._limit_paused or self.setpoint.paused
            return asked and ours and orders.allowed is not False
        if raw.state == E0:
            return lowers
        return lowers or asked or self._fell_back

    async def _assert(self, talk: Talk) -> Turns:
        """Bring a box that stands above its orders down to them."""
        token = self.begin()
        try:
            await self.identify(talk)
            raw = self.raw or await self.look(talk)
            if not self._must_assert(raw):
                # A command of the user came first and did it.
                return
            duty = limit_duty(self.setpoint)
            if duty == self._confirmed and not is_within(raw.duty, duty):
                self.statistics.reasserted += 1
            async for pause in self.enforce(talk, lambda: self.setpoint):
                yield pause
            self._fell_back = self.orders_expired
            if self.setpoint.paused and self.effective_orders.allowed is not False:
                self._limit_paused = True
        finally:
            self.end(token)

    async def enforce(
        self, talk: Talk, wanted: Callable[[], Setpoint], *, starts: bool = False
    ) -> Turns:
        """Write a set-point until it is read back, at it or below it.

        ``starts``: a pause read back does not count as below. Raises
        NotConfirmedError when the box does not follow, ExchangeRefusedError when it
        says so.
        """
        for attempt in range(WRITES):
            if attempt:
                self.statistics.reasserted += 1
            setpoint = wanted()
            duty = limit_duty(setpoint)
            try:
                await set_limit(talk, self.config.address, setpoint)
            except ExchangeRefusedError:
                self._tell(Fault.LIMIT_NOT_TAKEN, present=True)
                raise
            for pause in (SETTLING, None):
                raw = await self.look(talk)
                still_paused = starts and raw.duty == PAUSE != duty
                if is_within(raw.duty, duty) and not still_paused:
                    self._confirmed = duty
                    self._tell(Fault.LIMIT_NOT_TAKEN, present=False)
                    return
                if pause is not None:
                    yield pause
        self._tell(Fault.LIMIT_NOT_TAKEN, present=True)
        message = f"{self.config.name} does not follow its limit"
        raise NotConfirmedError(message)

    # -- Commands ----------------------------------------------------------------

    @override
    async def command(
        self,
        command: Command,
        value: bool | int | None = None,
    ) -> None:
        conversation, persistence = self._commands.conversation(command, value)
        await self.run(in_turns(conversation), persistence=persistence)

    def begin(self) -> object:
        """Note that a conversation began: until it ends, polls only read."""
        token = object()
        self._conversations.add(token)
        return token

    def end(self, token: object) -> None:
        """Note that a conversation is over."""
        self._conversations.discard(token)
