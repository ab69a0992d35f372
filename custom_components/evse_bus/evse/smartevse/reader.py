"""What is known of one SmartEVSE, and how it is asked: polled or as a slave.

Nothing is written before the box was read since the last (re)connect: the dialect was
found, and where it tells a serial number, that is the right one. PROTOCOLS.md, 3.
"""

from math import inf
from typing import ClassVar, Final, override

from ..charger import Charger
from ..conversation import rest
from ..errors import (
    ExchangeRefusedError,
    ImplausibleReplyError,
    NotAvailableError,
    ReplyTimeoutError,
    WrongChargerError,
)
from ..exchange import Turn
from ..model import (
    MINIMUM_CURRENT,
    Capability,
    Fault,
    Limits,
    Orders,
    Setting,
)
from ..registers import Block
from .config import SmartEvseConfig
from .dialects import MAPS, PROBE_A0, Dialect, Status
from .exchanges import read
from .probing import Probe
from .readings import capabilities_of, charger_info, charger_reading
from .registers import (
    ILLEGAL_ADDRESS,
    LONGEST_REQUEST,
    Configuration,
    decode_configuration,
    decode_status,
)
from .states import UNPLUGGED, tells_plug
from .timing import (
    CONFIGURATION_INTERVAL,
    ERROR_DOUBT,
    LOOK_AGAIN,
    PLUG_DOUBT,
    TIMING,
)

LOOKS: Final = 3
"""How often a box is looked at that does not answer in the midst of something."""
NOT_UNDERSTOOD: Final = 3
"""Answers in a row that cannot be, until nothing said before counts any more."""
CONFIGURATION_RETRY: Final = 30.0
"""Pause after settings that could not be read, s."""


