"""Line settings, times and frames of a protocol, as the bus needs them."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True, kw_only=True)
class LineSettings:
    """Coding of bytes on the wire, fixed by the protocol; and its reply time-out."""

    baudrate: int
    parity: str = "N"
    """``N``, ``E`` or ``O``."""
    stop_bits: int = 1
    reply_timeout: float | None = None
    """Set by the user for this line, s; ``None``: it follows what the line shows."""

    @property
    def byte_time(self) -> float:
        """Return the time one byte takes on the wire, s."""
        bits = 1 + 8 + (self.parity != "N") + self.stop_bits
        return bits / self.baudrate

    def __str__(self) -> str:
        """Return the usual short form, such as ``38400 8E1``."""
        return f"{self.baudrate} 8{self.parity}{self.stop_bits}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """A protocol's numbers for the bus, all in seconds unless named otherwise."""

    silence: float = 0.0
    """Quiet time of the line required before a request."""
    silence_patience: float = 2.0
    """Longest wait for that quiet time."""
    reply_timeout: float
    """From the end of a request to the first byte of its reply."""
    reply_timeout_limit: float = 3.0
    """Longest reply time-out on a line whose replies take longer."""
    gap: float = 0.1
    """Longest pause inside a reply (adapters deliver in chunks)."""
    longest_reply: int
    """Bytes; with ``reply_timeout`` it makes an exchange's worst case."""
    retry_pauses: tuple[float, ...] = (0.6, 2.0)
    """Pause after the first, second, ... unanswered request in a row."""
    misses: int = 3
    """Unanswered requests in a row after which a charger is unavailable."""
    backoff: float = 4.0
    """First pause between two probes of an unavailable charger; doubles."""
    backoff_limit: float = 30.0
    """Longest such pause."""
    attempts: int = 3
    """How often a command that may be repeated is sent."""

    def pause_after(self, misses: int) -> float:
        """Return the pause after so many unanswered requests in a row, s."""
        if misses < self.misses:
            return self.retry_pauses[min(misses, len(self.retry_pauses)) - 1]
        doubled = 2.0 ** min(misses - self.misses, 16)
        return min(self.backoff * doubled, self.backoff_limit)


class Frame(ABC):
    """One frame with good checksums, as a protocol sees it."""

    __slots__ = ()

    raw: bytes
    """The bytes on the wire, delimiters and all."""

    @property
    def is_request(self) -> bool:
        """Return whether it is surely a request: only a master sends it."""
        return False


class Framer[F: Frame](ABC):
    """Finds frames in a stream of bytes; keeps an incomplete one for the next call."""

    unsolicited: ClassVar[bool] = False
    """Frames may come at any moment, also right before a request."""

    def __init__(self) -> None:
        """Start without a frame."""
        self.noise = 0
        """Bytes that belong to no frame."""
        self.bad = 0
        """Frames with a wrong checksum, wrong length or impossible content."""

    @abstractmethod
    def feed(self, data: bytes) -> Sequence[F]:
        """Return the complete frames that end within these bytes."""

    @abstractmethod
    def reset(self) -> None:
        """Drop an incomplete frame; its bytes count as noise."""

    @property
    @abstractmethod
    def pending(self) -> int:
        """Return the number of bytes of an incomplete frame."""

    def redacted(self, raw: bytes) -> bytes:
        """Return received or sent bytes as they may be logged, without private data."""
        return raw
