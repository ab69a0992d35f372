"""Configuration of a ChargePoint, and the numbers of its line."""

from dataclasses import dataclass
from typing import ClassVar, Final

from ..framing import LineSettings, Timing
from ..model import ChargerConfig
from .frames import (
    ANY_SERIAL,
    INFORMATION_LENGTH,
    LARGEST_SERIAL,
    LONGEST_FRAME,
    CommandNumber,
)

SETTINGS: Final = LineSettings(baudrate=38400)
"""38400 8N1 (manual, "SmartGrid Protocol technical details")."""

TIMING: Final = Timing(
    # The manual asks for 100 ms. A USB adapter delivers bytes up to 16 ms late, so
    # the line may be in use that much longer than it seems.
    silence=0.12,
    silence_patience=2.0,
    # The box waits for 100 ms of silence too, longer if other stations send.
    reply_timeout=1.0,
    # A third of the shortest time-out that the usual poll interval allows.
    reply_timeout_limit=5.0,
    gap=0.1,
    longest_reply=LONGEST_FRAME,
    # The minimum interval of the box makes these longer where it is longer.
    retry_pauses=(1.0, 2.0),
    misses=3,
    backoff=4.0,
    # After a power failure a box charges at the maximum of its connection until it
    # gets a request ("initially ... equal to the maximum rating"): keep this short.
    backoff_limit=10.0,
    attempts=3,
)

UNKNOWN_INTERVAL: Final = 20
"""Minimum interval until a reply reports one, s (the manual's example)."""
MISSES_PER_LONG_PAUSE: Final = 30
"""After so many unanswered requests there is one pause of `UNKNOWN_INTERVAL`: the
interval that was reported may be another box's, and a request too soon may begin it
anew. Rare, because of the power failure above."""
SHORTEST_INTERVAL: Final = 1
"""Used where a box reports 0, s: even the shortest exchange takes 0.25 s."""
INTERVAL_MARGIN: Final = 0.1
"""Added to the minimum interval, s: two clocks and a USB adapter are not exact."""
FOLLOW_TIME: Final = 10.0
"""Time a car may take to follow a new current, s (manual, note **)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EvboxConfig(ChargerConfig):
    """A ChargePoint; its address is its serial number, 0 addresses any.

    Raises ValueError for a value that cannot be encoded.
    """

    command: CommandNumber = 68
    """69 for boxes without command 68: no serial number, no voltages."""
    information: bytes = bytes(INFORMATION_LENGTH)
    """Information module (68), passed on by the box: byte 1 vendor code, bytes 8-9
    maximum current of the connection in A, the rest free."""
    one_phase_modules: bool = False
    """Each module charges on one phase: a phase below the minimum pauses that phase
    only. The manual defines no 0 on a single phase."""

    live: ClassVar = ChargerConfig.live | {"one_phase_modules"}

    def __post_init__(self) -> None:
        """Check the values that go to the wire."""
        if self.command not in (68, 69):
            message = f"command {self.command} is neither 68 nor 69"
            raise ValueError(message)
        if not ANY_SERIAL <= self.address <= LARGEST_SERIAL:
            message = f"serial number {self.address} does not fit 8 digits"
            raise ValueError(message)
        if len(self.information) != INFORMATION_LENGTH:
            message = f"information module of {len(self.information)} bytes, not 16"
            raise ValueError(message)

    @property
    def addressed(self) -> int:
        """Return the serial number that requests are addressed to; 0: any."""
        return self.address if self.command == 68 else ANY_SERIAL  # noqa: PLR2004
