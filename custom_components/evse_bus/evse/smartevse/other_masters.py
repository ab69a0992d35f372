"""Another master on the line, recognised by what only a master sends. No clock."""

from collections.abc import Container
from typing import Final

from ..modbus import ModbusFrame
from .balancing import is_foreign_broadcast, is_poll_of_node

ECHO: Final = 0.5
"""A broadcast equal to ours that comes within this time is its echo, s: a network port
may pass it on when the next one has gone out already."""


class OtherMasters:
    """The frames of masters that were received unasked."""

    def __init__(self) -> None:
        """Nothing was broadcast yet."""
        self._echoes: list[tuple[float, bytes]] = []
        """Our broadcasts whose echo may still come, and when they were sent."""

    def sent(self, broadcast: bytes, now: float) -> None:
        """Note a broadcast of ours: its echo may be received."""
        self._echoes = [one for one in self._echoes if now - one[0] <= ECHO]
        self._echoes.append((now, broadcast))

    def is_one(self, frame: ModbusFrame, ours: Container[int], now: float) -> bool:
        """Return whether a frame comes from another master.

        ``ours``: the units that we poll, whose polls may be an echo.
        """
        if is_foreign_broadcast(frame):
            return not any(
                raw == frame.raw and now - when <= ECHO for when, raw in self._echoes
            )
        return is_poll_of_node(frame) and frame.unit not in ours
