"""A SmartEVSE without wire and thread: frames in, frames out, in simulated time.

For tests of its behaviour; minutes take milliseconds.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .smartevse_controller import SmartEvseController
from .smartevse_frames import (
    WRITE_ONE,
    exception_frame,
    frame,
    read_frame,
    words,
    write_frame,
    write_several_frame,
)
from .smartevse_registers import DIALECTS, Dialect

if TYPE_CHECKING:
    from .car import Car
    from .smartevse_outlet import SmartEvseOutlet

STEP = 0.01
ANSWER_HEAD = 3


class SmartEvseAlone:
    """A box alone: `now` in s, `sent`: unsolicited frames and their times."""

    def __init__(
        self,
        dialect: str | Dialect = "2.17",
        car: Car | None = None,
        *,
        cable: int = 16,
        unit: int | None = None,
        override_works: bool = True,
        serial: int = 1,
        factory_new: bool = False,
        **settings: int,
    ) -> None:
        """Switch it on."""
        self.box = SmartEvseController(
            DIALECTS[dialect] if isinstance(dialect, str) else dialect,
            car,
            cable=cable,
            unit=unit,
            override_works=override_works,
            serial=serial,
            factory_new=factory_new,
            settings=settings,
        )
        self.now = 0.0
        self.sent: list[tuple[float, bytes]] = []
        self.box.step(self.now)

    @property
    def outlet(self) -> SmartEvseOutlet:
        """Return its outlet."""
        return self.box.outlet

    @property
    def state(self) -> str:
        """Return the state."""
        return self.box.outlet.state

    def live(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now = min(end, self.now + STEP)
            self.box.step(self.now)
            self._collect()

    def pilot(self, volts: int, seconds: float = 0.5) -> None:
        """Set the voltage of the pilot, and wait."""
        self.outlet.pilot_voltage = volts
        self.live(seconds)

    def receive(self, data: bytes) -> bytes | None:
        """Send it a frame; return its reply."""
        answer = self.box.receive(data, self.now)
        self._collect()
        return answer

    def read(self, register: int, count: int = 1, function: int = 4) -> list[int]:
        """Read registers; the list is empty for silence and for refusals."""
        answer = self.receive(read_frame(self.box.unit, register, count, function))
        if answer is None or answer[2] != 2 * count:
            return []
        body = answer[ANSWER_HEAD:-2]
        pairs = range(0, len(body), 2)
        return [int.from_bytes(body[i : i + 2], "big") for i in pairs]

    def write(self, register: int, *values: int, function: int = 16) -> str:
        """Write registers; return "ok", "silence" or "refused 2"."""
        unit = self.box.unit
        if function == WRITE_ONE:
            request = good = write_frame(unit, register, values[0])
        else:
            request = write_several_frame(unit, register, *values)
            good = frame(unit, function, words(register, len(values)))
        answer = self.receive(request)
        if answer is None:
            return "silence"
        if answer == good:
            return "ok"
        for code in range(1, 5):
            if answer in (
                exception_frame(unit, function, code),
                exception_frame(unit, function | 0x80, code),
            ):
                return f"refused {code}"
        return answer.hex()

    def _collect(self) -> None:
        self.sent += [(self.now, data) for data in self.box.sending]
        self.box.sending.clear()
