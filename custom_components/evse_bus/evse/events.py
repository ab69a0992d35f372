"""Events of a charger: keys, cards, the begin and the end of charges.

A reading is a state; an event is reported once, when it happens.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
import logging
from typing import Final

from .model import SessionResult

_LOGGER = logging.getLogger(__name__)

KEYS: Final = 4
"""Most keys of one port."""


@dataclass(frozen=True, slots=True)
class KeyEvent:
    """A key was pressed, or released after a time."""

    port: int
    """From 1."""
    key: int
    """1 to `KEYS`."""
    held: float | None
    """Time for which it was pressed, s; ``None``: it is pressed now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CardPresented:
    """A card was presented to the reader, whether or not it may charge."""

    group: int = field(repr=False)
    number: int = field(repr=False)
    """Within its group."""
    user: str = field(repr=False)
    tag: bytes = field(repr=False)
    readable: bool
    """The box could read the card; otherwise only the tag is valid."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StartRequested:
    """A start was requested at the box; it waits for permission."""

    port: int
    optimised: bool
    """An optimised charge was requested."""
    group: int | None = field(default=None, repr=False)
    """Of the card that is logged in at the port; ``None``: no card."""
    number: int | None = field(default=None, repr=False)
    """Within its group."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ChargeStarted:
    """A charge has begun. One that goes on after a pause has not."""

    port: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ChargeEnded:
    """A charge has ended."""

    port: int
    result: SessionResult | None
    """Why it ended; ``None``: not reported, or unknown."""
    energy: int
    """Wh"""
    duration: int
    """s, as counted by the box."""


type Event = KeyEvent | CardPresented | StartRequested | ChargeStarted | ChargeEnded
type EventListener = Callable[[Event], None]


class Events:
    """Subscribers to the events of one charger or box."""

    def __init__(self) -> None:
        """Start without subscribers."""
        self._listeners: list[EventListener] = []

    def subscribe(self, listener: EventListener) -> Callable[[], None]:
        """Call back for each event; return a function that ends it."""
        self._listeners.append(listener)
        return partial(self._listeners.remove, listener)

    def publish(self, event: Event) -> None:
        """Call the subscribers; an error in one is logged and stops no other."""
        for listener in tuple(self._listeners):
            try:
                listener(event)
            except Exception:
                _LOGGER.exception("A listener failed")


def port_of(event: Event) -> int | None:
    """Return the number of the port of an event; ``None``: an event of the box."""
    return None if isinstance(event, CardPresented) else event.port
