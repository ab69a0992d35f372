"""What happens at an EWS-Box, as it happens: keys, cards, charges.

A reading says how things are; these say that something was done.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
import logging

from .info import KeyEvent
from .status import ChargeResult

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class CardPresented:
    """A card was held to the reader; that the box knows it is not said.

    Over Ethernet it calls every card valid (PROTOCOLS.md, 4).
    """

    group: int = field(repr=False)
    number: int = field(repr=False)
    """Within its group."""
    user: str = field(repr=False)
    tag: bytes = field(repr=False)
    readable: bool
    """The box could read what is on it; else only the tag means something."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StartRequested:
    """Somebody wants to charge, and waits for our permission."""

    port: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ChargeStarted:
    """A charge has begun; a pause of ours or of the car is none's end."""

    port: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ChargeEnded:
    """A charge has ended."""

    port: int
    result: ChargeResult | None
    """Why; ``None``: not told, or by a code that the manual does not know."""


type Event = KeyEvent | CardPresented | StartRequested | ChargeStarted | ChargeEnded
type Listener = Callable[[Event], None]


class Events:
    """Whoever wants to know."""

    def __init__(self) -> None:
        """Nobody yet."""
        self._listeners: list[Listener] = []

    def subscribe(self, listener: Listener) -> Callable[[], None]:
        """Call back for each event; return how to stop."""
        self._listeners.append(listener)
        return partial(self._listeners.remove, listener)

    def tell(self, event: Event) -> None:
        """Tell everybody; one that fails is logged and keeps nobody else waiting."""
        for listener in tuple(self._listeners):
            try:
                listener(event)
            except Exception:
                _LOGGER.exception("A listener failed")


def port_of(event: Event) -> int | None:
    """Return the port at which something happened; ``None``: at the box."""
    return None if isinstance(event, CardPresented) else event.port