class SmartEvseReader[C: SmartEvseConfig](Charger[C]):
    """One SmartEVSE, as far as it is asked and not told."""

    timing: ClassVar = TIMING

    def __init__(self, config: C, orders: Orders) -> None:
        """Take the set-up; the box is not known before it answers."""
        super().__init__(config, orders)
        self.dialect: Dialect | None = None
        """What it speaks; ``None``: not known since the last connect."""
        self.status: Status | None = None
        """What it told last; ``None``: nothing since the last connect."""
        self.configuration: Configuration | None = None
        self.configuration_due = 0.0
        """Loop time at which its settings are to be read again."""
        self._serial: str | None = None
        self._plug_doubted_until = 0.0
        self._not_understood = 0
        self._half_known = 0

    # -- What it is and has --------------------------------------------------------

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

    @override
    def on_line_open(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Learn anew what it is before anything is written."""
        self.dialect = None
        self.status = None
        self.configuration = None
        self.configuration_due = 0.0
        self._plug_doubted_until = 0.0

    @override
    def on_missed(self, now: float) -> None:
        super().on_missed(now)
        # Whoever answers next may be another one: read before anything is written.
        self.status = None

    # -- Who it is -----------------------------------------------------------------

    async def reach(self, turn: Turn) -> None:
        """Make sure that we know whom we talk to, and what state it is in.

        Raises ImplausibleReplyError for a box of no known dialect, WrongChargerError
        for another box, and what `read` raises.
        """
        if self.dialect is None:
            await self._find_dialect(turn)
            await rest(0.0)
        if self.status is None:
            await self.see(turn)
            await rest(0.0)

    async def _find_dialect(self, turn: Turn) -> None:
        found = self.config.dialect
        probe = Probe()
        while found is None:
            try:
                await self._ask(turn, probe)
            except ImplausibleReplyError:
                self.notice(Fault.UNSUPPORTED_FIRMWARE, present=True)
                raise
            found = probe.found
            if found is None:
                await rest(0.0)
        self.notice(Fault.UNSUPPORTED_FIRMWARE, present=False)
        self._half_known = 0
        self.dialect = found
        self.info = charger_info(found, self._serial)

    async def _ask(self, turn: Turn, probe: Probe) -> None:
        try:
            data = await self.read(turn, probe.ask)
        except ExchangeRefusedError as error:
            probe.refused(error.code)
        except ReplyTimeoutError:
            # It answered a moment ago: to silence here there is more than noise.
            self._half_known += probe.ask != PROBE_A0
            if self._half_known >= NOT_UNDERSTOOD:
                self.notice(Fault.UNSUPPORTED_FIRMWARE, present=True)
            raise
        else:
            probe.told(data)

    # -- What it says --------------------------------------------------------------

    @property
    def known_dialect(self) -> Dialect:
        """Return the dialect; raises NotAvailableError before it is known."""
        if self.dialect is None:
            message = f"{self.config.name} has not answered yet"
            raise NotAvailableError(message)
        return self.dialect

    async def read(self, turn: Turn, block: Block) -> bytes:
        """Return the bytes of a block (see `exchanges.read`)."""
        return await read(turn, self.config.address, block)

    async def see(self, turn: Turn) -> None:
        """Look at the box; a lost answer is asked for again."""
        for last in (False,) * (LOOKS - 1) + (True,):
            try:
                await self.look(turn)
            except ReplyTimeoutError:
                if last:
                    raise
            else:
                return
            await rest(LOOK_AGAIN)

    async def look(self, turn: Turn) -> Status:
        """Read the status, and keep it: one exchange.

        Raises ImplausibleReplyError for what cannot be (it changes nothing),
        WrongChargerError, and what `read` raises.
        """
        dialect = self.known_dialect
        try:
            status = decode_status(
                dialect, await self.read(turn, MAPS[dialect].status.block)
            )
        except ExchangeRefusedError as error:
            if error.code == ILLEGAL_ADDRESS:
                # Its firmware is another one than a moment ago.
                self._lose_faith()
            raise
        except ImplausibleReplyError:
            self._not_understood += 1
            if self._not_understood >= NOT_UNDERSTOOD:
                self._lose_faith()
            raise
        self._not_understood = 0
        self.notice(Fault.IMPLAUSIBLE, present=False)
        self._check_identity(status)
        self.take(status, turn.now)
        return status

    def _lose_faith(self) -> None:
        """Let nothing said before count: this box does not speak as it did."""
        self._not_understood = 0
        self.notice(Fault.IMPLAUSIBLE, present=True)
        self.set_unavailable()

    def _check_identity(self, status: Status) -> None:
        """Make sure that the right box answers, where it tells who it is."""
        if self.dialect is not Dialect.LATER:
            return
        expected = self.config.serial or self._serial
        if expected is not None and status.serial != expected:
            self.notice(Fault.WRONG_CHARGER, present=True)
            self.set_unavailable()
            found = status.serial or "no serial number"
            message = f"{self.config.name}: {found} answers, not {expected}"
            raise WrongChargerError(message, expected=expected, found=found)
        self.notice(Fault.WRONG_CHARGER, present=False)
        self._serial = status.serial
        self.info = charger_info(self.dialect, status.serial)

    def take(self, status: Status, now: float) -> None:
        """Make a reading of a status."""
        dialect = self.known_dialect
        if not tells_plug(dialect, status):
            doubt = ERROR_DOUBT if status.faults else PLUG_DOUBT
            self._plug_doubted_until = max(self._plug_doubted_until, now + doubt)
        elif status.raw_state != UNPLUGGED:
            self._plug_doubted_until = 0.0
        self.status = status
        reading = charger_reading(
            dialect,
            status,
            self.configuration,
            plug_told=now >= self._plug_doubted_until,
            waits=self.waits_for_current,
        )
        if reading != self.reading:
            self.reading = reading
            self.updated()

    # -- What it keeps in its memory -------------------------------------------------

    async def read_configuration(self, turn: Turn) -> None:
        """Read the settings; what is not told or cannot be changes nothing."""
        dialect = self.known_dialect
        told: dict[Block, bytes] = {}
        try:
            for block in MAPS[dialect].configuration:
                told[block] = await self.read(turn, block)
                await rest(0.0)
            configuration = decode_configuration(dialect, told)
        except ImplausibleReplyError, ReplyTimeoutError, ExchangeRefusedError:
            # Before they are known the limit is 6 A: then each poll tries again.
            pause = CONFIGURATION_RETRY if self.configuration is not None else 0.0
            self.configuration_due = turn.now + pause
            return
        self.configuration = configuration
        self.configuration_due = turn.now + CONFIGURATION_INTERVAL
        if self.status is not None:
            self.take(self.status, turn.now)
