"""What is known of a line, kept from one bus on it to the next.

A search has a bus of its own, and so has each set-up of a config entry; to a charger
all of them are one line, on which it was asked a moment ago. So whoever makes a bus
gives its line this memory: a minimum interval or a quiet time holds across a search, a
reload, and a charger that is added again.

It lasts as long as the process, because loop times mean nothing to the next one. What
must outlive that is stored with the configuration or the orders.
"""

from math import inf


class Renewals:
    """When the orders of chargers were renewed last."""

    def __init__(self) -> None:
        """Know no charger."""
        self.at: dict[str, float] = {}
        """Loop times, s, by the key of a charger's configuration."""


class LineMemory:
    """What is known of one line, whichever bus is on it."""

    def __init__(self) -> None:
        """Know nothing."""
        self.sent_at = -inf
        """Loop time at which the last request on it, to any address, was sent, s."""
        self._notes: dict[type[object], object] = {}

    def of[T](self, kind: type[T]) -> T:
        """Return the notes of one kind, made when first asked for."""
        note = self._notes.setdefault(kind, kind())
        if not isinstance(note, kind):
            raise TypeError(kind.__name__)
        return note
