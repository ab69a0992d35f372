"""Exchanges with one SmartEVSE, and the last known contents of its registers.

Nothing is written before the box was read after the last (re)connect: its dialect is
known, and a serial number that it reports is the expected one. Each turn has one
exchange at most, so that the broadcast of a master waits for one only. PROTOCOLS.md, 3.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import inf
from typing import ClassVar, Final, override

from ..charger import Charger
from ..conversation import rest
from ..errors import (
    ExchangeRefusedError,
    ImplausibleReplyError,
    NotAvailableError,
    NotConfirmedError,
    ReplyTimeoutError,
    SupersededError,
    WrongChargerError,
)
from ..exchange import Request, Turn
from ..framing import Timing
from ..model import (
    MINIMUM_CURRENT,
    Capability,
    Fault,
    Limits,
    Mode,
    Orders,
    Setting,
)
from ..pause_watch import FOLLOW_TIME
from ..registers import Block, Registers
from .config import SmartEvseConfig
from .dialects import LATER, MAPS, PROBE_A0, Dialect, Status
from .plug import PlugWatch, has_restarted
from .probing import find_dialect
from .readings import capabilities_of, charger_info, charger_reading
from .registers import (
    ILLEGAL_ADDRESS,
    LONGEST_REPLY,
    LONGEST_REQUEST,
    Configuration,
    decode_configuration,
    decode_status,
    read_answer,
    read_request,
    write_access,
    write_answer,
)
from .states import CHARGING, is_stopped

TIMING: Final = Timing(
    # More than 3 ms of silence end a frame, and a box replies after more than 6 ms.
    silence=0.010,
    silence_patience=0.1,
    # Network and USB adapters take longer than the box, and merge bytes into lumps.
    reply_timeout=0.25,
    gap=0.05,
    longest_reply=LONGEST_REPLY,
    retry_pauses=(0.4, 1.0),
)

READ_AGAIN: Final = 0.5
"""Pause between two readings of a box that has not replied or followed yet, s."""
READS: Final = 3
"""Attempts to read the status of a box in the course of a conversation."""
WRITES: Final = 2
"""Attempts to write a value, each followed by its read-back."""
FAILURES: Final = 3
"""Implausible or missing replies in a row before a fault is set."""
CONFIGURATION_INTERVAL: Final = 300.0
"""Time between two readings of a box's settings, s."""
CONFIGURATION_RETRY: Final = 30.0
"""Pause after settings that could not be read, s."""
COLD: Final = 5
"""From at most so many degrees Celsius, above or below 0, a reading of 0 is believed."""


