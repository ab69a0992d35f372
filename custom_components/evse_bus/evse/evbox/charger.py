"""A ChargePoint on a bus with the EVBox Protocol Max v4.

The protocol has no read: every request sets limits, fail-back and time-out, and its
reply is both the reading and the confirmation. So every poll applies the orders that
stand, and polling keeps the box from falling back.

Decisions beyond the manual (PROTOCOLS.md section 1):

- No more than 6 A is sent, fail-back included, until two replies agree on the maximum
  of the connection; again after each absence of the box, because another one may be
  in its place.
- A pause is 0 A on all phases. The minimum is that of the module that needs the least
  (modules share the limit: one that needs more cannot charge), at least 6 A.
- An unanswered request may have been received, so the minimum interval counts from the
  time it was sent.
- A request 68 with a serial number reaches that ChargePoint only. With serial number 0
  or command 69 any ChargePoint obeys: if two replies in a row have another serial
  number than expected, nothing more is sent until the charger is set up again, and the
  box falls back by itself.
"""

from collections.abc import Callable
from dataclasses import replace
import logging
from math import ceil, inf
from typing import Final, override

from ..charger import Charger
from ..errors import GarbledReplyError, ImplausibleReplyError, WrongChargerError
from ..exchange import Turn
from ..limit_monitor import LimitMonitor
from ..memory import LineMemory
from ..model import (
    Capability,
    FailSafe,
    Fault,
    Limits,
    OrderChange,
    Orders,
    Phases,
)
from ..pause_watch import NO_CURRENT
from ..readings import ChargerReading
from ..safety import INTERVALS_PER_TIMEOUT, MAXIMUM_TIMEOUT, Setpoint, clamp, number
from ..schedule import Kind
from .config import (
    FOLLOW_TIME,
    INTERVAL_MARGIN,
    MISSES_PER_LONG_PAUSE,
    SHORTEST_INTERVAL,
    TIMING,
    UNKNOWN_INTERVAL,
    EvboxConfig,
)
from .frames import (
    LONGEST_REQUEST,
    EvboxFrame,
    Reply,
    decode_reply,
    encode_68,
    encode_69,
)
from .memory import EvboxMemory
from .plausibility import AcceptedReply, Plausibility, used_currents
from .readings import charger_info, connectors, same_serial, serial_number

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
"""A limit may be exceeded for this long before it is a fault, or longer, s."""
_FAULT_FROM: Final = 2
"""Implausible replies in a row from which it is a fault, not a stray frame."""


# -- From orders to a request --------------------------------------------------------


def timeout_for(ordered: int, interval: float) -> int:
    """Return the time-out to send, s: at least three minimum intervals (s).

    With a shorter one the box would fall back whenever one request gets lost.
    """
    shortest = ceil(INTERVALS_PER_TIMEOUT * max(interval, SHORTEST_INTERVAL))
    return min(max(ordered, shortest), MAXIMUM_TIMEOUT)


def setpoint_for(orders: Orders, limits: Limits, interval: float) -> Setpoint:
    """Return the set-point to send for these orders; ``interval``: minimum, s.

    Raises RefusedOrderError for an order that is not a usable number.
    """
    ordered = int(number(orders.fail_safe_timeout, "fail-safe time-out"))
    timeout = timeout_for(ordered, interval)
    return clamp(replace(orders, fail_safe_timeout=timeout), limits)


def encode_request(config: EvboxConfig, setpoint: Setpoint) -> bytes:
    """Return the request that sends a set-point to this ChargePoint."""
    if config.command == 68:  # noqa: PLR2004 - the command's number
        return encode_68(
            setpoint, serial=config.address, information=config.information
        )
    return encode_69(setpoint)


