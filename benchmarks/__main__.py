"""Run benchmarks; print a table and write .bench/results.json."""

import argparse
import asyncio
import json
import sys
import traceback
from types import ModuleType
from typing import Final

from . import (
    abl_scan,
    adapter_away,
    byte_errors,
    evbox_bus,
    ews_events,
    ews_listener,
    ews_poll,
    exchange_cpu,
    fuse,
    home_assistant,
    hostile_bytes,
    set_value,
    slow_lines,
    smartevse_master,
    smartevse_polled,
    sun,
)
from .figures import Figure, results, table
from .machine import OUTPUT, machine
from .progress import report

BENCHMARKS: Final = {
    one.NAME: one
    for one in (
        abl_scan,
        evbox_bus,
        set_value,
        exchange_cpu,
        home_assistant,
        smartevse_master,
        smartevse_polled,
        ews_poll,
        ews_events,
        ews_listener,
        byte_errors,
        adapter_away,
        slow_lines,
        hostile_bytes,
        fuse,
        sun,
    )
}


def main() -> int:
    """Run the benchmarks of the command line, or all; return 1 if one failed."""
    options = _parser().parse_args()
    about = machine()
    figures: list[Figure] = []
    methods: dict[str, str] = {}
    failed: list[str] = []
    for name in options.names or BENCHMARKS:
        benchmark = BENCHMARKS[name]
        report(f"-- {name}")
        methods[name] = benchmark.METHOD
        try:
            more = {one: getattr(options, one) for one in _options_of(benchmark)}
            figures += asyncio.run(benchmark.run(quick=options.quick, **more))
        except Exception:  # noqa: BLE001 - the figures of the others still count
            traceback.print_exc()
            failed.append(name)
    OUTPUT.mkdir(exist_ok=True)
    path = OUTPUT / "results.json"
    written = results(figures, about, methods, quick=options.quick)
    path.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")
    print(", ".join(f"{name} {value}" for name, value in about.items()))
    for name, method in methods.items():
        print(f"\n{name}: {method}")
    print(f"\n{table(figures)}\n\nWritten to {path}")
    if failed:
        print(f"Failed: {', '.join(failed)}")
    return bool(failed)


def _options_of(benchmark: ModuleType) -> tuple[str, ...]:
    """Return the options that a benchmark takes beside `quick`."""
    return getattr(benchmark, "OPTIONS", ())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="scripts/bench",
        description="Figures of EVSE Bus, on virtual chargers at the wire's pace.",
        epilog="Names: " + ", ".join(BENCHMARKS),
    )
    parser.add_argument("names", nargs="*", choices=BENCHMARKS, metavar="NAME")
    parser.add_argument(
        "--quick", action="store_true", help="a short run: rough figures in 20 minutes"
    )
    parser.add_argument(
        "--minutes", type=float, help="length of each scene of smartevse-master"
    )
    parser.add_argument(
        "--scene",
        default="",
        metavar="TEXT",
        help="only scenes with this in their names, of smartevse-master or byte-errors",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
