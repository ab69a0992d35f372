"""Progress on stderr."""

import sys
import time

_STARTED = time.monotonic()


def report(text: str) -> None:
    """Show a line of progress on stderr."""
    print(f"[{time.monotonic() - _STARTED:5.0f} s] {text}", file=sys.stderr, flush=True)
