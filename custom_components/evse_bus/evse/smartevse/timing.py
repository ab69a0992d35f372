"""The numbers of a SmartEVSE bus."""

from typing import Final

from ..framing import Timing
from .registers import LONGEST_REPLY

TIMING: Final = Timing(
    # More than 3 ms of silence end a frame, and a box answers after more than 6 ms.
    silence=0.010,
    silence_patience=0.1,
    # Network and USB adapters take longer than the box, and lump what they hear.
    reply_timeout=0.25,
    gap=0.05,
    longest_reply=LONGEST_REPLY,
    retry_pauses=(0.4, 1.0),
)

QUIET: Final = 6.5
"""Time in which a later box must hear no request at all, s: any request holds its own
2 s cycle up for 4 s; without it no new current counts, and after 10 s it stops."""
SETTLING: Final = 3.0
"""Longest time in which 2.17 and 2.20 follow a new current, s (their cycle: 2 s)."""
LOOK_AGAIN: Final = 0.5
"""Pause between two looks at a box that has not followed yet, s."""
CONFIGURATION_INTERVAL: Final = 300.0
"""Time between two readings of a box's settings, s."""
PLUG_DOUBT: Final = 5.0
"""After access was off, ``A`` may still be a plugged car for so long, s."""
ERROR_DOUBT: Final = 65.0
"""After an error likewise: a box waits for 60 s before it looks again, s."""
