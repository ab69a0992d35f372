"""What is known of one ABL box, and how it is asked.

Who answers is checked anew after each (re)connect and after each missed answer,
before anything else is said. PROTOCOLS.md, 2.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, override

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
from ..framing import Timing
from ..model import Capability, ChargerConfig, Fault, Limits, Orders, Phases
from ..safety import Setpoint
from .duty import PAUSE, is_within
from .exchanges import read, set_limit
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
    LONGEST_REPLY,
    LONGEST_REQUEST,
    READING,
    SERIAL,
    Flags,
    Info,
    Reading,
    StateCode,
    limit_duty,
)
from .states import E0

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

    poll_interval: float = 2.0
    """s: it falls asleep when idle, and forgets its limit with each power failure."""
    phase_order: Phases[int] = (1, 2, 3)
    """The phase that each of Ict1, Ict2, Ict3 measures; some boxes begin with L3."""

    def __post_init__(self) -> None:
        """Raise ValueError for what is no order of three phases."""
        if sorted(self.phase_order) != [1, 2, 3]:
            message = f"{self.phase_order} is no order of the phases 1, 2, 3"
            raise ValueError(message)


@dataclass(frozen=True, slots=True)
class Debt:
    """A state that a command brings about on its way, and what ends it."""

    end: StateCode
    state: int | None = None
    """``None``: any but E0 (a disabled outlet that is being reset)."""

    def is_open(self, state: int) -> bool:
        """Return whether a box in this state still has to be led out of it."""
        return state != E0 if self.state is None else state == self.state


class AblReader(Charger[AblConfig]):
    """One ABL wallbox, as far as it is asked and not told."""

    timing = TIMING

    def __init__(self, config: AblConfig, orders: Orders) -> None:
        """Take the set-up; the box is not known before it answers."""
        super().__init__(config, orders)
        self.raw: Reading | None = None
        """What 0x002E told last, undecided."""
        self.tells_icmax: bool | None = None
        """Whether it knows register 0x000F; ``None``: not asked yet."""
        self.owes: Debt | None = None
        """A state that we brought about on the way, and have not ended yet."""
        self.confirmed: int | None = None
        """The duty cycle that was read back last, as it was written."""
        self._serial: str | None = None
        self._info: Info | None = None
        self._flags: Flags | None = None
        self._icmax: int | None = None
        self._identified = False
        self._flags_due = 0.0
        self._flags_missed = 0
        self._energy = EnergyEstimate(config.poll_interval)

    @override
    def reconfigure(self, config: ChargerConfig) -> None:
        super().reconfigure(config)
        self._energy.set_interval(config.poll_interval)

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
        self.tells_icmax = None
        self._energy.interrupt()

    @override
    def on_missed(self, now: float) -> None:
        super().on_missed(now)
        # Whoever answers next may be another one.
        self._identified = False

    @property
    def serial(self) -> str | None:
        """Return the serial number that was read at this address."""
        return self._serial if self._identified else None

    async def identify(self, turn: Turn) -> Info:
        """Make sure that the right box answers; return what it is.

        Raises WrongChargerError, and then nothing may be written.
        """
        if self._identified and self._info is not None:
            return self._info
        address = self.config.address
        info = await read(turn, address, INFO)
        serial = await self._read_serial(turn)
        expected = self.config.serial or self._serial
        if expected is not None and serial != expected:
            self.notice(Fault.WRONG_CHARGER, present=True)
            self.set_unavailable()
            found = serial or "no serial number"
            message = f"at device-ID {address} answers {found}, not {expected}"
            raise WrongChargerError(message, expected=expected, found=found)
        self.notice(Fault.WRONG_CHARGER, present=False)
        self._serial = serial
        self._info = info
        self._identified = True
        self.info = charger_info(info, serial, self._flags)
        return info

    async def _read_serial(self, turn: Turn) -> str | None:
        """Return the serial number; ``None`` from a box that tells none.

        The manual shows 0x0050 in an example only. Where no serial number is
        expected, silence is taken for a register that is not there.
        """
        try:
            serial = await read(turn, self.config.address, SERIAL, attempts=2)
        except GarbledReplyError:
            raise
        except ReplyTimeoutError, ExchangeRefusedError:
            if self.config.serial is not None or self._serial is not None:
                raise
            return None
        return serial.number

    # -- What it says ------------------------------------------------------------

    async def look(self, turn: Turn) -> Reading:
        """Read the state anew in the midst of a conversation, and keep it."""
        raw = await self.read_once(turn, attempts=2)
        self.take(raw, turn.now)
        return raw

    async def read_once(self, turn: Turn, *, attempts: int = 1) -> Reading:
        """Return what 0x002E tells; raises what `Turn.exchange` raises."""
        return await read(turn, self.config.address, READING, attempts=attempts)

    def take(self, raw: Reading, now: float) -> None:
        """Make a reading of what was told."""
        self.raw = raw
        if self._info is None:
            return
        snapshot = Snapshot(
            reading=raw, info=self._info, flags=self._flags, icmax=self._icmax
        )
        currents = phase_currents(snapshot, self.config.phase_order)
        power = power_of(currents, self.config.voltage)
        self._energy.add(power, now)
        energy = self._energy.energy if self._info.meter else None
        reading = charger_reading(snapshot, currents, power, energy)
        changed = reading != self.reading
        self.reading = reading
        if changed:
            self.updated()

    async def read_flags_if_due(self, turn: Turn, raw: Reading) -> None:
        """Read the flags from time to time, and when the state is another one."""
        known = self.raw
        if (
            known is None
            or (known.state, known.reduced) != (raw.state, raw.reduced)
            or turn.now >= self._flags_due
        ):
            await self.read_flags(turn)

    async def read_flags(self, turn: Turn) -> None:
        """Read the flags; without an answer the old ones count for a while."""
        try:
            self._flags = await read(turn, self.config.address, FLAGS)
            if self.tells_icmax:
                icmax = await read(turn, self.config.address, ICMAX)
                self._icmax = icmax.duty
        except ReplyTimeoutError, ExchangeRefusedError:
            self._flags_missed += 1
            if self._flags_missed >= FLAGS_MISSES:
                self._flags = None
                self._icmax = None
                self._flags_due = turn.now + FLAGS_INTERVAL
            return
        self._flags_missed = 0
        self._flags_due = turn.now + FLAGS_INTERVAL
        if self._info is not None:
            self.info = charger_info(self._info, self._serial, self._flags)

    async def look_for_icmax(self, turn: Turn) -> None:
        """Find out whether the box knows a register that the manual omits."""
        # Silence is its answer for "no", and no miss.
        self.tells_icmax = False
        try:
            icmax = await read(turn, self.config.address, ICMAX)
        except ReplyTimeoutError, ExchangeRefusedError:
            return
        self.tells_icmax = True
        self._icmax = icmax.duty

    # -- What is written -------------------------------------------------------------

    async def enforce(
        self, turn: Turn, wanted: Callable[[], Setpoint], *, starts: bool = False
    ) -> None:
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
                await set_limit(turn, self.config.address, setpoint)
            except ExchangeRefusedError:
                self.notice(Fault.LIMIT_NOT_TAKEN, present=True)
                raise
            for pause in (SETTLING, None):
                raw = await self.look(turn)
                still_paused = starts and raw.duty == PAUSE != duty
                if is_within(raw.duty, duty) and not still_paused:
                    self.confirmed = duty
                    self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
                    return
                if pause is not None:
                    await rest(pause)
        self.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        message = f"{self.config.name} does not follow its limit"
        raise NotConfirmedError(message)
