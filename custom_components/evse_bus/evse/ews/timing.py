"""Times of the conversation with an EWS-Box (manual, 3.1.4.2, 3.2.2)."""

from dataclasses import replace
from typing import Final

from ..framing import LineSettings, Timing
from .wire.frames import LONGEST_FRAME

SETTINGS: Final = LineSettings(baudrate=115200)

TIMING: Final = Timing(
    # USB and network adapters take longer than the box, and deliver bytes in lumps.
    reply_timeout=0.5,
    # As long as a box itself waits for the next byte.
    gap=0.1,
    longest_reply=LONGEST_FRAME,
    retry_pauses=(0.3, 1.0),
    # After a power failure a box may charge without a limit; it is alone on its line.
    backoff_limit=5.0,
)
"""On RS-232."""
TCP_TIMING: Final = replace(TIMING, reply_timeout=2.0, reply_timeout_limit=2.5, gap=2.0)
"""Over the network. The gap is the manual's own for TCP. With a longer time-out, a turn
could take longer than the time left before `COMMAND_TIMEOUT`, and never begin."""

COMMAND_TIMEOUT: Final = 30.0
"""A box ends the connection after so long without a command, s (3.1.4.2)."""
COMMAND_MARGIN: Final = 6.0
"""A command is sent so much sooner, s: there is time for one more if it is lost."""

FRESH: Final = 0.75
"""Share of the poll interval within which a status is not read again."""
BOX_INTERVAL: Final = 10.0
"""Time between two readings of the status of the box (``rs``), s."""
PARAMETERS_INTERVAL: Final = 600.0
"""Time between two readings of its parameters, s."""
PARAMETERS_RETRY: Final = 60.0
"""Pause after parameters that could not be read, s."""
INFO_PAUSE: Final = 0.2
"""Shortest time between two urgent polls because of info records, s."""

LOOK_AGAIN: Final = 0.5
"""Pause before the status of a port that has not followed yet is read again, s."""
SETTLING: Final = 5.0
"""Time for a port to follow an order before it is sent again, s: the motor of the lock
runs, and two seconds more."""
READY_PAUSE: Final = 5.0
"""Pause before a box that is starting gets a command again, s."""
READY_PATIENCE: Final = 60.0
"""Longest time a command waits for a box that is starting, s (0xF0 lasts up to 260 s
with a power backup, 2.2.3)."""
REASSERT_PAUSE: Final = 10.0
"""Pause before orders that a port did not follow are asserted again, s."""

CLOCK_TOLERANCE: Final = 60.0
"""Error of the clock above which it is set, s."""
CLOCK_PAUSE: Final = 3600.0
"""Pause after the clock was set, s: it may not follow."""
ERASE_PATIENCE: Final = 10.0
"""Additional time for a command that erases or writes memory, s."""
