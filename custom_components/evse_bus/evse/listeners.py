"""Telling whoever wants to know, whatever they make of it."""

from collections.abc import Callable, Iterable
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
