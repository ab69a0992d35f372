"""The frames of a virtual SmartEVSE: registers, refusals, silence.

Frames in, frames out, and the devices' time: no wire and no thread, so that it also
works in simulated time.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from .smartevse_frames import (
    READS,
    WRITE_ONE,
    WRITE_SEVERAL,
    Packet,
    decode,
    exception_frame,
    frame,
    read_frame,
    values_frame,
    words,
    write_frame,
    write_several_frame,
)
from .smartevse_history import BalanceBroadcast, Handshake, RegisterWrite
from .smartevse_nodes import Nodes
from .smartevse_outlet import SmartEvseOutlet
from .smartevse_outlet3 import EV_TIMEOUT, SmartEvseOutlet3
from .smartevse_registers import MASTER, NO_CURRENT, NORMAL, SOLAR, Setting
from .smartevse_states import pwm_of

if TYPE_CHECKING:
    from .car import Car
    from .smartevse_registers import Dialect

ILLEGAL_ADDRESS, ILLEGAL_VALUE = 0x02, 0x03
ERROR_BROADCAST = 0x02
ACKNOWLEDGEMENTS = range(0x81, 0x85)
REQUESTS = range(0x01, 0x05)
KELVIN = 273
VOLATILE_MODE_2_17 = 0xA8
# The read of a meter: register and number; each type of meter has its own.
METER_READ = (0, 4)


class SmartEvseController:
    """The controller of one box, with its outlet.

    `override_works`, `ignore_access`: defects, or missing in an earlier firmware.
    `factory_new`: it stored its settings when it was switched on, and reports them as
    changed until a power cycle (2.30 and HEAD, `reads`).
    `receive` takes one frame; after `step`, `sending` has the frames to send.
    `holds_requests`: a request while it measures a cable is answered after that;
    `answers_as_before`: with the state before it (`node_power_cycle` at 4 s, unit 2;
    `node_with_master` at 132.57 s has the one after it).
    """

    def __init__(
        self,
        dialect: Dialect,
        car: Car | None = None,
        *,
        cable: int = 16,
        settings: dict[str, int] | None = None,
        unit: int | None = None,
        serial: int = 1,
        override_works: bool = True,
        factory_new: bool = False,
    ) -> None:
        """Make a controller that was just switched on."""
        self.dialect = dialect
        outlet = SmartEvseOutlet3 if dialect.version3 else SmartEvseOutlet
        self.outlet = outlet(dialect, car, cable=cable, settings=settings)
        self.unit_when_disabled = dialect.unit_when_disabled if unit is None else unit
        self.serial = serial
        self.override_works = override_works
        self.ignore_access = False
        self.now = 0.0
        self.sending: list[bytes] = []
        self.writes: list[RegisterWrite] = []
        self.eeprom_writes: Counter[int] = Counter()
        self.broadcasts: list[BalanceBroadcast] = []
        self.requests_sent: list[Handshake] = []
        self.answers: list[Handshake] = []
        self.slave_requests: list[tuple[int, Handshake]] = []
        self.config_changed = int(factory_new)
        self.nodes = Nodes(dialect, self.outlet)
        self.holds_requests = False
        self.answers_as_before = False
        self.dropped = 0
        self.ignored = 0
        self._last_request: tuple[int, int] | None = None
        self._held: Packet | None = None
        self._held_answer: bytes | None = None

    @property
    def unit(self) -> int:
        """Return its address: the load-balance setting, if load balancing is on."""
        return self.outlet.load_balance or self.unit_when_disabled

    def power_cycle(self) -> None:
        """Lose power for a moment: access open again, override and errors gone."""
        self.outlet.power_up()
        self.sending.clear()
        self.config_changed = 0
        self._last_request = None
        self._held = self._held_answer = None

    def step(self, now: float) -> None:
        """Advance to `now`; the frames to send are then in `sending`."""
        self.now = now
        out = self.outlet
        cycles = out.cycles
        out.step(now)
        if not out.measuring_cable:
            self._answer_held()
        for register, value in out.asked:
            self.requests_sent.append(Handshake(now, register, value))
            self._say_request(write_frame(self.unit, register, value))
        out.asked.clear()
        self._poll()
        error_register = self.dialect.register_of("error")
        for bits in out.error_broadcasts:
            register = error_register if self.dialect.status_writable else 2
            self._say_request(write_frame(self.dialect.broadcast_unit, register, bits))
        out.error_broadcasts.clear()
        if out.load_balance == MASTER and out.cycles != cycles:
            self._broadcast()

    def _poll(self) -> None:
        """Ask meters and nodes, and reply to what those ask for."""
        out = self.outlet
        if isinstance(out, SmartEvseOutlet3):
            for address in out.meters_due:
                self._say_request(read_frame(address, *METER_READ))
            out.meters_due.clear()
        for unit in out.polls_due:
            register, count = self.dialect.polled or (0, 0)
            self._say_request(read_frame(unit, register, count))
        out.polls_due.clear()
        if out.round_begins:
            out.plan_polls(self.nodes.due(), self.now)
        if out.write_due:
            write = (
                self.nodes.next_write(self.now) if out.load_balance == MASTER else None
            )
            if write is not None:
                self._write_to_node(*write)
            out.write_sent(self.now, written=write is not None)

    def _broadcast(self) -> None:
        """As a master: broadcast the charge currents."""
        sharing = self.outlet.sharing
        sharing.currents[0] = self.outlet.current
        if self.dialect.measures:
            self.nodes.measure(self.now)
        self._say_request(
            write_several_frame(
                self.dialect.broadcast_unit,
                self.dialect.balance_register,
                *sharing.currents,
                *[0] * self.dialect.mains_words,
            )
        )

    def _write_to_node(self, unit: int, state: int, error: int) -> None:
        register = self.dialect.register_of("state")
        self._say_request(write_several_frame(unit, register, state, error))

    def _say_request(self, data: bytes) -> None:
        self._last_request = (data[0], data[1])
        self.sending.append(data)

    # Frames

    def receive(self, data: bytes, now: float) -> bytes | None:
        """Take a frame that silence has ended; return the reply, if any.

        A late one is in `sending` later.
        """
        self.step(now)
        packet = decode(data, self.dialect.functions, self.dialect.longest)
        if packet is None or not self._is_request(packet):
            return None
        if self.outlet.load_balance <= MASTER and self.dialect.external_master:
            self.outlet.external_master = 4
        if self.holds_requests and self.outlet.measuring_cable:
            self._hold(packet)
            return None
        answer = self._execute(packet)
        if answer is None:
            self.ignored += 1
        return answer

    def _hold(self, packet: Packet) -> None:
        """Keep a request while it measures a cable, and does nothing else."""
        if self.answers_as_before:
            self._held_answer = self._execute(packet)
        else:
            self._held = packet

    def _answer_held(self) -> None:
        answer, self._held_answer = self._held_answer, None
        packet, self._held = self._held, None
        if packet is not None:
            answer = self._execute(packet)
        if answer is not None:
            self.sending.append(answer)

    def _is_request(self, packet: Packet) -> bool:
        """Return whether it is a request; a reply matches the last request on the bus."""
        if packet.kind == "answer":
            self._take_reply(packet)
            self._last_request = None
            return False
        this = (packet.unit, packet.function)
        if self.dialect.version3:
            # A node looks at the address alone; a master or a disabled one never answers.
            return self.outlet.slave
        broadcast = packet.unit == self.dialect.broadcast_unit
        counts = not broadcast or not self.dialect.status_writable
        if packet.kind == "either" and this == self._last_request and counts:
            self._last_request = None
            exempt = packet.register in REQUESTS or packet.register in ACKNOWLEDGEMENTS
            if self.dialect.status_writable or not exempt:
                self.dropped += 1
                return False
            return True
        self._last_request = this
        return True

    def _take_reply(self, packet: Packet) -> None:
        """Take the reply to a poll of a node, or that of the EV meter."""
        out = self.outlet
        polled = self._last_request == (packet.unit, packet.function)
        if out.load_balance == MASTER and polled and packet.values:
            self.nodes.replied(packet.unit, packet.values, self.now)
        if not isinstance(out, SmartEvseOutlet3) or not packet.values:
            return
        if packet.unit == out.settings["ev_address"]:
            out.ev_timeout = EV_TIMEOUT

    def _execute(self, packet: Packet) -> bytes | None:
        if self._acknowledge(packet):
            return None
        own = packet.unit == self.unit
        if packet.function in READS:
            return self._read(packet) if own else None
        if not own and packet.unit != self.dialect.broadcast_unit:
            return None
        if packet.function == WRITE_SEVERAL and self._balance(packet):
            return None
        if packet.register in self.dialect.silent:
            self._handshake(packet)
            return None
        return self._write(packet)

    def _hidden(self, packet: Packet) -> bool:
        """Return whether the volatile mode makes it ignore the whole request."""
        if self.dialect.gentle or packet.register != VOLATILE_MODE_2_17:
            return False
        return self.outlet.disabled or self.outlet.settings["mode"] == NORMAL

    def _read(self, packet: Packet) -> bytes | None:
        if packet.register in self.dialect.silent or self._hidden(packet):
            return None
        items = self.dialect.find(packet.register, packet.count)
        if items is None:
            return self._refusal(packet, ILLEGAL_ADDRESS)
        values = [self.value_of(item) & 0xFFFF for item in items]
        return values_frame(packet.unit, packet.function, values)

    def _refusal(self, packet: Packet, code: int) -> bytes:
        standard = 0x80 if self.dialect.version3 else 0
        return exception_frame(packet.unit, packet.function | standard, code)

    def value_of(self, item: str | Setting) -> int:
        """Return the value of a register."""
        out = self.outlet
        if isinstance(item, Setting):
            return out.settings[item.name]
        maximum = out.cable_measured
        if not self.dialect.reports_cable:
            maximum = min(out.settings["max_current"], maximum)
        kelvin, access = KELVIN, int(out.access)
        if isinstance(out, SmartEvseOutlet3):
            kelvin = 0 if out.version.celsius else KELVIN
            access = out.access_word
        values = {
            "state": self.dialect.states[out.state],
            "error": out.error,
            "cable": out.cable_measured,
            "maximum": maximum,
            "minimum": out.settings["min_current"],
            "current": out.current,
            "access": access,
            "mode_now": out.settings["mode"],
            "solar_timer": out.solar_timer,
            "config_changed": self.config_changed,
            "phases": out.phases,
            "temperature": out.temperature_measured + kelvin,
            "serial": self.serial,
            "ev_meter_now": out.settings.get("ev_meter", 0),
            "ev_address_now": out.settings.get("ev_address", 0),
        }
        return values.get(item, 0)

    # Writes

    def _write(self, packet: Packet) -> bytes | None:
        if self._hidden(packet):
            return None
        items = self.dialect.find(packet.register, packet.count)
        taken = self._set_all(packet, items or ())
        answered = packet.unit != self.dialect.broadcast_unit or self.outlet.disabled
        self._note(packet, taken, answered=answered)
        if not answered:
            return None
        unit, function = packet.unit, packet.function
        if items is None:
            return self._refusal(packet, ILLEGAL_ADDRESS)
        if not taken:
            return self._refusal(packet, ILLEGAL_VALUE)
        if function == WRITE_ONE:
            return write_frame(unit, packet.register, packet.values[0])
        return frame(unit, function, words(packet.register, taken))

    def _set_all(self, packet: Packet, items: tuple[str | Setting, ...]) -> int:
        """Set these registers, store settings; return the number of values accepted."""
        taken = 0
        stored = False
        for index, (item, value) in enumerate(zip(items, packet.values, strict=False)):
            if not self._set(item, value):
                continue
            taken += 1
            if isinstance(item, Setting):
                stored = True
                self.eeprom_writes[packet.register + index] += 1
        if stored:
            self.outlet.stored = dict(self.outlet.settings)
            self.outlet.open_access()
            self.config_changed = 1
        return taken

    def _note(self, packet: Packet, taken: int, *, answered: bool) -> None:
        self.writes.append(
            RegisterWrite(
                self.now,
                packet.unit,
                packet.function,
                packet.register,
                packet.values,
                taken,
                answered,
            )
        )

    def _set(self, item: str | Setting, value: int) -> bool:
        """Set a register; return whether the box reports it as accepted."""
        out = self.outlet
        if isinstance(item, Setting):
            taken = item.low <= value <= item.high
            if taken:
                out.settings[item.name] = value
        elif item == "current":
            # A 2.17 accepts it, but reports a refusal.
            taken = self.dialect.status_writable
            if self.override_works:
                out.override = value
        elif isinstance(out, SmartEvseOutlet3) and item in ("access", "mode_now"):
            taken = self._set_3(out, item, value)
        elif item == "access":
            taken = value in (0, 1) or self.dialect.status_writable
            if value in (0, 1) and not self.ignore_access:
                out.set_access(bool(value))
        elif item == "mode_now":
            taken = self._set_mode(value)
        else:
            taken = self.dialect.status_writable and self._set_status(item, value)
        return taken

    def _set_3(self, out: SmartEvseOutlet3, item: str, value: int) -> bool:
        """Set access or mode of a 3.x, which answers any value."""
        highest = out.version.highest_access
        if item == "mode_now":
            if value <= SOLAR:
                out.set_mode(value)
        elif highest is None or value <= highest:
            out.set_access(value)
        return True

    def _set_mode(self, value: int) -> bool:
        """Set the mode without storing it."""
        out = self.outlet
        later = self.dialect.status_writable
        if later and (out.disabled or out.settings["mode"] == NORMAL):
            return True
        mode = self.dialect.settings["mode"]
        if not mode.low <= value <= mode.high:
            return False
        out.settings["mode"] = value
        return True

    def _set_status(self, item: str, value: int) -> bool:
        """Set a register that only the master of a later dialect writes."""
        out = self.outlet
        if item == "state" and self.dialect.version3 and value == self.value_of(item):
            return True
        if item == "state":
            names = {code: name for name, code in self.dialect.states.items()}
            state = names.get(value, "A")
            # "Granted": the node makes the transition itself.
            out.go({"F+": "B", "G+": "C"}.get(state, state))
        elif item == "error":
            out.set_error(value)
        elif item == "solar_timer":
            out.solar_timer = value
        elif item == "config_changed":
            self.config_changed = value
        elif item == "phases" and value <= 3 and self.dialect.measures:
            # Only HEAD takes it (2.30: `normal`; 3.x as read).
            out.phases = value
        else:
            return False
        return True

    # Load balancing

    def _balance(self, packet: Packet) -> bool:
        """Take broadcast charge currents; return whether the frame needs no reply."""
        if packet.register != self.dialect.balance_register or not self.outlet.slave:
            return False
        index = self.outlet.load_balance - 1
        if index >= len(packet.values):
            return True
        out = self.outlet
        if not self.dialect.status_writable and packet.unit != 0:
            return True
        self.broadcasts.append(BalanceBroadcast(self.now, packet.values))
        out.current = packet.values[index]
        out.comm_timeout = out.comm_time
        if self.dialect.status_writable and not out.current and out.state == "C":
            out.go("C1" if self.dialect.gentle else "A")
        elif out.state in ("B", "C"):
            out.pilot_current = pwm_of(out.current)
        return True

    def _acknowledge(self, packet: Packet) -> bool:
        """As a master of 2.17: reply to a slave's request; return whether it was one."""
        if self.outlet.load_balance != MASTER or self.dialect.status_writable:
            return False
        slave = MASTER < packet.unit <= self.dialect.units
        if not slave or packet.function != WRITE_ONE or packet.register not in REQUESTS:
            return False
        asked = Handshake(self.now, packet.register, packet.values[0])
        self.slave_requests.append((packet.unit, asked))
        value = self.outlet.sharing.answer(packet.unit, asked.register, asked.value)
        self._say_request(write_frame(packet.unit, 0x80 | asked.register, value))
        return True

    def _handshake(self, packet: Packet) -> None:
        """Take an error broadcast or an acknowledgement: neither has a reply."""
        if packet.function != WRITE_ONE:
            return
        out = self.outlet
        register, value = packet.register, packet.values[0]
        self._note(packet, 1, answered=False)
        if packet.unit == 0 and out.slave and register == ERROR_BROADCAST:
            out.set_error(value)
        if packet.unit != out.load_balance or register not in ACKNOWLEDGEMENTS:
            return
        self.answers.append(Handshake(self.now, register, value))
        if register == ACKNOWLEDGEMENTS[0]:
            out.go("A")
        elif register == ACKNOWLEDGEMENTS[3]:
            out.go("B")
        elif not value:
            out.error |= NO_CURRENT
        elif register == ACKNOWLEDGEMENTS[1]:
            out.enter_b()
            out.pilot_current = pwm_of(value)
        else:
            out.go("C")
            out.pilot_current = pwm_of(value)