class SmartEvseReader[C: SmartEvseConfig](Charger[C]):
    """One SmartEVSE: its registers, and access to them."""

    timing: ClassVar = TIMING

    def __init__(self, config: C, orders: Orders) -> None:
        """Begin with an unknown box."""
        super().__init__(config, orders)
        self.dialect: Dialect | None = None
        """``None``: not known since the last connect."""
        self.status: Status | None = None
        """The last status; ``None``: not read since the last connect or time-out."""
        self.configuration: Configuration | None = None
        self.configuration_due = 0.0
        """Loop time at which its settings are to be read again."""
        self.must_close_access = False
        """Pending cleanup: writing a setting may have opened access that was off."""
        self._serial: str | None = None
        self._plug = PlugWatch()
        self._closed_by_us = False
        """We have turned its access off, and nothing but the driver turns it on."""
        self._temperature: int | None = None
        """The last temperature that it has measured, degrees Celsius."""
        self._implausible_replies = 0
        self._unanswered_probes = 0

    # -- Capabilities and limits ---------------------------------------------------

    @property
    @override
    def capabilities(self) -> frozenset[Capability]:
        known = capabilities_of(self.dialect)
        if self.config.order_lifetime is not None:
            # The box has no such value; it counts when orders are not renewed.
            known |= {Capability.FAIL_SAFE_CURRENT}
        return known

    @property
    @override
    def limits(self) -> Limits:
        installation = self.config.installation_limit
        if self.configuration is None:
            return Limits(installation=installation, reports_maximum=True)
        settings = self.configuration.settings
        cable = self.status.maximum if self.status is not None else None
        return Limits(
            installation=installation,
            reports_maximum=True,
            reported=min(settings[Setting.MAXIMUM_CURRENT], cable or inf),
            minimum=max(settings[Setting.MINIMUM_CURRENT], MINIMUM_CURRENT),
        )

    @property
    @override
    def longest_request(self) -> int:
        return LONGEST_REQUEST

    @property
    @override
    def facts(self) -> Mapping[str, str]:
        if self.dialect is None or self.status is None:
            # Its serial number, if it has one, was not compared yet.
            return super().facts
        return {**super().facts, "dialect": self.dialect.value}

    @property
    def known_dialect(self) -> Dialect:
        """Return the dialect; raises NotAvailableError before it is known."""
        if self.dialect is None:
            message = f"{self.config.name} has not answered yet"
            raise NotAvailableError(message, "smartevse_not_read")
        return self.dialect

    @override
    def on_line_open(self) -> None:
        self.dialect = None
        self.status = None
        self.configuration = None
        self.configuration_due = 0.0
        self._temperature = None
        self._closed_by_us = False

    @override
    def on_missed(self, now: float, why: str) -> None:
        super().on_missed(now, why)
        # The next reply may be another box's: read it before anything is written.
        self.status = None
        # A power failure opens access, too.
        self._closed_by_us = False
        # Or it was switched off and on again.
        self._temperature = None
        self._plug.missed()

    # -- Identity ------------------------------------------------------------------

    async def reach(self, turn: Turn) -> None:
        """Make sure that dialect, identity and status are known.

        Raises ImplausibleReplyError for a box of no known dialect, WrongChargerError
        for another box, and what `read` raises.
        """
        if self.dialect is None:
            await self._identify(turn)
            await rest()
        if self.status is None:
            await self.read_status(turn)
            await rest()

    async def _identify(self, turn: Turn) -> None:
        """Find the dialect, which may have changed; raises as `reach`."""

        async def read(block: Block) -> bytes:
            if block != PROBE_A0:
                await rest()
            try:
                return await self.read(turn, block)
            except ReplyTimeoutError:
                # To PROBE_A0 it has just replied: this silence is not only noise.
                self._unanswered_probes += block != PROBE_A0
                if self._unanswered_probes >= FAILURES:
                    self.notice(Fault.UNSUPPORTED_FIRMWARE, present=True)
                raise

        try:
            dialect = await find_dialect(read)
        except ImplausibleReplyError:
            self.notice(Fault.UNSUPPORTED_FIRMWARE, present=True)
            raise
        self.notice(Fault.UNSUPPORTED_FIRMWARE, present=False)
        self._unanswered_probes = 0
        self.dialect = dialect
        self.info = charger_info(dialect, self._serial)

    def _check_identity(self, status: Status) -> None:
        """Raise WrongChargerError where another serial number is reported."""
        if self.dialect is None or self.dialect not in LATER:
            return
        expected = self.config.serial or self._serial
        if expected is not None and status.serial != expected:
            self.notice(Fault.WRONG_CHARGER, present=True)
            found = status.serial or "no serial number"
            self.set_unavailable(f"{found} answers, not {expected}")
            message = f"{self.config.name}: {found} answers, not {expected}"
            raise WrongChargerError(message, expected=expected, found=status.serial)
        self.notice(Fault.WRONG_CHARGER, present=False)
        self._serial = status.serial
        self.info = charger_info(self.dialect, status.serial)

    # -- Single exchanges ----------------------------------------------------------

    def guarded(self, request: Request) -> Request:
        """Return a request with the last check before it is sent; none by default."""
        return request

    async def read(self, turn: Turn, block: Block) -> bytes:
        """Return the bytes of a block.

        Raises ExchangeRefusedError and what `Turn.exchange` raises.
        """
        unit = self.config.address
        request = self.guarded(read_request(unit, block))
        return await turn.exchange(request, read_answer(unit, block))

    async def write(self, turn: Turn, request: Request, register: int) -> bool | None:
        """Write one register; only a read-back shows whether it took effect.

        True: accepted; False: refused, which may be untrue; ``None``: no reply.
        Raises ExchangeRefusedError where there is no such register, LineBusyError and
        LineLostError.
        """
        accept = write_answer(self.config.address, register)
        try:
            return await turn.exchange(self.guarded(request), accept)
        except ReplyTimeoutError:
            return None

    # -- Status --------------------------------------------------------------------

    async def read_status(self, turn: Turn) -> None:
        """Read the status, up to `READS` times where the reply is missing."""
        for last in (False,) * (READS - 1) + (True,):
            try:
                await self.read_status_once(turn)
            except ReplyTimeoutError:
                if last:
                    raise
            else:
                return
            await rest(READ_AGAIN)

    async def read_status_once(self, turn: Turn) -> None:
        """Read the status in one exchange.

        Raises ImplausibleReplyError for a reply that no box gives (it changes
        nothing), WrongChargerError, and what `read` raises.
        """
        dialect = self.known_dialect
        registers = self.status_registers(dialect, turn.now)
        try:
            data = await self.read(turn, registers.block)
            status = decode_status(dialect, data, registers)
        except ExchangeRefusedError as error:
            if error.code == ILLEGAL_ADDRESS:
                # Its firmware has changed.
                self._start_over()
            raise
        except ImplausibleReplyError:
            self._implausible_replies += 1
            if self._implausible_replies >= FAILURES:
                self._start_over()
            raise
        self._implausible_replies = 0
        self.notice(Fault.IMPLAUSIBLE, present=False)
        if registers is MAPS[dialect].status or self.status is None:
            self._check_identity(status)
        else:
            # The shorter block of a master is without these.
            status = replace(
                status,
                temperature=self.status.temperature,
                serial=self.status.serial,
            )
        self.on_status(status, turn.now)

    def status_registers(self, dialect: Dialect, now: float) -> Registers[Status]:  # noqa: ARG002
        """Return the block of the next status."""
        return MAPS[dialect].status

    def _start_over(self) -> None:
        """Drop what is known of a box that does not reply as it did before."""
        self._implausible_replies = 0
        self.notice(Fault.IMPLAUSIBLE, present=True)
        self.set_unavailable("its replies are not those of its firmware")

    def on_status(self, status: Status, now: float) -> None:
        """Accept a status, and make a reading of it."""
        dialect = self.known_dialect
        plugged = self._plug.see(
            dialect, status, now, may_be_refused=self._may_be_refused(status)
        )
        self._note_driver(status, plugged=plugged)
        status = self._with_measured_temperature(status)
        self.status = status
        reading = charger_reading(
            dialect,
            status,
            self.configuration,
            plugged=plugged,
            waits=self.waits_for_current,
        )
        if reading != self.reading:
            self.reading = reading
            self.updated()
        self.watch_pause(
            now,
            shown=status.access is False,
            patience=FOLLOW_TIME if status.raw_state in CHARGING else None,
        )

    def _may_be_refused(self, status: Status) -> bool:
        """Return whether it may have been refused current while it was out of sight.

        Without load balancing and in the mode normal there is nothing to refuse it.
        """
        is_alone = self.config.address <= 1 and status.mode is Mode.NORMAL
        return not (self.available or is_alone)

    def _with_measured_temperature(self, status: Status) -> Status:
        """Return a status without the 0 degrees that a box reports after power-up.

        They are believed from one that was about as cold before.
        """
        before = self._temperature
        if self.status is not None and has_restarted(self.status, status):
            before = None
        if status.temperature == 0 and (before is None or abs(before) > COLD):
            status = replace(status, temperature=None)
        self._temperature = status.temperature
        return status

    def _note_driver(self, status: Status, *, plugged: bool | None) -> None:
        """Note access that was opened at the box during a pause by a ceiling.

        It is the driver's word for this visit. (An "off" at the box during our pause
        cannot be told from it.)
        """
        if status.access is True:
            # A power failure opens it, too, and so may the write of a setting.
            before = self.status
            restarted = before is not None and has_restarted(before, status)
            other = self.must_close_access or restarted
            opened = self._closed_by_us and not other
            self._closed_by_us = False
            if opened and self.waits_for_current and self.governance.pauses:
                self.governance.driver_allows = True
        if plugged is False:
            self.governance.driver_allows = False

    # -- Configuration -------------------------------------------------------------

    async def read_configuration(self, turn: Turn) -> bool:
        """Read the settings; return whether they were read.

        A missing or implausible reply changes none of them.
        """
        dialect = self.known_dialect
        blocks: dict[Block, bytes] = {}
        try:
            for block in MAPS[dialect].configuration:
                blocks[block] = await self.read(turn, block)
                await rest()
            configuration = decode_configuration(dialect, blocks)
        except ImplausibleReplyError, ReplyTimeoutError, ExchangeRefusedError:
            # Before they are known the limit is 6 A: then each poll tries again.
            pause = CONFIGURATION_RETRY if self.configuration is not None else 0.0
            self.configuration_due = turn.now + pause
            return False
        self.configuration = configuration
        self.configuration_due = turn.now + CONFIGURATION_INTERVAL
        if self.status is not None:
            self.on_configuration(self.status, turn.now)
        return True

    def on_configuration(self, status: Status, now: float) -> None:
        """Follow settings that were just read; ``status`` is from before them."""
        self.on_status(status, now)

    # -- Access --------------------------------------------------------------------

    async def set_access(
        self,
        turn: Turn,
        allowed: bool,  # noqa: FBT001
        still_wanted: Callable[[], bool] = lambda: True,
    ) -> None:
        """Set the access bit, and read it back.

        Off is confirmed when no car can charge any more (`states.is_stopped`).
        ``still_wanted`` is called right before each write, so that a repeated start
        does not overtake a pause. Raises SupersededError where it returns False,
        NotConfirmedError when the box does not follow.
        """
        await self.reach(turn)
        dialect = self.known_dialect

        def request() -> bytes:
            if not still_wanted():
                message = "a newer command came first"
                raise SupersededError(message)
            self._closed_by_us = False
            return write_access(self.config.address, dialect, allowed)

        for _ in range(WRITES):
            await self.write(turn, request, MAPS[dialect].access_register)
            if allowed:
                # Opened on purpose: no cleanup is pending.
                self.must_close_access = False
            for pause in (0.0, READ_AGAIN):
                await rest(pause)
                await self.read_status(turn)
                if self._has_followed(allowed):
                    self._closed_by_us = self.has_access is False
                    return
            await rest()
        state = "on" if allowed else "off"
        message = f"{self.config.name} does not turn its access {state}"
        raise NotConfirmedError(message)

    async def close_access(self, turn: Turn) -> None:
        """Turn access off where a setting has opened it; raises as `set_access`."""
        await self.read_status(turn)
        if self.has_access is not False:
            await rest()
            await self.set_access(turn, allowed=False)
        self.must_close_access = False

    @property
    def has_access(self) -> bool | None:
        """Return its access bit by the last status; ``None``: not known."""
        return None if self.status is None else self.status.access

    def _has_followed(self, allowed: bool) -> bool:  # noqa: FBT001
        """Return whether the last status confirms that access is on, or off."""
        if self.status is None:
            return False
        if allowed:
            return self.status.access is True
        return is_stopped(self.known_dialect, self.status)
