"""The common part of all chargers: orders, presence, turns on the bus.

A protocol folder's charger derives from `Charger` and adds the conversations: what to
ask, what to check, what to repeat. The rules for orders live here, so that they hold
for every protocol alike:

- a lowering counts (and is stored) before it is sent, a raise only after the
  charger has confirmed it;
- permission and limit are independent of each other;
- an order that is not renewed within its lifetime becomes the fail-safe value;
- a ceiling that the house sets lowers what counts of them (`ceiling`).

A charger knows its bus as a `Scheduler`.
"""

from abc import ABC, abstractmethod
import asyncio
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
import logging
from math import inf
from typing import ClassVar, Final, Protocol, override

from .ceiling import (
    GOVERNED,
    PAUSED_BY_CEILING,
    RETRY,
    Ceiling,
    CeilingPause,
    Governance,
    lowered,
    released,
)
from .conversation import Conversation, FollowUp, nothing
from .errors import NotAvailableError, RefusedOrderError
from .events import EventListener, Events
from .exchange import Turn, Wire
from .framing import Frame, Timing
from .jobs import Job, merge_key
from .line import Line
from .listeners import Observable
from .memory import LineMemory, Renewals
from .model import (
    Capability,
    ChargerConfig,
    Command,
    FailSafe,
    Fault,
    Limits,
    OrderChange,
    Orders,
    OrderState,
    PauseReason,
    Persistence,
    Range,
    Setting,
    Status,
)
from .pause_watch import PauseWatch
from .readings import ChargerInfo, ChargerReading
from .safety import (
    Setpoint,
    cautious,
    check_change,
    clamp,
    expired,
    number,
    pause_reason,
)
from .schedule import Kind, Slot
from .statistics import ChargerStatistics
from .throttle import PresenceLog

_LOGGER = logging.getLogger(__name__)

PREVENTED: Final = 30.0
"""Time for which a line may prevent all polls of a charger before its reading is too
old, s."""


class Scheduler(Protocol):
    """A bus, as its chargers and its master know it."""

    name: str
    line: Line
    wire: Wire

    @property
    def chargers(self) -> Mapping[str, Charger]:
        """Return all chargers of the bus, by key."""

    @property
    def now(self) -> float:
        """Return the loop time, s."""

    async def submit(self, job: Job) -> object:
        """Queue a command and return its result (see `Bus.submit`)."""

    def queue(self, job: Job) -> bool:
        """Queue a command without a caller (see `Bus.queue`)."""

    def supersede(self, charger: Charger, which: Callable[[OrderChange], bool]) -> None:
        """Drop waiting order changes that a newer command makes wrong."""

    def worst_case(self, charger: Charger) -> float:
        """Return the longest time one turn of a charger can take, s."""

    def reschedule(self) -> None:
        """Choose the next turn anew: something has changed."""

    def silence(self, why: str) -> None:
        """Fail all waiting commands; drop all readings."""


