"""Sleeping until a time, or until somebody says that something has changed."""

import asyncio
from math import inf


class Alarm:
    """One sleeper, and whoever wakes it."""

    def __init__(self) -> None:
        """Nobody sleeps yet."""
        self._wake: asyncio.Future[None] | None = None

    async def sleep_until(self, wake_at: float) -> None:
        """Sleep until this loop time (inf: for ever), or until `ring`."""
        loop = asyncio.get_running_loop()
        self._wake = loop.create_future()
        handle = None
        if wake_at < inf:
            handle = loop.call_at(wake_at, self.ring)
        try:
            await self._wake
        finally:
            self._wake = None
            if handle is not None:
                handle.cancel()

    def ring(self) -> None:
        """Wake the sleeper, if there is one."""
        if self._wake is not None and not self._wake.done():
            self._wake.set_result(None)
