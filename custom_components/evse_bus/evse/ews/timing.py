"""The numbers of a conversation with an EWS-Box (manual, 3.1.4.2, 3.2.2)."""

from dataclasses import replace
from typing import Final

from ..framing import LineSettings, Timing
from .wire.frames import LONGEST_FRAME

SETTINGS: Final = LineSettings(baudrate=115200)

TIMING: Final = Timing(
    # USB and network adapters take longer than the box, and lump what they hear.
    reply_timeout=0.5,
    # As long as a box waits for the next byte itself.
    gap=0.1,
    longest_reply=LONGEST_FRAME,
    retry_pauses=(0.3, 1.0),
)
"""On RS-232."""
TCP_TIMING: Final = replace(TIMING, reply_timeout=2.0, gap=2.0)
"""Over the network. The gap is the manual's own for TCP."""

COMMAND_TIMEOUT: Final = 30.0
"""Without a command for so long, a box ends the connection, s (3.1.4.2)."""
COMMAND_MARGIN: Final = 6.0
"""A command goes out so much sooner: one may get lost, and one more follow, s."""

FRESH: Final = 0.75
"""What was read within this share of the poll interval is not asked for again."""
BOX_INTERVAL: Final = 10.0
"""Time between two readings of the box as a whole (``rs``), s."""
PARAMETERS_INTERVAL: Final = 600.0
"""Time between two readings of its parameters, s."""
PARAMETERS_RETRY: Final = 60.0
"""Pause after parameters that could not be read, s."""
INFO_PAUSE: Final = 0.2
"""Shortest time between two urgent polls because of info records, s."""

LOOK_AGAIN: Final = 0.5
"""Pause between two looks at a port that has not followed yet, s."""
SETTLING: Final = 5.0
"""Time in which a port must have followed an order, s: the lock's motor runs, and
two more seconds go by before an order is said again."""
READY_PAUSE: Final = 5.0
"""Pause before a box that is starting is asked again, s."""
READY_PATIENCE: Final = 60.0
"""Longest time somebody's command waits for a box that is starting, s (0xF0 lasts up
to 260 s with a power backup, 2.2.3)."""
REASSERT_PAUSE: Final = 10.0
"""Pause before what a port did not follow is said again by ourselves, s."""

CLOCK_TOLERANCE: Final = 60.0
"""A clock may be wrong by so much before it is set, s."""
CLOCK_PAUSE: Final = 3600.0
"""Pause after a clock was set: one that does not follow is not set all the time, s."""
ERASE_PATIENCE: Final = 10.0
"""Additional time for a command that erases or writes memory, s."""
