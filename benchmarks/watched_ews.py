"""An EWS-Box, on RS-232 and dialling, and what a witness compares of its ports."""

from collections.abc import Mapping
from datetime import datetime
from typing import ClassVar, Final, cast, override

from custom_components.evse_bus.evse.charger import Charger
from custom_components.evse_bus.evse.ews import (
    PROTOCOL,
    EwsPort,
    EwsPortConfig,
    Listener,
)
from custom_components.evse_bus.evse.readings import ConnectorReading
from tests.virtual import EwsBox, VirtualBus
from tests.virtual.ews_dialler import EwsDialler
from tests.virtual.ews_driver import Driver
from tests.virtual.ews_status import PROXIMITY, pilot_volts, power

from .watched import LIMIT, NO_FAULTS, TICK, Scene, WatchedBox, orders, visiting_car
from .witness import Values

RESULTS: Final = {
    1: "stopped",
    3: "pilot_lost",
    4: "cable_lost",
    5: "rcd",
    6: "meter",
    7: "server_timeout",
    8: "ventilation",
    9: "pilot_unstable",
}
"""By the manual's table of `rc`."""
RUNNING: Final = frozenset({0x40, 0x41, 0x42, 0x43})
WAITING: Final = 0x30
HOST: Final = "127.0.0.1"
_SILENCE: Final = 30.0
"""After so long without a command the box hangs up, s."""


class WatchedEwsPort(WatchedBox[EwsBox]):
    """One port of a box."""

    # `rs` is read every 10 s.
    windows: ClassVar = {"server connected": 45.0, "ventilating": 45.0, "faults": 30.0}
    tolerances: ClassVar = {
        f"{port}.{name}": tolerance
        for port in (1, 2)
        for name, tolerance in (
            ("power", 0.6),
            ("energy", 1.0),
            ("session energy", 1.0),
            ("session time", 1.0),
            ("last energy", 1.0),
            ("last time", 1.0),
            ("proximity", 0.006),
        )
    }

    def __init__(self, device: EwsBox, charger: Charger) -> None:
        """Begin without a missed keep-alive."""
        super().__init__(device, charger)
        self.port = device.ports[charger.config.address - 1]
        self._silent = False
        self._missed = 0

    @override
    def truth(self) -> Values:
        box, port, session = self.device, self.port, self.port.session
        silent = box.silent_for >= _SILENCE
        self._missed += silent and not self._silent and not self.disturbed
        self._silent = silent
        low, high = pilot_volts(port)
        cable = (port.cable or 0) if port.cable_in else 0
        number = port.number
        return {
            "info.serial": box.serial,
            "info.firmware": box.firmware.rstrip(b"\x00").decode(),
            "info.card_reader": "MCR6241-100",
            "info.website": "Web 1.0",
            "connectors": (number,),
            "allowed": self._allowed(),
            "offered": 0 if port.server_paused else port.offered,
            "maximum": box.jumper,
            "faults": NO_FAULTS,
            "server connected": box.server_connected,
            "ventilating": False,
            f"{number}.state": f"0x{port.status:02X}",
            f"{number}.plugged": port.status not in (0x00, 0xF0),
            f"{number}.charging": port.status in (0x40, 0x41),
            f"{number}.power": power(port),
            f"{number}.energy": session.total_wh,
            f"{number}.generation": 0,
            f"{number}.session energy": session.wh,
            f"{number}.session time": session.seconds,
            f"{number}.last energy": session.last_wh,
            f"{number}.last time": session.last_seconds,
            f"{number}.result": RESULTS.get(session.result),
            f"{number}.last end": _when(session.last_end),
            f"{number}.cable": cable,
            f"{number}.locked": port.locked,
            f"{number}.contactor": port.contactor,
            f"{number}.optimised": port.optimised,
            f"{number}.requested": port.start_mode == 1 and port.status == WAITING,
            f"{number}.rcd": port.rcd_tripped,
            f"{number}.ventilation": False,
            f"{number}.pilot low": low,
            f"{number}.pilot high": high,
            f"{number}.proximity": PROXIMITY.get(cable or None, PROXIMITY[None]),
        }

    def _allowed(self) -> bool | None:
        if self.port.server_paused:
            return False
        if self.port.status in RUNNING:
            return True
        return self.port.start_mode == 2 if self.port.status == WAITING else None  # noqa: PLR2004 - released

    @override
    def shown(self) -> Values:
        values = dict(super().shown())
        reading = self.charger.reading
        if reading is not None:
            values["server connected"] = reading.server_connected
            values["ventilating"] = reading.ventilating
        return values

    @override
    def connector(self, reading: ConnectorReading) -> dict[str, object]:
        result = reading.last_result
        return {
            "state": reading.raw_state,
            "plugged": reading.plugged,
            "charging": reading.charging,
            "power": reading.power,
            "energy": reading.energy,
            "generation": reading.meter_generation,
            "session energy": reading.session_energy,
            "session time": reading.session_time,
            "last energy": reading.last_session_energy,
            "last time": reading.last_session_time,
            "result": None if result is None else str(result),
            "last end": reading.last_end,
            "cable": reading.cable_current,
            "locked": reading.locked,
            "contactor": reading.contactor,
            "optimised": reading.optimised,
            "requested": reading.start_requested,
            "rcd": reading.rcd_tripped,
            "ventilation": reading.ventilation_requested,
            "pilot low": reading.pilot_low,
            "pilot high": reading.pilot_high,
            "proximity": reading.proximity_voltage,
        }

    @override
    def meters(self) -> Mapping[int, float]:
        return {self.port.number: self.port.session.total_wh}

    @override
    def offered(self) -> float:
        return float(self.port.offered) if self.port.contactor else 0.0

    @override
    def missed(self) -> int:
        """Return how often it had no command for 30 s."""
        return self._missed


