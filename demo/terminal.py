"""Output of the demo on the terminal."""

from collections.abc import Callable
import sys
import time
from typing import Final, Self

WIDTH: Final = 78
EVERY: Final = 5.0
"""Seconds between two lines of progress if lines cannot be overwritten."""


def report(text: str = "") -> None:
    """Print a line."""
    sys.stdout.write(f"demo: {text}\n" if text else "\n")
    sys.stdout.flush()


class Progress:
    """The progress of one task; `with` ends its line."""

    def __init__(self, title: str, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin now."""
        self.outcome = "done"
        self._title = title
        self._clock = clock
        self._begin = clock()
        self._printed_at = self._begin
        self._live = sys.stdout.isatty()

    def __enter__(self) -> Self:
        """Print the title."""
        if self._live:
            self.show()
        else:
            report(f"{self._title} ...")
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """Print the time it took, unless it raised."""
        if self._live:
            sys.stdout.write("\r" + " " * WIDTH + "\r")
        if kind is None:
            report(f"{self._title}: {self.outcome} ({self.seconds:.0f} s)")

    @property
    def seconds(self) -> float:
        """Return how long it has taken so far."""
        return self._clock() - self._begin

    def show(self, detail: str = "") -> None:
        """Print the progress."""
        now = self._clock()
        text = f"{self._title} ... {self.seconds:.0f} s"
        if detail:
            text += f", {detail}"
        if self._live:
            sys.stdout.write("\r" + f"demo: {text}"[:WIDTH].ljust(WIDTH))
            sys.stdout.flush()
        elif now - self._printed_at >= EVERY:
            self._printed_at = now
            report(text)
