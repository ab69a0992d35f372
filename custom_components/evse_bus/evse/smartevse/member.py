"""What the load-balancing master knows of one slave, and asks of it.

Its wish and its orders, its maximum, whether it follows; nothing is said to it here
but that it is read. PROTOCOLS.md, 3.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from math import inf
from typing import ClassVar, Final, override

from ..conversation import FollowUp
from ..errors import NotAvailableError
from ..exchange import Request, Turn
from ..model import (
    Capability,
    Fault,
    Limits,
    OrderChange,
    Orders,
    Range,
    Setting,
)
from ..registers import Block
from ..safety import Setpoint, clamp
from .balancing import RequestKind
from .box import SmartEvseBox
from .config import SlaveConfig
from .dialects import Dialect, Status
from .master import Master
from .registers import read_answer, read_request, tenths
from .sharing import LOWEST, Claim
from .states import CHARGING, UNPLUGGED

STOPS_WITHIN: Final = 3.0
"""Time in which a box that hears us stops when it is told to, s."""
GIVE_BACK: Final = 60.0
"""What was stopped for want of supply stays stopped for so long at least, s."""
LOOK_FOR_OTHERS: Final = 30.0
"""Pause between two looks at a box whose firmware cannot be used, s."""


class Member(SmartEvseBox[SlaveConfig]):
    """One slave, as far as its master knows and asks it."""

    pauses_hurry: ClassVar = True
    follows_master: ClassVar = True

    def __init__(self, config: SlaveConfig, orders: Orders) -> None:
        """Take the set-up; the box has no current before the master shares it."""
        super().__init__(config, orders)
        self.share = 0.0
        """What the last broadcast left for it, A."""
        self.is_foreign = False
        """It speaks another dialect: it hears none of our broadcasts."""
        self.came = inf
        """When its car began, for who comes first."""
        self._master: Master | None = None
        self._own_maximum: float | None = None
        self._promised_until = -inf
        self._withheld_at: float | None = None
        self._stopping_since = inf
        self._over = 0
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
        if self._master is None:
            message = f"{self.config.name} is on no bus with a master"
            raise NotAvailableError(message)
        return self._master

    def join(self, master: Master | None) -> None:
        """Take a master, or none."""
        self._master = master

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
            return self.order_to_send(self._confirming)
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
                self.look_soon(now)
        elif (
            share >= LOWEST
            and now >= self._withheld_at + GIVE_BACK
            and not self.master.draw(self.unit).may_draw
        ):
            self._withheld_at = None
            self.look_soon(now)

    def look_soon(self, now: float) -> None:
        """Let it be read as soon as the bus is free."""
        self.slot.ready = self.slot.due = min(self.slot.ready, now)
        if self.bus is not None:
            self.bus.reschedule()

    # -- What it tells -------------------------------------------------------------

    @override
    def forget(self) -> None:
        super().forget()
        self._answering.clear()

    @override
    async def poll(self, turn: Turn) -> FollowUp | None:
        if self.is_foreign and turn.now < self._look_again_at:
            raise self._refusal()
        return await super().poll(turn)

    @override
    async def read(self, turn: Turn, block: Block) -> bytes:
        request = partial(read_request, self.unit, block)
        return await turn.exchange(
            partial(self.master.unless_silent, request), read_answer(self.unit, block)
        )

    @override
    async def write(self, turn: Turn, request: Request, register: int) -> bool | None:
        checked = partial(self.master.unless_silent, request)
        return await super().write(turn, checked, register)

    @override
    async def _find_dialect(self, turn: Turn) -> None:
        await super()._find_dialect(turn)
        self.is_foreign = self.dialect is not Dialect.V2_17
        if self.is_foreign:
            self._look_again_at = turn.now + LOOK_FOR_OTHERS
            self.set_unavailable()
            self.notice(Fault.UNSUPPORTED_FIRMWARE, present=True)
            raise self._refusal()

    def _refusal(self) -> NotAvailableError:
        message = f"{self.config.name}: its firmware shakes hands in another way"
        return NotAvailableError(message)

    @override
    def take(self, status: Status, now: float) -> None:
        super().take(status, now)
        if self.configuration is None:
            # Without it the limit is 6 A: a box that charges must not wait for it.
            self.look_soon(now)
        closed = status.raw_state in CHARGING
        if status.raw_state == UNPLUGGED:
            # The next car may come with another cable.
            self._own_maximum = None
        if not closed:
            self.came = inf if now >= self._promised_until else self.came
        elif self.came == inf:
            # It charged before we came, or somebody else let it.
            self.came = now
        self.master.took(self, round(status.current * 10), closed=closed)
        self._see_whether_it_follows(status, closed=closed)

    def _see_whether_it_follows(self, status: Status, *, closed: bool) -> None:
        """Say again at once what it has not heard; more than once is a fault."""
        share = round(self.share * 10)
        # Without a share it is to be stopped, whatever it offers.
        if not closed or LOWEST <= share >= round(status.current * 10):
            self._over = 0
            self.notice(Fault.LIMIT_NOT_TAKEN, present=False)
            return
        self._over += 1
        self.statistics.reasserted += 1
        self.master.hurry()
        if self._over > 1:
            self.notice(Fault.LIMIT_NOT_TAKEN, present=True)

    @override
    def on_missed(self, now: float) -> None:
        super().on_missed(now)
        self.master.missed(self)
