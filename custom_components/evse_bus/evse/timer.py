"""A sleep that something else may end."""

import asyncio
from math import inf


class WakeTimer:
    """Sleeps until a time, or until something has changed."""

    def __init__(self) -> None:
        """Start without a sleeper."""
        self._wake: asyncio.Future[None] | None = None

    async def sleep_until(self, wake_at: float) -> None:
        """Sleep until this loop time (inf: for ever), or until `wake`."""
        loop = asyncio.get_running_loop()
        self._wake = loop.create_future()
        handle = None
        if wake_at < inf:
            handle = loop.call_at(wake_at, self.wake)
        try:
            await self._wake
        finally:
            self._wake = None
            if handle is not None:
                handle.cancel()

    def wake(self) -> None:
        """Wake the sleeper, if there is one."""
        if self._wake is not None and not self._wake.done():
            self._wake.set_result(None)
