"""(d) Processor time of an exchange, compared with another client on the same pty."""

import asyncio
import contextlib
from functools import partial
from statistics import median
import time
from unittest.mock import patch

from tmodbus import create_async_ascii_client
from tmodbus.transport import async_ascii

from custom_components.evse_bus.evse.bus import Bus
from custom_components.evse_bus.evse.errors import PortBusyError
from custom_components.evse_bus.evse.framing import LineSettings

from .figures import Figure
from .progress import report
from .responder import ABL, ABL_PIECES, MODBUS, MODBUS_PIECES, Responder
from .setup import abl_bus, settled

NAME = "exchange-cpu"
_figure = partial(Figure, NAME, digits=0)
METHOD = """\
Processor time (user and system) of the whole process over N reads of 5 registers from
0x002E, a reply of 31 bytes each, other values each time; the device is another process
on the same pty and replies at once with prepared frames. Ours: the whole path (bus,
schedule, ABL charger, frame, plausible reading, a listener). Compared with: tmodbus'
ASCII client as its own factory makes it, returning five numbers. It sleeps for 1 ms
between frames when the reply was faster than that; a third row is without. In turns,
median of all rounds; once with replies in one piece, once in pieces of 7 bytes 2 ms
apart, as a line at 38400 Bd delivers them. Garbage collection as Python has it."""

_PIECES = LineSettings(baudrate=38400)
_AT_ONCE = LineSettings(baudrate=4_000_000)
"""The line settings of the client: at 38400 Bd it would wait before each request until
the last one has left. Without parity: a pty accepts an 8E1 open only once (see
tests/virtual/ports.py)."""
_REGISTER = 0x2E
_CLIENTS = ("evse_bus", "tmodbus", "tmodbus without its pause between frames")
_PATIENCE = 5.0


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    figures: list[Figure] = []
    plans = (
        ("in one piece", _AT_ONCE, ABL, MODBUS, 500 if quick else 3000),
        ("in 5 pieces", _PIECES, ABL_PIECES, MODBUS_PIECES, 100 if quick else 400),
    )
    async with Responder() as responder:
        for name, line, ours, theirs, exchanges in plans:
            report(f"{exchanges} exchanges a round, answers {name}")
            rounds = 3 if quick else 9
            times = []
            for _ in range(rounds):
                mine = await _ours(responder.url, line, ours, exchanges)
                other = await _tmodbus(responder.url, line, theirs, exchanges)
                with patch.object(async_ascii, "MIN_INTERFRAME_GAP", 0.0):
                    hasty = await _tmodbus(responder.url, line, theirs, exchanges)
                times.append((mine, other, hasty))
            figures += [
                _figure(f"{client}, answers {name}", median(column) * 1e6, "us")
                for client, column in zip(
                    _CLIENTS, zip(*times, strict=True), strict=True
                )
            ]
            figures.append(
                _figure(
                    f"evse_bus / tmodbus, answers {name}",
                    median(mine / other for mine, other, _ in times),
                    digits=2,
                    aim=1.0,
                    note=f"{rounds} rounds of {exchanges}",
                )
            )
    return figures


async def _ours(url: str, line: LineSettings, unit: int, exchanges: int) -> float:
    """Return the processor time of one exchange, s."""
    bus = abl_bus(url, [unit], settings=line)
    await _start(bus)
    try:
        await settled(bus)
        charger = bus.chargers[f"abl-{unit}"]
        statistics = charger.statistics
        enough = asyncio.Event()
        wanted = statistics.replies + exchanges

        def count() -> None:
            if statistics.replies >= wanted:
                enough.set()

        charger.subscribe(count)
        before, begun = statistics.replies, time.process_time()
        await enough.wait()
        return (time.process_time() - begun) / (statistics.replies - before)
    finally:
        await bus.stop()


async def _start(bus: Bus) -> None:
    """Start a bus, as soon as the client before has closed the port."""
    async with asyncio.timeout(_PATIENCE):
        while True:
            try:
                await bus.start()
            except PortBusyError:
                await asyncio.sleep(0.02)
            else:
                return


async def _tmodbus(url: str, line: LineSettings, unit: int, exchanges: int) -> float:
    client = create_async_ascii_client(url, unit_id=unit, baudrate=line.baudrate)
    await client.connect()
    try:
        for _ in range(20):
            await client.read_holding_registers(_REGISTER, 5)
        begun = time.process_time()
        for _ in range(exchanges):
            await client.read_holding_registers(_REGISTER, 5)
        return (time.process_time() - begun) / exchanges
    finally:
        with contextlib.suppress(OSError):
            await client.disconnect()
