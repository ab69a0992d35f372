"""The common part of all chargers: presence, turns on the bus, what is asked of them.

A protocol folder's charger derives from `Charger` and adds the conversations: what to
ask, what to check, what to repeat. Its orders have the same rules for every protocol
(`standing_orders`), and so has the ceiling that the house may set (`governance`).

A charger knows its bus as a `Scheduler`.
"""

from abc import ABC, abstractmethod
import asyncio
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from math import inf
from typing import ClassVar, Final, override

from .ceiling import CeilingPause
from .conversation import Conversation, FollowUp
from .errors import NotAvailableError
from .events import EventListener, Events
from .exchange import Turn
from .framing import Frame, Timing
from .governance import Governance
from .jobs import Job
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
from .safety import Setpoint, check_change
from .schedule import Kind, Slot
from .scheduler import Scheduler
from .standing_orders import StandingOrders
from .statistics import ChargerStatistics
from .throttle import PresenceLog

PREVENTED: Final = 30.0
"""Time for which a line may prevent all polls of a charger before its reading is too
old, s."""


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
        self.accepts: Callable[[str], bool] = _accept
        """Return whether a box added without its serial number may have this one.

        Called before anything is written, where the protocol reads it first: the box
        may have another master.
        """
        self.slot = Slot(kind=Kind.PROBE)
        self._conversations = 0
        self.bus: Scheduler[Charger] | None = None
        self.standing_orders = StandingOrders(self, orders)
        self.governance = Governance(self, self.standing_orders)

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
    def setpoint(self) -> Setpoint:
        """Return the set-point that the orders come to now."""
        return self.governance.permitted

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
        waits = self.governance.unproved is not None and self.may_be_paused
        return (
            self.governance.pause_reason
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
        self.standing_orders.renewals = memory.of(Renewals)

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
        pause = self.timing.pause_after(self.misses)
        if self.misses >= self.timing.misses:
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

    # -- Orders and ceiling ------------------------------------------------------

    @property
    def orders(self) -> Orders:
        """Return the orders that stand."""
        return self.standing_orders.orders

    @property
    def orders_expired(self) -> bool:
        """Return whether the orders were not renewed: then the fail-safe counts."""
        return self.standing_orders.expired

    @property
    def valid_orders(self) -> Orders:
        """Return the orders that stand, their lifetime considered."""
        return self.standing_orders.valid

    @property
    def effective_orders(self) -> Orders:
        """Return the orders that count now: the valid ones under the ceiling."""
        return self.governance.effective_orders

    def order_to_send(self, change: OrderChange) -> Orders:
        """Return the orders to send for a change, lifetime and ceiling considered."""
        return self.governance.under_ceiling(self.standing_orders.valid_target(change))

    async def change_orders(self, change: OrderChange) -> None:
        """Change orders; return when the charger has confirmed the orders that stand.

        Raises RefusedOrderError for an unusable value, SupersededError when a newer
        command came first, NotAvailableError, NotConfirmedError, ExchangeError or
        LineError when the charger does not follow. A lowering stands all the same,
        and is sent as soon as the charger answers.
        """
        checked = check_change(change, self.limits)
        if checked.allowed is not None:
            self.governance.allowed_or_stopped()
        await self.standing_orders.change(checked)

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
        bus = self.require_bus()
        job = Job(
            owner=self,
            kind=kind,
            due=asyncio.get_running_loop().time(),
            worst_case=bus.worst_case(self),
            conversation=conversation,
            persistence=persistence,
        )
        return await bus.submit(job)  # type: ignore[return-value] # the job's own

    def order_job(
        self, conversation: Conversation[object], change: OrderChange, kind: Kind
    ) -> Job:
        """Return a command that sends orders; raises NotAvailableError on no bus."""
        return Job(
            owner=self,
            kind=kind,
            due=asyncio.get_running_loop().time(),
            worst_case=self.require_bus().worst_case(self),
            meets=self.slot if self.orders_keep_alive else None,
            conversation=conversation,
            persistence=Persistence.STANDING,
            change=change,
        )

    def require_bus(self) -> Scheduler[Charger]:
        """Return its bus; raises NotAvailableError while it is on none."""
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


def _accept(_serial: str) -> bool:
    """Accept any box: the default for a script."""
    return True
