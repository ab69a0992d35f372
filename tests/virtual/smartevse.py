"""A virtual SmartEVSE on the bus: polled, as a slave or node, or as a master."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from .device import Device, on_bus_thread
from .smartevse_controller import SmartEvseController
from .smartevse_frames import ANSWER_SILENCE, FRAME_GAP, WRITE_ONE
from .smartevse_outlet3 import SmartEvseOutlet3
from .smartevse_registers import DIALECTS, NORMAL, Dialect

if TYPE_CHECKING:
    import asyncio
    from collections import Counter

    from .car import Car
    from .smartevse_history import BalanceBroadcast, Handshake, RegisterWrite
    from .smartevse_outlet import SmartEvseOutlet
    from .wire import Segment

# Beyond the silence before a reply, so that the turn-round time counts.
EPSILON = 0.0001
# Spread of the boxes' detection of a silence, s.
SPREAD = 0.004


class SmartEvse(Device):
    """A SmartEVSE; `controller` handles its frames, `outlet` has its states.

    - `dialect`: a key of `DIALECTS`, or one of your own; `load_balance`: 0 off, 1
      master, else a slave and its unit; `unit`: its address with load balancing off, if
      not the default of the dialect
    - `config`: "socket" (with a `cable` of 13, 16, 32 or 63 A) or "fixed"
    - `override_works`: False: a 2.17 before the override: refused, no effect
    - `settings`: further stored settings by name, see `smartevse_registers`
    - `late_answers`: a request while it measures a cable is answered after that
    """

    baud: ClassVar[int] = 9600
    parity: ClassVar[str] = "N"
    protocol: ClassVar[str] = "smartevse"

    def __init__(
        self,
        dialect: str | Dialect = "2.17",
        *,
        load_balance: int = 0,
        car: Car | None = None,
        config: Literal["socket", "fixed"] = "socket",
        cable: int = 16,
        max_current: int = 13,
        min_current: int = 6,
        mode: int = NORMAL,
        serial: int = 1,
        unit: int | None = None,
        override_works: bool = True,
        settings: dict[str, int] | None = None,
        turn_round: float = 0.01,
        jitter: float = 0.06,
        late_answers: bool = True,
        name: str = "",
    ) -> None:
        """Make a box that is switched on when the bus starts."""
        stored = {
            "load_balance": load_balance,
            "config": int(config == "fixed"),
            "max_current": max_current,
            "min_current": min_current,
            "mode": mode,
            **(settings or {}),
        }
        self.controller = SmartEvseController(
            DIALECTS[dialect] if isinstance(dialect, str) else dialect,
            car,
            cable=cable,
            settings=stored,
            unit=unit,
            serial=serial,
            override_works=override_works,
        )
        self.controller.holds_requests = late_answers
        super().__init__(name or f"smartevse-{self.controller.unit}")
        self.turn_round = turn_round
        self.jitter = jitter
        self.unasked = 0
        self._received = bytearray()
        self._received_until = float("-inf")
        self._frame_timer: asyncio.TimerHandle | None = None

    # For tests: state

    @property
    def outlet(self) -> SmartEvseOutlet:
        """Return its outlet."""
        return self.controller.outlet

    @property
    def car(self) -> Car | None:
        """Return its car, plugged in or not."""
        return self.outlet.car

    @property
    def unit(self) -> int:
        """Return its address now."""
        return self.controller.unit

    @property
    def state(self) -> str:
        """Return the state: A to D, E to H waiting for a master, T, B1, C1."""
        return self.outlet.state

    @property
    def serial(self) -> int:
        """Return the serial number; only the later dialect reports it."""
        return self.controller.serial

    @serial.setter
    def serial(self, serial: int) -> None:
        self.controller.serial = serial

    @property
    def access(self) -> bool:
        """Return whether it may charge."""
        return self.outlet.access

    @property
    def error(self) -> int:
        """Return the error bits."""
        return self.outlet.error

    @property
    def contactor(self) -> bool:
        """Return whether the contactor is closed: the car has voltage."""
        return self.outlet.contactor

    @property
    def pilot_current(self) -> float:
        """Return the current that the pilot offers, A; 0 without PWM."""
        return self.outlet.pilot_current

    @property
    def car_current(self) -> float:
        """Return the current that the car draws, A per phase."""
        return self.outlet.car_current

    @property
    def writes(self) -> list[RegisterWrite]:
        """Return all well-formed writes, oldest first."""
        return self.controller.writes

    @property
    def eeprom_writes(self) -> Counter[int]:
        """Return the number of EEPROM writes of each register."""
        return self.controller.eeprom_writes

    @property
    def flash_writes(self) -> int:
        """Return how often a 3.x has stored its access."""
        outlet = self.outlet
        return outlet.flash_writes if isinstance(outlet, SmartEvseOutlet3) else 0

    @property
    def broadcasts(self) -> list[BalanceBroadcast]:
        """Return the charge currents received as a slave."""
        return self.controller.broadcasts

    @property
    def requests_sent(self) -> list[Handshake]:
        """Return the requests to its master (01 to 04)."""
        return self.controller.requests_sent

    @property
    def answers(self) -> list[Handshake]:
        """Return the acknowledgements received (81 to 84)."""
        return self.controller.answers

    def stats(self) -> dict[str, object]:
        """Return the counters."""
        controller = self.controller
        return {
            **super().stats(),
            "unasked": self.unasked,
            "dropped": controller.dropped,
            "ignored": controller.ignored,
            "writes": len(controller.writes),
            "eeprom_writes": sum(controller.eeprom_writes.values()),
            "flash_writes": self.flash_writes,
            "broadcasts": len(controller.broadcasts),
            "state": self.state,
            "error": self.error,
            "access": self.access,
            "contactor": self.contactor,
            "pilot_current": self.pilot_current,
            "car_current": round(self.car_current, 2),
        }

    # For tests: events

    @on_bus_thread
    def press_access(self) -> None:
        """Press the button, or move the switch, at the box; see setting `switch`."""
        self.outlet.press()

    @on_bus_thread
    def power_cycle(self) -> None:
        """Lose power for a moment: what is volatile is gone, the override too."""
        self.controller.power_cycle()

    @on_bus_thread
    def set_by_other_master(self, amps: float) -> None:
        """Override the charging current (A) as another client would; 0 ends it."""
        self.outlet.override = round(amps * 10)

    @on_bus_thread
    def set_at_the_box(self, name: str, value: int) -> None:
        """Change a stored setting in the box's own menu."""
        setting = self.controller.dialect.settings[name]
        if not setting.low <= value <= setting.high:
            msg = f"{name} is {setting.low} to {setting.high}"
            raise ValueError(msg)
        self.outlet.settings[name] = value
        self.outlet.stored[name] = value
        self.outlet.open_access()

    # On the bus

    def step(self) -> None:
        """Bring the box up to now; send its unsolicited frames."""
        self.controller.step(self.now())
        self._speak()

    def _speak(self) -> None:
        bus, sending = self.bus, self.controller.sending
        while sending and bus is not None:
            data = sending.pop(0)
            # Real boxes do not run in step, as our ticks do, and do not detect the same
            # silence at the same moment.
            # A late answer has waited long enough.
            asks = data[0] == self.unit and data[1] == WRITE_ONE
            wait = bus.rng.random() * self.jitter if asks else 0.0
            silence = ANSWER_SILENCE + EPSILON + bus.rng.random() * SPREAD
            self.unasked += 1
            self.send(data, wait, silence)

    def receive(self, segment: Segment) -> None:
        """Receive bytes: more than 3 ms of silence end a frame."""
        bus = self.bus
        if bus is None:
            return
        if self._frame_timer is not None:
            self._frame_timer.cancel()
            self._frame_timer = None
        if self._received and segment.start - self._received_until > FRAME_GAP:
            self._take_frame()
        self._received += segment.data
        self._received_until = segment.end
        self._frame_timer = bus.loop.call_at(
            segment.end + FRAME_GAP + EPSILON, self._frame_over
        )

    def _frame_over(self) -> None:
        self._frame_timer = None
        bus = self.bus
        if bus is None:
            return
        # Bytes arrive in whole runs: a run that has begun meanwhile belongs to this
        # frame if it began in time.
        if not bus.wire.begun_before(self._received_until + FRAME_GAP, self.name):
            self._take_frame()

    def _take_frame(self) -> None:
        longest = self.controller.dialect.longest
        data, self._received = bytes(self._received[: longest + 1]), bytearray()
        ended = self._received_until
        answer = self.controller.receive(data, self.now())
        self._speak()
        if answer is None or self.bus is None:
            return
        self.requests += 1
        wait = max(0.0, ended + self.turn_round - self.bus.time())
        self.send(answer, wait, ANSWER_SILENCE + EPSILON)
