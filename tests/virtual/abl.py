"""A virtual ABL EVCC2/3 on the bus, from the manual and the bytes of real boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

from .abl_frames import (
    BROADCAST,
    FAILURE,
    READ,
    WRITE,
    WRITE_FAILED,
    LineFinder,
    Request,
    line,
    twin_errors,
)
from .abl_outlet import Outlet
from .abl_registers import BLOCKS, BROADCAST_READS, EXTRA_BLOCKS, ICMAX_BLOCK
from .device import Device, on_bus_thread

if TYPE_CHECKING:
    from .car import Car
    from .wire import Segment

STATE = 0x05
CONFIGURATION = 0x2C
WRITABLE = frozenset({STATE, 0x14, CONFIGURATION})
RESET = 0x5A5A
LAST_ID = 16
FIELD_ON, FIELD_OFF = 0b10, 0b01


@dataclass(frozen=True, slots=True)
class Write:
    """A write received by the box: its real time, its value, and its outcome.

    `plugged`: a car was plugged in, whatever the state showed of it.
    """

    t: float
    register: int
    value: int
    accepted: bool
    broadcast: bool
    plugged: bool = False


class AblBox(Device):
    """An ABL wallbox; `outlet` has its states, limits, meter and car.

    - `device_id`: 1 to 16; `serial`: 14 characters
    - `writes`: every well-formed write
    - `answer_register`: sent in place of the right register number (a defect)
    - `unreadable_in_b2`: reports 0x3E8 also in B2
    - `l3_first`: L1 in the third word, as all public one-phase loads [trace, notes]
    - `tells_icmax`: answers 0x0F; every box in use with the programs that read it does
    - `sleep_after` (s, None = never), `wake_time`, `wakes_on`: see the README
    - `lost_asleep_each`: requests lost in each sleep: one [trace], several [some say]
    - `stray`: bytes before the first reply after a sleep [code of two projects]

    Setting a device-ID: one program does it, no trace shows it. No source settles:
    - `id_applies`: a written ID counts after the "reset", or from the "write" on
    - `id_confirmed_from`: the ID in the reply to a write that counts at once
    - `id_kept_without_power`: a written ID waits for the power to come back
    - `outside_e2`: a write of 0x2C outside E2 is "refused", or "ignored"
    - `reset_answer`: "before" the reset, "after" it (from the ID it then has), "never"
    - `boot_time`: how long it is deaf after a reset, s
    - `reads_in_e2`: in E2 it answers reads
    """

    parity: ClassVar[str] = "E"
    protocol: ClassVar[str] = "abl"

    def __init__(
        self,
        device_id: int = 1,
        *,
        car: Car | None = None,
        serial: str = "2W22xy01234567",
        default_current: float = 16.0,
        cable_current: float | None = None,
        meter: bool = True,
        upstream_enabled: bool = False,
        upstream_timeout: float = 30.0,
        enable_input: int = 0,
        sleep_after: float | None = None,
        wake_time: float = 0.3,
        wakes_on: Literal["any", "own"] = "any",
        extra_registers: bool = False,
        tells_icmax: bool = True,
        turn_round: float = 0.002,
        jitter: float = 0.0005,
        boot_time: float = 0.3,
        firmware: tuple[int, int] = (1, 2),
        hardware: int = 0b01,
        name: str = "",
    ) -> None:
        """Make a box without a car."""
        super().__init__(name or f"abl-{device_id}")
        self.device_id = device_id
        self.serial = serial
        self.outlet = Outlet(
            car,
            default_current=default_current,
            cable_current=cable_current,
            meter=meter,
            upstream_enabled=upstream_enabled,
            upstream_timeout=upstream_timeout,
            enable_input=enable_input,
        )
        self.faults.twin = twin_errors
        self.firmware = firmware
        self.hardware = hardware
        self.coding_resistor = cable_current is not None
        self.rdc_md = True
        self.welding_detection = True
        self.sleep_after = sleep_after
        self.wake_time = wake_time
        self.wakes_on = wakes_on
        self.extra_registers = extra_registers
        self.tells_icmax = tells_icmax
        self.icmax_byte = 0x3F
        self.lost_asleep_each = 1
        self.stray = b""
        self.turn_round = turn_round
        self.jitter = jitter
        self.boot_time = boot_time
        self.answer_register: int | None = None
        self.unreadable_in_b2 = False
        self.l3_first = True
        self.on = True
        self.id_applies: Literal["reset", "write"] = "reset"
        self.id_confirmed_from: Literal["old", "new"] = "old"
        self.id_kept_without_power = True
        self.outside_e2: Literal["refused", "ignored"] = "refused"
        self.reset_answer: Literal["before", "after", "never"] = "before"
        self.reads_in_e2 = True
        self.writes: list[Write] = []
        self.refused = 0
        self.ignored = 0
        self.lost_asleep = 0
        self.resets = 0
        self._finder = LineFinder()
        self._deaf_until = float("-inf")
        self._active_at: float | None = None
        self._still_lost = 0
        self._woken = False
        self._configuration = 0
        self._id_before = 0
        self._contacted = False

    # For tests

    @property
    def state(self) -> str:
        """Return the name of the state: A1, B2, C2, E0, F4..."""
        return self.outlet.state

    @property
    def ic_amps(self) -> float:
        """Return the current the car may draw, A per phase (0 = pause)."""
        return self.outlet.ic_amps

    @property
    def asleep(self) -> bool:
        """Return whether the next request will be lost."""
        if self.sleep_after is None:
            return False
        if self._active_at is None or self._still_lost:
            return True
        return self.now() - self._active_at > self.sleep_after

    @property
    def limits_written(self) -> list[int]:
        """Return the values of 0x14 that were accepted, oldest first."""
        return [w.value for w in self.writes if w.register == 0x14 and w.accepted]

    @on_bus_thread
    def power_cycle(self) -> None:
        """Lose power for a moment: Icmax is Idefault again."""
        self._power_up()

    @on_bus_thread
    def switch_off(self) -> None:
        """Take the power away: it receives and sends nothing."""
        self.on = False

    @on_bus_thread
    def switch_on(self) -> None:
        """Give it power again."""
        if not self.on:
            self.on = True
            self._power_up()

    @on_bus_thread
    def stop_locally(self) -> None:
        """Disable the outlet, as by a key switch: E0."""
        self.outlet.stop_locally()

    @on_bus_thread
    def start_locally(self) -> None:
        """Enable the outlet again at the box."""
        self.outlet.start_locally()

    @on_bus_thread
    def fail(self, number: int) -> None:
        """Go to failure F<number>."""
        self.outlet.fail(number)

    @on_bus_thread
    def clear_failure(self) -> None:
        """Leave a failure."""
        self.outlet.clear_failure()

    @on_bus_thread
    def set_by_other_master(self, amps: float) -> None:
        """Set Icmax as another master would."""
        self.outlet.set_by_other_master(amps)

    def stats(self) -> dict[str, object]:
        """Return the counters."""
        return {
            **super().stats(),
            "bad_frames": self._finder.bad,
            "refused": self.refused,
            "ignored": self.ignored,
            "lost_asleep": self.lost_asleep,
            "writes": len(self.writes),
            "state": self.state,
            "ic_amps": round(self.ic_amps, 2),
            "device_id": self.device_id,
            "on": self.on,
        }

    # On the bus

    def step(self) -> None:
        """Bring the outlet up to now."""
        now = self.now()
        if not self._contacted:
            # The time without polling counts from power-up.
            self._contacted = True
            self.outlet.contact(now)
        self.outlet.step(now)

    def receive(self, segment: Segment) -> None:
        """Receive bytes; reply to a request addressed to this box."""
        if not self.on or segment.end <= self._deaf_until:
            return
        asleep = self.asleep
        if self.wakes_on == "any":
            self._active_at = self.now()
            if asleep:
                self._wake(segment)
                return
        for request in self._finder.feed(segment):
            if request.device_id not in (self.device_id, BROADCAST):
                continue
            self._active_at = self.now()
            if asleep:
                self._wake(segment)
                return
            self.requests += 1
            self.step()
            self.outlet.contact(self.now())
            answer = self._answer(request)
            if answer is None:
                self.ignored += 1
            else:
                if self._woken:
                    answer = self.stray + answer
                self._woken = False
                wait = self.turn_round
                if self.bus is not None:
                    wait += self.bus.rng.random() * self.jitter
                self.send(answer, wait)

    def _wake(self, segment: Segment) -> None:
        self.lost_asleep += 1
        if self._still_lost:
            self._still_lost -= 1
        else:
            self._still_lost = self.lost_asleep_each - 1
        self._woken = True
        self._deaf_until = segment.end + self.wake_time

    def _answer(self, request: Request) -> bytes | None:
        """Return the reply, or None for silence (manual, 1.4.3)."""
        if request.function == READ:
            return self._read(request)
        if request.function != WRITE:
            return None
        value = request.value
        if value is None or request.register not in WRITABLE:
            return None
        return self._answer_write(request, value)

    def _answer_write(self, request: Request, value: int) -> bytes | None:
        register, own_id = request.register, request.device_id
        car = self.outlet.car
        plugged = car is not None and car.plugged
        accepted = self._write(register, value)
        broadcast = own_id == BROADCAST
        self.writes.append(
            Write(request.t, register, value, accepted, broadcast, plugged)
        )
        self.refused += not accepted
        self.step()
        ignored = register == CONFIGURATION and self.outside_e2 == "ignored"
        if broadcast or (not accepted and ignored):
            return None
        if not accepted:
            return line(">", bytes((own_id, FAILURE, WRITE_FAILED)))
        if (register, value) == (STATE, RESET):
            return self._reset_answer(request)
        if register == CONFIGURATION and self.id_confirmed_from == "new":
            own_id = self.device_id
        return line(">", bytes((own_id, WRITE)) + request.data[:4])

    def _reset_answer(self, request: Request) -> bytes | None:
        """Return the reply to a reset, or None where it comes later or never."""
        confirmation = bytes((WRITE,)) + request.data[:4]
        if self.reset_answer == "before":
            return line(">", bytes((request.device_id,)) + confirmation)
        if self.reset_answer == "after" and self.bus is not None:
            self.bus.loop.call_later(
                self._answer_time + self.boot_time + self.turn_round,
                self._send_late,
                confirmation,
            )
        return None

    def _send_late(self, confirmation: bytes) -> None:
        if self.on:
            self.send(line(">", bytes((self.device_id,)) + confirmation), 0.0)

    def _read(self, request: Request) -> bytes | None:
        blocks = dict(BLOCKS)
        if self.tells_icmax:
            blocks |= ICMAX_BLOCK
        if self.extra_registers:
            blocks |= EXTRA_BLOCKS
        quantity, content = blocks.get(request.register, (None, None))
        if len(request.data) != 4 or request.quantity != quantity or not content:
            return None
        broadcast = request.device_id == BROADCAST
        if broadcast and request.register not in BROADCAST_READS:
            return None
        if self.outlet.state == "E2" and not self.reads_in_e2:
            return None
        number = request.register
        if self.answer_register is not None:
            number = self.answer_register
        data = bytes((number,)) + content(self)
        return line(">", bytes((self.device_id, READ, len(data))) + data)

    def _write(self, register: int, value: int) -> bool:
        if register == 0x14:
            return self.outlet.write_icmax(value, self.now())
        if register == CONFIGURATION:
            return self._configure(value)
        return self._modify_state(value)

    def _configure(self, value: int) -> bool:
        """Store a new ID and settings; the settings take effect after a reset."""
        if self.outlet.state != "E2" or value & 0x0F00:
            return False
        if not 1 <= value & 0xFF <= LAST_ID:
            return False
        self._configuration = value
        self._id_before = self._id_before or self.device_id
        if self.id_applies == "write":
            self.device_id = value & 0xFF
        return True

    def _modify_state(self, value: int) -> bool:
        """Execute a value of register 0x05 if the state allows it."""
        if value == RESET:
            # The reset begins after the reply.
            self._schedule_reset()
            return True
        return self.outlet.execute(value)

    @property
    def _answer_time(self) -> float:
        """Return the time after which the reply to a request is over, s."""
        byte_time = self.bus.byte_time if self.bus is not None else 0.0
        return self.turn_round + self.jitter + 20 * byte_time

    def _schedule_reset(self) -> None:
        if self.bus is not None:
            self.bus.loop.call_later(self._answer_time, self._reset)

    def _reset(self) -> None:
        if not self.on:
            return
        self.resets += 1
        if configuration := self._configuration:
            self.device_id = configuration & 0xFF
            upstream = configuration >> 14
            if upstream in (FIELD_ON, FIELD_OFF):
                self.outlet.upstream_enabled = upstream == FIELD_ON
            enable = configuration >> 12 & 0b11
            if enable in (FIELD_ON, FIELD_OFF):
                self.outlet.b2_needs_enable_after_power = enable == FIELD_ON
        self._boot()

    def _power_up(self) -> None:
        if self._configuration and self.id_kept_without_power:
            self._reset()
        else:
            self.resets += 1
            self.device_id = self._id_before or self.device_id
            self._boot()

    def _boot(self) -> None:
        self._configuration = self._id_before = 0
        if self.bus is None:
            return
        self._finder = LineFinder()
        self._deaf_until = self.bus.time() + self.boot_time
        self.outlet.restart(self.now())
