"""Figures: statistics, the table, and results.json. Pure."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass
from itertools import pairwise
from typing import Any


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure, with its aim where there is one."""

    benchmark: str
    name: str
    value: float
    unit: str = ""
    _: KW_ONLY
    aim: float | None = None
    """The value must not be greater; ``None``: no aim."""
    digits: int = 1
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Return whether the aim is met, ``None`` without an aim."""
        return None if self.aim is None else self.value <= self.aim

    @property
    def shown(self) -> str:
        """Return the value with its unit."""
        return f"{self.value:.{self.digits}f} {self.unit}".rstrip()

    @property
    def shown_aim(self) -> str:
        """Return the aim and whether it is met."""
        if self.aim is None:
            return ""
        return f"<= {self.aim:.{self.digits}f} {'yes' if self.met else 'NO'}"

    def as_dict(self) -> dict[str, Any]:
        """Return the item for results.json."""
        return {**asdict(self), "met": self.met}


def percentile(values: Sequence[float], share: float) -> float:
    """Return the smallest value that this share (0..1) of them does not exceed.

    The nearest-rank method: always one of the values. Raises ValueError for none.
    """
    if not values:
        message = "no values"
        raise ValueError(message)
    ordered = sorted(values)
    rank = max(-int(-share * len(ordered) // 1), 1)
    return ordered[min(rank, len(ordered)) - 1]


def spread(seconds: Sequence[float]) -> str:
    """Return the least, the median and p95 of some times (s), in words."""
    least, median = min(seconds), percentile(seconds, 0.5)
    return (
        f"of {len(seconds)}: min {least:.2f}, median {median:.2f},"
        f" p95 {percentile(seconds, 0.95):.2f} s"
    )


def gaps(times: Iterable[float]) -> list[float]:
    """Return the times between each and the next one."""
    return [after - before for before, after in pairwise(times)]


_HEADS = ("benchmark", "figure", "value", "aim", "note")
_RIGHT = 2
"""The column that is aligned to the right: values."""


def table(figures: Iterable[Figure]) -> str:
    """Return the figures as a table in Markdown, aligned for a terminal."""
    rows: list[tuple[str, ...]] = [_HEADS]
    before = ""
    for one in figures:
        name = "" if one.benchmark == before else one.benchmark
        rows.append((name, one.name, one.shown, one.shown_aim, one.note))
        before = one.benchmark
    widths = [max(len(row[at]) for row in rows) for at in range(len(_HEADS))]
    lines = [_line(row, widths) for row in rows]
    rule = "|".join(
        "-" * (width + 1) + (":" if at == _RIGHT else "-")
        for at, width in enumerate(widths)
    )
    lines.insert(1, f"|{rule}|")
    return "\n".join(lines)


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    cells = (
        cell.rjust(width) if at == _RIGHT else cell.ljust(width)
        for at, (cell, width) in enumerate(zip(row, widths, strict=True))
    )
    return f"| {' | '.join(cells)} |"


def results(
    figures: Iterable[Figure],
    machine: Mapping[str, object],
    methods: Mapping[str, str],
    *,
    quick: bool,
) -> dict[str, Any]:
    """Return the item for results.json."""
    return {
        "machine": dict(machine),
        "quick": quick,
        "methods": dict(methods),
        "figures": [one.as_dict() for one in figures],
    }
