"""A bus, as those below it know it: who queues a command, a charger, a master."""

from collections.abc import Callable, Mapping
from typing import Protocol

from .exchange import Wire
from .jobs import Job, JobOwner
from .line import Line
from .model import OrderChange


class CommandQueue(Protocol):
    """A bus, as those who queue a command know it."""

    async def submit(self, job: Job) -> object:
        """Queue a command and return its result (see `Bus.submit`)."""

    def queue(self, job: Job) -> bool:
        """Queue a command without a caller (see `Bus.queue`)."""

    def supersede(self, owner: JobOwner, which: Callable[[OrderChange], bool]) -> None:
        """Drop waiting order changes that a newer command makes wrong."""

    def reschedule(self) -> None:
        """Choose the next turn anew: something has changed."""


class Scheduler[C](CommandQueue, Protocol):
    """A bus, as its chargers ``C`` and its master know it."""

    name: str
    line: Line
    wire: Wire

    @property
    def chargers(self) -> Mapping[str, C]:
        """Return all chargers of the bus, by key."""

    @property
    def now(self) -> float:
        """Return the loop time, s."""

    def worst_case(self, charger: C) -> float:
        """Return the longest time one turn of a charger can take, s."""

    def silence(self, why: str) -> None:
        """Fail all waiting commands; drop all readings."""
