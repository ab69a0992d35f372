"""Evidence of the registers for an order, and whether it is written again.

Icmax is read back in word 3 of register 0x000F. The Ic of 0x002E shows a lower limit,
but not a pause: it then stays at Idefault (PROTOCOLS.md, 2). Not every box answers
0x000F. The rules are those of the decision table in docs/abl.md, by its row numbers.
Pure functions of what was read and of what has been written; all times in seconds.
"""

from dataclasses import dataclass, replace
from math import inf
from typing import Final

from ..model import OrderState
from .duty import PAUSE, current_for
from .states import A1, B1, B2, E0, SETUP, is_failure

GRACE: Final = 10.0
"""Time for a car to follow a pause or a limit that the box has taken."""
EXCESS: Final = 1.0
"""A above a limit that show that it is not followed."""
REPEAT_PAUSE: Final = 60.0
"""A pause that cannot be read back is written again after this time."""
FAILED_AFTER: Final = 15.0
"""After the first of three writes."""
FRESH: Final = 10.0
"""An older Icmax counts as unknown."""

WRITE_PAUSES: Final = (3.0, 5.0, 10.0, 30.0, 60.0)
"""Between the writes of one order: at 0, 3, 8 s, then ever more rarely."""
FREE_REPEATS: Final = 2
"""Writes without a reply that are repeated as soon as the box has been read."""
_FAILED_WRITES: Final = 3

IDLE: Final = frozenset({A1, B1, B2, E0})
"""The contactor is open; all other states count as C, but for Ex and Fx."""
_LOWEST: Final = 0x50
_HIGHEST: Final = 0x3CA


def is_charging(state: int) -> bool:
    """Return whether a state byte is C or counts as C."""
    return not (state in IDLE | SETUP or is_failure(state))


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """The registers read from a box."""

    state: int
    """State byte."""
    ic: int
    """Ic of 0x002E, 0.1 %."""
    reports_icmax: bool | None
    """It answers reads of 0x000F; ``None``: not known yet."""
    icmax: int | None = None
    """Word 3 of 0x000F, 0.1 %, read at most `FRESH` ago; ``None``: unknown."""
    current: float | None = None
    """Highest measured phase current, A."""
    charging_for: float = 0.0
    """Time since it has come to C."""

    @property
    def idle(self) -> bool:
        """Return whether the contactor is open."""
        return self.state in IDLE

    @property
    def charging(self) -> bool:
        """Return whether it is in C, or in a state that counts as C."""
        return is_charging(self.state)


