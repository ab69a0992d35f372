"""A box and its load-balancing master, as they know each other."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Protocol

from ..exchange import Request, Turn
from ..safety import Setpoint
from .dialects import Dialect, Status
from .sharing import Claim, Contactor, Draw


class Balancer(Protocol):
    """A master, as its slaves know it."""

    @property
    def now(self) -> float:
        """Return the loop time, s."""

    def draw(self, unit: int) -> Draw:
        """Return the knowledge of the current that one unit draws."""

    def shares(self) -> Mapping[int, int]:
        """Return the share of each slave once all have followed, 0.1 A."""

    def room(self, unit: int) -> float:
        """Return the current that the others leave for a unit now, 0.1 A."""

    def waits_for_unread(self, unit: int) -> bool:
        """Return whether it may not begin before another was read, however long."""

    def grant(self, unit: int) -> int:
        """Return the current that may be granted to this unit now, 0.1 A; 0: none."""

    def above_share(self, unit: int) -> Sequence[Member]:
        """Return the slaves that must go down before this one may begin."""

    def next_probe(self, now: float) -> float:
        """Return when one that has not replied is to be read again."""

    def on_dialect(self) -> None:
        """Look again at the dialects of all slaves: one was read."""

    def on_status(
        self, unit: int, value: int, contactor: Contactor, *, complete: bool
    ) -> None:
        """Note a status: the current read back, 0.1 A, and the contactor."""

    def on_complete(self, unit: int) -> None:
        """Note that the settings of a slave are known, too."""

    def on_missed(self, unit: int, *, gone: bool) -> None:
        """Note that a slave did not reply; ``gone``: several times in a row."""

    def update_shares(self) -> None:
        """Share anew; broadcast at once if that changes a value."""

    def broadcast_soon(self) -> None:
        """Broadcast as soon as the line is free."""

    async def send_broadcast(self, turn: Turn) -> None:
        """Broadcast in any turn; raises what `Turn.send` raises."""

    async def lower(self, turn: Turn, slaves: Sequence[Member]) -> None:
        """Broadcast lower values, then read them back: a conversation."""

    def unless_silent(self, request: Request) -> bytes:
        """Return the bytes of a request that reads; called right before it is sent.

        Raises NotAvailableError where nothing may be sent.
        """

    def unless_forbidden(self, request: Request) -> bytes:
        """Return the bytes of a request that writes; likewise."""


class Member(ABC):
    """A slave of the master."""

    available: bool
    share: float
    """Current that the last broadcast left for it, A."""
    status: Status | None
    """The last status; ``None``: its last reply is missing."""
    dialect: Dialect | None
    """As read since the last connect."""
    expected_dialect: Dialect | None
    """As read last, or else kept from earlier."""

    @property
    @abstractmethod
    def unit(self) -> int:
        """Return its address."""

    @property
    @abstractmethod
    def setpoint(self) -> Setpoint:
        """Return the set-point within its `share`."""

    @abstractmethod
    def setpoint_within(self, share: float) -> Setpoint:
        """Return the set-point within a share, A."""

    @property
    @abstractmethod
    def wanted(self) -> Setpoint:
        """Return the set-point with the whole circuit limit as its share."""

    @property
    @abstractmethod
    def may_begin(self) -> bool:
        """Return whether neither its orders nor its share forbid it to charge."""

    @property
    @abstractmethod
    def withheld(self) -> bool:
        """Return whether it must not charge because its share is too small."""

    @property
    @abstractmethod
    def has_no_access(self) -> bool:
        """Return whether its access was off in the last status."""

    @abstractmethod
    def join(self, master: Balancer | None) -> None:
        """Set its master."""

    # -- Its share ---------------------------------------------------------------

    @abstractmethod
    def has_reservation(self, now: float) -> bool:
        """Return whether a current is reserved for it that it does not draw yet."""

    @abstractmethod
    def reserve(self, until: float) -> None:
        """Reserve its share until then, a loop time, s; -inf: no longer."""

    @abstractmethod
    def begins(self, now: float) -> None:
        """Note that its request was granted."""

    @abstractmethod
    def claim(self, now: float, *, may_draw: bool) -> Claim:
        """Return its claim to a share."""

    @abstractmethod
    def on_share(self, share: int, now: float) -> None:
        """Follow a changed share, 0.1 A; 0: stop."""

    # -- Its turns ---------------------------------------------------------------

    @property
    @abstractmethod
    def worst_case(self) -> float | None:
        """Return the longest time that one exchange with it can take, s."""

    @property
    @abstractmethod
    def send_time(self) -> float | None:
        """Return the longest time it takes to send it an answer or a broadcast, s."""

    @abstractmethod
    def read_soon(self, now: float) -> None:
        """Read its status as soon as the bus is free."""

    @abstractmethod
    async def read_status_once(self, turn: Turn) -> None:
        """Read its status in one exchange."""

    @abstractmethod
    async def write_state(self, turn: Turn, request: Request) -> None:
        """Write its state and its error in one exchange; no reply is no error.

        Raises LineBusyError, and what ``request`` raises.
        """
