"""Events of an EWS-Box: keys, cards, the begin and the end of charges.

A reading is a state; an event is reported once, when it happens.
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
    """A card was presented to the reader, whether or not it may charge.

    Over Ethernet the box calls every card valid (PROTOCOLS.md, 4).
    """

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
    result: ChargeResult | None
    """Why it ended; ``None``: not reported, or a code that is not in the manual."""
    energy: int
    """Wh"""
    duration: int
    """s, as counted by the box."""


type Event = KeyEvent | CardPresented | StartRequested | ChargeStarted | ChargeEnded
type EventListener = Callable[[Event], None]


class Events:
    """Subscribers to the events of one box."""

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


def start_requested(port: int, status: PortStatus) -> StartRequested:
    """Return the event of a start request, with the card that is logged in."""
    card = status.card
    return StartRequested(
        port=port,
        optimised=status.optimised,
        group=None if card is None else card.group,
        number=None if card is None else card.number,
    )


def charge_ended(
    port: int, running: PortStatus | None, status: PortStatus
) -> ChargeEnded:
    """Return the event of the end of a charge.

    ``running``: the last status while it was under way, ``status``: the first one
    after it. The manual does not define when the box takes a charge over as its last
    one, nor when the counters of the session are reset (docs/ews-protocol.md).
    """
    time, energy = status.last_time, status.last_energy
    if running is not None and (time, energy) == (
        running.last_time,
        running.last_energy,
    ):
        # Not taken over (yet), or by chance equal to the charge before it.
        was_reset = (
            status.session_time < running.session_time
            or status.session_energy < running.session_energy
        )
        counted = running if was_reset else status
        time, energy = counted.session_time, counted.session_energy
    return ChargeEnded(port=port, result=status.result, energy=energy, duration=time)


def port_of(event: Event) -> int | None:
    """Return the number of the port of an event; ``None``: an event of the box."""
    return None if isinstance(event, CardPresented) else event.port
