"""Telling whoever wants to know, whatever they make of it."""

from collections.abc import Callable, Iterable
from functools import partial
import logging

_LOGGER = logging.getLogger(__name__)


def tell(listeners: Iterable[Callable[[], None]]) -> None:
    """Call each listener; one that fails is logged and keeps nobody else waiting.

    The bus tells from the one task that speaks with all chargers: somebody else's
    mistake must not end it.
    """
    for listener in tuple(listeners):
        try:
            listener()
        except Exception:
            _LOGGER.exception("A listener failed")


class Observed:
    """Somebody of whom others want to know when something has changed."""

    def __init__(self) -> None:
        """Nobody wants to know yet."""
        self._listeners: list[Callable[[], None]] = []

    def subscribe(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call back after each change of what is known; return how to stop."""
        self._listeners.append(listener)
        return partial(self._listeners.remove, listener)

    def updated(self) -> None:
        """Tell the listeners."""
        tell(self._listeners)
