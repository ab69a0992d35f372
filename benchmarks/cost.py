"""The cost of chargers in Home Assistant: processor, memory, blocks of its loop."""

from collections.abc import Mapping
from typing import Any, Final

from .figures import Figure, percentile
from .house import House

LONGEST_BLOCK: Final = 10.0
"""Aim, ms."""


async def measure(house: House, seconds: float) -> dict[str, Any]:
    """Return the cost now; takes twice this time (s)."""
    return {
        **await house.do("cost", seconds=seconds),
        **await house.do("blocks", seconds=seconds),
        **await house.do("count"),
    }


def cost_figures(
    benchmark: str, idle: Mapping[str, Any], polled: Mapping[str, Any], what: str
) -> list[Figure]:
    """Return the cost of chargers, and that of Home Assistant without them."""
    new = polled["states"] - idle["states"]
    rate = polled["changes_per_second"] - idle["changes_per_second"]

    def figure(name: str, value: float, unit: str, note: str = "") -> Figure:
        return Figure(benchmark, name, value, unit, note=note)

    return [
        figure("CPU, idle", idle["cpu"] * 100, "% of a core"),
        figure(
            f"CPU, more with {what}",
            (polled["cpu"] - idle["cpu"]) * 100,
            "% of a core",
            f"{new} entities with a state, {rate:.0f} changes/s",
        ),
        figure("memory, idle", idle["memory"] / 1e6, "MB"),
        figure(
            f"memory, more with {what}",
            (polled["memory"] - idle["memory"]) / 1e6,
            "MB",
        ),
        figure("longest block, idle", idle["longest"][0][0] * 1000, "ms"),
        block_figure(benchmark, "longest block, all polled", polled, aim=LONGEST_BLOCK),
        busy_figure(benchmark, "all polled", polled, aim=LONGEST_BLOCK),
        Figure(
            benchmark,
            "p99.9 of callbacks, all polled",
            _p999(polled),
            "ms",
            digits=2,
            note=f"{polled['callbacks']} callbacks",
        ),
    ]


def block_figure(
    benchmark: str, name: str, blocks: Mapping[str, Any], aim: float | None = None
) -> Figure:
    """Return the longest block, and its callback."""
    took, own, what = blocks["longest"][0]
    note = f"own time {own * 1000:.1f} ms: {what}"
    return Figure(benchmark, name, took * 1000, "ms", aim=aim, note=note)


def busy_figure(
    benchmark: str, name: str, blocks: Mapping[str, Any], aim: float | None = None
) -> Figure:
    """Return the most processor time of one callback, and its name."""
    used, what = blocks["busiest"]
    name = f"most own time of one callback, {name}"
    return Figure(benchmark, name, used * 1000, "ms", aim=aim, note=what)


def _p999(blocks: Mapping[str, Any]) -> float:
    # Only those above a millisecond are listed one by one.
    short = blocks["callbacks"] - len(blocks["seconds"])
    return percentile([0.0] * short + blocks["seconds"], 0.999) * 1000
