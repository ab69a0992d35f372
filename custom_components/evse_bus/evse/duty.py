"""What a bus owes to all its chargers at once: a turn that comes again and again.

A load-balancing master must be heard every few seconds, or its slaves stop. That is
a duty of the bus, not of one charger: its turn has a hard deadline of its own, and it
may impose silence on everybody.
"""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

from .listeners import Observed
from .schedule import Kind, Slot
from .statistics import ChargerStatistics

if TYPE_CHECKING:
    from .bus import Bus
    from .exchange import Talk
    from .framing import Frame
    from .model import Fault, Supply


class Duty(Observed, ABC):
    """A recurring turn of the bus itself."""

    def __init__(self) -> None:
        """Nothing is said before the bus starts."""
        super().__init__()
        self.slot = Slot(kind=Kind.PAUSE)
        self.statistics = ChargerStatistics()
        self.bus: Bus | None = None
        self.noticed: frozenset[Fault] = frozenset()
        """Faults of the whole bus."""

    @property
    @abstractmethod
    def silent(self) -> bool:
        """Return whether nobody on this bus may speak, but for this duty's turn."""

    @property
    @abstractmethod
    def refusal(self) -> str | None:
        """Return why a command cannot be taken now; ``None``: it can."""

    @abstractmethod
    def on_line_open(self, now: float) -> None:
        """Begin anew: the line was opened at this loop time."""

    @abstractmethod
    async def turn(self, talk: Talk) -> None:
        """Do it, and say in `slot` when it is due again; raises EvseError."""

    @abstractmethod
    def failed(self, now: float) -> None:
        """Say in `slot` when to try again: the turn raised."""

    def heard(self, frame: Frame) -> bool:  # noqa: ARG002
        """Look at a frame that nobody asked for; return whether it was for us."""
        return False

    async def change_supply(self, supply: Supply) -> None:
        """Share this much among all chargers from now on; return when they heard.

        Raises RefusedOrderError for a supply that cannot be.
        """

    def notice(self, fault: Fault, *, present: bool) -> None:
        """Set or clear a fault of the whole bus, and tell."""
        before = self.noticed
        self.noticed = before | {fault} if present else before - {fault}
        if self.noticed != before:
            self.updated()
