"""What every charger shares, whatever it speaks: orders, presence, its turn.

A protocol folder's charger derives from `Charger` and adds the conversation:
what to ask, what to check, what to repeat. The rules for orders live here, so
that they hold for every protocol alike:

- a lowering counts (and is stored) before it is sent, a raise only after the
  charger has confirmed it;
- permission and limit are independent of each other;
- an order that nobody renewed for its lifetime becomes the fail-safe value.
"""

from abc import ABC, abstractmethod
import asyncio
from collections.abc import Awaitable, Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
import logging
from math import inf
from typing import TYPE_CHECKING, ClassVar, override

from .errors import NotAvailableError
from .exchange import Talk
from .framing import Frame, Timing
from .jobs import Job, Later, Step, merge_key
from .listeners import Observed
from .model import (
    Capability,
    ChargerConfig,
    Command,
    Fault,
    Limits,
    OrderChange,
    Orders,
    Persistence,
    Range,
    Setting,
)
from .readings import ChargerInfo, ChargerReading
from .safety import Setpoint, cautious, check_change, clamp, expired
from .schedule import Kind, Slot
from .statistics import ChargerStatistics
from .turns import Conversation, in_turns

if TYPE_CHECKING:
    from .bus import Bus

_LOGGER = logging.getLogger(__name__)


