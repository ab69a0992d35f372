"""A ChargePoint that speaks the EVBox Protocol Max v4.

There is no read: every message sets limits, fail-back and time-out, and its
answer is both the reading and the confirmation. So every poll imposes what
stands, and polling is what keeps the box from falling back.

What this takes from the manual, and where it chooses (PROTOCOLS.md section 1):

- Before two replies agree on the maximum of the connection no more than 6 A is
  sent, fail-back included; again after each time the box was away, because
  another one may be in its place.
- A pause is 0 A on all phases. The minimum is that of the module that needs the
  least (the limit is shared: one that needs more goes without), at least 6 A.
- A request without an answer may have been heard, so the minimum interval counts
  from when it was sent.
- Addressed by its serial number (68), a ChargePoint hears nothing that is meant
  for another. With serial 0 or command 69 whoever is there obeys: when the serial
  number in two replies is another one, nothing is sent any more until the charger
  is set up again, and the box falls back by itself.
"""

from collections.abc import Callable
import logging
from math import inf
from typing import Final, override

from ..charger import Charger
from ..errors import GarbledReplyError, ImplausibleReplyError, WrongChargerError
from ..exchange import Turn
from ..model import Capability, Fault, Limits, OrderChange, Orders
from ..readings import ChargerReading
from ..safety import INTERVALS_PER_TIMEOUT, Setpoint
from ..schedule import Kind
from .config import EvboxConfig
from .frames import LONGEST_REQUEST, EvboxFrame, Reply, decode_reply
from .over_limit import LimitWatch
from .plausibility import Plausibility, Taken, used_currents
from .reading import charger_info, connectors, same_serial, serial_number
from .request import effective_timeout, encode, wire_setpoint
from .timing import FOLLOW_TIME, INTERVAL_MARGIN, TIMING

_LOGGER = logging.getLogger(__name__)

_ALWAYS: Final = frozenset(
    {
        Capability.CHARGING,
        Capability.CURRENT,
        Capability.COS_PHI,
        Capability.ENERGY,
        Capability.FAULTS,
        Capability.MAXIMUM_CURRENT,
        Capability.MINIMUM_CURRENT,
        Capability.PHASE_LIMITS,
        Capability.FAIL_SAFE_CURRENT,
        Capability.FAIL_SAFE_TIMEOUT,
    }
)
_BY_COMMAND: Final = {
    68: frozenset({Capability.VOLTAGE, Capability.POWER}),
    69: frozenset({Capability.ESTIMATED_POWER}),
}
_SHORTEST_GRACE: Final = 15.0
"""A limit may be exceeded for this long at least before it is a fault, s."""
_NOTICED_FROM: Final = 2
"""Implausible replies in a row from which it is a fault, not a stray frame."""


