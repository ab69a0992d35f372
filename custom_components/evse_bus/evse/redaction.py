"""Serial numbers in raw frames: where they stand, and how to hide them."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
import re
from typing import Final

NOWHERE: Final = re.compile(rb"(?!)")
"""Matches nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SerialNumbers:
    """How one protocol sends serial numbers."""

    encode: Callable[[str], bytes] = str.encode
    """Return a serial number as it is sent; empty for one that cannot be sent."""
    in_frame: re.Pattern[bytes] = NOWHERE
    """Matches a serial number in a frame, also in one that was cut off."""
    in_rest: re.Pattern[bytes] = NOWHERE
    """Matches what may be one in the rest of a frame whose beginning is missing."""
    distinct: bool = True
    """Long enough that equal bytes are a serial number wherever they stand.

    Otherwise known numbers are looked for only in pieces of frames.
    """

    def encoded(self, serials: Iterable[str | None]) -> list[bytes]:
        """Return known serial numbers as they are sent."""
        return [data for one in serials if one and (data := self.encode(one))]

    def hide(
        self, data: bytes, known: Iterable[bytes] = (), *, whole: bool = True
    ) -> bytes:
        """Return the bytes with asterisks in place of serial numbers.

        ``known`` ones (see `encoded`) are hidden wherever they stand, also in a
        damaged frame. A piece that is not ``whole`` may begin in the middle of one.
        """
        if self.distinct or not whole:
            for serial in known:
                data = data.replace(serial, b"*" * len(serial))
        data = self.in_frame.sub(_hide, data)
        return data if whole else self.in_rest.sub(_hide, data)


def _hide(found: re.Match[bytes]) -> bytes:
    return b"*" * len(found.group())
