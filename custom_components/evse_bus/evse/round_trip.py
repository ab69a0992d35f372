"""The reply time-out of a line, learnt from its replies. PROTOCOLS.md, 2.

A network adapter may need longer than any box. Its line gets a longer time-out, up to a
limit of the protocol; a line never gets a shorter one than the protocol's own.
"""

from .framing import Timing

_WEIGHT = 1 / 8
"""Weight of a new round trip in the mean (as in RFC 6298)."""
_DEVIATION_WEIGHT = 1 / 4
_DEVIATIONS = 4
_MARGIN = 1.5
"""The time-out is at least so many mean round trips."""
_USUAL_DEVIATIONS = 2
_NOTABLE = 1.1
"""A usual round trip that differs by this factor is worth to be followed."""
_SLOW = 1 / 4
"""A line is slow when its mean round trip is more than this part of the protocol's own
time-out."""


class RoundTrip:
    """The round trips of one line: from the end of a request to its reply, s."""

    def __init__(self, timing: Timing) -> None:
        """Begin with the time-out of the protocol."""
        self._least = timing.reply_timeout
        self._most = max(timing.reply_timeout, timing.reply_timeout_limit)
        self._mean: float | None = None
        self._deviation = 0.0
        self.timeout = timing.reply_timeout
        """The reply time-out of this line now, s."""
        self._followed = 0.0

    @property
    def mean(self) -> float | None:
        """Return the mean round trip, s; ``None``: no reply yet."""
        return self._mean

    @property
    def usual(self) -> float | None:
        """Return a round trip that few exceed, s; ``None``: no usable reply yet."""
        if self._mean is None or self.too_slow:
            return None
        return min(self._mean + _USUAL_DEVIATIONS * self._deviation, self.timeout)

    @property
    def too_slow(self) -> bool:
        """Return whether replies come later than the line may be waited for."""
        return self._mean is not None and self._mean > self._most

    @property
    def longest(self) -> float:
        """Return the time after which no reply is expected any more, s."""
        return self._most

    @property
    def drain(self) -> float:
        """Return how long to wait after a time-out for the late reply, s.

        On a slow line one mean round trip: the next request must not get the reply to
        the one before it. A fast line has no late replies.
        """
        if self._mean is None or self._mean <= _SLOW * self._least:
            return 0.0
        return min(self._mean, self._most)

    def measure(self, round_trip: float) -> bool:
        """Take note of a round trip, s, of a reply that belongs to its request.

        One that is longer than the time-out counts at once, alone. Returns whether
        times have changed that others depend on.
        """
        timeout = self.timeout
        if self._mean is None or round_trip > self.timeout:
            self._mean, self._deviation = round_trip, round_trip / 4
        else:
            difference = abs(round_trip - self._mean)
            self._deviation += _DEVIATION_WEIGHT * (difference - self._deviation)
            self._mean += _WEIGHT * (round_trip - self._mean)
        wanted = max(_MARGIN * self._mean, self._mean + _DEVIATIONS * self._deviation)
        self.timeout = min(max(wanted, self._least), self._most)
        usual = self.usual or 0.0
        followed = self._followed / _NOTABLE <= usual <= self._followed * _NOTABLE
        if not followed:
            self._followed = usual
        return self.timeout != timeout or not followed
