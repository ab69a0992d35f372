"""Hostile bytes in the library of one source tree: the process of `hostile_bytes`.

``hostile_tree.py EVSE framers`` prints processor times, ``hostile_tree.py EVSE listen
SECONDS`` prints the port of a listener, then its blocks. EVSE: the folder that holds the
package ``evse``, of any commit.
"""

import asyncio
from collections.abc import Callable, Iterator
from importlib import import_module
import json
import selectors
import sys
import time
from typing import Any, Final, override

BYTES: Final = 4096
"""Bytes of one measurement."""
SIZES: Final = {"single bytes": 1, "pieces of 256 bytes": 256, "one block": BYTES}
FRAMERS: Final = {
    "RTU": (("evse.modbus",), "RtuFramer"),
    "ASCII": (("evse.modbus",), "AsciiFramer"),
    "EVBox": (("evse.evbox.frames",), "EvboxFramer"),
    "EWS": (("evse.ews.wire.frames", "evse.ews.frames"), "EwsFramer"),
}
"""Modules that have them, the present one first."""
RECORD: Final = "02000b4969660000000000000000004d"
PATTERNS: Final = {
    "RTU": ("fa10f804f6", "fa04f8", "10f6", "04", "04048310"),
    "ASCII": ("3a3e", "3a" + 600 * "30", "3a300d", "3a0d0a"),
    "EVBox": ("02", "0203", "02" + 988 * "30", "02" + 2000 * "30" + "03"),
    "EWS": (
        "02000b49696600",
        "02000243696402000b496966430200054169640202000b496966",
        "02000243696402000b4969660204004169640002000b49696602000b49696602000b4902",
        "020400416964" + 150 * "020005416964" + 10 * RECORD,
        "02",
    ),
}
"""The most costly that searches have found; see tests/evse/test_framer_work.py."""


def framers() -> Iterator[tuple[str, str, str, float]]:
    """Yield framer, pattern, how it is fed, and processor time per kilobyte, ms."""
    for name, (modules, kind) in FRAMERS.items():
        make = getattr(_first(modules), kind)
        for number, pattern in enumerate(PATTERNS[name]):
            for fed, size in SIZES.items():
                yield name, f"{number}", fed, _cpu(make, bytes.fromhex(pattern), size)


def _first(modules: tuple[str, ...]) -> Any:  # noqa: ANN401 - of any commit
    for name in modules:
        try:
            return import_module(name)
        except ModuleNotFoundError:
            continue
    raise ModuleNotFoundError(name)


def _cpu(make: Callable[[], Any], pattern: bytes, size: int) -> float:
    data = (pattern * (BYTES // len(pattern) + 1))[:BYTES]
    framer = make()
    begun = time.process_time()
    for at in range(0, BYTES, size):
        framer.feed(data[at : at + size])
    return (time.process_time() - begun) * 1e3 * 1024 / BYTES


class _Selector(selectors.DefaultSelector):
    """Measures what the loop does between two calls of `select`."""

    def __init__(self) -> None:
        super().__init__()
        self.longest = self.busiest = 0.0
        """Of one round of the loop: time and processor time, s."""
        self._since: tuple[float, float] | None = None

    @override
    def select(self, timeout: float | None = None) -> Any:
        if self._since is not None:
            wall, own = self._since
            self.longest = max(self.longest, time.perf_counter() - wall)
            self.busiest = max(self.busiest, time.thread_time() - own)
        ready = super().select(timeout)
        self._since = time.perf_counter(), time.thread_time()
        return ready


async def _listen(listener: Any, seconds: float, measured: _Selector) -> dict[str, Any]:  # noqa: ANN401 - of any commit
    await listener.start()
    print(listener.port, flush=True)
    await asyncio.sleep(seconds)
    # The stop is not measured: it ends all connections in one round.
    blocks = {"longest": measured.longest, "busiest": measured.busiest}
    counted = listener.statistics
    await listener.stop()
    return blocks | {
        name: getattr(counted, name, 0)
        for name in ("accepted", "crowded_out", "unidentified", "over_budget")
    }


def listen(seconds: float) -> dict[str, Any]:
    """Listen for so long; return the longest blocks, processor time and counters."""
    # Not measured: imports take longer than anything below.
    listener = import_module("evse.ews").Listener("127.0.0.1", 0)
    selector = _Selector()
    loop = asyncio.SelectorEventLoop(selector)
    begun = time.process_time()
    try:
        counted = loop.run_until_complete(_listen(listener, seconds, selector))
    finally:
        loop.close()
    return {
        **counted,
        "cpu": (time.process_time() - begun) / seconds,
    }


if __name__ == "__main__":
    sys.path.insert(0, sys.argv[1])
    if sys.argv[2] == "framers":
        print(json.dumps(list(framers())))
    else:
        print(json.dumps(listen(float(sys.argv[3]))))
