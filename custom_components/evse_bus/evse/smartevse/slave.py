"""One SmartEVSE slave under Home Assistant as load-balancing master (dialect 2.17).

Its current is a value of the master's broadcast; only its access bit and the answers to
its requests are addressed to it alone. A broadcast of 0 A does not stop it (it then
offers 6 A): a pause is its access bit, confirmed when the box has obeyed it.
PROTOCOLS.md, 3.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from math import inf
from typing import ClassVar, Final, override

from ..conversation import FollowUp, nothing, rest
from ..errors import (
    EvseError,
    LineBusyError,
    NotAvailableError,
    NotConfirmedError,
)
from ..exchange import Request, Turn
from ..framing import Frame
from ..modbus import ModbusFrame
from ..model import (
    Capability,
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
from ..safety import Setpoint, clamp
from ..schedule import Kind
from .balancing import RequestKind, SlaveRequest, acknowledge, decode_request
from .charger import SmartEvseCharger
from .config import SlaveConfig
from .dialects import Dialect, Status
from .master import Master, Slave
from .reader import READ_AGAIN
from .registers import LONGEST_REQUEST, tenths
from .sharing import LOWEST, Claim
from .states import CHARGING, UNPLUGGED, is_stopped

STOPS_WITHIN: Final = 3.0
"""Time in which a box that receives a stop obeys it, s."""
WITHHELD_FOR: Final = 60.0
"""Shortest pause of a box that was stopped for lack of current, s."""
RESERVED_FOR: Final = 10.0
"""Time for which the share of a car that was granted current waits for it, s."""
BROADCASTS: Final = 4
"""Attempts to broadcast a new current, each followed by its read-back."""
ANSWER_WITHIN: Final = 0.8
"""Latest answer to a request, s: after 1 s the box has given it up, and would close its
contactor on a late answer all the same. It asks again."""
ROUNDS: Final = 2
"""Attempts to lower the others for one request."""
OTHER_DIALECT_INTERVAL: Final = 30.0
"""Pause between two readings of a box of another dialect, s."""

_OTHER_HANDSHAKE: Final = "its firmware has another handshake"
_ANSWER_BYTES: Final = LONGEST_REQUEST
"""A turn that answers may have a broadcast instead."""
_FOR_CURRENT: Final = frozenset({RequestKind.B, RequestKind.C})
"""Requests that are granted a current."""


class SlaveSmartEvse(SmartEvseCharger[SlaveConfig], Slave):
    """One slave."""

    pauses_hurry: ClassVar = True

    def __init__(self, config: SlaveConfig, orders: Orders) -> None:
        """Begin with an unknown box, without a share of the circuit limit."""
        super().__init__(config, orders)
        self.share = 0.0
        self.has_other_dialect = False
        self._master: Master | None = None
        self._own_maximum: float | None = None
        """The maximum of box and cable, as in its last request, A."""
        self._charging_since = inf
        self._reserved_until = -inf
        self._withheld_at: float | None = None
        """Loop time at which its share became too small to charge."""
        self._stopping_since = inf
        self._over_share = 0
        """Readings in a row that were above its share."""
        self._paused_by_us = False
        """We have turned its access off for lack of current."""
        self._confirming: OrderChange | None = None
        """The change of orders under way."""
        self._answering: dict[RequestKind, float] = {}
        """Requests being answered, and until when their repetition is ignored."""
        self._read_dialect_at = -inf

    # -- Capabilities and limits ---------------------------------------------------

    @property
    @override
    def unit(self) -> int:
        return self.config.address

    @property
    def master(self) -> Master:
        """Return the master; raises NotAvailableError without one."""
        if self._master is None:
            message = f"{self.config.name} is on no bus with a master"
            raise NotAvailableError(message)
        return self._master

    @override
    def join(self, master: Master | None) -> None:
        self._master = master

    @property
    @override
    def worst_case(self) -> float | None:
        return self.bus.worst_case(self) if self.bus is not None else None

    @property
    @override
    def fail_safe(self) -> FailSafe:
        return FailSafe.STOPS

    @property
    @override
    def capabilities(self) -> frozenset[Capability]:
        # The mode of a slave is its master's.
        return super().capabilities - {Capability.MODE}

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
        maxima = [one for one in (known.reported, self._own_maximum) if one is not None]
        # The minimum in the memory of a slave applies to masters only.
        return Limits(
            installation=known.installation,
            reports_maximum=True,
            reported=min(maxima, default=None),
        )

    @property
    def wanted(self) -> Setpoint:
        """Return the set-point with the whole circuit limit as its share."""
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
    def pause_reason(self) -> PauseReason | None:
        withheld = PauseReason.SUPPLY_TOO_LOW if self.withheld else None
        return super().pause_reason or withheld

    # -- Its share -----------------------------------------------------------------

    @property
    def withheld(self) -> bool:
        """Return whether it must not charge because its share is too small."""
        return self._withheld_at is not None

    @property
    def may_begin(self) -> bool:
        """Return whether neither its orders nor its share forbid it to charge."""
        return not self.wanted.paused and not self.withheld

    @override
    def has_reservation(self, now: float) -> bool:
        return now < self._reserved_until

    @override
    def claim(self, now: float, *, may_draw: bool) -> Claim:
        demand = tenths(self.wanted)
        gone = not self.available and self.status is None
        if not may_draw or (demand >= LOWEST and not self.withheld):
            self._stopping_since = inf
        else:
            # It is about to stop, so no other box is stopped on its account, unless
            # it does not obey.
            self._stopping_since = min(self._stopping_since, now)
            disobeys = gone or now - self._stopping_since > STOPS_WITHIN
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
            and now >= self._withheld_at + WITHHELD_FOR
            and not self.master.draw(self.unit).may_draw
        ):
            self._withheld_at = None
            self.read_soon(now)

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
    def on_line_open(self) -> None:
        super().on_line_open()
        self._answering.clear()

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        if self.has_other_dialect and turn.now < self._read_dialect_at:
            raise self._refusal()
        return await super().poll(turn)

    @override
    async def _identify(self, turn: Turn) -> None:
        await super()._identify(turn)
        self.has_other_dialect = self.dialect is not Dialect.V2_17
        if self.has_other_dialect:
            self._read_dialect_at = turn.now + OTHER_DIALECT_INTERVAL
            self.set_unavailable(_OTHER_HANDSHAKE)
            self.notice(Fault.UNSUPPORTED_FIRMWARE, present=True)
            raise self._refusal()

    def _refusal(self) -> NotAvailableError:
        message = f"{self.config.name}: {_OTHER_HANDSHAKE}"
        return NotAvailableError(message, "smartevse_other_firmware")

    @override
    def on_status(self, status: Status, now: float) -> None:
        super().on_status(status, now)
        if self.configuration is None:
            # Without it the limit is 6 A: a box that charges must not wait for it.
            self.read_soon(now)
        closed = status.raw_state in CHARGING
        if status.raw_state == UNPLUGGED:
            # The next car may come with another cable.
            self._own_maximum = None
        if not closed:
            if now >= self._reserved_until:
                self._charging_since = inf
        elif self._charging_since == inf:
            # Begun before our start, or under another master.
            self._charging_since = now
        self.master.on_status(
            self.unit,
            round(status.current * 10),
            closed=closed,
            complete=self.configuration is not None,
        )
        self._check_share(status, closed=closed)
        if status.access and self.may_begin:
            # Access is on already: nothing is left to restore.
            self._paused_by_us = False

    def _check_share(self, status: Status, *, closed: bool) -> None:
        """Reassert a share that is exceeded; a second time in a row is a fault."""
        share = round(self.share * 10)
        # Without a share it is to be stopped, whatever it offers.
        if not closed or LOWEST <= share >= round(status.current * 10):
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
        self.master.on_missed(self.unit)

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
        if self.status is None:
            return None
        if not is_stopped(self.known_dialect, self.status):
            return False if self._must_be_off() else None
        return True if self._paused_by_us and self.may_begin else None

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
        return not self.may_begin or self._has_no_access

    @property
    def _has_no_access(self) -> bool:
        """Return whether its access was off in the last status."""
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
                if self.wanted.paused:
                    await self._switch_access(turn, allowed=False)
                    if change.allowed is True and self._standing.allowed is not False:
                        # The user has allowed it; a higher limit will do the rest.
                        self._paused_by_us = True
                    return
                starts = change.allowed is True or self._paused_by_us
                if starts and not self.withheld:
                    await self._switch_access(turn, allowed=True)
                    await rest()
                await self._follow(turn)
        finally:
            self._confirming = None
            with suppress(NotAvailableError):
                self.master.update_shares()

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
    async def on_shutdown(self, *, removed: bool = False) -> None:
        if removed:
            # It would follow the broadcasts to the others, and not be counted.
            await self.run(
                partial(self.set_access, allowed=False),
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
        now = self.master.now
        if self.dialect is not Dialect.V2_17:
            # A box that was not read is not answered.
            self.read_soon(now)
            return FollowUp(nothing)
        reads_first = False
        if request.kind in _FOR_CURRENT:
            self._own_maximum = request.wanted
            # Its access was turned on since its last status, or off after the request.
            reads_first = self.may_begin and self._has_no_access
        else:
            # The others need not wait for what it leaves.
            self._reserved_until = -inf
            self.read_soon(now)
        if now < self._answering.get(request.kind, -inf):
            return FollowUp(nothing)
        answer_by = now + ANSWER_WITHIN
        self._answering[request.kind] = answer_by
        if reads_first:
            return FollowUp(partial(self._read_and_answer, request, answer_by))
        return FollowUp(
            partial(self._answer, request, answer_by), worst_case=self._answer_time
        )

    async def _read_and_answer(
        self, request: SlaveRequest, answer_by: float, turn: Turn
    ) -> None:
        """Answer a request if the box has access: a conversation."""
        try:
            await self.read_status_once(turn)
        finally:
            if self._has_no_access or self.status is None:
                # It asks again in a second.
                self._answering.pop(request.kind, None)
        if not self._has_no_access:
            await rest(worst_case=self._answer_time)
            await self._answer(request, answer_by, turn)

    async def _answer(
        self, request: SlaveRequest, answer_by: float, turn: Turn
    ) -> None:
        """Answer a request, once the others have made room for it: a conversation."""
        rounds = ROUNDS
        while turn.now <= answer_by:
            others: list[Slave] = []
            if rounds and self._needs_room(request, answer_by):
                others = self.master.above_share(self.unit)
                rounds -= 1
            try:
                if not others:
                    await turn.send(partial(self._answer_frame, request))
                    self._answering.pop(request.kind, None)
                    self.master.update_shares()
                    return
                await self.master.lower(turn, others)
            except LineBusyError:
                pass
            await rest(worst_case=self._answer_time)
        self._answering.pop(request.kind, None)

    @property
    def _answer_time(self) -> float | None:
        """Return the longest time it takes to send an answer, s."""
        return self.bus.wire.send_time(_ANSWER_BYTES) if self.bus is not None else None

    def _needs_room(self, request: SlaveRequest, answer_by: float) -> bool:
        """Return whether others must go down first; reserves its share meanwhile."""
        if request.kind not in _FOR_CURRENT or not self.may_begin:
            return False
        self._reserved_until = answer_by
        return not self.master.grant(self.unit) and bool(
            self.master.shares().get(self.unit)
        )

    def _answer_frame(self, request: SlaveRequest) -> bytes:
        """Return the answer of this moment, which must be sent now.

        Raises NotAvailableError beside another master.
        """
        return self.master.unless_silent(partial(self._granted, request))

    def _granted(self, request: SlaveRequest) -> bytes:
        if request.kind not in _FOR_CURRENT or not self.may_begin:
            return acknowledge(request, None)
        now = self.master.now
        setpoint = self.setpoint_within(self.master.grant(self.unit) / 10)
        if setpoint.paused:
            self._reserved_until = -inf
            return acknowledge(request, None)
        if request.kind is RequestKind.C:
            self.master.draw(self.unit).granted(tenths(setpoint), now)
        self._charging_since = min(self._charging_since, now)
        self._reserved_until = now + RESERVED_FOR
        return acknowledge(request, setpoint)
