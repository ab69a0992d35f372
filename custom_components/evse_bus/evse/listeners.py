"""Calling listeners after a change."""

from collections.abc import Callable, Iterable
from functools import partial
import logging

_LOGGER = logging.getLogger(__name__)


def notify(listeners: Iterable[Callable[[], None]]) -> None:
    """Call each listener; one that fails is logged, and the others are still called.

    The bus notifies from the one task that serves all chargers: an error in a listener
    must not end it.
    """
    for listener in tuple(listeners):
        try:
            listener()
        except Exception:
            _LOGGER.exception("A listener failed")


class Observable:
    """An object with listeners that are called after each change."""

    def __init__(self) -> None:
        """Start without listeners."""
        self._listeners: list[Callable[[], None]] = []

    def subscribe(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Add a listener; return a function that removes it."""
        self._listeners.append(listener)
        return partial(self._listeners.remove, listener)

    def updated(self) -> None:
        """Call the listeners."""
        notify(self._listeners)
