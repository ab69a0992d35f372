"""Roles above single chargers: a group that shares one box, the master of a bus.

A load-balancing master must broadcast every few seconds, or its slaves stop. Its turn
belongs to the bus, not to one charger; it has a hard deadline of its own, and the
master may silence the whole bus.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping

from .charger import Charger
from .errors import NotAvailableError
from .exchange import Turn
from .framing import Frame
from .listeners import Observable
from .memory import LineMemory
from .model import Circuit, Fault
from .schedule import Kind, Slot
from .scheduler import Scheduler
from .statistics import ChargerStatistics


class ChargerGroup:
    """The owner of the state that all chargers of one bus have in common."""

    bus: Scheduler[Charger] | None = None
    """The bus; set by it."""

    def resume(self, memory: LineMemory) -> None:
        """Go on with what an earlier bus or a search has learnt on this line."""

    def added(self, charger: Charger) -> None:
        """Take in a charger that was put on the bus."""

    def removed(self, charger: Charger) -> None:
        """Let go of a charger that was taken off the bus."""


class BusMaster(ChargerGroup, Observable, ABC):
    """The master of a bus, with a recurring turn of its own."""

    def __init__(self) -> None:
        """Nothing is sent before the bus starts."""
        super().__init__()
        self.slot = Slot(kind=Kind.PAUSE)
        self.statistics = ChargerStatistics()
        self.noticed: frozenset[Fault] = frozenset()
        """Faults of the whole bus."""

    @property
    @abstractmethod
    def period(self) -> float:
        """Return the time within which its turn must come again, s."""

    @property
    @abstractmethod
    def silent(self) -> bool:
        """Return whether nothing may be sent on this bus outside the master's turn."""

    @property
    @abstractmethod
    def refusal(self) -> NotAvailableError | None:
        """Return why no command is accepted now; ``None``: commands are accepted."""

    @property
    def details(self) -> Mapping[str, object]:
        """Return further values of its state, for diagnostics only."""
        return {}

    @abstractmethod
    def on_line_open(self, now: float) -> None:
        """Begin anew: the line was opened at this loop time, s."""

    @abstractmethod
    async def turn(self, turn: Turn) -> None:
        """Have the recurring turn, and set in `slot` when it is due again.

        Raises EvseError.
        """

    @abstractmethod
    def failed(self, now: float) -> None:
        """Set in `slot` when to try again: the turn raised."""

    def on_unsolicited(self, frame: Frame) -> bool:  # noqa: ARG002
        """Look at an unsolicited frame; return whether it was for the master."""
        return False

    async def change_circuit(self, circuit: Circuit) -> None:
        """Keep to this circuit limit from now on; return when it has been sent.

        Raises RefusedOrderError for values out of range.
        """

    def notice(self, fault: Fault, *, present: bool) -> None:
        """Set or clear a fault of the whole bus; a change calls the listeners."""
        if present != (fault in self.noticed):
            self.noticed = self.noticed ^ {fault}
            self.updated()