class Charger[C: ChargerConfig = ChargerConfig](Observable, ABC):
    """One charger on a bus."""

    timing: ClassVar[Timing]
    orders_keep_alive: ClassVar[bool] = False
    """Applying orders meets the deadline of the regular exchange as well."""
    pauses_hurry: ClassVar[bool] = False
    """A pause does not wait for the end of the minimum interval."""
    bursts: ClassVar[bool] = False
    """Its conversations rest only where they must wait: many exchanges in one turn."""

    def __init__(self, config: C, orders: Orders) -> None:
        """Begin with the orders that stand; nothing is sent before the bus starts."""
        super().__init__()
        self._config = config
        self.orders = orders
        self._requested = orders
        self.reading: ChargerReading | None = None
        self.info: ChargerInfo | None = None
        self.statistics = ChargerStatistics()
        self.events = Events()
        self.last_fingerprint: tuple[object, ...] = ()
        """`fingerprint` at the last call of the listeners."""
        self.misses = 0
        """Requests left unanswered in a row."""
        self.available = False
        """It answers, and its reading is up to date."""
        self._presence = PresenceLog()
        self._prevented_since = inf
        """Loop time of the first poll since its last reply that the line prevented."""
        self._pause_watch = PauseWatch()
        self.noticed: frozenset[Fault] = frozenset()
        """Faults found by this library, beside those the charger reports."""
        self.other_serial: str | None = None
        """Serial number of the last wrong box in its place (`Fault.WRONG_CHARGER`)."""
        self.orders_expired = False
        """The orders were not renewed within their lifetime: the fail-safe counts."""
        self.commit: Callable[[Orders], Awaitable[None]] = _no_commit
        """Stores orders; awaited before a lowering is sent, after a raise."""
        self.accepts: Callable[[str], bool] = _accept
        """Return whether a box added without its serial number may have this one.

        Called before anything is written, where the protocol reads it first: the box
        may have another master.
        """
        self.slot = Slot(kind=Kind.PROBE)
        self._conversations = 0
        self.bus: Scheduler | None = None
        self._renewals = Renewals()
        """That of the line, once it is on a bus."""
        self.governance = Governance(orders)
        self._ceiling_job: Job | None = None
        self._clamped: tuple[tuple[Orders, Limits], Setpoint] | None = None
        self._reason: (
            tuple[tuple[Orders, Orders, Limits], PauseReason | None] | None
        ) = None

    # -- Configuration and state -------------------------------------------------

    @property
    def config(self) -> C:
        """Return how it is set up."""
        return self._config

    @property
    @abstractmethod
    def capabilities(self) -> frozenset[Capability]:
        """Return the known capabilities; more may become known later."""

    @property
    @abstractmethod
    def limits(self) -> Limits:
        """Return the limits that no order may exceed now."""

    @property
    def facts(self) -> Mapping[str, str]:
        """Return what was read of the box and is kept, by `ChargerConfig.facts`.

        Nothing of a box that was not accepted, or that is not known to be the right
        one.
        """
        serial = self.info.serial if self.info is not None else None
        if serial is None or Fault.WRONG_CHARGER in self.noticed:
            return {}
        return {"serial": serial}

    @property
    def valid_orders(self) -> Orders:
        """Return the orders that stand, their lifetime considered."""
        return expired(self.orders) if self.orders_expired else self.orders

    @property
    def effective_orders(self) -> Orders:
        """Return the orders that count now: the valid ones under the ceiling."""
        return self._under_ceiling(self.valid_orders)

    def _under_ceiling(self, orders: Orders) -> Orders:
        if self.governance.ceiling is None:
            return orders
        now = asyncio.get_running_loop().time()
        return lowered(orders, self.governance.amperes(now, self.limits.minimum))

    @property
    def setpoint(self) -> Setpoint:
        """Return the set-point that the orders come to now."""
        inputs = (self.effective_orders, self.limits)
        # Computed for every poll, and rarely different.
        if self._clamped is None or self._clamped[0] != inputs:
            self._clamped = (inputs, clamp(*inputs))
        return self._clamped[1]

    @property
    def waits_for_current(self) -> bool:
        """Return whether it is paused by us for lack of current.

        Its permission stands: the pause is taken back as soon as there is current.
        """
        return False

    @property
    def is_allowed(self) -> bool:
        """Return whether it may charge: by its own account, else by the orders.

        One that we have paused for lack of current stays allowed: it resumes without
        being allowed again.
        """
        allowed = self.reading.allowed if self.reading is not None else None
        if allowed is None or (allowed is False and self.waits_for_current):
            return self.orders.allowed is not False
        return allowed

    @property
    def pause_reason(self) -> PauseReason | None:
        """Return why no car can charge now; ``None``: nothing known prevents it.

        The orders come first; then the state, in which "allow" starts nothing.
        """
        allowed = self.reading.allowed if self.reading is not None else None
        if allowed is False and not self.waits_for_current:
            # Behind a disabled outlet nothing is allowed, whatever was ordered.
            if self.orders.allowed is False:
                return PauseReason.NOT_ALLOWED
            if self.hindrance is PauseReason.OUTLET_DISABLED:
                return PauseReason.OUTLET_DISABLED
            if self.governance.unproved is not None:
                return PauseReason.WAITS_FOR_USER
            return PauseReason.NOT_ALLOWED
        inputs = (self.valid_orders, self.effective_orders, self.limits)
        if self._reason is None or self._reason[0] != inputs:
            self._reason = (inputs, _reason_of(*inputs))
        waits = self.governance.unproved is not None and self.may_be_paused
        return (
            self._reason[1]
            or self.hindrance
            or (PauseReason.WAITS_FOR_USER if waits else None)
        )

    @property
    def hindrance(self) -> PauseReason | None:
        """Return what in its state keeps a car from charging, whatever is ordered."""
        reading = self.reading
        if reading is None:
            return None
        if reading.outlet_enabled is False:
            return PauseReason.OUTLET_DISABLED
        statuses = {one.status for one in reading.connectors.values()}
        if statuses == {Status.FAULTED}:
            return PauseReason.FAULTED
        if statuses == {Status.OUT_OF_SERVICE}:
            return PauseReason.OUT_OF_SERVICE
        return None

    @property
    def order_state(self) -> OrderState | None:
        """Return what its registers prove about the order that stands.

        ``None``: not known, or its protocol cannot read it back.
        """
        return None

    @property
    def fail_safe(self) -> FailSafe | None:
        """Return what it does when no message comes; ``None``: not known yet."""
        return FailSafe.NOTHING

    @property
    def shares_address(self) -> bool:
        """Return whether other chargers on its bus obey requests to its address."""
        return False

    @property
    def fingerprint(self) -> tuple[object, ...]:
        """Return all state that listeners depend on; compared to find a change."""
        return (
            self.reading,
            self.available,
            self.noticed,
            self.info,
            self.waits_for_current,
            self.pause_reason,
            self.order_state,
            None if self.governance.ceiling is None else self.setpoint,
        )

    @property
    def faults(self) -> frozenset[Fault]:
        """Return the faults it reports and those found by this library."""
        reported = self.reading.faults if self.reading else frozenset[Fault]()
        return reported | self.noticed

    # -- Conversations -----------------------------------------------------------

    @abstractmethod
    async def poll(self, turn: Turn) -> FollowUp | None:
        """Have the regular exchange; return a conversation that it leads to.

        May rest, as any conversation: the charger has answered when it ends, and has
        missed a reply when it fails in any turn.
        """

    @abstractmethod
    async def apply(self, turn: Turn, orders: Orders, change: OrderChange) -> None:
        """Make the charger follow these orders, through `clamp`; return when sure.

        A conversation. The orders are `order_to_send` of the change, which may differ
        in a later turn. ``change`` has led from the orders before to these: only where
        it has ``allowed=True`` did the user switch charging on just now; a box that is
        paused stays so after any other change.

        Raises NotConfirmedError when the charger does not follow, and what
        `Turn.exchange` raises.
        """

    async def follow_ceiling(self, turn: Turn) -> None:
        """Make the charger follow the ceiling that counts now; return when sure.

        A conversation; raises as `apply`. A ceiling below the minimum pauses it; a
        higher one ends no pause but one of ours (see `ceiling`).
        """
        await self.apply(turn, self.effective_orders, OrderChange())

    @property
    @abstractmethod
    def longest_request(self) -> int:
        """Return the length of its longest request, bytes."""

    @property
    def exchanges_per_turn(self) -> int:
        """Return the number of exchanges that one turn may have at most."""
        return 1

    @property
    def keep_alive(self) -> float | None:
        """Return the time within which it must be asked again, s; ``None``: no limit.

        Otherwise it does what its fail-safe is.
        """
        return None

    def on_unsolicited(self, frame: Frame) -> FollowUp | None:  # noqa: ARG002
        """Return an urgent conversation for an unsolicited frame.

        ``None``: the frame is not from this charger.
        """
        return None

    async def on_shutdown(self, *, removed: bool = False) -> None:
        """Send the shutdown command, if there is one; orders stay as they are.

        ``removed``: only this charger is taken off for good; the bus goes on. Raises
        what `run` raises.
        """

    def resume(self, memory: LineMemory) -> None:
        """Go on with what an earlier bus or a search has learnt on this line.

        Called when it is put on a bus, before it is polled.
        """
        self._renewals = memory.of(Renewals)

    @abstractmethod
    def on_line_open(self) -> None:
        """Drop all state that must be checked anew after each (re)connect."""

    def on_line_reopened(self) -> None:
        """Do the same where the line was closed and opened again at once.

        Some adapters close an idle connection all the time.
        """
        self.on_line_open()

    def plan(self, now: float) -> None:
        """Set in `slot` when the next regular exchange may and must be."""
        self.slot.ready = self.slot.due = now + self.config.poll_interval

    def reconfigure(self, config: ChargerConfig) -> None:
        """Follow a changed configuration at once: a lower limit waits for no poll.

        Identity and address must be the same as before. Raises TypeError for the
        configuration of another protocol.
        """
        own = type(self._config)
        if not isinstance(config, own):
            message = f"{self.config.name} needs a {own.__name__}"
            raise TypeError(message)
        self._config = config
        now = asyncio.get_running_loop().time()
        soon = now + self.minimum_pause(now)
        self.slot.ready = self.slot.due = min(self.slot.ready, soon)
        if self.bus is not None:
            self.bus.reschedule()

    def move(self, address: int) -> None:
        """Follow a charger to another address on the bus."""
        self._config = replace(self._config, address=address)
        self.updated()

    @property
    def busy(self) -> bool:
        """Return whether a conversation is under way: then polls only read."""
        return self._conversations > 0

    @contextmanager
    def conversing(self) -> Iterator[None]:
        """Count a conversation as under way until it ends or is closed."""
        self._conversations += 1
        try:
            yield
        finally:
            self._conversations -= 1

    # -- Presence ----------------------------------------------------------------

    def on_reply(self, now: float) -> None:
        """Take note of a good reply; the charger is available."""
        self.misses = 0
        self._prevented_since = inf
        self.slot.kind = Kind.POLL
        self.slot.served = now
        if not self.available:
            self.available = True
            self._presence.back(self.config.name)

    def on_missed(self, now: float, why: str) -> None:
        """Take note of an unanswered request; after some in a row: unavailable.

        ``why``: the error, for the log.
        """
        self.misses += 1
        self.slot.kind = Kind.PROBE
        self.slot.start_by = inf
        pauses = self.timing.retry_pauses
        if self.misses < self.timing.misses:
            pause = pauses[min(self.misses, len(pauses)) - 1]
        else:
            doubled = 2 ** min(self.misses - self.timing.misses, 16)
            pause = min(self.timing.backoff * doubled, self.timing.backoff_limit)
            self.set_unavailable(why)
        self.slot.ready = self.slot.due = now + max(pause, self.minimum_pause(now))

    def on_prevented(self, now: float, why: str) -> None:
        """Take note of a poll that the line has prevented: that is no missed reply.

        Where it goes on, the reading is dropped all the same. ``why``: for the log.
        """
        self._prevented_since = min(self._prevented_since, now)
        if self.available and now - self._prevented_since >= PREVENTED:
            self.set_unavailable(why)

    def is_wrong(self, found: str | None, expected: str | None) -> bool:
        """Return whether a serial number is that of another box than this one."""
        if expected is not None:
            return found != expected
        return found is not None and not self.accepts(found)

    def on_wrong_charger(self, serial: str | None) -> None:
        """Take note of the serial number of the box that answers in its place."""
        if serial != self.other_serial:
            self.other_serial = serial
            self.updated()

    def minimum_pause(self, now: float) -> float:  # noqa: ARG002
        """Return the time for which nothing may be sent to it from now on, s."""
        return 0.0

    def set_unavailable(self, why: str) -> None:
        """Drop the reading: a stale value would mislead.

        ``why``: for the log.
        """
        now = asyncio.get_running_loop().time()
        self._presence.gone(self.config.name, why, now)
        was = self.available
        self.available = False
        self.reading = None
        self.on_line_open()
        if was:
            self.updated()

    # -- Orders ------------------------------------------------------------------

    async def change_orders(self, change: OrderChange) -> None:
        """Change orders; return when the charger has confirmed the orders that stand.

        Raises RefusedOrderError for an unusable value, SupersededError when a newer
        command came first, NotAvailableError, NotConfirmedError, ExchangeError or
        LineError when the charger does not follow. A lowering stands all the same,
        and is sent as soon as the charger answers.
        """
        checked = check_change(change, self.limits)
        loop = asyncio.get_running_loop()
        if checked.is_about_now:
            self._renewals.at[self.config.key] = loop.time()
            self.orders_expired = False
        if checked.allowed is not None:
            self.governance.allowed_or_stopped()
        self._requested = checked.apply(self._requested)
        lowered = cautious(self.orders, checked.apply(self.orders))
        if lowered != self.orders:
            self.orders = lowered
            self.updated()
            await self._store(lowered)
        bus = self._bus()
        pause = checked.allowed is False
        if pause:
            bus.supersede(self, lambda waiting: waiting.allowed is True)
        job = Job(
            owner=self,
            kind=Kind.PAUSE if pause else Kind.COMMAND,
            due=loop.time(),
            worst_case=bus.worst_case(self),
            meets=self.slot if self.orders_keep_alive else None,
            conversation=nothing,
            persistence=Persistence.STANDING,
            merge_key=merge_key(checked),
            change=checked,
        )
        # Its change may be another one by its turn: waiting changes are merged.
        job.conversation = partial(self._apply_change, job)
        await bus.submit(job)

    async def _apply_change(self, job: Job, turn: Turn) -> None:
        """Apply the change of a job; let it stand once it is confirmed."""
        change = job.change or OrderChange()
        await self.apply(turn, self.order_to_send(change), change)
        confirmed = self.confirmed_target(change)
        changed = confirmed != self.orders
        self.orders = confirmed
        self.updated()
        if changed:
            await self._store(confirmed)

    async def remember(self, name: str, value: str | None) -> None:
        """Store a note of the protocol with the orders; ``None`` deletes it."""
        if self.orders.remembered.get(name) == value:
            return
        notes = {**self.orders.remembered, name: value}
        kept = {key: note for key, note in notes.items() if note is not None}
        self.orders = replace(self.orders, remembered=kept)
        await self._store(self.orders)

    async def _store(self, orders: Orders) -> None:
        try:
            await self.commit(orders)
        except Exception:
            # A full disk must not keep a pause from the wire.
            _LOGGER.exception("%s: orders were not stored", self.config.name)

    def confirmed_target(self, change: OrderChange) -> Orders:
        """Return the orders that stand once a change under way is confirmed.

        Other changes may have been confirmed meanwhile. A newer lowering stands from
        the moment of its request, whether or not it has been sent.
        """
        return cautious(change.apply(self.orders), self._requested)

    def order_to_send(self, change: OrderChange) -> Orders:
        """Return the orders to send for a change: its target, unless expired.

        A change of the fail-safe alone renews nothing.
        """
        target = self.confirmed_target(change)
        return self._under_ceiling(expired(target) if self.orders_expired else target)

    def expire_orders(self, now: float) -> bool:
        """Expire orders whose lifetime is over; return whether they just expired."""
        lifetime = self.config.order_lifetime
        if lifetime is None or self.orders_expired:
            return False
        # Counted from the first turn, so that automations can renew after a restart.
        renewed = self._renewals.at.setdefault(self.config.key, now)
        if now - renewed < lifetime:
            return False
        self.orders_expired = True
        _LOGGER.warning(
            "%s: no automation has renewed its orders for %g s; "
            "the fail-safe current counts until one does",
            self.config.name,
            lifetime,
        )
        self.updated()
        return True

    # -- The ceiling ---------------------------------------------------------------

    @property
    def ceiling(self) -> Ceiling | None:
        """Return the ceiling set last; ``None``: it is not governed."""
        return self.governance.ceiling

    async def govern(self, safe: float) -> None:
        """Put it under a ceiling from now on, also after a restart.

        Until one is set (`set_ceiling`), and whenever none is any more, it gets no more
        than the safe value, A. Raises RefusedOrderError for an unusable number.
        """
        checked = number(safe, "safe value")
        governance, before = self.governance, self._permitted
        now = asyncio.get_running_loop().time()
        if governance.ceiling is None:
            governance.ceiling = Ceiling.first(checked, paused=False)
        else:
            governance.ceiling = governance.ceiling.with_safe(checked, now)
        self._on_ceiling(before)
        await self.remember(GOVERNED, f"{checked:g}")

    def set_ceiling(self, amperes: float, *, guard: float | None = None) -> None:
        """Set the ceiling, A, or renew it; it is sent like a limit.

        Does not wait: one charger that is slow or silent must not hold up the others of
        the house. `setpoint` follows at once, the reading when the charger does.
        ``guard``: what the main fuse permits, where the ceiling is lower for another
        reason. Raises RefusedOrderError for an unusable number, or while the charger is
        not governed.
        """
        governance, before = self.governance, self._permitted
        if governance.ceiling is None:
            message = f"{self.config.name} is not governed"
            raise RefusedOrderError(message)
        now = asyncio.get_running_loop().time()
        governance.ceiling = governance.ceiling.renew(amperes, guard, now)
        governance.expired = False
        self._on_ceiling(before)

    def give_up_ceiling(self) -> None:
        """Let the ceiling expire now: the house is reloaded, disabled or has failed."""
        governance, before = self.governance, self._permitted
        if governance.ceiling is not None:
            now = asyncio.get_running_loop().time()
            governance.ceiling = governance.ceiling.give_up(now)
            governance.expired = True
            self._on_ceiling(before)

    async def release(self) -> None:
        """End that it is governed: the house is removed.

        Its orders are lowered to the safe value, and stored; where a ceiling pauses it,
        it stays stopped. Raising them is the user's word.
        """
        governance = self.governance
        if governance.ceiling is None:
            return
        now = asyncio.get_running_loop().time()
        least = self.limits.minimum
        stop = governance.amperes(now, least) < least or governance.unproved is not None
        safe = governance.ceiling.safe
        self._requested = released(self._requested, safe, stop=stop)
        self.orders = released(self.orders, safe, stop=stop)
        notes = dict(self.orders.remembered)
        for name in (GOVERNED, PAUSED_BY_CEILING):
            notes.pop(name, None)
        self.orders = replace(self.orders, remembered=notes)
        await self._store(self.orders)
        governance.ceiling = governance.unproved = None
        governance.allowed_or_stopped()
        self._send_ceiling(lowers=True)
        self.updated()

    def expire_ceiling(self, now: float) -> float:
        """Lower a ceiling that was not renewed; return when it will have to be."""
        governance = self.governance
        if governance.ceiling is None or governance.expired:
            return inf
        if now < governance.ceiling.expires_at:
            return governance.ceiling.expires_at
        governance.expired = True
        _LOGGER.warning(
            "%s: the house has set no ceiling in time; no more than %g A until it does",
            self.config.name,
            governance.ceiling.amperes(now),
        )
        governance.pending = True
        self._send_ceiling(lowers=True)
        self.updated()
        return inf

    @property
    def _permitted(self) -> Setpoint:
        """Return the set-point of orders and ceiling, without any share of it."""
        return clamp(self.effective_orders, self.limits)

    def _on_ceiling(self, before: Setpoint) -> None:
        """Send a ceiling that changes what counts, or that was not followed yet."""
        governance, wanted = self.governance, self._permitted
        changed = wanted.currents != before.currents
        lowers = all(
            new <= old
            for new, old in zip(wanted.currents, before.currents, strict=True)
        )
        now = asyncio.get_running_loop().time()
        if changed or (governance.pending and now >= governance.retry_at):
            governance.pending = True
            self._send_ceiling(lowers=lowers)
        if changed:
            self.updated()

    def _send_ceiling(self, *, lowers: bool) -> None:
        """Have the ceiling that counts sent; several that wait are one command."""
        if self.bus is None:
            return
        kind = Kind.PAUSE if self._permitted.paused else Kind.COMMAND
        waiting = self._ceiling_job
        if waiting is not None and waiting.waits:
            waiting.kind = kind
            waiting.raises = not lowers
            self.bus.reschedule()
            return
        job = Job(
            owner=self,
            kind=kind,
            due=asyncio.get_running_loop().time(),
            worst_case=self.bus.worst_case(self),
            meets=self.slot if self.orders_keep_alive else None,
            conversation=self._follow_ceiling,
            persistence=Persistence.STANDING,
            change=OrderChange(),
            raises=not lowers,
        )
        if self.bus.queue(job):
            self._ceiling_job = job

    async def _follow_ceiling(self, turn: Turn) -> None:
        governance = self.governance
        governance.retry_at = turn.now + RETRY
        wanted = self._permitted
        await self.follow_ceiling(turn)
        if self._permitted == wanted:
            governance.pending = False
        self.updated()

    # -- Its pause -----------------------------------------------------------------

    @property
    def holds_ceiling_pause(self) -> bool:
        """Return whether it is paused by us for lack of current."""
        return self.waits_for_current

    @property
    def may_be_paused(self) -> bool:
        """Return whether a pause may stand at the box, whoever has sent it."""
        return self.reading is not None and self.reading.allowed is not True

    @property
    def visit(self) -> str | None:
        """Return what proves, after a restart, that the same car is still there."""
        return None

    def continues(self, pause: CeilingPause) -> bool:  # noqa: ARG002
        """Return whether box and visit are provably those of a pause noted before."""
        return False

    @property
    def serial_read(self) -> str | None:
        """Return the serial number that was read from the box."""
        return self.info.serial if self.info is not None else None

    async def keep_ceiling_pause(self) -> None:
        """Note with its orders that a ceiling has paused it, or no more."""
        governance = self.governance
        if governance.ceiling is None or not self.available or self.reading is None:
            return
        if governance.unproved is not None:
            if self.may_be_paused and not self.holds_ceiling_pause:
                return
            # There is no pause any more, or it has been proved to be ours.
            governance.unproved = None
        noted = self.orders.remembered.get(PAUSED_BY_CEILING)
        note = noted if self.holds_ceiling_pause else None
        if self.holds_ceiling_pause and self.is_paused_by_ceiling:
            known = None if noted is None else CeilingPause.from_note(noted)
            if known is None or (self.visit is not None and not self.continues(known)):
                note = CeilingPause(self.serial_read, self.visit).note
        await self.remember(PAUSED_BY_CEILING, note)

    @property
    def is_paused_by_ceiling(self) -> bool:
        """Return whether the ceiling alone allows no current."""
        valid = clamp(self.valid_orders, self.limits)
        return not valid.paused and self._permitted.paused

    # -- Commands ----------------------------------------------------------------

    async def command(
        self,
        command: Command,
        value: bool | int | str | None = None,  # noqa: FBT001
    ) -> None:
        """Carry out a command; return when it is confirmed.

        Raises NotAvailableError where the charger has no such command, and what
        `change_orders` raises.
        """
        message = f"{self.config.name} knows no command {command}: {value}"
        raise NotAvailableError(message)

    @property
    def begins_with(self) -> float | None:
        """Return the current that a car may be offered before its limit is in force, A.

        ``None``: none above its limit, or not known.
        """
        return None

    @property
    def settings(self) -> Mapping[Setting, Range]:
        """Return the settings in the charger's own memory, and their ranges."""
        return {}

    async def configure(
        self, setting: Setting, value: int, *, only_lower: bool = False
    ) -> None:
        """Write to the charger's own memory; return when it is read back.

        Such a memory wears out: this is for people, not for automations.
        ``only_lower``: a value that is read to be lower stays. Raises
        NotAvailableError where the charger has no such setting, RefusedOrderError
        for a value out of its range, NotConfirmedError, and what `run` raises.
        """
        del only_lower
        message = f"{self.config.name} has no setting {setting}: {value}"
        raise NotAvailableError(message)

    async def run[T](
        self,
        conversation: Conversation[T],
        *,
        persistence: Persistence = Persistence.ONCE,
        kind: Kind = Kind.COMMAND,
    ) -> T:
        """Hold a conversation with this charger; return its result.

        Raises what the conversation raises, NotConfirmedError (see `rest`),
        NotAvailableError and LineLostError.
        """
        bus = self._bus()
        job = Job(
            owner=self,
            kind=kind,
            due=asyncio.get_running_loop().time(),
            worst_case=bus.worst_case(self),
            conversation=conversation,
            persistence=persistence,
        )
        return await bus.submit(job)  # type: ignore[return-value] # the job's own

    def _bus(self) -> Scheduler:
        if self.bus is None:
            message = f"{self.config.name} is on no bus"
            raise NotAvailableError(message)
        return self.bus

    # -- Listeners ---------------------------------------------------------------

    @override
    def updated(self) -> None:
        """Call the listeners."""
        self.last_fingerprint = self.fingerprint
        super().updated()

    async def wait_available(self, patience: float = 60.0) -> ChargerReading:
        """Return the first reading, as soon as there is one.

        Raises NotAvailableError when the charger has not answered within
        ``patience`` seconds.
        """
        changed = asyncio.Event()
        stop = self.subscribe(changed.set)
        try:
            async with asyncio.timeout(patience):
                while self.reading is None or not self.available:
                    changed.clear()
                    await changed.wait()
                return self.reading
        except TimeoutError as error:
            message = f"{self.config.name} does not answer"
            raise NotAvailableError(message) from error
        finally:
            stop()

    def subscribe_events(self, listener: EventListener) -> Callable[[], None]:
        """Call back for each event; return a function that ends it."""
        return self.events.subscribe(listener)

    def notice(self, fault: Fault, *, present: bool) -> None:
        """Set or clear a fault found by this library; a change calls the listeners."""
        if present != (fault in self.noticed):
            self.noticed = self.noticed ^ {fault}
            self.updated()

    def watch_pause(self, now: float, *, shown: bool, patience: float | None) -> None:
        """Notice a car that charges against a pause (see `PauseWatch.charges`)."""
        against = self._pause_watch.charges(
            now, ordered=self.setpoint.paused, shown=shown, patience=patience
        )
        self.notice(Fault.CHARGES_ALTHOUGH_PAUSED, present=against)


def _reason_of(valid: Orders, effective: Orders, limits: Limits) -> PauseReason | None:
    """Return why orders let no car charge, by themselves or under the ceiling."""
    if (reason := pause_reason(valid, limits)) is not None:
        return reason
    return PauseReason.CEILING_TOO_LOW if pause_reason(effective, limits) else None


def _accept(_serial: str) -> bool:
    """Accept any box: the default for a script."""
    return True


async def _no_commit(_orders: Orders) -> None:
    """Store nothing: the default for a script without a store."""
