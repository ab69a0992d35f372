"""Benchmarks in simulated time: a day takes a minute, and the machine changes nothing.

A scene runs in a process of its own, on a loop whose clock jumps to the next timer
(`tests.simulated_time`). Library and virtual chargers are both on it, and the library
opens the ports of virtual buses by their names.
"""

import asyncio
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import ProcessPoolExecutor
import logging
from math import inf
import multiprocessing
import os
from typing import Any, override

from tests.simulated_ports import direct_ports
from tests.simulated_time import SimulatedLoop

DAY = 86400.0
HOUR = 3600.0


class ErrorCounter(logging.Handler):
    """Counts what the library logs as an error: a mistake of its own."""

    def __init__(self) -> None:
        """Count from 0."""
        super().__init__(logging.ERROR)
        self.texts: list[str] = []

    @override
    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(self.format(record))


def simulate[**P, T](
    scene: Callable[P, Coroutine[Any, Any, T]], *args: P.args, **kwargs: P.kwargs
) -> T:
    """Run a scene in simulated time, however long that takes; return its result.

    Raises RuntimeError if the library logged an error.
    """
    errors = ErrorCounter()
    library = logging.getLogger("custom_components.evse_bus")
    library.addHandler(errors)
    propagated, library.propagate = library.propagate, False
    loop = SimulatedLoop()
    loop.ends_at = inf
    try:
        with direct_ports(), asyncio.Runner(loop_factory=lambda: loop) as runner:
            result = runner.run(scene(*args, **kwargs))
    finally:
        library.removeHandler(errors)
        library.propagate = propagated
    if errors.texts:
        message = f"{len(errors.texts)} errors were logged: {errors.texts[0]}"
        raise RuntimeError(message)
    return result


async def simulate_all[C, T](
    scene: Callable[[C], Coroutine[Any, Any, T]], cases: Sequence[C]
) -> list[T]:
    """Run a scene for each case, in as many processes as there are cores."""
    loop = asyncio.get_running_loop()
    # Forking would copy threads of this process that are in the middle of something.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
        runs = (loop.run_in_executor(pool, simulate, scene, case) for case in cases)
        return await asyncio.gather(*runs)
