"""A driver at a virtual EWS-Box: presses start; without success, stop and start."""

from __future__ import annotations

from dataclasses import dataclass, field
from random import Random
from typing import TYPE_CHECKING

from .ews_io import START, STOP
from .ews_states import Status

if TYPE_CHECKING:
    from .ews_io import UserInterface
    from .ews_port import EwsPort

PRESS = 0.3
STEP_BACK = 5.0


@dataclass
class Driver:
    """The driver of the car at one port; times in device seconds.

    In server mode the start key only sends a request to the server. After `patience`
    without a start the driver withdraws the request, and makes it again.
    """

    port: EwsPort
    seed: int = 0
    hesitates: tuple[float, float] = (1.0, 5.0)
    patience: float = 30.0
    rng: Random = field(init=False)
    _next: float | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        """Seed the random numbers."""
        self.rng = Random(self.seed)  # noqa: S311 - repeatable on purpose

    def step(self, now: float, keys: UserInterface) -> None:
        """Do the next step if it is due."""
        port = self.port
        wants = port.car is not None and port.car.requesting
        if not wants or port.status != Status.WAITING:
            self._next = None
        elif self._next is None:
            self._next = now + self.rng.uniform(*self.hesitates)
        elif now >= self._next:
            asked = port.start_mode != 0
            keys.press(port.number, STOP if asked else START, now, PRESS)
            self._next = now + (STEP_BACK if asked else self.patience)
