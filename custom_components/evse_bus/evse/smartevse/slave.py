"""One SmartEVSE that Home Assistant is the load-balancing master of (dialect 2.17).

Its current is a word of the master's broadcast; what is said to it alone is its access
bit and the answers to its requests. A broadcast of 0 A is no stop (it then offers 6 A):
a pause is its access bit, and counts when the box says that it has obeyed.
PROTOCOLS.md, 3.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from math import inf
from typing import ClassVar, Final, override

from ..errors import (
    NotAvailableError,
    NotConfirmedError,
)
from ..exchange import Request, Talk
from ..framing import Frame
from ..jobs import Later
from ..modbus import ModbusFrame
from ..model import (
    Capability,
    ChargerConfig,
    Fault,
    Limits,
    OrderChange,
    Orders,
    Range,
    Setting,
)
from ..safety import Setpoint, clamp
from ..turns import Turns, in_turns
from .answers import ANSWER_BYTES, ANSWER_WITHIN, Answer
from .balancing import (
    RequestKind,
    SlaveRequest,
    acknowledge,
    decode_request,
)
from .box import SmartEvseBox
from .dialects import Block, Dialect
from .master import Master
from .registers import Status, read_answer, read_request, tenths
from .sharing import LOWEST, Claim
from .states import CHARGING, is_stopped
from .timing import LOOK_AGAIN

PROMISE: Final = 10.0
"""A car that was told a current has its share kept until it begins, s."""
STOPS_WITHIN: Final = 3.0
"""Time in which a box that hears us stops when it is told to, s."""
GIVE_BACK: Final = 60.0
"""What was stopped for want of supply stays stopped for so long at least, s."""
BROADCASTS: Final = 4
"""How often a new current is broadcast until it must be read back."""
LOOK_FOR_OTHERS: Final = 30.0
"""Pause between two looks at a box whose firmware cannot be used, s."""


class SlaveSmartEvse(SmartEvseBox):
    """One slave."""

    pauses_hurry: ClassVar = True

    def __init__(self, config: ChargerConfig, orders: Orders) -> None:
        """Take the set-up; the box has no current before the master shares it."""
        super().__init__(config, orders)
        self.share = 0.0
        """What the last broadcast left for it, A."""
        self.is_foreign = False
        """It speaks another dialect: it hears none of our broadcasts."""
        self.came = inf
        """When its car began, for who comes first."""
        self._own_maximum: float | None = None
        self._promised_until = -inf
        self._withheld_at: float | None = None
        self._stopping_since = inf
        self._is_ours = False
        self._confirming: OrderChange | None = None
        self._answering: dict[RequestKind, float] = {}
        self._look_again_at = -inf

    # -- What it is and has --------------------------------------------------------

    @property
    def unit(self) -> int:
        """Return its address."""
        return self.config.address

    @property
    def master(self) -> Master:
        """Return the master; NotAvailableError without one."""
        duty = self.bus.duty if self.bus is not None else None
        if not isinstance(duty, Master):
            message = f"{self.config.name} is on no bus with a master"
            raise NotAvailableError(message)
        return duty

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
        told = [one for one in (known.reported, self._own_maximum) if one is not None]
        # The minimum that a slave keeps in its memory is for masters only.
        return Limits(
            installation=known.installation,
            reports_maximum=True,
            reported=min(told, default=None),
        )

    @property
    def wanted(self) -> Setpoint:
        """Return what would be sent to it if it had all of the supply."""
        return clamp(self._standing, self.limits)

    @property
    def _standing(self) -> Orders:
        """Return the orders that count, with those that are just being confirmed."""
        if self._confirming is not None:
            return self.target(self._confirming)
        return self.effective_orders

    def setpoint_within(self, share: float) -> Setpoint:
        """Return what may be sent to it with this share of the supply, A."""
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
        return self._is_ours

    # -- What the master asks ------------------------------------------------------

    @property
    def withheld(self) -> bool:
        """Return whether it was stopped because the supply does not suffice."""
        return self._withheld_at is not None

    def is_promised(self, now: float) -> bool:
        """Return whether a current is kept for it that it does not draw yet."""
        return now < self._promised_until

    def claim(self, now: float, *, may_draw: bool) -> Claim:
        """Return what it asks of the supply."""
        wish = tenths(self.wanted)
        gone = not self.available and self.status is None
        if not may_draw or (wish >= LOWEST and not self.withheld):
            self._stopping_since = inf
        else:
            # It is as good as gone, and nobody is stopped for its sake: unless it
            # does not obey.
            self._stopping_since = min(self._stopping_since, now)
            disobeys = gone or now - self._stopping_since > STOPS_WITHIN
            return Claim(unit=self.unit, wish=0, fixed=disobeys)
        if may_draw and gone:
            return Claim(unit=self.unit, wish=min(wish, LOWEST), fixed=True)
        return Claim(unit=self.unit, wish=wish, came=self.came)

    def may_have(self, share: int, now: float) -> None:
        """Stop it where there is no share for it, 0.1 A; give back what was stopped."""
        if self._withheld_at is None:
            charges = self.status is not None and self.status.raw_state in CHARGING
            if share < LOWEST <= tenths(self.wanted) and charges:
                self._withheld_at = now
                self._tend_soon(now)
        elif (
            share >= LOWEST
            and now >= self._withheld_at + GIVE_BACK
            and not self.master.draw(self.unit).may_draw
        ):
            self._withheld_at = None
            self._tend_soon(now)

    def _tend_soon(self, now: float) -> None:
        self.slot.ready = self.slot.due = min(self.slot.ready, now)
        if self.bus is not None:
            self.bus.look_again()

    # -- What it tells -------------------------------------------------------------

    @override
    def forget(self) -> None:
        super().forget()
        self._answering.clear()

    @override
    async def poll(self, talk: Talk) -> Later[None] | None:
        if self.is_foreign and talk.now < self._look_again_at:
            raise self._refusal()
        return await super().poll(talk)

    @override
    async def read(self, talk: Talk, block: Block) -> bytes:
        request = partial(read_request, self.unit, block)
        return await talk.exchange(
            partial(self.master.unless_silent, request), read_answer(self.unit, block)
        )

    @override
    async def write(self, talk: Talk, request: Request, register: int) -> bool | None:
        checked = partial(self.master.unless_silent, request)
        return await super().write(talk, checked, register)

    @override
    async def _find_dialect(self, talk: Talk) -> Turns:
        async for pause in super()._find_dialect(talk):
            yield pause
        self.is_foreign = self.dialect is not Dialect.V2_17
        if self.is_foreign:
            self._look_again_at = talk.now + LOOK_FOR_OTHERS
            self.set_unavailable()
            self.tell(Fault.UNSUPPORTED_FIRMWARE, present=True)
            raise self._refusal()

    def _refusal(self) -> NotAvailableError:
        message = f"{self.config.name}: its firmware shakes hands in another way"
        return NotAvailableError(message)

    @override
    def take(self, status: Status, now: float) -> None:
        super().take(status, now)
        if self.configuration is None:
            # Without it the limit is 6 A: a box that charges must not wait for it.
            self._tend_soon(now)
        closed = status.raw_state in CHARGING
        if not closed:
            self.came = inf if now >= self._promised_until else self.came
        elif self.came == inf:
            # It charged before we came, or somebody else let it.
            self.came = now
        self.master.took(self, round(status.current * 10), closed=closed)
        if status.raw_state not in CHARGING or status.current <= self.share:
            self.tell(Fault.LIMIT_NOT_TAKEN, present=False)

    @override
    def missed(self, now: float) -> None:
        super().missed(now)
        self.master.missed(self)

    # -- Access --------------------------------------------------------------------

    @override
    def must_tend(self, now: float) -> bool:
        return super().must_tend(now) or self._access_due() is not None

    @override
    async def tend(self, talk: Talk) -> Turns:
        due = self._access_due()
        if due is not None:
            async for pause in self._turn(talk, due):
                yield pause
        async for pause in super().tend(talk):
            yield pause

    def _access_due(self) -> bool | None:
        """Return what its access must be set to; ``None``: it may stay as it is.

        On only where we have turned it off ourselves, for want of current.
        """
        if self.status is None:
            return None
        off = self.wanted.paused or self.withheld
        if off and not is_stopped(self.known_dialect, self.status):
            return False
        if not off and not self.status.access and self._is_ours:
            return True
        return None

    async def _turn(self, talk: Talk, allowed: bool) -> Turns:  # noqa: FBT001
        """Set the access bit, and remember whether that was our own doing."""
        if not allowed:
            had_access = self.status is None or self.status.access
            own = self._standing.allowed is not False
            self._is_ours = own and (had_access or self._is_ours)
        async for pause in self.set_access(talk, allowed):
            yield pause
        if allowed:
            self._is_ours = False

    # -- Orders --------------------------------------------------------------------

    @override
    async def impose(
        self, talk: Talk, orders: Orders, change: OrderChange
    ) -> Later[None] | None:
        return await in_turns(partial(self._impose, change))(talk)

    async def _impose(self, change: OrderChange, talk: Talk) -> Turns:
        token = self.begin()
        self._confirming = change
        try:
            async for pause in self.reach(talk):
                yield pause
            if change.allowed is False:
                # The user's word: nothing of it is ours to give back.
                self._withheld_at = None
            if self.wanted.paused:
                async for pause in self._turn(talk, allowed=False):
                    yield pause
                return
            starts = change.allowed is True or self._is_ours
            if starts and not self.withheld:
                async for pause in self._turn(talk, allowed=True):
                    yield pause
                yield 0.0
            async for pause in self._follow(talk):
                yield pause
        finally:
            self._confirming = None
            self.end(token)
            self._changed()

    async def _follow(self, talk: Talk) -> Turns:
        """Broadcast its current until it is read back, at it or below it.

        More than its share is not waited for. Raises NotConfirmedError.
        """
        for _ in range(BROADCASTS):
            await self.master.speak(talk)
            yield 0.0
            async for pause in self.see(talk):
                yield pause
            if self.status and round(self.status.current * 10) <= tenths(self.wanted):
                self.tell(Fault.LIMIT_NOT_TAKEN, present=False)
                return
            self.statistics.reasserted += 1
            yield LOOK_AGAIN
        self.tell(Fault.LIMIT_NOT_TAKEN, present=True)
        message = f"{self.config.name} does not follow its limit"
        raise NotConfirmedError(message)

    def _changed(self) -> None:
        with suppress(NotAvailableError):
            self.master.changed()

    # -- Its requests --------------------------------------------------------------

    @override
    def on_unsolicited(self, frame: Frame) -> Later[None] | None:
        if not isinstance(frame, ModbusFrame):
            return None
        request = decode_request(frame)
        if request is None or request.unit != self.unit or self.bus is None:
            return None
        now = self.master.now
        if self.dialect is not Dialect.V2_17:
            # Nothing is said to a box that we have not read.
            self._tend_soon(now)
            return Later(0.0, _nothing, 0.0)
        if request.kind in (RequestKind.B, RequestKind.C):
            self._own_maximum = request.wanted
        else:
            # What it leaves the others need not wait for.
            self._promised_until = -inf
            self._tend_soon(now)
        if now < self._answering.get(request.kind, -inf):
            return Later(0.0, _nothing, 0.0)
        self._answering[request.kind] = now + ANSWER_WITHIN
        answer = Answer(self, request, now)
        return Later(0.0, answer.give, self.bus.wire.send_time(ANSWER_BYTES))

    def answered(self, request: SlaveRequest) -> None:
        """Note that a request needs no answer any more."""
        self._answering.pop(request.kind, None)

    def keep(self, until: float) -> None:
        """Keep its share for it, so that the others make room."""
        self._promised_until = until

    def may_begin(self) -> bool:
        """Return whether its requests for current may be granted at all."""
        return not self.wanted.paused and not self.withheld and not self._is_ours

    def answer_frame(self, request: SlaveRequest) -> bytes:
        """Return the answer of this moment, which must be sent now.

        Raises NotAvailableError where another master has just spoken.
        """
        return self.master.unless_silent(partial(self._answer, request))

    def _answer(self, request: SlaveRequest) -> bytes:
        if request.kind not in (RequestKind.B, RequestKind.C) or not self.may_begin():
            return acknowledge(request, None)
        now = self.master.now
        setpoint = self.setpoint_within(self.master.grant(self.unit) / 10)
        if setpoint.paused:
            self._promised_until = -inf
            return acknowledge(request, None)
        if request.kind is RequestKind.C:
            self.master.draw(self.unit).granted(tenths(setpoint), now)
        self.came = min(self.came, now)
        self._promised_until = now + PROMISE
        return acknowledge(request, setpoint)


async def _nothing(_talk: Talk) -> None:
    """Say nothing."""
