"""Showing the progress of what takes its time."""

import asyncio
from collections.abc import Awaitable
from typing import Final

SHOWN_FOR: Final = 1.5
"""Shortest time a progress is shown, s.

The frontend subscribes to the event of the end only once it shows the progress; an
event before that is lost, and the dialogue stays as it is for ever.
"""


async def async_show_long_enough[T](work: Awaitable[T]) -> T:
    """Return the result of some work after `SHOWN_FOR` at least, also where it fails."""
    result, _ = await asyncio.gather(
        work, asyncio.sleep(SHOWN_FOR), return_exceptions=True
    )
    if isinstance(result, BaseException):
        raise result
    return result