@dataclass(frozen=True, slots=True, kw_only=True)
class Standing:
    """An order, and what has become of it so far."""

    code: int
    """Icmax that it comes to, 0.1 %; `PAUSE`: charging is not allowed."""
    acknowledged: float | None = None
    """Time since the last acknowledged write of it; ``None``: none since connecting."""
    state_changed: bool = False
    """The state has changed since that acknowledged write."""
    unsettled: bool = False
    """Another one was written just now, and may still take effect."""
    raised: bool = False
    """It is higher than the one before, and has not been written yet."""
    ends_pause: bool = False
    """A limit of ours has paused the box for certain, and this one ends that."""
    after_pause: bool = False
    """The order before it was a pause."""
    confirmed: bool = False
    """A limit of ours has been read back since connecting."""
    missed: bool = False
    """A reply has been missed since then: the power may have been cut."""
    allowed: bool = False
    """The user has allowed charging since connecting."""
    failed: bool = False
    """Three writes have not been followed."""
    charges: bool = False
    """A car charges although the box is paused, for too long."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """A decision about an order: its evidence, and the action."""

    state: OrderState | None
    """``None``: nothing can be known in this state."""
    paused: bool | None
    """Charging is not allowed; ``None``: unknown."""
    offered: int | None
    """Duty cycle that is offered, 0.1 %."""
    write: bool = False
    """The order is to be written, as soon as `Writes` permits."""
    ignored: bool = False
    """The box does not take it, for too long."""


def decide(seen: Evidence, order: Standing) -> Decision:
    """Return what the registers prove about an order."""
    if seen.state in SETUP or is_failure(seen.state):
        # Row 16, and E1 to E3: nothing is written.
        return Decision(state=None, paused=None, offered=None)
    if PAUSE in (seen.ic, seen.icmax):
        return _paused(seen, order)
    if seen.reports_icmax and seen.icmax:
        return _read_back(seen, order, seen.icmax)
    if order.code == PAUSE:
        return _pause_not_read_back(seen, order)
    return _limit_by_ic(seen, order)


def believed_paused(seen: Evidence) -> bool | None:
    """Return whether charging is not allowed, by the registers alone."""
    if PAUSE in (seen.ic, seen.icmax):
        return True
    return False if seen.reports_icmax and seen.icmax else None


def is_taken(seen: Evidence, order: Standing, *, starts: bool, is_last: bool) -> bool:
    """Return whether what was read after a write of an order confirms it.

    ``starts``: a pause that is read back does not count as below. ``is_last``: there
    is no more time to wait for a raise.
    """
    if PAUSE in (seen.ic, seen.icmax):
        return order.code == PAUSE or not starts
    if seen.reports_icmax:
        if seen.icmax is None or order.code == PAUSE:
            return False
        return seen.icmax == order.code or (is_last and seen.icmax < order.code)
    # One that may still show that Icmax can be read confirms nothing yet.
    if order.acknowledged is None or seen.reports_icmax is None:
        return False
    return seen.idle if order.code == PAUSE else 0 < seen.ic <= order.code


def _paused(seen: Evidence, order: Standing) -> Decision:
    """Rows 14, 1 and 2: the pause is in a register."""
    if order.code != PAUSE:
        # Else only the user's "allow" ends it.
        state = (
            OrderState.NOT_READ_BACK
            if order.ends_pause
            else OrderState.PAUSED_ELSEWHERE
        )
        return Decision(state=state, paused=True, offered=PAUSE, write=order.ends_pause)
    if seen.idle or seen.ic == PAUSE:
        return Decision(
            state=OrderState.CONFIRMED,
            paused=True,
            offered=PAUSE,
            write=order.unsettled,
        )
    return Decision(
        state=OrderState.NOT_TAKEN if order.charges else OrderState.CONFIRMED,
        paused=True,
        offered=PAUSE,
        write=order.unsettled or _write_in_c(seen, order),
    )


def _write_in_c(seen: Evidence, order: Standing) -> bool:
    """Return whether a pause is written again while the car is still on.

    The car has its grace after an acknowledged write, but none where it has come to C
    after it.
    """
    since = order.acknowledged
    return since is None or seen.charging_for < since or since >= GRACE


def _read_back(seen: Evidence, order: Standing, icmax: int) -> Decision:
    """Rows 6, 7, 3, 4 and 5: Icmax is read, and is no pause."""
    offered = min(icmax, seen.ic) if _is_limit(icmax) and seen.ic else seen.ic
    if order.code == PAUSE or icmax > order.code or not _is_limit(icmax):
        paused = False if _is_limit(icmax) else None
        return _lost(order, paused=paused, offered=offered)
    if icmax == order.code:
        if _exceeds(seen, order):
            return _lost(order, paused=False, offered=seen.ic)
        return Decision(state=OrderState.CONFIRMED, paused=False, offered=seen.ic)
    return Decision(
        state=OrderState.LOWER_THAN_ORDERED,
        paused=False,
        offered=offered,
        write=order.raised and seen.state != E0,
    )


def _exceeds(seen: Evidence, order: Standing) -> bool:
    """Row 6: Icmax is right, but Ic is above it, and more may flow."""
    if seen.idle or seen.ic <= order.code or seen.charging_for < GRACE:
        return False
    if order.acknowledged is not None and order.acknowledged < GRACE:
        return False
    limit = current_for(order.code)
    return seen.current is None or limit is None or seen.current > limit + EXCESS


def _pause_not_read_back(seen: Evidence, order: Standing) -> Decision:
    """Rows 12 and 13: a pause on a box that does not show it."""
    since = order.acknowledged
    if not seen.idle:
        not_taken = order.failed or order.charges
        return Decision(
            state=OrderState.NOT_TAKEN if not_taken else OrderState.NOT_READ_BACK,
            paused=True if since is not None else None,
            offered=PAUSE if since is not None else None,
            write=_write_in_c(seen, order),
            ignored=order.failed and since is None,
        )
    unknown = since is None or order.state_changed or since >= REPEAT_PAUSE
    return Decision(
        state=OrderState.NOT_READ_BACK,
        paused=True if since is not None else None,
        offered=PAUSE if since is not None else None,
        # A box that reports Icmax is read first.
        write=unknown and seen.reports_icmax is False,
    )


def _limit_by_ic(seen: Evidence, order: Standing) -> Decision:
    """Rows 8 to 11: a limit on a box that shows its Ic alone."""
    if order.ends_pause:
        return replace(_held(paused=None, offered=seen.ic), write=True)
    within = _LOWEST <= seen.ic <= order.code
    if seen.idle:
        return _limit_when_idle(seen, order, within=within)
    # In C no pause stands.
    if not within:
        return _lost(order, paused=False, offered=seen.ic)
    if seen.reports_icmax is not False:
        return _held(paused=False, offered=seen.ic)
    return Decision(
        state=OrderState.CONFIRMED,
        paused=False,
        offered=seen.ic,
        write=order.raised and seen.ic < order.code,
    )


def _limit_when_idle(seen: Evidence, order: Standing, *, within: bool) -> Decision:
    """Rows 8, 10 and 11: Ic does not show whether a pause stands."""
    if not order.after_pause and seen.reports_icmax is False:
        if within:
            paused = False if order.allowed else None
            return Decision(state=OrderState.CONFIRMED, paused=paused, offered=seen.ic)
        if order.confirmed and order.missed and seen.ic:
            return _lost(order, paused=False, offered=seen.ic)
    # Perhaps paused by another: a write would end that.
    return _held(paused=None, offered=seen.ic)


def _held(*, paused: bool | None, offered: int) -> Decision:
    return Decision(
        state=OrderState.NOT_READ_BACK, paused=paused, offered=offered or None
    )


def _lost(order: Standing, *, paused: bool | None, offered: int) -> Decision:
    """Row 5: the box does not have the order, or not any more."""
    return Decision(
        state=OrderState.NOT_TAKEN if order.failed else OrderState.NOT_READ_BACK,
        paused=paused,
        offered=offered or None,
        write=True,
        ignored=order.failed,
    )


def _is_limit(code: int) -> bool:
    return _LOWEST <= code <= _HIGHEST


class Writes:
    """When an order has been written, and when it may be written again."""

    def __init__(self) -> None:
        """Nothing has been written."""
        self.code: int | None = None
        """Icmax written last, 0.1 %."""
        self.last = -inf
        """Loop time of the last write, s."""
        self.acknowledged: float | None = None
        """Loop time of the last acknowledged write; ``None``: none since connecting."""
        self._first = -inf
        self._count = 0
        self._unanswered = 0

    def due(self, code: int) -> float:
        """Return the loop time from which a code may be written, s."""
        if code != self.code or not self._count:
            return -inf
        if 0 < self._unanswered <= FREE_REPEATS:
            return -inf
        pause = WRITE_PAUSES[min(self._count, len(WRITE_PAUSES)) - 1]
        return self.last + pause

    def restart(self, now: float) -> None:
        """Begin anew, on the user's word: the next write waits no longer than 3 s."""
        if now - self.last >= WRITE_PAUSES[0]:
            self._count = 0

    def wrote(self, code: int, now: float) -> None:
        """Note a write."""
        if code != self.code:
            self.acknowledged = None
        if not self.is_repeat(code, now):
            self._first = now
            self._count = 0
        self.code = code
        self.last = now
        self._count += 1

    def unanswered(self) -> None:
        """Note that no reply came to the last write: it may be repeated at once."""
        self._unanswered += 1

    def acknowledge(self, now: float) -> None:
        """Note the reply to the last write."""
        self.acknowledged = now
        self._unanswered = 0

    def is_repeat(self, code: int, now: float) -> bool:
        """Return whether a write of this code would repeat a recent one."""
        recent = now - self.last <= 2 * WRITE_PAUSES[-1]
        return code == self.code and recent and self._count > 0

    def settled(self, code: int, now: float) -> bool:
        """Return whether no other code written may still take effect."""
        return code == self.code or now - self.last >= FAILED_AFTER

    def forget(self) -> None:
        """Drop the acknowledgement: the box may have lost the order since."""
        self.acknowledged = None

    def failed(self, code: int, now: float) -> bool:
        """Return whether three writes of a code should have been followed by now."""
        return (
            code == self.code
            and self._count >= _FAILED_WRITES
            and now - self._first >= FAILED_AFTER
        )