class Charger(Observed, ABC):
    """One charger on a bus."""

    timing: ClassVar[Timing]
    orders_keep_alive: ClassVar[bool] = False
    """Imposing orders meets the deadline of the regular exchange as well."""
    pauses_hurry: ClassVar[bool] = False
    """A pause does not wait for the end of the minimum interval."""

    def __init__(self, config: ChargerConfig, orders: Orders) -> None:
        """Take the orders that stand; nothing is sent before the bus starts."""
        super().__init__()
        self.config = config
        self.orders = orders
        self._wish = orders
        self.reading: ChargerReading | None = None
        self.info: ChargerInfo | None = None
        self.statistics = ChargerStatistics()
        self.last_told: tuple[object, ...] = ()
        """What `told` was when the listeners were told last."""
        self.misses = 0
        """Requests left unanswered in a row."""
        self.available = False
        """It answers, and what it said is what we know."""
        self.noticed: frozenset[Fault] = frozenset()
        """Faults that we noticed, beside those it told."""
        self.orders_expired = False
        """Nobody renewed the orders for their lifetime: the fail-safe counts."""
        self.commit: Callable[[Orders], Awaitable[None]] = _no_commit
        """Stores orders; awaited before a lowering is sent, after a raise."""
        self.slot = Slot(kind=Kind.PROBE)
        self._conversations: set[object] = set()
        self.bus: Bus | None = None
        self._renewed: float | None = None
        self._clamped: tuple[tuple[Orders, Limits], Setpoint] | None = None

    # -- What it is and has ------------------------------------------------------

    @property
    @abstractmethod
    def capabilities(self) -> frozenset[Capability]:
        """Return what is known to be there; grows when more is learnt."""

    @property
    @abstractmethod
    def limits(self) -> Limits:
        """Return what no order may exceed now."""

    @property
    def effective_orders(self) -> Orders:
        """Return the orders that count now, lifetime considered."""
        return expired(self.orders) if self.orders_expired else self.orders

    @property
    def setpoint(self) -> Setpoint:
        """Return what may be sent now."""
        asked = (self.effective_orders, self.limits)
        # Asked for with every poll, and hardly ever another one.
        if self._clamped is None or self._clamped[0] != asked:
            self._clamped = (asked, clamp(*asked))
        return self._clamped[1]

    @property
    def waits_for_current(self) -> bool:
        """Return whether only a want of current has stopped it, by our own doing.

        Its permission stands: the charger says that it may not charge, and gets that
        taken back as soon as there is current.
        """
        return False

    @property
    def ends_in_silence(self) -> bool | None:
        """Return whether it ends a charge that nobody looks after, of its own accord.

        ``None``: not known (yet); only where it has a server that it may miss.
        """
        return None

    @property
    def shares_address(self) -> bool:
        """Return whether others on its bus hear what is said to it, by their nature."""
        return False

    @property
    def told(self) -> tuple[object, ...]:
        """Return all that listeners may care about, to see whether it changed."""
        return (
            self.reading,
            self.available,
            self.noticed,
            self.info,
            self.waits_for_current,
        )

    @property
    def faults(self) -> frozenset[Fault]:
        """Return the faults it told and those we noticed."""
        told = self.reading.faults if self.reading else frozenset[Fault]()
        return told | self.noticed

    # -- The conversation --------------------------------------------------------

    @abstractmethod
    async def poll(self, talk: Talk) -> Later[None] | None:
        """Have the regular exchange; may ask for a further turn."""

    @abstractmethod
    async def impose(self, talk: Talk, orders: Orders, change: OrderChange) -> None:
        """Make the charger follow these orders, through `clamp`; return when sure.

        They are what is `sought` by the change, which may be another one in a later turn.
        ``change`` is what made these orders of those before: only where it says
        ``allowed=True`` has the user switched charging on just now; a box that is
        paused stays so after any other change. May take further turns.

        Raises NotConfirmedError when the charger does not follow, and what
        `Talk.exchange` raises.
        """

    def turns(self, conversation: Conversation) -> Step[None]:
        """Return the first turn of a conversation with this charger."""
        return in_turns(conversation)

    @property
    @abstractmethod
    def longest_request(self) -> int:
        """Return the bytes of its longest request."""

    @property
    def exchanges_per_turn(self) -> int:
        """Return how many exchanges one turn may hold at most."""
        return 1

    def on_unsolicited(self, frame: Frame) -> Later[None] | None:  # noqa: ARG002
        """Return an urgent turn for a frame nobody asked for; ``None``: not mine."""
        return None

    async def farewell(self, *, for_good: bool = False) -> None:
        """Say what is to be said when everything stops; orders stay as they are.

        ``for_good``: only this charger is taken off, for ever; the bus goes on.

        Raises what `run` raises.
        """

    @abstractmethod
    def on_line_open(self) -> None:
        """Forget what must be checked anew after each (re)connect."""

    def plan(self, now: float) -> None:
        """Say in `slot` when the next regular exchange may and must be."""
        self.slot.ready = self.slot.due = now + self.config.poll_interval

    def set_up(self, config: ChargerConfig) -> None:
        """Follow a changed set-up at once: a lower limit waits for no poll.

        Who the charger is and how it is spoken to must be the same as before.
        """
        self.config = config
        now = asyncio.get_running_loop().time()
        soon = now + self.minimum_pause(now)
        self.slot.ready = self.slot.due = min(self.slot.ready, soon)
        if self.bus is not None:
            self.bus.look_again()

    @property
    def busy(self) -> bool:
        """Return whether a conversation is under way: then polls only read."""
        return bool(self._conversations)

    @contextmanager
    def conversing(self) -> Iterator[None]:
        """Note that a conversation is under way, until it ends or is cut short."""
        token = object()
        self._conversations.add(token)
        try:
            yield
        finally:
            self._conversations.discard(token)

    # -- What the bus tells ------------------------------------------------------

    def heard(self, now: float) -> None:
        """Note a good answer."""
        self.misses = 0
        self.slot.kind = Kind.POLL
        self.slot.served = now
        if not self.available:
            self.available = True
            _LOGGER.debug("%s answers", self.config.name)

    def missed(self, now: float) -> None:
        """Note an unanswered request; after some in a row the charger is gone."""
        self.misses += 1
        self.slot.kind = Kind.PROBE
        self.slot.start_by = inf
        pauses = self.timing.retry_pauses
        if self.misses < self.timing.misses:
            pause = pauses[min(self.misses, len(pauses)) - 1]
        else:
            doubled = 2 ** min(self.misses - self.timing.misses, 16)
            pause = min(self.timing.backoff * doubled, self.timing.backoff_limit)
            self.set_unavailable()
        self.slot.ready = self.slot.due = now + max(pause, self.minimum_pause(now))

    def minimum_pause(self, now: float) -> float:  # noqa: ARG002
        """Return how long the charger must be left alone from now, s."""
        return 0.0

    def set_unavailable(self) -> None:
        """Forget the reading: an old one is wrong, not a little out of date."""
        was = self.available
        self.available = False
        self.reading = None
        self.on_line_open()
        if was:
            self.updated()

    # -- Orders ------------------------------------------------------------------

    async def change_orders(self, change: OrderChange) -> None:
        """Change orders; return when the charger has confirmed what stands now.

        Raises RefusedOrderError for an unusable wish, SupersededError when a
        newer command came first, NotAvailableError, NotConfirmedError,
        ExchangeError or LineError when the charger does not follow. A lowering
        stands all the same, and is sent as soon as the charger can hear it.
        """
        checked = check_change(change, self.limits)
        loop = asyncio.get_running_loop()
        if checked.is_about_now:
            self._renewed = loop.time()
            self.orders_expired = False
        self._wish = checked.apply(self._wish)
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
            charger=self,
            kind=Kind.PAUSE if pause else Kind.COMMAND,
            due=loop.time(),
            worst_case=bus.worst_case(self),
            meets=self.slot if self.orders_keep_alive else None,
            step=_nothing,
            persistence=Persistence.STANDING,
            merge_key=merge_key(checked),
            change=checked,
        )
        job.step = self.turns(partial(self._impose_job, job))
        await bus.submit(job)

    async def _impose_job(self, job: Job, talk: Talk) -> None:
        """Impose an order change, and let it stand once it is confirmed."""
        change = job.change or OrderChange()
        await self.impose(talk, self.sought(change), change)
        stands = self.target(change)
        changed = stands != self.orders
        self.orders = stands
        self.updated()
        if changed:
            await self._store(stands)

    async def _store(self, orders: Orders) -> None:
        try:
            await self.commit(orders)
        except Exception:
            # A full disk must not keep a pause from the wire.
            _LOGGER.exception("%s: orders were not stored", self.config.name)

    def target(self, change: OrderChange) -> Orders:
        """Return the orders that a change on its way leads to, as of now.

        Others may have been confirmed since it set out. A newer lowering stands from
        the moment it was said, whatever becomes of the commands before it and of its
        own sending.
        """
        return cautious(change.apply(self.orders), self._wish)

    def sought(self, change: OrderChange) -> Orders:
        """Return the orders to be imposed for a change: its target, unless expired.

        Who sets only the fail-safe renews nothing.
        """
        target = self.target(change)
        return expired(target) if self.orders_expired else target

    def expire_orders(self, now: float) -> bool:
        """Note that the orders' lifetime is over; return whether it just ended."""
        lifetime = self.config.order_lifetime
        if lifetime is None or self.orders_expired:
            return False
        if self._renewed is None:
            # Counted from the first turn: a restart gives automations their time.
            self._renewed = now
        if now - self._renewed < lifetime:
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

    # -- Commands ----------------------------------------------------------------

    async def command(
        self,
        command: Command,
        value: bool | int | str | None = None,  # noqa: FBT001
    ) -> None:
        """Carry out a command; return when it is known to have worked.

        Raises NotAvailableError where the charger has no such command, and what
        `change_orders` raises.
        """
        message = f"{self.config.name} knows no command {command}: {value}"
        raise NotAvailableError(message)

    @property
    def settings(self) -> Mapping[Setting, Range]:
        """Return what can be set in the charger's own memory, and how far."""
        return {}

    async def configure(self, setting: Setting, value: int) -> None:
        """Set something in the charger's own memory; return when it is read back.

        Such a memory wears out: this is for people, not for automations. Raises
        NotAvailableError where the charger has no such setting, RefusedOrderError
        for a value out of its range, NotConfirmedError, and what `run` raises.
        """
        message = f"{self.config.name} has no setting {setting}: {value}"
        raise NotAvailableError(message)

    async def run[T](
        self,
        step: Step[T],
        *,
        persistence: Persistence = Persistence.ONCE,
        kind: Kind = Kind.COMMAND,
    ) -> T:
        """Have a conversation of one's own with this charger; return its result."""
        bus = self._bus()
        job = Job(
            charger=self,
            kind=kind,
            due=asyncio.get_running_loop().time(),
            worst_case=bus.worst_case(self),
            step=step,
            persistence=persistence,
        )
        return await bus.submit(job)  # type: ignore[return-value]

    def _bus(self) -> Bus:
        if self.bus is None:
            message = f"{self.config.name} is on no bus"
            raise NotAvailableError(message)
        return self.bus

    # -- Listeners ---------------------------------------------------------------

    @override
    def updated(self) -> None:
        """Tell the listeners."""
        self.last_told = self.told
        super().updated()

    async def wait_available(self, patience: float = 60.0) -> ChargerReading:
        """Return the first reading, as soon as there is one.

        Raises NotAvailableError when the charger has not answered within
        ``patience`` seconds.
        """
        heard = asyncio.Event()
        stop = self.subscribe(heard.set)
        try:
            async with asyncio.timeout(patience):
                while self.reading is None or not self.available:
                    heard.clear()
                    await heard.wait()
                return self.reading
        except TimeoutError as error:
            message = f"{self.config.name} does not answer"
            raise NotAvailableError(message) from error
        finally:
            stop()

    def notice(self, fault: Fault, *, present: bool) -> None:
        """Set or clear a fault that we noticed ourselves, and tell of a change."""
        if present != (fault in self.noticed):
            self.noticed = self.noticed ^ {fault}
            self.updated()


async def _no_commit(_orders: Orders) -> None:
    """Store nothing: the default for a script without a store."""


async def _nothing(_talk: Talk) -> None:
    """Do nothing: the place of a step that is set right after."""
