"""An adapter that comes and goes, a thousand times: nothing is late, nothing is left."""

import asyncio
from itertools import pairwise
from math import exp, log
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import pytest

from custom_components.evse_bus.evse import line
from custom_components.evse_bus.evse.abl import PROTOCOL
from custom_components.evse_bus.evse.abl.config import AblConfig
from custom_components.evse_bus.evse.model import CurrentLimit, Orders
from custom_components.evse_bus.evse.recovery import PAUSES
from tests.simulated_time import now
from tests.virtual import AblBox, VirtualBus

UNPLUGS = 1000
BACK_WITHIN = 10.0
"""s"""


def open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def timers() -> int:
    """Return how many timers wait in the loop."""
    scheduled = asyncio.get_running_loop()._scheduled  # type: ignore[attr-defined]
    return sum(not handle.cancelled() for handle in scheduled)


class Attempts:
    """Each attempt to open a port; one of an adapter that hangs never ends by itself."""

    def __init__(self) -> None:
        self.begun: list[float] = []
        self.hangs = False
        self._open = line.create_serial_connection

    async def __call__(self, *args: Any, **settings: Any) -> Any:  # noqa: ANN401
        self.begun.append(now())
        if self.hangs:
            await asyncio.Event().wait()
        return await self._open(*args, **settings)


@pytest.mark.slow
async def test_a_thousand_unplugs() -> None:
    random = Random(1)  # noqa: S311 - repeatable on purpose
    attempts = Attempts()
    box = AblBox(1)
    with (
        VirtualBus.in_loop(box) as adapter,
        patch.object(line, "create_serial_connection", attempts),
    ):
        bus = PROTOCOL.bus(adapter.url)
        config = AblConfig(
            key="1", name="box", address=1, installation_limit=16.0, poll_interval=2.0
        )
        charger = PROTOCOL.charger(config, Orders(limit=CurrentLimit(current=10.0)))
        bus.add(charger)
        async with bus:
            await charger.wait_available()
            tasks, files, waiting = len(asyncio.all_tasks()), open_files(), timers()
            for _ in range(UNPLUGS):
                # From 0.1 s to 10 min, as many short ones as long ones.
                away = exp(random.uniform(log(0.1), log(600.0)))
                attempts.hangs = random.random() < 0.5
                adapter.unplug()
                gone = now()
                await asyncio.sleep(away)
                attempts.hangs = False
                adapter.replug()
                back = now()
                while not (charger.available and bus.line.is_open):
                    assert now() - back <= BACK_WITHIN
                    await asyncio.sleep(0.05)
                # An attempt takes 4 s at most, the pause before it 5 s.
                tried = [at for at in attempts.begun if at > gone]
                longest = max((b - a for a, b in pairwise(tried)), default=0.0)
                assert longest <= line.OPEN_TIMEOUT + PAUSES[-1] + 0.01
                attempts.begun.clear()
                await asyncio.sleep(random.uniform(0.5, 15.0))
            assert len(asyncio.all_tasks()) == tasks
            assert open_files() == files
            assert abs(timers() - waiting) <= 5
    assert bus.line.statistics.lost == UNPLUGS
