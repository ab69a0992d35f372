"""(n) Bytes and connections that are made to cost as much as possible."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
import io
import json
from pathlib import Path
import subprocess
import sys
import tarfile
from tempfile import TemporaryDirectory
from typing import Any, Final

from .figures import Figure
from .hostile_tree import BYTES, FRAMERS, PATTERNS, SIZES
from .progress import report

NAME = "hostile-bytes"
_figure = partial(Figure, NAME)

BEFORE: Final = "c1835e8"
"""The commit that the figures are compared with."""
STRANGERS: Final = (12, 100)
AIM: Final = 0.05
"""Longest block of the event loop, s."""
PACKAGE: Final = "custom_components/evse_bus"
ROOT: Final = Path(__file__).parents[1]

METHOD = f"""\
Framers: processor time per kilobyte of {BYTES} bytes, the most costly of the patterns
that searches have found for this framer (counted work led them: see
tests/evse/test_framer_work.py), in single bytes, in pieces of 256 and in one block; in
a process of its own for this tree and for {BEFORE}. Strangers: a listener without boxes
in a process of its own; connections from another one, each from an address of its own
(127.0.1.x), send patterns as fast as they can, by turns in single bytes (the first
pattern) and in blocks, and connect anew as soon as they are ended. A block is one round
of the event loop, between two calls of select; its processor time, which other load
does not change, has the aim."""


async def run(*, quick: bool) -> list[Figure]:
    """Return the figures."""
    seconds = 5.0 if quick else 20.0
    figures: list[Figure] = []
    with _trees() as trees:
        times = {}
        for name, tree in trees.items():
            report(f"framers, {name}")
            times[name] = await _framers(tree)
        for framer in FRAMERS:
            for fed in SIZES:
                figures += [
                    _figure(
                        f"{framer} framer, {fed}, {name}",
                        measured[framer, fed],
                        "ms/kB",
                        note=f"worst of {len(PATTERNS[framer])} patterns",
                    )
                    for name, measured in times.items()
                ]
        for count in STRANGERS:
            for name, tree in trees.items():
                report(f"{count} strangers, {name}, {seconds:.0f} s")
                figures += _blocks(count, name, await _strangers(tree, count, seconds))
    return figures


@contextmanager
def _trees() -> Iterator[dict[str, Path]]:
    """Unpack the commit to compare with, if this clone has it."""
    trees = {"now": ROOT / PACKAGE}
    with TemporaryDirectory() as folder:
        archive = subprocess.run(  # noqa: S603 - fixed arguments
            ["git", "archive", BEFORE, PACKAGE],  # noqa: S607
            cwd=ROOT,
            capture_output=True,
            check=False,
        )
        if archive.returncode == 0:
            with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as packed:
                packed.extractall(folder, filter="data")
            trees = {f"at {BEFORE}": Path(folder) / PACKAGE, **trees}
        yield trees


async def _start(tree: Path, *arguments: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        *(sys.executable, str(Path(__file__).with_name("hostile_tree.py"))),
        *(str(tree), *arguments),
        stdout=asyncio.subprocess.PIPE,
    )


async def _framers(tree: Path) -> dict[tuple[str, str], float]:
    """Return the worst processor time of each framer and way of feeding, ms/kB."""
    process = await _start(tree, "framers")
    printed, _ = await process.communicate()
    worst: dict[tuple[str, str], float] = {}
    for framer, _pattern, fed, taken in json.loads(printed):
        worst[framer, fed] = max(taken, worst.get((framer, fed), 0.0))
    return worst


async def _strangers(tree: Path, count: int, seconds: float) -> dict[str, Any]:
    """Let strangers connect to a listener; return what its process has measured."""
    process = await _start(tree, "listen", str(seconds))
    if process.stdout is None:
        raise RuntimeError("no output")
    port = int(await process.stdout.readline())
    tasks = [
        asyncio.create_task(_stranger(port, number, seconds)) for number in range(count)
    ]
    printed = await process.stdout.readline()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    await process.wait()
    result: dict[str, Any] = json.loads(printed)
    return result


async def _stranger(port: int, number: int, seconds: float) -> None:
    patterns = [bytes.fromhex(one) for one in PATTERNS["EWS"]]
    turn = number
    async with asyncio.timeout(seconds + 5.0):
        while True:
            turn += 1
            with suppress(OSError):
                if turn % 2:
                    await _attack(port, number, patterns[0], single=True)
                else:
                    pattern = patterns[turn // 2 % len(patterns)]
                    await _attack(port, number, pattern, single=False)
            await asyncio.sleep(0.01)


async def _attack(port: int, number: int, pattern: bytes, *, single: bool) -> None:
    """Connect and send a pattern until the connection is ended."""
    source = (f"127.0.1.{number + 1}", 0)
    reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=source)
    try:
        data = pattern * (BYTES // len(pattern) + 1)
        while not reader.at_eof() and reader.exception() is None:
            for at in range(0, len(data), 1 if single else len(data)):
                writer.write(data[at : at + 1] if single else data)
                await writer.drain()
                if single:
                    # Each byte is a packet of its own.
                    await asyncio.sleep(0)
    finally:
        writer.close()


def _blocks(count: int, name: str, measured: dict[str, Any]) -> list[Figure]:
    note = (
        f"{measured['longest'] * 1e3:.0f} ms with other load; {measured['accepted']}"
        f" accepted, {measured['crowded_out']} too many, {measured['over_budget']} over"
        " budget"
    )
    return [
        _figure(
            f"{count} strangers, longest block, {name}",
            measured["busiest"] * 1e3,
            "ms",
            aim=AIM * 1e3 if name == "now" else None,
            note=note,
        ),
        _figure(
            f"{count} strangers, processor time, {name}",
            measured["cpu"] * 100,
            "% of a core",
        ),
    ]