class EvboxCharger(Charger[EvboxConfig]):
    """One ChargePoint with its 0 to 20 ChargeBox modules."""

    timing = TIMING
    orders_keep_alive = True

    def __init__(self, config: EvboxConfig, orders: Orders) -> None:
        """Take the orders that stand; the first poll imposes them, up to 6 A."""
        super().__init__(config, orders)
        self._believed = Plausibility()
        self._watch = LimitWatch()
        self._serial = config.serial
        self._foreign: str | None = None
        """The wrong serial number that the last reply had."""
        self._wrong: WrongChargerError | None = None
        """Why nothing is sent any more."""
        self._sent_at: float | None = None
        self._timeout_at = inf
        """When the box falls back unless it hears us, loop time."""
        self._sent: Setpoint | None = None
        """What the last answered request imposed."""
        self._outdated = False
        """That is not what should stand now."""
        self._held_back = 0

    @property
    @override
    def capabilities(self) -> frozenset[Capability]:
        """Return what this command tells and sets; the wire has no status."""
        return _ALWAYS | _BY_COMMAND[self.config.command]

    @property
    @override
    def limits(self) -> Limits:
        """Return the limits: 6 A until two replies agree on a maximum."""
        return Limits(
            installation=self.config.installation_limit,
            reports_maximum=True,
            reported=(
                None
                if self._believed.maximum.told is None
                else self._believed.maximum.value
            ),
            minimum=self._believed.minimum.value,
        )

    @property
    @override
    def setpoint(self) -> Setpoint:
        """Return what is sent now, the time-out raised where it is too short."""
        return self._setpoint(self.effective_orders)

    @property
    def minimum_interval(self) -> float:
        """Return the time that has to pass between two requests, s.

        A longer one counts when two replies agree; until then only as far as it
        does not make the box fall back.
        """
        told = self._believed.interval.told or 0
        return max(self._believed.interval.value, min(told, self._third_of_timeout))

    @property
    def effective_timeout(self) -> int:
        """Return the time-out that is sent, s: what was ordered or longer."""
        return effective_timeout(
            self.effective_orders.fail_safe_timeout, self._believed.interval.value
        )

    @property
    @override
    def longest_request(self) -> int:
        """Return the bytes of a request."""
        return LONGEST_REQUEST[self.config.command]

    @override
    def on_line_open(self) -> None:
        """Trust nothing that another box in this one's place would tell otherwise."""
        self._believed.forget()
        self._watch = LimitWatch()
        self._foreign = None
        self._held_back = 0

    # -- The conversation --------------------------------------------------------

    @override
    async def poll(self, turn: Turn) -> None:
        """Impose what stands, and take the reading that answers it."""
        await self._converse(turn, lambda: self.effective_orders)

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        """Send these orders; a believed answer confirms them."""
        try:
            await self._converse(turn, lambda: self.order_to_send(change))
        except ImplausibleReplyError as error:
            # Said again, it is believed at last: let the bus repeat it.
            self.statistics.implausible += 1
            self.plan(turn.now)
            self._after_retry(turn.now)
            raise GarbledReplyError(str(error)) from error
        self.on_reply(turn.now)
        self.plan(turn.now)

    async def _converse(self, turn: Turn, orders: Callable[[], Orders]) -> None:
        """Impose the orders that count when the line is quiet; take the answer."""
        if self._wrong is not None:
            raise self._wrong
        setpoint: Setpoint | None = None

        def request() -> bytes:
            nonlocal setpoint
            setpoint = self._setpoint(orders())
            return encode(self.config, setpoint)

        reply = None
        try:
            reply = await turn.exchange(request, self._accept)
        finally:
            if turn.sent_at is not None and setpoint is not None:
                self._note_sent(turn.sent_at, setpoint, answered=reply is not None)
                pause = self.minimum_pause(turn.now)
                self.slot.ready = max(self.slot.ready, turn.now + pause)
        # Whatever it says, the box is there.
        self.misses = 0
        self.slot.kind = Kind.POLL
        self._check_identity(reply)
        try:
            taken = self._believed.take(reply, turn.now)
        except ImplausibleReplyError:
            self._hold_back()
            raise
        self._take(taken, turn.now)
        self._outdated = setpoint != self._setpoint(orders())

    def _setpoint(self, orders: Orders) -> Setpoint:
        return wire_setpoint(orders, self.limits, self._believed.interval.value)

    def _accept(self, frame: EvboxFrame) -> Reply | None:
        """Return the reply to our request; ``None``: somebody else's frame."""
        reply = decode_reply(frame)
        if reply is None or reply.command != self.config.command:
            return None
        addressed = self.config.addressed
        if addressed and reply.serial != f"{addressed:08d}":
            # Another ChargePoint answers another SmartGrid module.
            return None
        return reply

    def _note_sent(self, at: float, setpoint: Setpoint, *, answered: bool) -> None:
        self._sent_at = at
        self._watch.sent(at, setpoint.currents, answered=answered)
        timeout_at = at + setpoint.fail_safe_timeout
        if answered:
            self._sent = setpoint
            self._timeout_at = timeout_at
        else:
            # It may have been heard, and then its time-out counts.
            self._timeout_at = min(self._timeout_at, timeout_at)

    # -- What an answer means ----------------------------------------------------

    def _check_identity(self, reply: Reply) -> None:
        found = serial_number(reply)
        if found is None:
            return
        if self._serial is None:
            self._serial = found
        if same_serial(self._serial, found):
            self._foreign = None
            return
        expected = self._serial
        if found != self._foreign:
            # A damaged frame looks the same: ask once more, with 6 A at most.
            self._believed.forget()
            self._foreign = found
            message = f"serial number {found} instead of {expected}"
            raise ImplausibleReplyError(message)
        message = f"{self.config.name}: {found} answers in place of {expected}"
        _LOGGER.warning("%s; nothing is sent to it any more", message)
        self._wrong = WrongChargerError(message, expected=expected, found=found)
        self.notice(Fault.WRONG_CHARGER, present=True)
        self.set_unavailable()
        self._stop()
        self.updated()
        raise self._wrong

    def _hold_back(self) -> None:
        """Note a reply that was not believed; too many in a row are no reading."""
        self._held_back += 1
        if self._held_back < _NOTICED_FROM:
            return
        if Fault.IMPLAUSIBLE not in self.noticed:
            self.notice(Fault.IMPLAUSIBLE, present=True)
            self.updated()
        if self._held_back >= self.timing.misses and self.available:
            self.set_unavailable()

    def _take(self, taken: Taken, now: float) -> None:
        self._held_back = 0
        grace = max(_SHORTEST_GRACE, FOLLOW_TIME + self._period)
        exceeded = self._watch.exceeded(now, used_currents(taken.reply), grace)
        self.notice(Fault.LIMIT_EXCEEDED, present=exceeded)
        self.notice(Fault.OVERCURRENT, present=taken.over_current)
        self.notice(Fault.IMPLAUSIBLE, present=taken.strange)
        if self.info is None or self.info.serial != serial_number(taken.reply):
            self.info = charger_info(serial_number(taken.reply))
        maximum = self._believed.maximum
        self.reading = ChargerReading(
            connectors=connectors(taken, self.config.voltage),
            maximum_current=maximum.value if maximum.sure else None,
            minimum_interval=taken.reply.minimum_interval,
            details=self._details(taken),
        )

    def _details(self, taken: Taken) -> dict[str, str | int | float | bool | None]:
        sent = self._sent
        return {
            "command": self.config.command,
            "modules": len(taken.reply.modules),
            "told_maximum_current": taken.reply.maximum_current,
            "ordered_timeout": self.effective_orders.fail_safe_timeout,
            "effective_timeout": self.effective_timeout,
            "sent_currents": _amperes(sent.currents) if sent else None,
            "sent_fail_safe": _amperes(sent.fail_safe) if sent else None,
            "sent_timeout": sent.fail_safe_timeout if sent else None,
        }

    # -- When it may and must be spoken to ---------------------------------------

    @property
    def _third_of_timeout(self) -> float:
        timeout = self._sent.fail_safe_timeout if self._sent else self.effective_timeout
        return timeout / INTERVALS_PER_TIMEOUT

    @property
    def _period(self) -> float:
        """Return the time between two regular requests, s."""
        wanted = min(self.config.poll_interval, self._third_of_timeout)
        return max(wanted, self._pace)

    @property
    def _pace(self) -> float:
        interval = self.minimum_interval
        return interval + INTERVAL_MARGIN if interval else 0.0

    @override
    def minimum_pause(self, now: float) -> float:
        """Return the rest of the minimum interval since our last request, s."""
        if self._sent_at is None:
            return 0.0
        return max(self._sent_at + self._pace - now, 0.0)

    @override
    def plan(self, now: float) -> None:
        """Poll each period, sooner to be sure of something, and before the time-out."""
        if self._wrong is not None:
            self._stop()
            return
        slot = self.slot
        hurry = self._outdated or self._believed.unsettled or self._foreign is not None
        sent_at = now if self._sent_at is None else self._sent_at
        slot.ready = slot.due = sent_at + (self._pace if hurry else self._period)
        slot.start_by = max(self._deadline, slot.ready)

    def _after_retry(self, now: float) -> None:
        """Let a command be repeated before a poll imposes the older orders again."""
        slot = self.slot
        retry = now + self.timing.retry_pauses[0] + INTERVAL_MARGIN
        slot.ready = slot.due = max(slot.ready, retry)
        slot.start_by = max(slot.start_by, slot.ready)

    @override
    def on_missed(self, now: float) -> None:
        """Retry after the minimum interval, and still before the time-out."""
        super().on_missed(now)
        if self._wrong is not None:
            self._stop()
        elif self.available and self._deadline >= self.slot.ready:
            self.slot.start_by = self._deadline

    @property
    def _deadline(self) -> float:
        """Return by when a request must start: one more can follow it in time."""
        spare = self._pace + self.slot.worst_case
        return self._timeout_at - min(spare, self._third_of_timeout)

    def _stop(self) -> None:
        self.slot.ready = self.slot.due = self.slot.start_by = inf


def _amperes(phases: tuple[float, float, float]) -> str:
    return " / ".join(f"{amperes:g}" for amperes in phases)