class EvboxCharger(Charger[EvboxConfig]):
    """One ChargePoint with its 0 to 20 ChargeBox modules."""

    timing = TIMING
    orders_keep_alive = True

    def __init__(self, config: EvboxConfig, orders: Orders) -> None:
        """Begin with the orders that stand; the first poll applies them, up to 6 A."""
        super().__init__(config, orders)
        self._plausibility = Plausibility()
        self._monitor = LimitMonitor()
        self._serial = config.serial
        """The expected serial number; ``None``: not known yet."""
        self._other_serial: str | None = None
        """The serial number of the last reply, if it was not the expected one, or if
        none is expected yet."""
        self._wrong_charger: WrongChargerError | None = None
        """The reason why nothing more is sent."""
        self._memory = EvboxMemory()
        """That of the line, once it is on a bus."""
        self._not_before = -inf
        """Loop time until which nothing is sent: it does not answer."""
        self._timeout_at = inf
        """Loop time at which the box falls back unless it gets a request."""
        self._confirmed: Setpoint | None = None
        """The set-point of the last answered request."""
        self._outdated = False
        """It is not the set-point of the orders that stand now."""
        self._implausible = 0
        """Implausible replies in a row."""

    @property
    @override
    def capabilities(self) -> frozenset[Capability]:
        """Return the capabilities of its command; the wire has no status."""
        return _ALWAYS | _BY_COMMAND[self.config.command]

    @property
    @override
    def fail_safe(self) -> FailSafe:
        return FailSafe.FALLS_BACK

    @property
    @override
    def limits(self) -> Limits:
        """Return the limits: 6 A until two replies agree on a maximum."""
        maximum = self._plausibility.maximum
        return Limits(
            installation=self.config.installation_limit,
            reports_maximum=True,
            reported=None if maximum.reported is None else maximum.value,
            minimum=self._plausibility.minimum.value,
            phases_alone=self.config.one_phase_modules,
        )

    @property
    @override
    def setpoint(self) -> Setpoint:
        """Return the set-point to send now, its time-out raised if too short."""
        return self._setpoint(self.effective_orders)

    @property
    def minimum_interval(self) -> float:
        """Return the minimum time between two requests, s.

        A longer one counts when two replies agree; until then only as far as it does
        not make the box fall back.
        """
        interval = self._plausibility.interval
        return max(interval.value, min(interval.reported or 0, self._third_of_timeout))

    @property
    def effective_timeout(self) -> int:
        """Return the time-out to send, s: the one ordered or longer."""
        return timeout_for(
            self.effective_orders.fail_safe_timeout, self._plausibility.interval.value
        )

    @property
    @override
    def keep_alive(self) -> float:
        return float(self.effective_timeout)

    @property
    @override
    def longest_request(self) -> int:
        """Return the length of a request, bytes."""
        return LONGEST_REQUEST[self.config.command]

    @override
    def resume(self, memory: LineMemory) -> None:
        super().resume(memory)
        self._memory = memory.of(EvboxMemory)
        self._plausibility.interval = self._memory.interval(self.config.addressed)

    @property
    def _sent_at(self) -> float:
        """Return the loop time of the last request that it may have received, or -inf.

        Another bus or a search on this line may have sent it.
        """
        return self._memory.sent_at(self.config.addressed)

    @override
    def on_line_open(self) -> None:
        """Drop all state that differs if another box has taken its place."""
        self._plausibility.reset()
        self._monitor = LimitMonitor()
        self._other_serial = None
        self._implausible = 0

    @override
    def on_line_reopened(self) -> None:
        # Between two polls of a box that answers nothing has taken its place; each time
        # down to 6 A, it would never get more behind an adapter that closes idle lines.
        if self.misses:
            self.on_line_open()

    # -- Conversations -----------------------------------------------------------

    @override
    async def poll(self, turn: Turn) -> None:
        """Apply the orders that stand, and take the reading from the reply."""
        await self._send_orders(turn, lambda: self.effective_orders)

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        """Send these orders; an accepted reply confirms them."""
        try:
            await self._send_orders(turn, lambda: self.order_to_send(change))
        except ImplausibleReplyError as error:
            # Repeated by the bus, the reply is accepted in the end.
            self.statistics.implausible += 1
            self.plan(turn.now)
            self._postpone_poll(turn.now)
            raise GarbledReplyError(str(error)) from error
        self.on_reply(turn.now)
        self.plan(turn.now)

    async def _send_orders(self, turn: Turn, orders: Callable[[], Orders]) -> None:
        """Send the orders that count once the line is quiet; evaluate the reply."""
        if self._wrong_charger is not None:
            raise self._wrong_charger
        setpoint: Setpoint | None = None

        def request() -> bytes:
            nonlocal setpoint
            setpoint = self._setpoint(orders())
            return encode_request(self.config, setpoint)

        reply = None
        try:
            reply = await turn.exchange(request, self._match_reply)
        finally:
            if turn.sent_at is not None and setpoint is not None:
                self._on_sent(turn.sent_at, setpoint, answered=reply is not None)
                pause = self.minimum_pause(turn.now)
                self.slot.ready = max(self.slot.ready, turn.now + pause)
        # The box is there, even if its reply is implausible.
        self.misses = 0
        self.slot.kind = Kind.POLL
        self._check_identity(reply)
        try:
            accepted = self._plausibility.accept(reply, turn.now)
        except ImplausibleReplyError:
            self._on_implausible()
            raise
        self._on_accepted(accepted, turn.now)
        self._outdated = setpoint != self._setpoint(orders())

    def _setpoint(self, orders: Orders) -> Setpoint:
        interval = self._plausibility.interval.value
        wanted = setpoint_for(orders, self.limits, interval)
        governed = self.governance.fail_safe(orders, paused=wanted.paused)
        if governed is orders:
            return wanted
        # A car that is paused must not start when Home Assistant dies.
        return setpoint_for(governed, self.limits, interval)

    @property
    @override
    def may_be_paused(self) -> bool:
        # Its pause is in our set-point alone: nothing at the box can pause it.
        return False

    @property
    @override
    def holds_ceiling_pause(self) -> bool:
        confirmed = self._confirmed
        return (
            confirmed is not None
            and confirmed.paused
            and self.governance.permitted.paused
        )

    def _match_reply(self, frame: EvboxFrame) -> Reply | None:
        """Return the reply to our request; ``None``: the frame is another."""
        reply = decode_reply(frame)
        if reply is None or reply.command != self.config.command:
            return None
        addressed = self.config.addressed
        if addressed and reply.serial != f"{addressed:08d}":
            # The reply of another ChargePoint to another SmartGrid module.
            return None
        return reply

    def _on_sent(self, at: float, setpoint: Setpoint, *, answered: bool) -> None:
        self._memory.sent(self.config.addressed, at)
        self._monitor.sent(at, setpoint.currents, answered=answered)
        timeout_at = at + setpoint.fail_safe_timeout
        if answered:
            self._confirmed = setpoint
            self._timeout_at = timeout_at
        else:
            # It may have been received: the earlier time-out counts.
            self._timeout_at = min(self._timeout_at, timeout_at)

    # -- Evaluation of a reply ---------------------------------------------------

    def _check_identity(self, reply: Reply) -> None:
        """Check the serial number of a reply, if it has one; learn it from two.

        Raises ImplausibleReplyError for the first reply with another one,
        WrongChargerError for the second.
        """
        found = serial_number(reply)
        if found is None:
            return
        if self._serial is None:
            # One reply may be corrupt: the box is known when two agree.
            if found != self._other_serial:
                self._other_serial = found
                return
            if self.is_wrong(found, None):
                raise self._refuse(found, None)
            self._serial = found
        if same_serial(self._serial, found):
            self._other_serial = None
            return
        expected = self._serial
        if found != self._other_serial:
            # It may be a corrupt frame: send once more, with 6 A at most.
            self._plausibility.reset()
            self._other_serial = found
            message = f"serial number {found} instead of {expected}"
            raise ImplausibleReplyError(message)
        raise self._refuse(found, expected)

    def _refuse(self, found: str, expected: str | None) -> WrongChargerError:
        """Send nothing more to another ChargePoint; return the error to raise."""
        why = f"serial number {found} instead of {expected or 'one of its own'}"
        message = f"{self.config.name}: {why}"
        _LOGGER.warning("%s; nothing more is sent to it", message)
        self._wrong_charger = WrongChargerError(message, expected=expected, found=found)
        self.notice(Fault.WRONG_CHARGER, present=True)
        self.set_unavailable(why)
        self._stop()
        self.updated()
        return self._wrong_charger

    def _on_implausible(self) -> None:
        """Count an implausible reply; too many in a row drop the reading."""
        self._implausible += 1
        if self._implausible < _FAULT_FROM:
            return
        if Fault.IMPLAUSIBLE not in self.noticed:
            self.notice(Fault.IMPLAUSIBLE, present=True)
            self.updated()
        if self._implausible >= self.timing.misses and self.available:
            self.set_unavailable("implausible replies only")

    def _on_accepted(self, accepted: AcceptedReply, now: float) -> None:
        self._implausible = 0
        reply = accepted.reply
        grace = max(_SHORTEST_GRACE, FOLLOW_TIME + self._period)
        exceeded = self._monitor.exceeded(now, used_currents(reply), grace)
        confirmed = self._confirmed
        is_paused = confirmed is not None and confirmed.paused
        highest = max((max(one.currents) for one in reply.modules), default=0.0)
        self.watch_pause(
            now, shown=is_paused, patience=grace if highest > NO_CURRENT else None
        )
        self.notice(Fault.LIMIT_EXCEEDED, present=exceeded and not is_paused)
        self.notice(Fault.OVERCURRENT, present=accepted.over_current)
        self.notice(Fault.IMPLAUSIBLE, present=accepted.out_of_range)
        if self._monitor.unconfirmed or not accepted.is_shown:
            # It may be corrupt as a whole: shown only if the next reply agrees.
            self._add_unconfirmed(reply)
            return
        serial = serial_number(reply) if self._serial is not None else None
        if self.info is None or self.info.serial != serial:
            self.info = charger_info(serial)
        self.reading = ChargerReading(
            connectors=connectors(accepted, self.config.voltage),
            maximum_current=self._plausibility.maximum.agreed,
            minimum_interval=reply.minimum_interval,
            details=self._details(reply),
        )

    def _add_unconfirmed(self, reply: Reply) -> None:
        """Let the currents of a reply that is not shown count for guards."""
        if self.reading is None:
            return
        connectors = dict(self.reading.connectors)
        for index, module in enumerate(reply.modules, 1):
            shown = connectors.get(index)
            if shown is not None and shown.exceeded_by(module.currents):
                connectors[index] = replace(shown, unconfirmed_current=module.currents)
        self.reading = replace(self.reading, connectors=connectors)

    def _details(self, reply: Reply) -> dict[str, str | int | float | bool | None]:
        confirmed = self._confirmed
        return {
            "command": self.config.command,
            "modules": len(reply.modules),
            "reported_maximum_current": reply.maximum_current,
            "ordered_timeout": self.effective_orders.fail_safe_timeout,
            "effective_timeout": self.effective_timeout,
            "sent_currents": _amperes(confirmed.currents) if confirmed else None,
            "sent_fail_safe": _amperes(confirmed.fail_safe) if confirmed else None,
            "sent_timeout": confirmed.fail_safe_timeout if confirmed else None,
        }

    # -- Times -------------------------------------------------------------------

    @property
    def _third_of_timeout(self) -> float:
        confirmed = self._confirmed
        timeout = confirmed.fail_safe_timeout if confirmed else self.effective_timeout
        return timeout / INTERVALS_PER_TIMEOUT

    @property
    def _period(self) -> float:
        """Return the time between two regular requests, s."""
        wanted = min(self.config.poll_interval, self._third_of_timeout)
        return max(wanted, self._shortest_period)

    @property
    def _shortest_period(self) -> float:
        interval = self.minimum_interval
        return interval + INTERVAL_MARGIN if interval else 0.0

    @override
    def minimum_pause(self, now: float) -> float:
        """Return the rest of the minimum interval since our last request, s."""
        earliest = max(self._sent_at + self._shortest_period, self._not_before)
        return max(earliest - now, 0.0)

    @override
    def plan(self, now: float) -> None:
        """Poll once a period, sooner to confirm a value, and before the time-out."""
        if self._wrong_charger is not None:
            self._stop()
            return
        slot = self.slot
        soon = (
            self._outdated
            or self._plausibility.unconfirmed
            or self._monitor.unconfirmed
            or self._other_serial is not None
        )
        period = self._shortest_period if soon else self._period
        slot.ready = slot.due = max(self._sent_at + period, now)
        slot.start_by = max(self._deadline, slot.ready)

    def _postpone_poll(self, now: float) -> None:
        """Let the bus repeat a command before a poll sends the older orders again."""
        slot = self.slot
        retry = now + self.timing.retry_pauses[0] + INTERVAL_MARGIN
        slot.ready = slot.due = max(slot.ready, retry)
        slot.start_by = max(slot.start_by, slot.ready)

    @override
    def on_missed(self, now: float, why: str) -> None:
        """Retry after the minimum interval, and still before the time-out."""
        if (self.misses + 1) % MISSES_PER_LONG_PAUSE == 0:
            # It may be another box, silent because it is asked too often.
            self._not_before = self._sent_at + UNKNOWN_INTERVAL + INTERVAL_MARGIN
        super().on_missed(now, why)
        if self._wrong_charger is not None:
            self._stop()
        elif self.available and self._deadline >= self.slot.ready:
            self.slot.start_by = self._deadline

    @property
    def _deadline(self) -> float:
        """Return the latest start of a request that leaves time for one more."""
        spare = self._shortest_period + self.slot.worst_case
        return self._timeout_at - min(spare, self._third_of_timeout)

    def _stop(self) -> None:
        """Send nothing more."""
        self.slot.ready = self.slot.due = self.slot.start_by = inf


def _amperes(phases: Phases[float]) -> str:
    return " / ".join(f"{amperes:g}" for amperes in phases)
