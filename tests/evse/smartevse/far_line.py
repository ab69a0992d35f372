"""The simulated line behind a network port: bytes arrive late, and in order."""

import asyncio
from random import Random
from typing import override

from custom_components.evse_bus.evse.errors import LineLostError
from tests.evse.smartevse.scene import BYTE, SmartEvseLine
from tests.simulated_time import now

MERGES = 0.003
"""A pause that does not end a frame, s."""
SPIKES = 0.004
"""Share of the bytes with another delay."""


class FarLine(SmartEvseLine):
    """Both directions have a delay, and some bytes up to ``jitter`` more, s."""

    def __init__(self, delay: float, jitter: float, dice: Random) -> None:
        super().__init__()
        self.delay = delay
        self.jitter = jitter
        self._dice = dice
        self._there = self._back = 0.0

    def _late(self, after: float) -> float:
        spike = self._dice.random() < SPIKES and self.jitter * self._dice.random()
        # Timers of the same moment run in no order.
        return max(after + 1e-6, now() + self.delay + spike)

    @override
    def write(self, data: bytes, *, reply_may_equal: bool = False) -> float:
        if not self._open:
            raise LineLostError("not open")
        self._there = self._late(self._there)
        asyncio.get_running_loop().call_at(self._there, self._put, data)
        self._there += len(data) * BYTE
        self.last_activity = now() + len(data) * BYTE
        return self.last_activity

    def _put(self, data: bytes) -> None:
        if now() < self.busy_until + MERGES:
            self.busy_until = max(self.busy_until, now())
            self._lost_until = self.busy_until
        if self._open:
            super().write(data)

    @override
    def hear(self, data: bytes) -> None:
        if now() > self._lost_until:
            self._back = self._late(self._back)
            asyncio.get_running_loop().call_at(self._back, self._arrive_here, data)

    def _arrive_here(self, data: bytes) -> None:
        if self._open:
            self.last_activity = max(self.last_activity, now())
            self.on_data(data)
