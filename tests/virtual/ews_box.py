"""A virtual P-CHARGE EWS-Box, written from the manual."""

from __future__ import annotations

from dataclasses import asdict
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, ClassVar, Literal

from .ews_commands import COMMANDS, WRITING
from .ews_frames import ANSWER, COMMAND, INFO, RS232_TIMEOUT, FrameReader, frame
from .ews_interaction import EwsInteraction
from .ews_io import UserInterface
from .ews_parameters import (
    CableMode,
    CardList,
    ExtraConfiguration,
    Masking,
    SystemMode,
    SystemParameters,
    UserInfo,
    UserParameters,
)
from .ews_port import EwsPort
from .ews_records import (
    EwsCommand,
    EwsInfo,
    EwsLimit,
    mixed,
    with_false_length,
)
from .ews_rfid import Reader
from .ews_session import Result
from .ews_states import Installation, Status
from .ews_status import clock_fields
from .log import CLIENT

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from .car import Car
    from .ews_driver import Driver
    from .ews_frames import Bcc, Message
    from .wire import Segment

COMMAND_TIMEOUT = 30.0
SERVER_TIMEOUT = 600.0
POWER_BACKUP_TIME = 260.0
POWER_UP_CLOCK = datetime(2000, 1, 1)  # noqa: DTZ001 - the box has no zone
# Change bits: bit 2 is car 1, bit 1 car 2, bit 0 the card.
CAR_BITS = (0b100, 0b010)


