"""One SmartEVSE slave under Home Assistant as load-balancing master.

Its current is a value of the master's broadcast; only its access bit and the answers to
its requests are addressed to it alone. A pause is its access bit where that is not kept
in its flash memory (2.17 goes on with 6 A after a broadcast of 0), else a broadcast of
0 and the refusal of its requests. It is confirmed when the box has obeyed it.
PROTOCOLS.md, 3.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from math import inf
from typing import ClassVar, Final, override

from ..conversation import FollowUp, rest
from ..errors import (
    EvseError,
    NotAvailableError,
    NotConfirmedError,
    ReplyTimeoutError,
)
from ..exchange import Request, Turn
from ..framing import Frame
from ..modbus import ModbusFrame
from ..model import (
    MINIMUM_CURRENT,
    Capability,
    Command,
    FailSafe,
    Fault,
    Limits,
    OrderChange,
    Orders,
    PauseReason,
    Persistence,
    Range,
    Setting,
)
from ..registers import Registers
from ..safety import Setpoint, clamp
from ..schedule import Kind
from .balancing import answer_to_state, decode_request
from .charger import SmartEvseCharger
from .config import SlaveConfig
from .dialects import (
    ASKS_FOR_B,
    ASKS_FOR_C,
    MAPS,
    OPENS_WITHIN,
    Balancing,
    Dialect,
    Handshake,
    Status,
)
from .handshake_polled import PolledHandshake
from .handshake_requests import RequestHandshake
from .member import Balancer, Member
from .reader import READ_AGAIN, TIMING
from .registers import LONGEST_REQUEST, tenths
from .sharing import LOWEST, Claim, Contactor
from .states import CHARGING, STOPPING, UNPLUGGED, is_stopped

WITHHELD_FOR: Final = 60.0
"""Shortest pause of a box of 2.17 that was stopped for lack of current, s."""
WITHHELD_POLLED: Final = 10.0
"""Likewise from 2.20 on, s: one that asks sooner (up to 2.30) is refused, and waits for
a minute by itself."""
BROADCASTS: Final = 4
"""Attempts to broadcast a new current, each followed by its read-back."""
LONG_STATUS_INTERVAL: Final = 30.0
"""Time between two readings of temperature and serial number, which are not in the
block that a master polls, s."""
MAXIMUM_INTERVAL: Final = 30.0
"""Time between two readings of the settings while a box charges that does not report
its *MAX* in its status, and does not obey it, s."""

_ANSWER_BYTES: Final = LONGEST_REQUEST
"""A turn that answers may have a broadcast instead."""
_OPEN: Final = frozenset({UNPLUGGED, "B", "B1", "T", "F", ASKS_FOR_B})
"""From 2.20 on: the states in which the contactor is surely open."""


class SlaveSmartEvse(SmartEvseCharger[SlaveConfig], Member):
    """One slave."""

    pauses_hurry: ClassVar = True

    def __init__(self, config: SlaveConfig, orders: Orders) -> None:
        """Begin with an unknown box, without a share of the circuit limit."""
        super().__init__(config, orders)
        self.share = 0.0
        self.expected_dialect = config.dialect
        self._master: Balancer | None = None
        self._requests = RequestHandshake(self)
        self._polled = PolledHandshake(self)
        self._cable: int | None = None
        """From 2.20 on: maximum of its cable, A; ``None``: no car is plugged in."""
        self._long_status_due = -inf
        self._charging_since = inf
        self._reserved_until = -inf
        self._withheld_at: float | None = None
        """Loop time at which its share became too small to charge."""
        self._stopping_since = inf
        self._over_share = 0
        """Readings in a row that were above its share."""
        self._paused_by_us = False
        """We have turned its access off for lack of current."""
        self._is_leaving = False
        """It will receive no more broadcasts, and must not go on."""
        self._confirming: OrderChange | None = None
        """The change of orders under way."""

    # -- Capabilities and limits ---------------------------------------------------

    @property
    @override
    def unit(self) -> int:
        return self.config.address

    @property
    def _habits(self) -> Balancing | None:
        """Return the habits of its dialect, as read last; ``None``: never read."""
        if self.expected_dialect is None:
            return None
        return MAPS[self.expected_dialect].balancing

    @property
    def _is_polled(self) -> bool:
        habits = self._habits
        return habits is not None and habits.handshake is Handshake.POLLED

    @property
    def _charges(self) -> bool:
        """Return whether its contactor may be closed."""
        return self._master is not None and self._master.draw(self.unit).may_draw

    @property
    def master(self) -> Balancer:
        """Return the master; raises NotAvailableError without one."""
        if self._master is None:
            message = f"{self.config.name} is on no bus with a master"
            raise NotAvailableError(message)
        return self._master

    @override
    def join(self, master: Balancer | None) -> None:
        self._master = master

    @property
    @override
    def worst_case(self) -> float | None:
        return self.bus.worst_case(self) if self.bus is not None else None

    @property
    @override
    def send_time(self) -> float | None:
        return self.bus.wire.send_time(_ANSWER_BYTES) if self.bus is not None else None

    @property
    @override
    def fail_safe(self) -> FailSafe | None:
        habits = self._habits
        if habits is None:
            return None
        return FailSafe.STOPS if habits.fail_safe_proven else FailSafe.UNPROVEN

    @property
    @override
    def capabilities(self) -> frozenset[Capability]:
        # The mode of a slave is its master's.
        known = super().capabilities - {Capability.MODE}
        habits = self._habits
        if habits is not None and not habits.access_is_volatile:
            known |= {Capability.STORED_ACCESS}
        return known

    @property
    @override
    def settings(self) -> Mapping[Setting, Range]:
        # A slave follows none of the others (menu of the manual, 2.17).
        own = Setting.MAXIMUM_CURRENT
        return {
            setting: span
            for setting, span in super().settings.items()
            if setting is own
        }

    @property
    @override
    def limits(self) -> Limits:
        known = super().limits
        if self._is_polled:
            # Until the cable of the next car was measured: 6 A.
            reported = None if self._cable is None else known.reported
            if reported is not None and self._cable is not None:
                reported = min(reported, self._cable)
            return Limits(
                installation=known.installation,
                reports_maximum=True,
                reported=reported,
            )
        own = self._requests.own_maximum
        maxima = [one for one in (known.reported, own) if one is not None]
        # The minimum in the memory of a slave applies to masters only.
        return Limits(
            installation=known.installation,
            reports_maximum=True,
            reported=min(maxima, default=None),
        )

    @property
    @override
    def wanted(self) -> Setpoint:
        return clamp(self._standing, self.limits)

    @property
    def _standing(self) -> Orders:
        """Return the orders that count, including a change under way."""
        if self._confirming is not None:
            return self.order_to_send(self._confirming)
        return self.effective_orders

    @override
    def setpoint_within(self, share: float) -> Setpoint:
        limits = self.limits
        if self._is_leaving:
            share = 0.0
        if self._is_polled and not self._charges:
            # A charge begins with the last current that was broadcast before.
            share = min(share, MINIMUM_CURRENT)
        return clamp(
            self._standing, replace(limits, reported=min(share, limits.ceiling))
        )

    @property
    @override
    def setpoint(self) -> Setpoint:
        return self.setpoint_within(self.share)

    @property
    @override
    def waits_for_current(self) -> bool:
        return self._paused_by_us

    @property
    @override
    def is_allowed(self) -> bool:
        # Where access is not written for a pause, it stays on meanwhile.
        is_off = not self._has_volatile_access and self.orders.allowed is False
        return super().is_allowed and not is_off

    @property
    @override
    def holds_ceiling_pause(self) -> bool:
        if self._has_volatile_access:
            return self._paused_by_us
        # Access in flash memory is not written: the pause is in our broadcasts alone.
        return self._is_paused

    @property
    @override
    def pause_reason(self) -> PauseReason | None:
        if (reason := super().pause_reason) is not None:
            return reason
        if self.withheld:
            return PauseReason.SUPPLY_TOO_LOW
        if self._master is None or self.status is None or self._charges:
            return None
        waits = self._master.waits_for_unread(self.unit)
        return PauseReason.OTHER_NOT_READ if waits else None

    # -- Its share -----------------------------------------------------------------

    @property
    @override
    def withheld(self) -> bool:
        return self._withheld_at is not None

    @property
    @override
    def may_begin(self) -> bool:
        return not self._is_paused and not self.withheld

    @property
    def _is_paused(self) -> bool:
        """Return whether its orders, or our end, forbid it to charge."""
        return self.wanted.paused or self._is_leaving

    @override
    def has_reservation(self, now: float) -> bool:
        return now < self._reserved_until

    @override
    def reserve(self, until: float) -> None:
        self._reserved_until = until

    @override
    def begins(self, now: float) -> None:
        self._charging_since = min(self._charging_since, now)

    @override
    def claim(self, now: float, *, may_draw: bool) -> Claim:
        demand = 0 if self._is_leaving else tenths(self.wanted)
        gone = not self.available and self.status is None
        habits = self._habits
        if gone and habits and habits.zero_stops and self.misses >= TIMING.misses:
            # It cannot confirm anything: it gets a 0, and has stopped some time later.
            return Claim(unit=self.unit, demand=0)
        if not may_draw or (demand >= LOWEST and not self.withheld):
            self._stopping_since = inf
        else:
            # It is about to stop, so no other box is stopped on its account, unless
            # it does not obey.
            self._stopping_since = min(self._stopping_since, now)
            disobeys = gone or now - self._stopping_since > (
                OPENS_WITHIN if habits is None else habits.opens_within
            )
            return Claim(unit=self.unit, demand=0, fixed=disobeys)
        if may_draw and gone:
            return Claim(unit=self.unit, demand=min(demand, LOWEST), fixed=True)
        return Claim(unit=self.unit, demand=demand, since=self._charging_since)

    @override
    def on_share(self, share: int, now: float) -> None:
        if self._withheld_at is None:
            charges = self.status is not None and self.status.raw_state in CHARGING
            if share < LOWEST <= tenths(self.wanted) and charges:
                self._withheld_at = now
                self.read_soon(now)
        elif (
            share >= LOWEST
            and now >= self._withheld_at + self._withheld_for
            and not self.master.draw(self.unit).may_draw
        ):
            self._withheld_at = None
            self.read_soon(now)

    @property
    def _withheld_for(self) -> float:
        return WITHHELD_POLLED if self._is_polled else WITHHELD_FOR

    @override
    def read_soon(self, now: float) -> None:
        self.slot.ready = self.slot.due = min(self.slot.ready, now)
        if self.bus is not None:
            self.bus.reschedule()

    # -- Readings ------------------------------------------------------------------

    @override
    def guarded(self, request: Request) -> Request:
        return partial(self.master.unless_silent, request)

    @override
    async def write(self, turn: Turn, request: Request, register: int) -> bool | None:
        allowed = partial(self.master.unless_forbidden, request)
        return await super().write(turn, allowed, register)

    @override
    def on_line_open(self) -> None:
        super().on_line_open()
        self._requests.reset()
        self._cable = None

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        follow_up = await super().poll(turn)
        answer = self._polled.after_poll(self.master) if self._is_polled else None
        return answer or follow_up

    @override
    async def _identify(self, turn: Turn) -> None:
        await super()._identify(turn)
        self.expected_dialect = self.dialect
        self.master.on_dialect()

    @override
    def status_registers(self, dialect: Dialect, now: float) -> Registers[Status]:
        longer, polled = MAPS[dialect].status, MAPS[dialect].balancing.status
        has_more = longer.words.keys() > polled.words.keys()
        if has_more and (self.status is None or now >= self._long_status_due):
            self._long_status_due = now + LONG_STATUS_INTERVAL
            return longer
        return polled

    @override
    def on_status(self, status: Status, now: float) -> None:
        super().on_status(status, now)
        if self.configuration is None:
            # Without it the limit is 6 A: a box that charges must not wait for it.
            self.read_soon(now)
        charges = status.raw_state in CHARGING
        contactor = self._contactor(status)
        if status.raw_state == UNPLUGGED:
            # The next car may come with another cable.
            self._requests.own_maximum = None
        self._cable = None if status.raw_state == UNPLUGGED else status.maximum
        if contactor in (Contactor.OPEN, Contactor.ASKED):
            if now >= self._reserved_until:
                self._charging_since = inf
        elif self._charging_since == inf:
            # Begun before our start, or under another master.
            self._charging_since = now
        if self._is_polled:
            self._polled.on_status(status, now)
            if charges and not MAPS[self.known_dialect].reports_maximum:
                due = now + MAXIMUM_INTERVAL
                self.configuration_due = min(self.configuration_due, due)
        self.master.on_status(
            self.unit,
            round(status.current * 10),
            contactor,
            complete=self.configuration is not None,
        )
        self._check_share(status, charges=charges)
        if status.access and self.may_begin:
            # Access is on already: nothing is left to restore.
            self._paused_by_us = False

    @override
    def on_configuration(self, status: Status, now: float) -> None:
        # Broadcasts and grants may have been sent since that status, so it is no
        # reading of its current, nor a request.
        super().on_status(status, now)
        self.master.on_complete(self.unit)

    def _contactor(self, status: Status) -> Contactor:
        state = status.raw_state
        if not self._is_polled:
            return Contactor.CLOSED if state in CHARGING else Contactor.OPEN
        special = {ASKS_FOR_C: Contactor.ASKED, STOPPING: Contactor.ENDING}
        known = Contactor.OPEN if state in _OPEN else Contactor.CLOSED
        return special.get(state, known)

    def _check_share(self, status: Status, *, charges: bool) -> None:
        """Reassert a share that is exceeded; a second time in a row is a fault."""
        share = round(self.share * 10)
        # Without a share it is to be stopped, whatever it offers.
        if not charges or LOWEST <= share >= round(status.current * 10):
            self._over_share = 0
            self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
            return
        self._over_share += 1
        self.statistics.reasserted += 1
        self.master.broadcast_soon()
        if self._over_share > 1:
            self.notice(Fault.LIMIT_NOT_TAKEN, present=True)

    @override
    def on_missed(self, now: float, why: str) -> None:
        super().on_missed(now, why)
        if self._is_polled:
            # No second attempt within a round, and one such box in each.
            ready = max(self.slot.ready, self.master.next_probe(now))
            self.slot.ready = self.slot.due = ready
        self.master.on_missed(self.unit, gone=self.misses >= TIMING.misses)

    @override
    async def write_state(self, turn: Turn, request: Request) -> None:
        accept = answer_to_state(self.unit, self.known_dialect)
        with suppress(ReplyTimeoutError):
            await turn.exchange(partial(self.master.unless_forbidden, request), accept)

    # -- Access --------------------------------------------------------------------

    @override
    def must_maintain(self, now: float) -> bool:
        return super().must_maintain(now) or self._access_due() is not None

    @override
    async def maintain(self, turn: Turn) -> None:
        due = self._access_due()
        if due is not None:
            await self._switch_access(turn, due)
        await super().maintain(turn)

    def _access_due(self) -> bool | None:
        """Return the access that must be set; ``None``: it may stay as it is.

        On only where we have turned it off for lack of current.
        """
        if self.status is None or not self._has_volatile_access:
            return None
        if not is_stopped(self.known_dialect, self.status):
            return False if self._must_be_off() else None
        return True if self._paused_by_us and self.may_begin else None

    @property
    def _has_volatile_access(self) -> bool:
        """Return whether its access may be written for a pause."""
        habits = self._habits
        return habits is not None and habits.access_is_volatile

    async def _switch_access(self, turn: Turn, allowed: bool) -> None:  # noqa: FBT001
        """Set the access bit, and remember whether to restore it."""
        if not allowed:
            own = self._standing.allowed is not False
            if own:
                # If it was turned off at the box first, it is not ours to restore.
                with suppress(EvseError):
                    await self.read_status_once(turn)
                await rest()
            had_access = self.status is None or self.status.access is not False
            self._paused_by_us = own and (had_access or self._paused_by_us)
        still_wanted = self._may_be_on if allowed else self._must_be_off
        await self.set_access(turn, allowed, still_wanted)
        if allowed:
            self._paused_by_us = False

    def _may_be_on(self) -> bool:
        return not self.wanted.paused

    def _must_be_off(self) -> bool:
        # Access turned off at the box counts, too: an answer of ours that crossed it
        # on the line has closed the contactor all the same.
        if self.has_no_access:
            return True
        # A polled box without a share is stopped by a 0, and refused.
        return self._is_paused if self._is_polled else not self.may_begin

    @property
    @override
    def has_no_access(self) -> bool:
        return self.status is not None and self.status.access is False

    # -- Orders --------------------------------------------------------------------

    @override
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        self._confirming = change
        try:
            with self.conversing():
                await self.reach(turn)
                if change.allowed is False:
                    # Paused by the user: no longer for lack of current.
                    self._withheld_at = None
                if self.wanted.paused and not self._has_volatile_access:
                    await self._stop_by_broadcast(turn)
                    return
                if self.wanted.paused:
                    await self._switch_access(turn, allowed=False)
                    if change.allowed is True and self._standing.allowed is not False:
                        # The user has allowed it; a higher limit will do the rest.
                        self._paused_by_us = True
                    return
                starts = change.allowed is True or self._paused_by_us
                if not self._has_volatile_access:
                    self._check_access(change)
                elif starts and not self.withheld:
                    await self._switch_access(turn, allowed=True)
                    await rest()
                await self._follow(turn)
        finally:
            self._confirming = None
            with suppress(NotAvailableError):
                self.master.update_shares()

    def _check_access(self, change: OrderChange) -> None:
        """Raise NotAvailableError for a start where access is kept, and off."""
        if change.allowed is True and self.has_no_access:
            message = f"{self.config.name}: its access is off in its own memory"
            raise NotAvailableError(message, "smartevse_access_stored_off")

    async def _stop_by_broadcast(self, turn: Turn) -> None:
        """Broadcast 0 until it is read back that no current flows.

        Raises NotConfirmedError.
        """
        habits = MAPS[self.known_dialect].balancing
        until = turn.now + habits.opens_within
        while True:
            await self.master.send_broadcast(turn)
            await rest()
            await self.read_status(turn)
            if not self.master.draw(self.unit).may_draw:
                return
            if turn.now > until:
                message = f"{self.config.name} does not stop"
                raise NotConfirmedError(message)
            await rest(READ_AGAIN)

    async def _follow(self, turn: Turn) -> None:
        """Broadcast until a current within its orders is read back.

        Its share may be less. Raises NotConfirmedError.
        """
        for _ in range(BROADCASTS):
            await self.master.send_broadcast(turn)
            await rest()
            await self.read_status(turn)
            if self.status and round(self.status.current * 10) <= tenths(self.wanted):
                self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
                return
            self.statistics.reasserted += 1
            await rest(READ_AGAIN)
        self.notice(Fault.LIMIT_NOT_TAKEN, present=True)
        message = f"{self.config.name} does not follow its limit"
        raise NotConfirmedError(message)

    @override
    async def command(
        self,
        command: Command,
        value: bool | int | str | None = None,
    ) -> None:
        if command is Command.STORE_ACCESS:
            await self.store_access(bool(value))
        else:
            await super().command(command, value)

    async def store_access(self, allowed: bool) -> None:  # noqa: FBT001
        """Turn its access on or off in its own memory; return when it is read back.

        Such a memory wears out: this is for people, not for pauses. Raises
        NotAvailableError where access is not kept, NotConfirmedError, and what `run`
        raises.
        """
        if self._habits is None or self._has_volatile_access:
            message = f"{self.config.name} does not keep its access"
            raise NotAvailableError(message)
        if self.has_access is not allowed:
            await self.run(partial(self.set_access, allowed=allowed))

    @property
    def has_access(self) -> bool | None:
        """Return its access in the last status; ``None``: not known."""
        return None if self.status is None else self.status.access

    @override
    async def on_shutdown(self, *, removed: bool = False) -> None:
        habits = self._habits
        if habits is None or habits.access_is_volatile:
            if removed:
                # It would follow the broadcasts to the others, and not be counted.
                await self.run(
                    partial(self.set_access, allowed=False),
                    persistence=Persistence.STANDING,
                    kind=Kind.PAUSE,
                )
        elif removed or not habits.fail_safe_proven:
            # Likewise, or without broadcasts it might go on for ever.
            self._is_leaving = True
            await self.run(
                self._stop_by_broadcast,
                persistence=Persistence.STANDING,
                kind=Kind.PAUSE,
            )

    # -- Its requests --------------------------------------------------------------

    @override
    def on_unsolicited(self, frame: Frame) -> FollowUp | None:
        if not isinstance(frame, ModbusFrame):
            return None
        request = decode_request(frame)
        if request is None or request.unit != self.unit or self.bus is None:
            return None
        return self._requests.on_request(request, self.master)
