"""The traffic log: every transmission on the wire, with its times and sender."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

CLIENT = "client"
INJECTED = "injected"
NOISE = "noise"


@dataclass(frozen=True, slots=True)
class Entry:
    """One transmission.

    `data`: bytes as sent; `wire`: bytes as received, different after a collision or a
    fault. Times are real monotonic seconds.
    """

    t: float
    end: float
    source: str
    data: bytes
    wire: bytes
    collided: bool

    def __iter__(self) -> Iterator[object]:
        """Unpack as (t, source, bytes)."""
        return iter((self.t, self.source, self.data))


class TrafficLog:
    """The transmissions in order of their end, the newest last.

    A ring of the last `ring` transmissions, or everything if `ring` is None.
    Reading from another thread is safe: it works on a copy.
    """

    def __init__(self, ring: int | None = 20_000) -> None:
        """Make an empty log."""
        self._entries: deque[Entry] = deque(maxlen=ring)
        self.total = 0

    def add(self, entry: Entry) -> None:
        """Append (on the bus thread)."""
        self._entries.append(entry)
        self.total += 1

    def clear(self) -> None:
        """Remove all entries."""
        self._entries.clear()

    @property
    def entries(self) -> list[Entry]:
        """Return a copy of the entries."""
        while True:
            try:
                return list(self._entries)
            except RuntimeError:
                # The bus thread appended while we copied: copy again.
                continue

    def __iter__(self) -> Iterator[Entry]:
        """Iterate over a copy."""
        return iter(self.entries)

    def __len__(self) -> int:
        """Return the number of entries kept."""
        return len(self._entries)

    def of(self, source: str, since: float = 0.0) -> list[Entry]:
        """Return the transmissions of one source that began at or after `since`."""
        return [e for e in self.entries if e.source == source and e.t >= since]

    def sent_by_client(self, since: float = 0.0) -> bytes:
        """Return all bytes the client sent, one after the other."""
        return b"".join(e.data for e in self.of(CLIENT, since))

    def bursts(self, source: str = CLIENT, gap: float = 0.003) -> list[Entry]:
        """Return transmissions of one source; those without a pause between are joined.

        A frame that the client wrote in several pieces is one entry.
        """
        result: list[Entry] = []
        for entry in self.of(source):
            last = result[-1] if result else None
            if last is not None and entry.t - last.end <= gap:
                result[-1] = Entry(
                    last.t,
                    entry.end,
                    source,
                    last.data + entry.data,
                    last.wire + entry.wire,
                    last.collided or entry.collided,
                )
            else:
                result.append(entry)
        return result