def _when(fields: tuple[int, ...]) -> datetime | None:
    return datetime(*fields) if fields[0] else None  # noqa: DTZ001 - of the box, without a zone


class EwsScene(Scene):
    """One box with two ports, whose drivers press start; on RS-232."""

    def __init__(self, seed: int) -> None:
        """Describe it."""
        super().__init__()
        self.seed = seed

    def make_box(self) -> EwsBox:
        """Make the box, its cars and drivers."""
        cars = tuple(visiting_car(self.seed * 10 + at, phases=at) for at in (1, 3))
        box = EwsBox(serial="000012345678", cars=cars)
        box.drivers = [
            Driver(port, seed=self.seed * 10 + port.number) for port in box.ports
        ]
        return box

    @override
    async def make(self) -> None:
        box = self.make_box()
        self.virtual = VirtualBus.in_loop(box, seed=self.seed, ring=100, tick=TICK)
        self.virtual.start()
        self.bus = PROTOCOL.bus(self.virtual.url)
        self.add_ports(box)

    def add_ports(self, box: EwsBox) -> None:
        """Put both ports on the bus of the library."""
        for port in box.ports:
            config = EwsPortConfig(
                key=f"{box.name}-{port.number}",
                name=f"{box.name}-{port.number}",
                address=port.number,
                serial=box.serial,
                installation_limit=LIMIT,
            )
            charger = EwsPort(config, orders())
            self.bus.add(charger)
            self.boxes.append(WatchedEwsPort(box, charger))


class EwsNetworkScene(EwsScene):
    """The same box, which dials."""

    dials = True
    checks_bytes = True
    listener: Listener

    @override
    async def make(self) -> None:
        self.listener = Listener(HOST, 0)
        await self.listener.start()
        box = self.make_box()
        self.bus = self.listener.register(box.serial)
        dialler = EwsDialler(
            box,
            HOST,
            self.listener.port,
            source_ports=0,
            own_thread=False,
            seed=self.seed,
            ring=100,
            tick=TICK,
        )
        self.virtual = cast("VirtualBus", dialler.start())
        self.add_ports(box)

    @override
    async def __aexit__(self, *error: object) -> None:
        await super().__aexit__(*error)
        await self.listener.stop()
