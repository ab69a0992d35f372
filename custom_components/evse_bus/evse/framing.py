"""What a protocol tells the bus about its frames and its times."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True, slots=True, kw_only=True)
class LineSettings:
    """How bytes look on the wire; fixed by the protocol."""

    baudrate: int
    parity: str = "N"
    """``N``, ``E`` or ``O``."""
    stop_bits: int = 1

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
    """How long the line must have been quiet before we speak."""
    silence_patience: float = 2.0
    """How long to wait for that quiet before giving up."""
    reply_timeout: float
    """From the end of a request to the first byte of its answer."""
    gap: float = 0.1
    """Longest pause inside an answer (adapters deliver in lumps)."""
    longest_reply: int
    """Bytes; with ``reply_timeout`` it makes an exchange's worst case."""
    retry_pauses: tuple[float, ...] = (0.6, 2.0)
    """Pause after the first, second, ... request in a row left unanswered."""
    misses: int = 3
    """Requests in a row left unanswered until a charger counts as gone."""
    backoff: float = 4.0
    """First pause between two tries to find a charger that is gone; doubles."""
    backoff_limit: float = 30.0
    """Longest such pause."""
    attempts: int = 3
    """How often a command that may be repeated is sent."""


class Frame(ABC):
    """One frame with good checksums, as a protocol sees it."""

    __slots__ = ()

    raw: bytes
    """The bytes on the wire, delimiters and all."""


class Framer[F: Frame](ABC):
    """Finds frames in a stream of bytes; keeps what is left for the next call."""

    unasked: ClassVar[bool] = False
    """Frames come at any moment, also while we begin to speak."""

    def __init__(self) -> None:
        """Start with nothing heard."""
        self.noise = 0
        """Bytes that belong to no frame."""
        self.bad = 0
        """Frames with a wrong checksum, wrong length or impossible content."""

    @abstractmethod
    def feed(self, data: bytes) -> Sequence[F]:
        """Return the whole frames that end within these bytes."""

    @abstractmethod
    def reset(self) -> None:
        """Forget a frame begun; its bytes count as noise."""

    @property
    @abstractmethod
    def pending(self) -> int:
        """Return the number of bytes of a frame begun and not ended."""

    def shown(self, raw: bytes) -> bytes:
        """Return bytes that passed as they may stand in a log: nothing private."""
        return raw
