"""EVBox's numbers: how its line looks, and who may speak when."""

from typing import Final

from ..framing import LineSettings, Timing
from .frames import LONGEST_FRAME

SETTINGS: Final = LineSettings(baudrate=38400)
"""38400 8N1 (manual, "SmartGrid Protocol technical details")."""

TIMING: Final = Timing(
    # The manual asks for 100 ms. A USB adapter hands over what it heard up to
    # 16 ms late: within that time the line may be in use without our knowing.
    silence=0.12,
    silence_patience=2.0,
    # The box has to wait for 100 ms of silence itself, longer if others speak.
    reply_timeout=1.0,
    gap=0.1,
    longest_reply=LONGEST_FRAME,
    # The box's minimum interval makes these longer where it asks for more.
    retry_pauses=(1.0, 2.0),
    misses=3,
    backoff=4.0,
    # A box back from a power failure charges at its connection's maximum until it
    # hears us ("initially ... equal to the maximum rating"): do not leave it long.
    backoff_limit=10.0,
    attempts=3,
)

UNKNOWN_INTERVAL: Final = 20
"""Minimum interval until a reply tells one, s (the manual's example)."""
SHORTEST_INTERVAL: Final = 1
"""Taken where a box tells 0, s: even the shortest round costs 0.25 s."""
INTERVAL_MARGIN: Final = 0.1
"""Added to the minimum interval, s: two clocks and a USB adapter are not exact."""
FOLLOW_TIME: Final = 10.0
"""Time a car may take to accept a new current, s (manual, note **)."""
