"""Progress on stderr."""

import sys
import time

_STARTED = time.monotonic()


def say(text: str) -> None:
    """Show a line of progress on stderr."""
    print(f"[{time.monotonic() - _STARTED:5.0f} s] {text}", file=sys.stderr, flush=True)
