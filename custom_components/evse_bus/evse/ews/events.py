"""What happens at an EWS-Box, as it happens: keys, cards, charges.

A reading says how things are; these say that something was done.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
import logging

from .wire.info import KeyEvent
from .wire.status import ChargeResult, PortStatus

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
    optimised: bool
    """They want an optimised charge."""
    group: int | None = field(default=None, repr=False)
    """Of the card that is logged in at the port; ``None``: no card is."""
    number: int | None = field(default=None, repr=False)
    """Within its group."""


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
    energy: int
    """Wh"""
    duration: int
    """s, as the box counts it."""


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


def start_requested(port: int, seen: PortStatus) -> StartRequested:
    """Return that a start is asked for, by whoever is logged in there."""
    card = seen.card
    return StartRequested(
        port=port,
        optimised=seen.optimised,
        group=None if card is None else card.group,
        number=None if card is None else card.number,
    )


def charge_ended(
    port: int, running: PortStatus | None, seen: PortStatus
) -> ChargeEnded:
    """Return that a charge has ended, by how the port was while it ran, and is now.

    The manual does not say when the box takes a charge over as its last one, nor when
    the counters of the charge under way begin anew (docs/ews-protocol.md).
    """
    time, energy = seen.last_time, seen.last_energy
    if running is not None and (time, energy) == (
        running.last_time,
        running.last_energy,
    ):
        # Not taken over (yet), or one as long as the one before.
        anew = seen.session_time < running.session_time
        told = running if anew or seen.session_energy < running.session_energy else seen
        time, energy = told.session_time, told.session_energy
    return ChargeEnded(port=port, result=seen.result, energy=energy, duration=time)


def port_of(event: Event) -> int | None:
    """Return the port at which something happened; ``None``: at the box."""
    return None if isinstance(event, CardPresented) else event.port
