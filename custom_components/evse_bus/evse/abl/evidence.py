"""What is known of one box: its registers, and the orders written to it.

0x002E and 0x000F together show what has become of an order (`decisions`). Nothing is
sent here: the reader keeps what it reads, and the writer notes what it writes.
"""

from math import inf
from typing import Final

from .decisions import (
    FRESH,
    Decision,
    Evidence,
    Standing,
    Writes,
    believed_paused,
    decide,
    is_charging,
)
from .duty import PAUSE, highest_current
from .registers import Icmax, Reading

ICMAX_PROBES: Final = 3
"""Unanswered reads of 0x000F, each after another reply, that prove its absence."""
ICMAX_ABSENT: Final = 600.0
"""Time after which that is tried again, s."""


class BoxEvidence:
    """The registers as read last, the writes, and what both prove."""

    def __init__(self) -> None:
        """Nothing is known before the first reply."""
        self.status: Reading | None = None
        """Contents of 0x002E, as read last."""
        self.status_at = 0.0
        """Loop time of that, s."""
        self.icmax: Icmax | None = None
        """Contents of 0x000F, read since the last write."""
        self.known_icmax: Icmax | None = None
        """The same, read at any time from this box."""
        self.reports_icmax: bool | None = None
        """It answers reads of 0x000F; ``None``: not known yet."""
        self.default: int | None = None
        """Idefault of this box, 0.1 %; ``None``: not reported."""
        self.confirmed: int | None = None
        """Duty cycle (0.1 %) of the last limit that was read back."""
        self.writes = Writes()
        self.raised = False
        """A limit was raised, and not written in the state the box was in."""
        self.missed = False
        """A reply was missed since the last limit was read back."""
        self.allowed_by_user = False
        """The user has allowed charging, and no reply was missed since."""
        self.icmax_misses = 0
        """Reads of 0x000F in a row that a box which has it did not answer."""
        self._icmax_at = -inf
        self._icmax_due = -inf
        self._icmax_silent = 0
        self._charging_since = inf
        self._state_written: int | None = None

    def invalidate(self) -> None:
        """Drop what was read: another box may answer next."""
        self.status = None
        self.icmax = self.known_icmax = None
        self.reports_icmax = None
        self.forget()

    def forget(self) -> None:
        """Drop what a power cut or another master may have changed unseen."""
        self.missed = True
        self.allowed_by_user = False
        self.writes.forget()
        self._icmax_silent = 0

    def replaced(self) -> None:
        """Drop what is true of one box alone: another one is in its place."""
        self.default = self.known_icmax = None

    # -- What was read -------------------------------------------------------------

    def keep_status(self, status: Reading, now: float) -> None:
        """Take a status that was read at a loop time, s."""
        if not is_charging(status.state):
            self._charging_since = inf
        elif self._charging_since == inf:
            self._charging_since = now
        self.status = status
        self.status_at = now

    def keep_icmax(self, icmax: Icmax, now: float) -> None:
        """Take contents of 0x000F that were read at a loop time, s."""
        self.icmax = self.known_icmax = icmax
        self.reports_icmax = True
        self._icmax_at = now
        self._icmax_silent = self.icmax_misses = 0
        if highest_current(icmax.default) is not None:
            self.default = icmax.default

    def is_icmax_due(self, now: float) -> bool:
        """Return whether 0x000F is to be read, which a box may not have."""
        if self.reports_icmax is False:
            if now < self._icmax_due:
                return False
            self.reports_icmax = None
            self._icmax_silent = 0
        return True

    def on_icmax_silent(self, now: float, *, refused: bool = False) -> None:
        """Take note of a read of 0x000F without a reply, after another reply.

        A box that has answered it before has missed this one; from any other, several
        prove that it has no such register, and so does a refusal.
        """
        if self.reports_icmax:
            self.icmax_misses += 1
            return
        self._icmax_silent = ICMAX_PROBES if refused else self._icmax_silent + 1
        if self._icmax_silent >= ICMAX_PROBES:
            self.reports_icmax = False
            self._icmax_due = now + ICMAX_ABSENT

    @property
    def highest(self) -> float | None:
        """Return the highest current that the box allows, A; ``None``: not reported."""
        return None if self.default is None else highest_current(self.default)

    @property
    def rated(self) -> float | None:
        """Return the rated current of the box, A; ``None``: not reported."""
        known = self.known_icmax
        return None if known is None else highest_current(known.rated)

    # -- What was written ----------------------------------------------------------

    def on_write(self, code: int, now: float) -> None:
        """Take note of a write of Icmax; what was read before it proves nothing."""
        self.writes.wrote(code, now)
        self.raised = False
        self.icmax = None

    def on_acknowledged(self, now: float) -> None:
        """Take note of the reply to that write."""
        self.writes.acknowledge(now)
        self._state_written = self._state

    # -- What both prove -----------------------------------------------------------

    @property
    def _state(self) -> int | None:
        return None if self.status is None else self.status.state

    def seen(self, now: float) -> Evidence | None:
        """Return what was read, with Icmax if it is fresh; ``None``: nothing yet."""
        status = self.status
        if status is None:
            return None
        known = [current for current in status.currents if current is not None]
        fresh = self.icmax is not None and now - self._icmax_at <= FRESH
        return Evidence(
            state=status.state,
            ic=status.duty,
            reports_icmax=self.reports_icmax,
            icmax=self.icmax.duty if self.icmax is not None and fresh else None,
            current=max(known, default=None),
            charging_for=max(0.0, now - self._charging_since),
        )

    def standing(self, code: int, now: float, *, charges: bool = False) -> Standing:
        """Return what has become of an order that comes to this Icmax (0.1 %).

        ``charges``: a car charges although the box is paused.
        """
        writes = self.writes
        acknowledged = writes.acknowledged if writes.code == code else None
        return Standing(
            code=code,
            acknowledged=None if acknowledged is None else now - acknowledged,
            state_changed=self._state_written != self._state,
            unsettled=not writes.settled(code, now),
            raised=self.raised,
            confirmed=self.confirmed is not None,
            missed=self.missed,
            allowed=self.allowed_by_user,
            failed=writes.failed(code, now),
            charges=charges,
        )

    def decide(self, order: Standing, now: float) -> Decision | None:
        """Return what is proved about an order; ``None``: nothing was read yet."""
        seen = self.seen(now)
        return None if seen is None else decide(seen, order)

    @property
    def paused(self) -> bool | None:
        """Return whether the box is paused, as far as its registers show."""
        seen = self.seen(self.status_at)
        return None if seen is None else believed_paused(seen)

    def is_open(self, now: float) -> bool:
        """Return whether what was read shows that no pause stands."""
        seen = self.seen(now)
        if seen is None:
            return False
        paused = believed_paused(seen)
        # In C no pause stands; else a pause that cannot be read may be another's.
        is_known = seen.charging or self.allowed_by_user
        return paused is False or (paused is None and is_known)

    def note_confirmed(self, code: int) -> None:
        """Take note that the registers show an order."""
        if code != PAUSE:
            self.confirmed = code
