"""The record that an EWS-Box sends on its own: ``I`` with ``if``.

Source: manual, 3.2.3. It may come at any moment, also between a command and its
answer, and is a reason to poll at once.
"""

from enum import KEEP, IntFlag
from typing import Final

from ...events import KEYS, KeyEvent
from ...fields import Flags, Number
from ...structs import Struct, coded, many, record
from .frames import EwsFrame, MessageId

_NAME: Final = "if"
_PRESSED: Final = 255
_STEP: Final = 0.1
"""s"""


class Change(IntFlag, boundary=KEEP):
    """Kinds of changes."""

    CARD = 1 << 0
    """Another card is at the reader."""
    PORT_2 = 1 << 1
    PORT_1 = 1 << 2
    """Start or stop by key or web page, or charging has ended."""


@record
class Info:
    """One info record."""

    changes: Change = coded(Flags(kind=Change))
    keys: tuple[int, ...] = coded(many(Number(width=1, unit="0.1 s"), 2 * KEYS))
    """Port 1, key 1 to 4, then port 2: 0 nothing, 255 pressed, else held for 0.1 s."""

    @property
    def key_events(self) -> tuple[KeyEvent, ...]:
        """Return the events of keys; only a box with manual keys reports them."""
        return tuple(
            KeyEvent(
                port=1 + at // KEYS,
                key=1 + at % KEYS,
                held=None if code == _PRESSED else round(code * _STEP, 1),
            )
            for at, code in enumerate(self.keys)
            if code
        )


INFO: Final = Struct(Info, "3.2.3 if")


def decode_info(frame: EwsFrame) -> Info | None:
    """Decode an info record; ``None``: the frame is none, or has another name.

    Raises ImplausibleReplyError for one of another length.
    """
    if frame.message_id is not MessageId.INFO or frame.name != _NAME:
        return None
    return INFO.decode(frame.data)