class EwsBox(EwsInteraction):
    """An EWS-Box with two charging ports (`ports[0]` is car 1).

    - `commands`, `writes`, `currents_set`, `infos`: commands received, records sent
    - `mode`, `rfid`, `manual_io`, `exclusive`: the system mode; see also `system`,
      `user`, `user_info`, `extra`, `cards`: the stored parameters
    - `drivers`: people that press the start key when their cars request charge
    - `masking`: how `rp` and `ru` hide passwords; `bcc`: how it counts the BCC
    - `ignores_limits`: accepts `st` without effect; `clamps_limits`: accepts one that is
      too high as the highest possible; `unanswered`: commands without an answer
    - `restart_flag_until`: the event that clears bit 0 of `rs`: "read", "clock", "never"
    """

    baud: ClassVar[int] = 115200
    protocol: ClassVar[str] = "ews"
    duplex: ClassVar[bool] = True

    def __init__(
        self,
        *,
        serial: str = "012345678901",
        cars: Sequence[Car | None] = (None, None),
        jumper: int = 32,
        mode: Literal["server", "standalone"] = "server",
        bcc: Bcc = "all",
        ports: int = 2,
        rfid: bool = False,
        manual_io: bool = False,
        exclusive: bool = False,
        fixed_cable: bool = False,
        mode1: tuple[bool, bool] = (False, False),
        fan: bool = False,
        restart_after_power: bool = False,
        max_current: int = 0,
        masking: Masking = "no",
        power_backup: bool = False,
        init_time: float = 1.0,
        firmware: str = "M165300103",
        restart_flag_until: Literal["read", "clock", "never"] = "read",
        turn_round: float = 0.002,
        jitter: float = 0.001,
        name: str = "",
    ) -> None:
        """Make a box that is switched on and ready."""
        super().__init__(name or f"ews-{serial}")
        self.serial = serial
        self.jumper = jumper
        self.masking = masking
        self.power_backup = power_backup
        self.init_time = POWER_BACKUP_TIME if power_backup else init_time
        self.firmware = firmware.encode("ascii").ljust(11, b"\x00")[:11]
        self.mac = bytes.fromhex("0004a3") + int(serial).to_bytes(8, "big")[-3:]
        self.restart_flag_until = restart_flag_until
        self.turn_round = turn_round
        self.jitter = jitter
        self.lease = 0
        self.rd_extra = b""
        self.clock_survives = False
        self.ignores_limits = self.clamps_limits = False
        self.unanswered: set[str] = set()
        self.system = SystemParameters.of(
            server=mode == "server",
            rfid=rfid,
            manual_io=manual_io,
            exclusive=exclusive,
            fixed_cable=fixed_cable,
            mode1=mode1,
            ports=ports,
            fan=int(fan),
            max_current=max_current,
            restart_after_power=int(restart_after_power),
        )
        self.user = UserParameters()
        self.user_info = UserInfo()
        self.extra = ExtraConfiguration()
        self.cards = CardList()
        self.reader = Reader()
        self.drivers: list[Driver] = []
        two = [*cars, None, None][:2]
        self.ports = (EwsPort(1, two[0]), EwsPort(2, two[1]))
        for port, bit in zip(self.ports, CAR_BITS, strict=True):
            port.on_event = self._port_event(bit)
            port.clock = lambda: clock_fields(self.clock())
        self.user_interface = UserInterface(
            self.ports, self.system, self.reader, self.cards, self._event
        )
        # The network side, set by a dialler.
        self.network = False
        self.link_up = False
        self.on_power: Callable[[bool], None] = lambda _on: None
        self.frames = FrameReader(RS232_TIMEOUT, bcc)
        self._bits = 0
        self._keys: dict[int, int] = {}
        self._clock = (0.0, POWER_UP_CLOCK)
        self._received_at = 0.0
        self._timed_out_at: dict[int, float] = {}
        self.take_parameters()

    # For tests

    @property
    def bcc(self) -> Bcc:
        """Return the bytes that the BCC covers."""
        return self.frames.bcc

    @bcc.setter
    def bcc(self, bcc: Bcc) -> None:
        """Let it cover other bytes from now on."""
        self.frames.bcc = bcc

    @property
    def initialising(self) -> bool:
        """Return whether it is in 0xF0."""
        return self.ports[0].status == Status.INIT

    @property
    def server_connected(self) -> bool:
        """Return whether it counts as connected: by TCP, or by commands."""
        if self.network:
            return self.link_up
        return self.requests > 0 and self.silent_for < COMMAND_TIMEOUT

    @property
    def silent_for(self) -> float:
        """Return the time since the last command, s."""
        return self.now() - self._received_at

    @property
    def card_counts_as_valid(self) -> bool:
        """Return the flag of `rs`; over Ethernet the card is not checked."""
        card = self.reader.noted
        if card is None or self.network:
            return card is not None
        return self.reader.accepted or (
            self.reader.valid and self.cards.allows(card.group, card.number)
        )

    def clock(self) -> datetime:
        """Return its local time."""
        at, base = self._clock
        return base + timedelta(seconds=self.now() - at)

    def commands_named(self, *names: str) -> list[EwsCommand]:
        """Return the commands of these names, oldest first."""
        return [c for c in self.commands if c.name in names]

    def stats(self) -> dict[str, object]:
        """Return the counters."""
        return {
            **super().stats(),
            **asdict(self.frames.counters),
            "writes": len(self.writes),
            "infos": len(self.infos),
            "restarts": self.restarts,
            "server_timeouts": self.server_timeouts,
            "status": [port.status for port in self.ports],
            "unlocked_while_car_wants": sum(
                len(port.unlocked_while_car_wants) for port in self.ports
            ),
        }

    # On the bus

    def step(self) -> None:
        """Bring the ports up to now; check the server time-out."""
        now = self.now()
        if self._power_on_at is not None and now >= self._power_on_at:
            self._power_on_at = None
            self._boot()
        if self.powered:
            for driver in self.drivers:
                driver.step(now, self.user_interface)
            self.user_interface.step(now)
            self._block_ports()
            self._watch_server(now)
        for port in self.ports:
            port.step(now)
        self._tell_events()

    def receive(self, segment: Segment) -> None:
        """Receive bytes; answer commands."""
        if not self.powered or segment.sources != (CLIENT,):
            return
        for message in self.frames.feed(segment):
            if message.msgid == COMMAND and len(message.parameters) >= 2:
                self._command(message)

    def link_changed(self, *, up: bool) -> None:
        """Take note that the TCP connection is up or down (called by a dialler)."""
        self.link_up = up
        self.frames.reset()
        if up:
            self._tell_events()

    # For the commands

    def take_parameters(self) -> None:
        """Pass the parameters on to the ports."""
        system = self.system
        limits = (system.max_current, self.extra.max_current_2 or system.max_current)
        for port in self.ports:
            index = port.number - 1
            port.installation = Installation(
                enabled=port.number <= system.ports,
                jumper=self.jumper,
                limit=limits[index],
                fixed_cable=bool(system.cable_mode & CableMode.FIXED),
                mode1=bool(system.cable_mode & CableMode.PORT_MODE1[index]),
                fan=bool(system.fan),
            )

    def initialise(self) -> None:
        """Go through the initialisation, as after `sp`."""
        self.take_parameters()
        for port in self.ports:
            port.initialise(self.now(), self.init_time)

    def set_clock(self, now: datetime) -> None:
        """Set the clock."""
        self._clock = (self.now(), now)

    def limit_sent(self, port: int, amps: int, *, accepted: bool) -> None:
        """Record an `st`."""
        self.currents_set.append(EwsLimit(self._time(), port, amps, accepted))

    def reset_after_answer(self) -> None:
        """Reset the processor as soon as the answer was sent."""
        if self.bus is not None:
            out = self.turn_round + self.jitter + 20 * self.bus.byte_time
            self.bus.loop.call_later(out, self._reset)

    # Inside

    def _time(self) -> float:
        return self.bus.time() if self.bus is not None else 0.0

    def _command(self, message: Message) -> None:
        self.requests += 1
        self._received_at = self.now()
        self.step()
        handler = COMMANDS.get(message.name)
        answer = None
        if handler is not None and message.name not in self.unanswered:
            answer = handler(self, message.data)
        received = EwsCommand(message.t, self.now(), message.name, message.data, answer)
        self.commands.append(received)
        if message.name in WRITING:
            self.writes.append(received)
        if answer is not None:
            self._answer(message.parameters[:2] + answer)
        self.step()

    def _answer(self, parameters: bytes) -> None:
        if self.bus is None:
            return
        data = frame(ANSWER, parameters, self.bcc)
        if self._false_lengths:
            difference = self._false_lengths.pop(0)
            data = with_false_length(parameters, difference, self.bcc)
        self._send_rest()
        wait = self.turn_round + self.bus.rng.random() * self.jitter
        mix = self._mixes.pop(0) if self._mixes else None
        if mix is None:
            self.send(data, wait)
            return
        record = b"" if mix.where == "none" else self._record(mix.bits, {})
        first, rest = mixed(data, record, mix)
        self.replies += 1
        self.bus.loop.call_later(wait, self._send_cut, first, rest, mix.pause)

    def _record(self, bits: int, keys: dict[int, int]) -> bytes:
        key_bytes = bytes(keys.get(index, 0) for index in range(8))
        self.infos.append(EwsInfo(self._time(), bits, key_bytes))
        return frame(INFO, b"if" + bytes((bits,)) + key_bytes, self.bcc)

    def _port_event(self, bit: int) -> Callable[[], None]:
        return lambda: self._event(bit, {})

    def _event(self, bits: int, keys: dict[int, int]) -> None:
        """Add an event to the next info record."""
        self._bits |= bits
        self._keys.update(keys)

    def _tell_events(self) -> None:
        """Send the pending events, if the server is connected."""
        if not (self._bits or self._keys) or self.bus is None or not self.powered:
            return
        if not self.system.has(SystemMode.SERVER):
            self._bits, self._keys = 0, {}
            return
        over_network = not self.system.has(SystemMode.RS232)
        if over_network != self.network or (self.network and not self.link_up):
            return
        bits, self._bits = self._bits, 0
        keys, self._keys = self._keys, {}
        self.send_raw(self._record(bits, keys))

    def _block_ports(self) -> None:
        """Let the port in use block the other one; check for the reader."""
        exclusive = self.system.has(SystemMode.EXCLUSIVE) and self.system.ports == 2
        missing = self.system.has(SystemMode.RFID) and not self.reader.fitted
        for port, other in zip(self.ports, reversed(self.ports), strict=True):
            port.installation.blocked = exclusive and other.in_use
            port.installation.reader_missing = missing

    def _watch_server(self, now: float) -> None:
        """End charges and unlock after ten minutes without a command."""
        if not self.system.has(SystemMode.SERVER):
            return
        for port in self.ports:
            started = port.history.starts[-1][0] if port.history.starts else 0.0
            since = max(self._received_at, started)
            if now - since < SERVER_TIMEOUT:
                continue
            if self._timed_out_at.get(port.number) != since:
                self._timed_out_at[port.number] = since
                self.server_timeouts += 1
                port.abort(Result.SERVER_TIMEOUT, "server timeout")

    def _lose_power(self, *, mains: bool) -> None:
        now = self.now()
        restart = bool(self.system.restart_after_power)
        for port in self.ports:
            port.step(now)
            port.power_off(now, restart=restart, mains=mains)
        self.powered = False
        self._rest = None
        self._bits, self._keys = 0, {}
        self.frames.reset()

    def _boot(self) -> None:
        now = self.now()
        self.powered = True
        self.restarted = True
        self.restarts += 1
        self._received_at = now
        if not self.clock_survives:
            self._clock = (now, POWER_UP_CLOCK)
        self.initialise()
        self.on_power(True)  # noqa: FBT003 - a callback

    def _reset(self) -> None:
        if not self.powered:
            return
        self._lose_power(mains=False)
        self.on_power(False)  # noqa: FBT003 - a callback
        self._boot()
