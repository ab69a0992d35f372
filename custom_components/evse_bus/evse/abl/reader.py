"""Exchanges with one ABL wallbox, and the state read from it.

The identity is checked after each (re)connect and after each missed reply, before
anything else is exchanged (PROTOCOLS.md, 2).
"""

from collections.abc import Callable
from dataclasses import dataclass
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
from ..model import ChargerConfig, Fault, Orders
from ..registers import Registers
from ..safety import Setpoint
from .config import TIMING, AblConfig, Pauses
from .duty import PAUSE, is_within
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
    Info,
    Reading,
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

LIMIT_WRITES: Final = 2
"""Writes of a limit before it counts as not taken."""
SETTLING: Final = 0.25
"""Time for a limit that is not read back at once, s."""


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
        self.has_icmax: bool | None = None
        """It answers reads of 0x000F; ``None``: not tried yet."""
        self.confirmed: int | None = None
        """Duty cycle (0.1 %) of the last limit that was read back."""
        self.pending_cleanup: Cleanup | None = None
        """State that a command brought about and has not ended yet."""
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
        # Identity (info, serial twice), status, limit, status twice.
        return 7

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
        self._icmax = None
        self.has_icmax = None
        self._energy.interrupt()

    @override
    def on_missed(self, now: float) -> None:
        super().on_missed(now)
        # The next reply may come from another box.
        self._identified = False

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
        info = await read(turn, address, INFO)
        serial = await self._read_serial(turn)
        expected = self.config.serial or self._serial
        if expected is not None and serial != expected:
            self.notice(Fault.WRONG_CHARGER, present=True)
            self.set_unavailable()
            found = serial or "no serial number"
            message = f"found {found} at device-ID {address}, expected {expected}"
            raise WrongChargerError(message, expected=expected, found=found)
        self.notice(Fault.WRONG_CHARGER, present=False)
        self._serial = serial
        self._info = info
        self._identified = True
        self.info = charger_info(info, serial, self._flags)

    async def _read_serial(self, turn: Turn) -> str | None:
        """Return the serial number; ``None`` from a box that has none.

        The manual shows 0x0050 in an example only. Where no serial number is
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
        return serial.number

    # -- Status, flags, Icmax ----------------------------------------------------

    async def poll_status(self, turn: Turn) -> Reading:
        """Read the status once, and the flags where due; keep and return it.

        The flags are due every `FLAGS_INTERVAL`, and when the status has changed.
        """
        status = await read(turn, self.config.address, READING)
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
        status = await read(turn, self.config.address, READING, attempts=2)
        self.keep_status(status, turn.now)
        return status

    def keep_status(self, status: Reading, now: float) -> None:
        """Keep a status read at a loop time (s), and make the reading of it."""
        self.last_status = status
        if self._info is None:
            return
        snapshot = Snapshot(
            reading=status, info=self._info, flags=self._flags, icmax=self._icmax
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

    async def read_flags(self, turn: Turn) -> None:
        """Read flags and Icmax; without a reply the old values count for a while."""
        try:
            self._flags = await read(turn, self.config.address, FLAGS)
            if self.has_icmax:
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

    async def probe_icmax(self, turn: Turn) -> None:
        """Find out whether the box has register 0x000F, which is not in the manual."""
        # Silence means no; it is not a missed reply.
        self.has_icmax = False
        try:
            icmax = await read(turn, self.config.address, ICMAX)
        except ReplyTimeoutError, ExchangeRefusedError:
            return
        self.has_icmax = True
        self._icmax = icmax.duty

    # -- Writes ------------------------------------------------------------------

    async def apply_setpoint(
        self, turn: Turn, setpoint: Callable[[], Setpoint], *, starts: bool = False
    ) -> Reading:
        """Write a set-point until the limit read back is at or below it.

        ``setpoint`` is called for each write: the orders may change between turns.
        ``starts``: a pause that is read back does not count as below. Returns the
        status that confirms it.

        Raises NotConfirmedError when the box does not follow, ExchangeRefusedError
        when it refuses.
        """
        for attempt in range(LIMIT_WRITES):
            if attempt:
                self.statistics.reasserted += 1
            limit = setpoint()
            duty = limit_duty(limit)
            try:
                await turn.exchange(
                    write_limit(self.config.address, limit),
                    write_answer(self.config.address, LIMIT_REGISTER),
                )
            except ExchangeRefusedError:
                self.notice(Fault.LIMIT_NOT_TAKEN, present=True)
                raise
            for pause in (SETTLING, None):
                status = await self.read_status(turn)
                still_paused = starts and status.duty == PAUSE != duty
                if is_within(status.duty, duty) and not still_paused:
                    self.confirmed = duty
                    self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
                    return status
                if pause is not None:
                    await rest(pause)
        self.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        message = f"{self.config.name} does not follow its limit"
        raise NotConfirmedError(message)

    async def set_state(self, turn: Turn, code: StateCode) -> bool:
        """Write a state code once; return whether the box has confirmed it.

        A reply that stays away decides nothing: the state has to be read.
        """
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
        device_id: int,
        *,
        upstream_timeout: bool | None = None,
        needs_enable: bool | None = None,
    ) -> None:
        """Write device-ID and settings (in E2); ``None``: no change."""
        request = write_configuration(
            self.config.address,
            device_id,
            upstream_timeout=upstream_timeout,
            needs_enable=needs_enable,
        )
        await turn.exchange(
            request, write_answer(self.config.address, CONFIGURATION_REGISTER)
        )
