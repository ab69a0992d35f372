"""What is known of the SmartEVSEs on one line, kept from one bus to the next."""

from dataclasses import dataclass
from math import inf


@dataclass(slots=True)
class SmartEvseMemory:
    """The rhythm that the boxes on one line need."""

    needs_quiet: bool = False
    """A box of a later dialect is polled here."""
    broadcast_at: float = -inf
    """Loop time of our last broadcast as the master, s."""
